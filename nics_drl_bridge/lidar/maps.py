"""Static maps of square cells, also from the files of Nav2's map_server."""

import io
import struct
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from pathlib import Path
from typing import Literal

import numpy as np
import scipy  # its parts load slowly, when used
from numpy.typing import ArrayLike, NDArray
from PIL import Image
from pydantic import Field, model_validator

from nics_drl_bridge.config import Heading, Schema, dump_yaml, find_config, load_yaml
from nics_drl_bridge.errors import ConfigError, suggest
from nics_drl_bridge.files import write_bytes, write_text
from nics_drl_bridge.geometry import rotate
from nics_drl_bridge.lidar import map_kernels
from nics_drl_bridge.lidar.arrays import AnyArray, Array, Integers, Mask, Singles
from nics_drl_bridge.lidar.shapes import Coordinate

FREE = 0
OCCUPIED = 100
UNKNOWN = -1
# for the kernels
NO_MAP = map_kernels.GridArrays(np.zeros((0, 0), np.uint32), np.zeros(0))


@dataclass(frozen=True, eq=False)
class GridMap:
    """A static map. Cells are solid squares or free; everything outside is free.

    Cells are as in `nav_msgs/OccupancyGrid`: 0 free, 100 occupied, -1 unknown, else probability of
    occupancy [%]. Row 0 has the lowest y of the map and is the last row of its image. The origin is
    x [m], y [m], heading [rad] of the outer corner of cell (0, 0) in the world.
    """

    cells: NDArray[np.int8]  # (rows, columns)
    resolution: float  # side of a cell [m]
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    # True: cells that are neither free nor occupied stop a beam
    unknown_stops: bool = False

    @cached_property
    def free(self) -> Mask:
        """(rows, columns) cells that are known to be free."""
        return np.asarray(self.cells == FREE)

    @cached_property
    def blocked(self) -> Mask:
        """(rows, columns) cells that stop a beam."""
        if self.unknown_stops:
            return ~self.free
        return np.asarray(self.cells >= OCCUPIED)

    @cached_property
    def arrays(self) -> map_kernels.GridArrays:
        """The map for the kernels; baked on first use."""
        x, y, heading = self.origin
        frame = np.array([x, y, np.cos(heading), np.sin(heading), self.resolution])
        return map_kernels.GridArrays(
            map_kernels.find_free_squares(self.blocked), frame
        )

    def world_to_cell(self, points: ArrayLike) -> Integers:
        """Return row and column (..., 2) of points (..., 2) x, y [m]; may be outside the map."""
        place = rotate(
            np.asarray(points, np.float64) - self.origin[:2], -self.origin[2]
        )
        return np.floor(place[..., ::-1] / self.resolution).astype(np.int64)

    def cell_to_world(self, cells: ArrayLike) -> Array:
        """Return the centres (..., 2) x, y [m] of cells (..., 2) row, column."""
        place = (np.asarray(cells, np.float64)[..., ::-1] + 0.5) * self.resolution
        return np.asarray(rotate(place, self.origin[2]) + self.origin[:2])

    @cached_property
    def distance_field(self) -> Singles:
        """(rows, columns) distance from each cell's centre to the nearest blocked square [m].

        Exact, 0 in blocked cells and `inf` if nothing is blocked. A disc around the centre touches
        nothing if its radius is less. Off the centres the distance differs by at most the offset.
        """
        if not self.blocked.any():
            return np.full(self.cells.shape, np.inf, np.float32)
        rows, columns = self.cells.shape
        # The nearest lattice points take far less memory than distances at every lattice point.
        nearest = scipy.ndimage.distance_transform_edt(
            self._find_clear_points(), return_distances=False, return_indices=True
        )
        distances = np.empty((rows, columns), np.float32)
        own_columns = 2.0 * np.arange(columns) + 1.0
        for row in range(rows):
            dy = nearest[0, 2 * row + 1, 1::2] - (2.0 * row + 1.0)
            dx = nearest[1, 2 * row + 1, 1::2] - own_columns
            distances[row] = np.sqrt(dy * dy + dx * dx) * (self.resolution / 2.0)
        return distances

    def _find_clear_points(self) -> Mask:
        """(2 rows + 1, 2 columns + 1) points of a lattice that are in no blocked square.

        At half the cell size, centres and corners are points of one lattice, and the point of a
        square nearest to a lattice point is one too.
        """
        rows, columns = self.cells.shape
        clear = np.ones((2 * rows + 1, 2 * columns + 1), np.bool_)
        at, to = np.nonzero(self.blocked)
        for down, right in product(range(3), repeat=2):
            clear[2 * at + down, 2 * to + right] = False
        return clear


