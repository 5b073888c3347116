"""LidarTable: the rows of every shape, at every distance and rotation (Sec. IV-B)."""

from __future__ import annotations

import json
import math
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, field_validator

from nics_drl_bridge.config import Schema, no_device
from nics_drl_bridge.errors import ModelError
from nics_drl_bridge.files import sha256
from nics_drl_bridge.lidar.baked_kernels import (
    ABOUT,
    CELLS_PER_PART,
    CORNERS,
    CORNERS_PER_PART,
    FIRST_CELL,
    HULL_END,
    PARTS_PER_ROTATION,
    PER_METRE,
    ROTATIONS,
    ROUND_RADIUS,
)
from nics_drl_bridge.lidar.block_kernels import BLOCK
from nics_drl_bridge.lidar.sensor_models import SENSOR_MODELS, SensorModel, intensity_of
from nics_drl_bridge.lidar.shapes import SHAPES, Circle, Outlines, Shape
from nics_drl_bridge.lidar.spec import LidarSpec
from nics_drl_bridge.npz import npz_bytes, npz_mapped, read_file

FORMAT = "nics_drl_bridge/lidar_table/3"
POINT_ANGLE = 0.01
"""By default the points of a row are no farther apart, as far as `MOST_PHASES` go [rad]."""
MOST_PHASES = 8
MOST_WIDE = 0xFFFF
"""So many beams one row can have."""


class Density(Schema):
    """How finely a table is sampled.

    Attributes:
        distances: grid distances, from the shape's own radius to out of range.
        rotations: grid rotations in a full turn; a shape that looks the same after a part of a
            turn is baked for that part only.
        phases: points per beam, 1, 2, 4 or 8; see `for_beams`.
    """

    distances: int = Field(default=100, ge=3, le=10_000)
    rotations: int = Field(default=240, ge=1, le=100_000)
    phases: int = 1

    @classmethod
    def for_beams(cls, beam_angle: float) -> Density:
        """The default for beams so far apart [rad]: few beams need several points each."""
        wanted = math.ceil(math.log2(max(beam_angle / POINT_ANGLE, 1.0)))
        return cls(phases=min(2**wanted, MOST_PHASES))

    @field_validator("phases")
    @classmethod
    def _power_of_two(cls, phases: int) -> int:
        if phases not in (1, 2, 4, 8):
            raise ValueError("phases must be 1, 2, 4 or 8")
        return phases


def padding(beam_angle: float) -> int:
    """How many numbers one look-up can read from where a row begins: half a turn, and a block.

    A shape that the lidar is outside of covers less.
    """
    return math.ceil(math.pi / beam_angle) + 1 + BLOCK


