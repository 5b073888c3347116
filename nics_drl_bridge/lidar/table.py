"""LidarTable: the baked rows of every shape, at every distance and rotation (Sec. IV-B)."""

import hashlib
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from nics_drl_bridge.config import Schema, read_text, validate
from nics_drl_bridge.errors import ModelError
from nics_drl_bridge.files import (
    MOST_BYTES,
    SUMS,
    check_sums,
    write_sums,
    write_text,
    write_whole_folder,
)
from nics_drl_bridge.lidar.arrays import (
    AnyArray,
    Array,
    Integers,
    ShortIntegers,
    Singles,
)
from nics_drl_bridge.lidar.lookup_kernels import LEAST_FUSED, TABLE_SHAPE, TableArrays
from nics_drl_bridge.lidar.shapes import Circle, Outlines, Shape
from nics_drl_bridge.lidar.spec import LidarSpec, WithoutSensorModel

FORMAT = "nics_drl_bridge/lidar_table/4"
ABOUT_FILE = "about.json"
ARRAYS = ("grid", "start", "cell", "rows")
TABLE_FILES = (ABOUT_FILE, *(f"{name}.npy" for name in ARRAYS))  # and a manifest
# maximum default angle of points in a row, as `MOST_PHASES` allows [rad]
POINT_ANGLE = 0.01
MOST_PHASES = 8
MOST_WIDE = 0xFFFF  # maximum number of beams in a row


class Density(Schema):
    """Sampling density of a table. Shapes with rotational symmetry are baked for one period."""

    # number of grid distances, from the shape's radius to out of range
    distances: int = Field(default=100, ge=3, le=10_000)
    rotations: int = Field(default=240, ge=1, le=100_000)  # in a full turn
    phases: Literal[1, 2, 4, 8] = 1  # points per beam, see `for_beams`

    @classmethod
    def for_beams(cls, beam_angle: float) -> "Density":
        """Return the default for an angle between beams [rad]; wide angles need more points."""
        wanted = math.ceil(math.log2(max(beam_angle / POINT_ANGLE, 1.0)))
        return cls.model_validate({"phases": min(2**wanted, MOST_PHASES)})


class TableAbout(WithoutSensorModel):
    """The content of `about.json`; see `LidarTable`."""

    format: str
    shapes: tuple[Shape, ...]
    density: Density
    beam_angle: float = Field(gt=0.0, lt=7.0)


def count_padding(beam_angle: float) -> int:
    """Maximum number of values that a look-up reads from a row: half a turn and a block."""
    return math.ceil(math.pi / beam_angle) + 1 + 16