MAX_CELLS = 64_000_000
MAX_BYTES = 4 * MAX_CELLS + 2**20  # larger image files are not opened
FORMATS = {"PPM": (".pgm", ".pnm", ".ppm", ".pbm"), "PNG": (".png",), "BMP": (".bmp",)}
PIXELS_AT_ONCE = 2**20  # pixels whose brightness is computed at once
BRIGHTEST_16 = 65535.0  # of a pixel with 16 bits
# weights of R, G, B (Rec. 709), as in ImageMagick for Nav2
LUMA = np.array([0.212656, 0.715158, 0.072186])


class MapFile(Schema):
    """Keys of a map's YAML file, as in Nav2's map_server.

    Mode `trinary`: pixels are free, occupied, else unknown. `scale`: pixels between the thresholds
    become 0 to 100 %. `raw`: pixels from 0 to 100 are the percentage itself.
    """

    # path, absolute or relative to the folder of the YAML file
    image: str = Field(min_length=1)
    resolution: float = Field(ge=1e-4, le=100.0)  # side of a pixel [m]
    origin: tuple[
        Coordinate, Coordinate, Heading
    ]  # pose of the image's lower left corner
    negate: bool  # 0 or 1; True if white is occupied, rather than black
    # pixels at least this dark are occupied
    occupied_thresh: float = Field(ge=0.0, le=1.0)
    free_thresh: float = Field(ge=0.0, le=1.0)  # pixels at most this dark are free
    # how pixels become cells, see above
    mode: Literal["trinary", "scale", "raw"] = "trinary"

    @model_validator(mode="after")
    def _check_consistent(self) -> "MapFile":
        if not self.free_thresh < self.occupied_thresh:
            raise ValueError("free_thresh must be less than occupied_thresh")
        return self


def load_map(name: str | Path) -> GridMap:
    """Load a shipped map by name (`room`), or any other by the path of its YAML file.

    Cells equal those of Nav2's map_server: pixels exactly on a threshold are occupied or free,
    colours count by brightness (Rec. 709) in 256 steps, and pixels that are not opaque are unknown
    unless the mode is `raw`. Raises ConfigError if file or image is missing, invalid or too large.
    """
    path = find_config(name, "maps")
    file = load_yaml(path, MapFile)
    grey, opaque = read_image(path.parent / file.image, str(path))
    cells = _convert_brightness(file)[grey]
    if opaque is not None and file.mode != "raw":
        cells[~opaque] = UNKNOWN
    cells = np.ascontiguousarray(cells[::-1])
    return GridMap(cells, file.resolution, file.origin)


def files_of(name: str | Path) -> tuple[Path, Path]:
    """The YAML file and the image of a map, see `load_map`."""
    path = find_config(name, "maps")
    return path, path.parent / load_yaml(path, MapFile).image


def map_files(grid: GridMap, path: Path) -> None:
    """Write a map as files of Nav2's map_server: YAML, and a PGM of the same name next to it.

    `load_map` gives the same cells. They are trinary, or raw if some are neither free nor occupied.
    """
    image = path.with_suffix(".pgm")
    mode = "trinary"
    if np.isin(grid.cells, (FREE, OCCUPIED, UNKNOWN)).all():
        pixels = np.select([grid.cells == FREE, grid.cells == OCCUPIED], [254, 0], 205)
    else:
        mode = "raw"
        pixels = np.where(grid.cells == UNKNOWN, 255, grid.cells)
    content = io.BytesIO()
    Image.fromarray(pixels.astype(np.uint8)[::-1]).save(content, "PPM")
    write_bytes(image, content.getvalue())
    about = {
        "image": image.name,
        "resolution": float(grid.resolution),
        "origin": list(grid.origin),
        "negate": 0,
        "occupied_thresh": 0.65,
        "free_thresh": 0.196,
        "mode": mode,
    }
    write_text(path, dump_yaml(about))


def _convert_brightness(file: MapFile) -> NDArray[np.int8]:
    """(256,) the cell for each brightness of a pixel."""
    grey = np.arange(256)
    if file.mode == "raw":
        return np.where(grey <= OCCUPIED, grey, UNKNOWN).astype(np.int8)
    # In float32, as in Nav2: 0.6 and the pixel 102 are equal there.
    bright = grey.astype(np.float32) / np.float32(255.0)
    dark = bright
    if not file.negate:
        dark = np.float32(1.0) - bright
    low = np.float32(file.free_thresh)
    high = np.float32(file.occupied_thresh)
    cells = np.full(grey.shape, UNKNOWN, np.int8)
    if file.mode == "scale":
        between = (dark - low) / (high - low) * np.float32(100.0)
        cells = np.floor(np.clip(between, 0.0, 100.0) + np.float32(0.5)).astype(np.int8)
    cells[dark >= high] = OCCUPIED
    cells[dark <= low] = FREE
    return cells