@dataclass(frozen=True)
class LidarTable:
    """The ranges that shapes give, as rows over angle, for a grid of distance and rotation.

    A cell is one grid distance at one grid rotation. Its row holds only the directions that the
    shape can cover until the next cells, as many times as there are phases: the points of one
    phase stand one beam apart, so that the beams of a scan find theirs one after the other.

    Attributes:
        shapes: H of them.
        density: of the grid.
        beam_angle: angle between the beams that it was baked for [rad].
        grid: (H, 3) greatest grid distance [m], grid rotations in the part of a turn after which
            the shape looks the same, first cell.
        start: (cells,) int32 where each row begins in `rows`.
        cell: (cells, 6) int16 first beam of the row from the bearing, its width in beams (without
            a sign, see `widths`); a corner
            of the hull that can be the right edge within the cell, and the same corner, or the one
            other that can be it, or minus the stride with which to look around when there are
            more; the same two for the left edge.
        rows: (R,) float32 ranges [m]; longer than its rows by what one look-up can read.
        sensor_model: named models that were baked in.
        reflectance: (R,) float32 of the surface at each point of `rows`, reflectivity times a power
            of the cosine of the angle of incidence; only where a model yields intensities.
    """

    shapes: tuple[Shape, ...]
    density: Density
    beam_angle: float
    grid: NDArray[np.float64]
    start: NDArray[np.int32]
    cell: NDArray[np.int16]
    rows: NDArray[np.float32]
    sensor_model: tuple[SensorModel, ...] = ()
    reflectance: NDArray[np.float32] | None = None

    @classmethod
    def without_rows(cls, spec: LidarSpec, shapes: Sequence[Shape]) -> LidarTable:
        """Shapes that are only scanned exactly: for a lidar of any beams, and at no cost."""
        shapes = tuple(dict.fromkeys(shapes))
        grid = np.ones((len(shapes), 3))
        grid[:, 0] = [spec.range_max + 2.0 * shape.radius for shape in shapes]
        return cls(
            shapes,
            Density(),
            spec.angle_increment,
            grid,
            np.zeros(0, np.int32),
            np.zeros((0, 6), np.int16),
            np.zeros(0, np.float32),
            spec.sensor_model,
        )

    @property
    def has_rows(self) -> bool:
        """Whether its shapes can be looked up."""
        return len(self.cell) > 0 or not self.shapes

    @property
    def widths(self) -> NDArray[np.int64]:
        """(cells,) of the rows, in beams."""
        return self.cell[:, 1].astype(np.int64) & MOST_WIDE

    @cached_property
    def outlines(self) -> Outlines:
        """The shapes as arrays."""
        return Outlines.of(self.shapes)

    @cached_property
    def lookup(self) -> tuple[Any, ...]:
        """What the kernels take.

        Flat (H * ABOUT,) numbers of each shape: cells per metre; rotations in a full turn, 0 for a
        circle; parts of a turn after which it looks the same per rotation; first cell; cells per
        part; the corner after the hull's last; corners per part; corners; radius of a circle [m],
        0 for others. Then the distances, the cells, the rows, log2 of the phases, and the hulls.
        """
        outlines, distances = self.outlines, self.density.distances
        parts, rotations = outlines.orders, self.grid[:, 1]
        corners = np.diff(outlines.hull) // 2
        round_ = np.array([isinstance(shape, Circle) for shape in self.shapes], bool)
        about = np.zeros((len(self.shapes), ABOUT))
        about[:, PER_METRE] = (distances - 1) / (self.grid[:, 0] - outlines.radii)
        about[:, ROTATIONS] = np.where(round_, 0.0, rotations * parts)
        about[:, PARTS_PER_ROTATION] = 1.0 / rotations
        about[:, FIRST_CELL], about[:, CELLS_PER_PART] = self.grid[:, 2], rotations * distances
        about[:, HULL_END] = outlines.hull[:-1] + corners
        about[:, CORNERS_PER_PART], about[:, CORNERS] = corners // parts, corners
        about[:, ROUND_RADIUS] = np.where(round_, outlines.radii, 0.0)
        missing = max(2 * BLOCK - padding(self.beam_angle), 0)  # two blocks are read at least
        rows = np.append(self.rows, np.zeros(missing, np.float32)) if missing else self.rows
        shift = self.density.phases.bit_length() - 1
        return about.ravel(), distances, self._packed, rows, shift, outlines.hulls.ravel()

    @property
    def _packed(self) -> NDArray[np.int32]:
        """(cells * 4,) `start` and `cell`, two numbers in one, so that one cache line holds both.

        Where the row begins; its first beam and its width; the other and the first corner of the
        right edge; those of the left one.
        """
        cell = self.cell.astype(np.int32)
        pairs = (cell[:, [0, 3, 5]] << 16) | (cell[:, [1, 2, 4]] & MOST_WIDE)
        return np.column_stack([self.start, pairs]).ravel()

    @property
    def memory(self) -> int:
        """Memory of the table [bytes]."""
        return sum(array.nbytes for array in self._arrays.values())

    @property
    def _arrays(self) -> dict[str, NDArray[Any]]:
        arrays: dict[str, NDArray[Any]] = {
            "grid": self.grid,
            "start": self.start,
            "cell": self.cell,
            "rows": self.rows,
        }
        return arrays if self.reflectance is None else arrays | {"reflectance": self.reflectance}

    def cells_of_shapes(self) -> list[tuple[int, int]]:
        """(H,) first cell of each shape, and the one after its last."""
        counts = (self.grid[:, 1] * self.density.distances).astype(np.int64)
        ends = np.cumsum(counts)
        return list(zip((ends - counts).tolist(), ends.tolist(), strict=True))

    def dump(self) -> bytes:
        """The table as the content of an `.npz` file that can be mapped."""
        about = np.frombuffer(self._about().encode(), np.uint8)
        return npz_bytes({"about": about, **self._arrays}, packed=False)

    def _about(self) -> str:
        about: dict[str, Any] = {
            "format": FORMAT,
            "shapes": SHAPES.dump_python(self.shapes, mode="json", exclude_none=True),
            "density": self.density.model_dump(),
            "beam_angle": self.beam_angle,
        }
        if self.sensor_model:
            about["sensor_model"] = SENSOR_MODELS.dump_python(self.sensor_model, mode="json")
        return json.dumps(about | {"crc32": self._crc32(json.dumps(about))})

    def _crc32(self, about: str) -> int:
        """Tells whether anything of the table was damaged."""
        crc = zlib.crc32(about.encode())
        for array in self._arrays.values():
            crc = zlib.crc32(np.ascontiguousarray(array).data, crc)
        return crc

    @classmethod
    def load(cls, path: str | Path, checksum: str | None = None) -> LidarTable:
        """Maps a table that `dump` made into memory; processes that do so share it.

        Args:
            path: of the file.
            checksum: SHA-256 that the file must have, in hexadecimal.

        Raises:
            ModelError: the file can't be read, is another one, damaged, or no table.
        """
        path = Path(path)
        try:
            no_device(path).open("rb").close()
            if checksum is not None and sha256(read_file(path)) != checksum:
                raise ModelError(f"{path}: does not match its checksum; generate the model anew.")
            arrays = npz_mapped(path)
            about = json.loads(arrays.pop("about").tobytes())
            if about["format"] != FORMAT:
                raise ValueError(f"its format is {about['format']!r}, not {FORMAT!r}")
            shapes = SHAPES.validate_python(about["shapes"])
            density = Density.model_validate(about["density"])
            model = SENSOR_MODELS.validate_python(about.get("sensor_model", ()))
            angle = float(about["beam_angle"])
            table = cls(shapes, density, angle, **arrays, sensor_model=model)
            table._check()
            if table._about() != json.dumps(about):
                raise ValueError("its numbers were damaged")
        except OSError as error:
            raise ModelError(
                f"{path}: can't be read ({error.strerror}); generate the model anew."
            ) from None
        except (
            ArithmeticError, AttributeError, IndexError, KeyError, RecursionError, TypeError,
            ValueError,
        ) as error:  # fmt: skip
            reason = " ".join(str(error).split())
            raise ModelError(
                f"{path}: is no lidar table ({reason}); generate the model anew."
            ) from None
        return table

    def _check(self) -> None:
        """Raises ValueError when the kernels would read beyond an array."""
        arrays: tuple[NDArray[Any], ...] = (self.grid, self.start, self.cell, self.rows)
        if [array.dtype for array in arrays] != [np.float64, np.int32, np.int16, np.float32]:
            raise ValueError("an array has another type of number")
        if self.grid.shape != (len(self.shapes), 3) or not np.isfinite(self.grid).all():
            raise ValueError("the grid does not fit the shapes")
        counts = self.grid[:, 1] * self.density.distances
        cells = int(counts.sum())
        if (counts < 1).any() or not np.array_equal(self.grid[:, 2], np.cumsum(counts) - counts):
            raise ValueError("the grid does not fit the density")
        if (self.grid[:, 0] <= self.outlines.radii).any() or not 0.0 < self.beam_angle < 7.0:
            raise ValueError("the grid has no extent")
        if self.start.shape != (cells,) or self.cell.shape != (cells, 6) or self.rows.ndim != 1:
            raise ValueError("the number of cells does not fit the grid")
        widths = self.widths * self.density.phases
        ends = self.start + widths
        last = len(self.rows) - padding(self.beam_angle)
        if cells and (self.start.min() < 0 or widths.min() < 1 or ends.max() > last):
            raise ValueError("a row lies outside of the table")
        self._check_corners(counts.astype(np.int64))
        self._check_reflectance()

    def _check_reflectance(self) -> None:
        if (self.reflectance is None) != (intensity_of(self.sensor_model) is None):
            raise ValueError("its reflectance does not belong to its sensor model")
        if self.reflectance is not None and (
            self.reflectance.shape != self.rows.shape or self.reflectance.dtype != np.float32
        ):
            raise ValueError("its reflectance does not fit its rows")

    def _check_corners(self, counts: NDArray[np.int64]) -> None:
        corners = np.repeat(np.diff(self.outlines.hull) // 2, counts)[:, None]
        hint, other = self.cell[:, 2::2], self.cell[:, 3::2]
        if (hint < 0).any() or (hint >= corners).any() or (np.abs(other) >= corners).any():
            raise ValueError("a cell names a corner that its shape has not")