@dataclass(frozen=True)
class LidarTable:
    """Ranges of shapes as rows over angle, on a grid of distances and rotations.

    A cell is one grid distance at one grid rotation. Its row contains only the
    directions that the shape can cover up to the next cells, once for each phase. The
    points of one phase are one beam apart, so that those for the beams of a scan are
    contiguous.

    The columns of a cell are the first beam of its row, relative to the bearing; its width in beams
    (unsigned, see `widths`); a corner of the hull that can be the right edge within the
    cell; the other such corner (or the same one if there is no other, or minus the
    initial stride for climbing if there are more); the same two for the left edge.
    """

    shapes: tuple[Shape, ...]  # H
    density: Density
    beam_angle: float  # between the beams that it was baked for [rad]
    # (H, 3) maximum distance [m], rotations in a period, first cell
    grid: Array
    start: ShortIntegers  # (cells,) start of each row in `rows`
    cell: NDArray[np.int16]  # (cells, 6) see above
    rows: Singles  # (R,) ranges [m], padded by what one look-up can read

    @classmethod
    def without_rows(cls, spec: LidarSpec, shapes: Sequence[Shape]) -> "LidarTable":
        """Create a table of shapes for exact scans only, without limits or baking."""
        shapes = tuple(dict.fromkeys(shapes))
        grid = np.ones((len(shapes), 3))
        grid[:, 0] = [spec.range_max + 2.0 * shape.radius for shape in shapes]
        none = (
            np.zeros(0, np.int32),
            np.zeros((0, 6), np.int16),
            np.zeros(0, np.float32),
        )
        return cls(shapes, Density(), spec.angle_increment, grid, *none)

    @property
    def has_rows(self) -> bool:
        """True if the shapes can be looked up."""
        return len(self.cell) > 0 or not self.shapes

    @property
    def widths(self) -> Integers:
        """(cells,) widths of the rows, in beams."""
        return self.cell[:, 1].astype(np.int64) & MOST_WIDE

    @cached_property
    def outlines(self) -> Outlines:
        """The shapes as arrays."""
        return Outlines.of(self.shapes)

    @cached_property
    def arrays(self) -> TableArrays:
        """The table for the kernels."""
        outlines = self.outlines
        distances = self.density.distances
        rotations = self.grid[:, 1]
        corners = np.diff(outlines.hull) // 2
        circles = np.array([isinstance(shape, Circle) for shape in self.shapes], bool)
        shapes = np.zeros(len(self.shapes), TABLE_SHAPE)
        shapes["distances_per_metre"] = (distances - 1) / (
            self.grid[:, 0] - outlines.radii
        )
        shapes["rotations"] = np.where(circles, 0.0, rotations * outlines.orders)
        shapes["periods_per_grid_rotation"] = 1.0 / rotations
        shapes["first_cell"] = self.grid[:, 2]
        shapes["cells_per_period"] = rotations * distances
        shapes["second_hull"] = outlines.hull[:-1] + corners
        shapes["corners_per_period"] = corners // outlines.orders
        shapes["corners"] = corners
        shapes["round_radius"] = np.where(circles, outlines.radii, 0.0)
        cell = self.cell.astype(np.int32)
        # Extent of the row, corners on the right and on the left: see `TableArrays.cells`.
        pairs = (cell[:, [0, 3, 5]] << 16) | (cell[:, [1, 2, 4]] & MOST_WIDE)
        cells = np.column_stack([self.start, pairs])
        rows = self.rows
        missing = LEAST_FUSED - count_padding(self.beam_angle)
        if missing > 0:
            rows = np.append(rows, np.zeros(missing, np.float32))
        return TableArrays(
            shapes,
            distances,
            cells,
            rows,
            self.density.phases.bit_length() - 1,
            outlines.hulls,
        )

    @property
    def memory(self) -> int:
        """Memory of the table [bytes]."""
        return sum(array.nbytes for array in self._arrays.values())

    @property
    def _arrays(self) -> dict[str, AnyArray]:
        return {name: np.ascontiguousarray(getattr(self, name)) for name in ARRAYS}

    @property
    def _about(self) -> str:
        about = TableAbout(
            format=FORMAT,
            shapes=self.shapes,
            density=self.density,
            beam_angle=self.beam_angle,
        )
        return about.model_dump_json(indent=1, exclude_none=True) + "\n"

    @cached_property
    def fingerprint(self) -> str:
        """The SHA-256 of everything that `save` writes, in hexadecimal."""
        digest = hashlib.sha256(self._about.encode())
        for array in self._arrays.values():
            digest.update(array.data)
        return digest.hexdigest()

    def save(self, folder: str | Path) -> None:
        """Write the table as a folder, atomically; ConfigError if the folder is something else."""
        names = {*TABLE_FILES, SUMS}
        with write_whole_folder(folder, ABOUT_FILE, names.__contains__) as temporary:
            write_text(temporary / ABOUT_FILE, self._about)
            for name, array in self._arrays.items():
                np.save(temporary / f"{name}.npy", array, allow_pickle=False)
            write_sums(temporary)

    @classmethod
    def load(cls, folder: str | Path, checked: bool = False) -> "LidarTable":
        """Memory-map a table that `save` wrote, `checked` if its checksums were compared already.

        Raises ConfigError, ModelError if a file is missing, damaged or of another format.
        """
        folder = Path(folder)
        if not checked:
            check_sums(folder, TABLE_FILES)
        path = folder / ABOUT_FILE
        try:
            data = json.loads(read_text(path, MOST_BYTES))
        except (RecursionError, ValueError) as error:
            raise ModelError(
                f"{path}: is not JSON ({error}); generate the model again."
            ) from None
        if not isinstance(data, dict) or data.get("format") != FORMAT:
            raise ModelError(
                f"{path}: its format is not {FORMAT!r}; generate the model again."
            )
        parts: dict[str, Any] = dict(validate(data, TableAbout, str(path)))
        parts |= {name: _map_file(folder / f"{name}.npy") for name in ARRAYS}
        del parts["format"]
        table = cls(**parts)
        try:
            table._check()
        except (ArithmeticError, IndexError, ValueError) as error:
            raise ModelError(
                f"{folder}: is not a lidar table ({error}); generate the model again."
            ) from None
        return table

    def _check(self) -> None:
        arrays: tuple[AnyArray, ...] = (self.grid, self.start, self.cell, self.rows)
        types = [array.dtype for array in arrays if array.flags.c_contiguous]
        if types != [np.float64, np.int32, np.int16, np.float32]:
            raise ValueError("an array has another number type or axis order")
        if self.grid.shape != (len(self.shapes), 3) or not np.isfinite(self.grid).all():
            raise ValueError("the grid does not fit the shapes")
        counts = self.grid[:, 1] * self.density.distances
        cells = int(counts.sum())
        if (counts < 1).any() or not np.array_equal(
            self.grid[:, 2], np.cumsum(counts) - counts
        ):
            raise ValueError("the grid does not fit the density")
        if (self.grid[:, 0] <= self.outlines.radii).any():
            raise ValueError("the grid has no extent")
        if (
            self.start.shape != (cells,)
            or self.cell.shape != (cells, 6)
            or self.rows.ndim != 1
        ):
            raise ValueError("the number of cells does not fit the grid")
        widths = self.widths * self.density.phases
        ends = self.start + widths
        last = len(self.rows) - count_padding(self.beam_angle)
        if cells and (self.start.min() < 0 or widths.min() < 1 or ends.max() > last):
            raise ValueError("a row is outside the table")
        corners = np.repeat(np.diff(self.outlines.hull) // 2, counts.astype(np.int64))[
            :, None
        ]
        hint = self.cell[:, 2::2]
        climb = self.cell[:, 3::2]
        if (
            (hint < 0).any()
            or (hint >= corners).any()
            or (np.abs(climb) >= corners).any()
        ):
            raise ValueError("a cell refers to a corner that its shape does not have")


def _map_file(path: Path) -> AnyArray:
    """Map a `.npy` file into memory; writing to the array never changes the file."""
    try:
        with np.errstate(over="raise"):  # a shape with an overflowing size
            array = np.load(path, mmap_mode="c", allow_pickle=False)
        if not isinstance(array, np.memmap):
            raise TypeError("an archive of arrays")
    except Exception:  # noqa: BLE001 - a false header breaks numpy in any way
        raise ModelError(
            f"{path}: is not an array of numbers; generate the model again."
        ) from None
    return np.asarray(array)