def read_image(path: Path, source: str) -> tuple[NDArray[np.uint8], Mask | None]:
    """Read brightness (rows, columns), and opacity if any, of a PGM (8, 16 bit), PNG or BMP.

    Raises ConfigError, with the `source` that names it, if it is missing, damaged or too large.
    """
    if not path.is_file():
        endings = sum(FORMATS.values(), ())
        folder = path.parent
        images = [
            file.name
            for file in folder.glob("*")
            if file.name.lower().endswith(endings)
        ]
        if images:
            hint = suggest(path.name, images)
        else:
            hint = f"there are no images in {str(folder)!r}."
        raise ConfigError(
            f"{source}: key 'image': there is no file {str(path)!r}; {hint}"
        )
    try:
        with warnings.catch_warnings():
            # MAX_CELLS is less
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            if path.stat().st_size > MAX_BYTES:
                raise Image.DecompressionBombError
            with Image.open(path, formats=tuple(FORMATS)) as image:
                if image.width * image.height > MAX_CELLS:
                    raise Image.DecompressionBombError
                return _read_pixels(image)
    except Image.DecompressionBombError:
        raise ConfigError(
            f"{path}: has too many pixels, a map may have {MAX_CELLS}; cut or coarsen it."
        ) from None
    except (
        EOFError,
        IndexError,
        OSError,
        OverflowError,
        SyntaxError,
        ValueError,
        struct.error,
    ):
        raise ConfigError(
            f"{path}: is no whole PGM, PNG or BMP image; save the map again in one of them."
        ) from None


def _read_pixels(image: Image.Image) -> tuple[NDArray[np.uint8], Mask | None]:
    """Brightness and opacity, computed in blocks of rows: intermediate numbers are far larger."""
    shape = (image.height, image.width)
    grey = np.empty(shape, np.uint8)
    sixteen_bits = image.mode in ("I", "F") or image.mode.startswith("I;")
    transparent = image.has_transparency_data and not sixteen_bits
    opaque = None
    if transparent:
        opaque = np.empty(shape, np.bool_)
    rows = max(1, PIXELS_AT_ONCE // max(image.width, 1))
    for first in range(0, image.height, rows):
        block = slice(first, first + rows)
        part = image.crop((0, first, image.width, min(first + rows, image.height)))
        if sixteen_bits:
            bright = np.clip(np.asarray(part).astype(np.float64), 0.0, BRIGHTEST_16)
            grey[block] = np.floor(bright / 257.0 + 0.5)
        elif image.mode in ("1", "L") and not transparent:
            grey[block] = np.asarray(part.convert("L"))
        else:
            pixels = np.asarray(part.convert("RGBA"))
            grey[block] = np.floor(pixels[..., :3] @ LUMA + 0.5)
            if opaque is not None:
                opaque[block] = pixels[..., 3] == 255
    return grey, opaque


def stack_fixtures(
    walls: Sequence[Array],
    grids: Sequence[GridMap | None],
    member: Integers,
) -> map_kernels.Fixtures:
    """Stack the fixtures of P worlds: walls (W, 4) and the map of each."""
    maps = [NO_MAP if grid is None else grid.arrays for grid in grids]
    squares, places = joined([grid_arrays.squares for grid_arrays in maps])
    frames = np.zeros((len(maps), 5))
    for frame, grid_arrays in zip(frames, maps, strict=True):
        frame[: len(grid_arrays.frame)] = grid_arrays.frame
    first = np.cumsum([0, *map(len, walls)])
    return map_kernels.Fixtures(
        member, np.concatenate(walls), first, squares, places, frames
    )


def joined(cells: Sequence[AnyArray]) -> tuple[AnyArray, Integers]:
    """Cells (rows, columns) one after the other, and first cell, rows, columns of each (P, 3).

    An array that occurs again, as the map of several worlds, is stored once.
    """
    once = {id(array): array for array in cells}
    starts = np.cumsum([0, *(array.size for array in once.values())]).tolist()
    first = dict(zip(once, starts, strict=False))
    shapes = [(first[id(array)], *array.shape) for array in cells]
    flat = [array.reshape(-1) for array in once.values()]
    places = np.array(shapes, np.int64)
    if len(flat) == 1:  # no copy
        return flat[0], places
    return np.concatenate(flat), places
