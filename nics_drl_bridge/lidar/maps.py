"""Static maps from files, as Nav2's map_server reads them."""

from __future__ import annotations

import struct
import warnings
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from pydantic import Field, field_validator, model_validator

from nics_drl_bridge.config import Schema, find_config, load_yaml
from nics_drl_bridge.errors import ConfigError, nearest
from nics_drl_bridge.lidar.maps_grid import FREE, NO_MAP, OCCUPIED, UNKNOWN, GridMap
from nics_drl_bridge.lidar.shapes import Coordinate, Heading

__all__ = ["FREE", "NO_MAP", "OCCUPIED", "UNKNOWN", "GridMap", "MapFile", "load_map"]

MAX_CELLS = 64_000_000
MAX_BYTES = 4 * MAX_CELLS + 2**20
"""Of an image; what is longer is none, and not opened."""
FORMATS = {"PPM": (".pgm", ".pnm", ".ppm", ".pbm"), "PNG": (".png",), "BMP": (".bmp",)}
LUMA = np.array([0.212656, 0.715158, 0.072186])
"""Brightness of red, green, blue (Rec. 709), as ImageMagick weighs them for Nav2."""


class MapFile(Schema):
    """The keys of a map's YAML file, those of Nav2's map_server.

    Attributes:
        image: its path, absolute or from the folder of the YAML file.
        resolution: side of a pixel [m].
        origin: x [m], y [m], heading [rad] of the lower left corner of the image in the world.
        negate: 0 or 1; whether white is occupied, rather than black.
        occupied_thresh: pixels at least this dark, of 1, are occupied.
        free_thresh: pixels at most this dark are free.
        mode: `trinary`: free, occupied, else unknown. `scale`: what lies between the thresholds
            becomes 0 to 100 %. `raw`: pixels of 0 to 100 are the percentage itself.
    """

    image: str = Field(min_length=1)
    resolution: float = Field(ge=1e-4, le=100.0)
    origin: tuple[Coordinate, Coordinate, Heading]
    negate: bool
    occupied_thresh: float = Field(ge=0.0, le=1.0)
    free_thresh: float = Field(ge=0.0, le=1.0)
    mode: Literal["trinary", "scale", "raw"] = "trinary"

    @field_validator("mode", mode="before")
    @classmethod
    def _known(cls, mode: object) -> object:
        known = ("trinary", "scale", "raw")
        if isinstance(mode, str) and mode not in known:
            raise ValueError(f"unknown mode; {nearest(mode, known)}")
        return mode

    @model_validator(mode="after")
    def _consistent(self) -> MapFile:
        if not self.free_thresh < self.occupied_thresh:
            raise ValueError("free_thresh must be less than occupied_thresh")
        return self


def load_map(
    name: str | Path, unknown_stops: bool = False, occupied_from: int = OCCUPIED
) -> GridMap:
    """Loads a shipped map by name (`room`), or any by the path of its YAML file.

    Cells come out as those of Nav2's map_server: thresholds belong to what they name, colours
    count by their brightness (Rec. 709) in 256 steps, and pixels that are not opaque are unknown
    unless the mode is `raw`. (Older releases of Nav2 average red, green, blue, and alpha into
    the darkness, and leave pixels exactly on a threshold unknown; grey maps without alpha differ in
    the latter only.)

    Args:
        name: of the map, or path.
        unknown_stops: see GridMap.
        occupied_from: see GridMap.

    Returns:
        The map.

    Raises:
        ConfigError: the YAML file or the image is missing, wrong or too large.
    """
    path = find_config(name, "maps")
    file = load_yaml(path, MapFile)
    grey, opaque = read_image(path.parent / file.image, str(path))
    cells = np.ascontiguousarray(cells_of(grey, opaque, file)[::-1])
    return GridMap(cells, file.resolution, file.origin, unknown_stops, occupied_from)


def cells_of(
    grey: NDArray[np.uint8], opaque: NDArray[np.bool_] | None, file: MapFile
) -> NDArray[np.int8]:
    """Cells of an image (rows, columns), in its own order of rows.

    Args:
        grey: brightness of each pixel.
        opaque: whether each is; None when the image has no alpha channel.
        file: thresholds and mode.
    """
    if file.mode == "raw":
        return np.where(grey <= OCCUPIED, grey, UNKNOWN).astype(np.int8)
    # In float32, as Nav2 compares: 0.6 and the pixel 102 are equal there.
    bright = grey.astype(np.float32) / np.float32(255.0)
    dark = bright if file.negate else np.float32(1.0) - bright
    low, high = np.float32(file.free_thresh), np.float32(file.occupied_thresh)
    cells = np.full(grey.shape, UNKNOWN, np.int8)
    if file.mode == "scale":
        between = (dark - low) / (high - low) * np.float32(100.0)
        cells = np.floor(np.clip(between, 0.0, 100.0) + np.float32(0.5)).astype(np.int8)
    cells[dark >= high] = OCCUPIED
    cells[dark <= low] = FREE
    if opaque is not None:
        cells[~opaque] = UNKNOWN
    return cells


def read_image(path: Path, source: str) -> tuple[NDArray[np.uint8], NDArray[np.bool_] | None]:
    """Brightness (rows, columns) of an image and, if it has an alpha channel, what is opaque.

    Args:
        path: of a PGM (binary or plain, 8 or 16 bit), PNG or BMP file.
        source: the YAML file's name, for errors.

    Raises:
        ConfigError: it is missing, not such an image, damaged or too large.
    """
    if not path.is_file():
        raise ConfigError(f"{source}: key 'image': there is no file {str(path)!r}; {_near(path)}")
    try:
        if path.stat().st_size > MAX_BYTES:
            raise ConfigError(_too_large(path, "too many"))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)  # MAX_CELLS is less
            with Image.open(path, formats=tuple(FORMATS)) as image:
                _check_size(image.size, path)
                return _pixels(image)
    except Image.DecompressionBombError:
        raise ConfigError(_too_large(path, "too many")) from None
    except (EOFError, IndexError, OSError, OverflowError, SyntaxError, ValueError, struct.error):
        raise ConfigError(
            f"{path}: is no whole PGM, PNG or BMP image; save the map anew in one of them."
        ) from None


def _near(path: Path) -> str:
    endings = tuple(ending for some in FORMATS.values() for ending in some)
    folder = path.parent
    known = [file.name for file in folder.glob("*") if file.name.lower().endswith(endings)]
    return nearest(path.name, known) if known else f"there are no images in {str(folder)!r}."


def _too_large(path: Path, cells: str) -> str:
    return f"{path}: has {cells} pixels, and a map may have {MAX_CELLS}; cut or coarsen it."


def _check_size(size: tuple[int, int], path: Path) -> None:
    if size[0] * size[1] > MAX_CELLS:
        raise ConfigError(_too_large(path, str(size[0] * size[1])))


def _pixels(image: Image.Image) -> tuple[NDArray[np.uint8], NDArray[np.bool_] | None]:
    if image.mode in ("I", "F") or image.mode.startswith("I;"):  # 16 bit, of 65535
        grey = np.asarray(image).astype(np.float64) / 257.0
        return np.floor(grey + 0.5).astype(np.uint8), None
    if image.mode in ("1", "L") and not image.has_transparency_data:
        return np.asarray(image.convert("L")), None
    pixels = np.asarray(image.convert("RGBA"))
    grey = np.floor(pixels[..., :3] @ LUMA + 0.5).astype(np.uint8)
    return grey, pixels[..., 3] == 255 if image.has_transparency_data else None
