"""LidarTable: the rows of every shape, at every distance and rotation (Sec. IV-B)."""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, field_validator

from nics_drl_bridge.config import Schema
from nics_drl_bridge.errors import ModelError
from nics_drl_bridge.files import npz_bytes, npz_mapped, sha256
from nics_drl_bridge.lidar.shapes import SHAPES, Circle, Outlines, Shape


class Density(Schema):
    """How finely a table is sampled.

    Attributes:
        distances: grid distances, from the shape's own radius to out of range.
        rotations: grid rotations in a full turn; a shape that looks the same after a part of a
            turn is baked for that part only.
        phases: points per beam, 1, 2, 4 or 8.
    """

    distances: int = Field(default=100, ge=3, le=10_000)
    rotations: int = Field(default=240, ge=1, le=100_000)
    phases: int = 4

    @field_validator("phases")
    @classmethod
    def _power_of_two(cls, phases: int) -> int:
        if phases not in (1, 2, 4, 8):
            raise ValueError("phases must be 1, 2, 4 or 8")
        return phases


@dataclass(frozen=True)
class LidarTable:
    """The ranges that shapes give, as rows over angle, for a grid of distance and rotation.

    A cell is one grid distance at one grid rotation. Its row holds only the directions that the
    shape can cover until the next cells, as many times as there are phases: the points of one
    phase stand one beam apart, so that the beams of a scan find theirs one after the other.

    Attributes:
        shapes: H of them.
        density: of the grid.
        grid: (H, 3) greatest grid distance [m], grid rotations in the part of a turn after which
            the shape looks the same, first cell.
        start: (cells,) int32 where each row begins in `rows`.
        cell: (cells, 6) int16 first beam of the row from the bearing, its width in beams, two
            corners of the hull that can be the right edge, two that can be the left.
        rows: (R,) float32 ranges [m].
    """

    shapes: tuple[Shape, ...]
    density: Density
    grid: NDArray[np.float64]
    start: NDArray[np.int32]
    cell: NDArray[np.int16]
    rows: NDArray[np.float32]

    @cached_property
    def outlines(self) -> Outlines:
        """The shapes as arrays."""
        return Outlines.of(self.shapes)

    @cached_property
    def lookup(self) -> tuple[Any, ...]:
        """What the kernels take.

        Per shape (H, 11): radius [m], cells per metre, distances, rotations per radian, grid
        rotations in a part of a turn, parts, 1 / (grid rotations x parts), first cell, first
        corner of the hull, corners per part, 1 for a circle; then `start`, `cell`, `rows`, log2
        of the phases, the hulls.
        """
        outlines, distances = self.outlines, self.density.distances
        of = np.zeros((len(self.shapes), 11))
        of[:, 0] = outlines.radii
        of[:, 1] = (distances - 1) / (self.grid[:, 0] - outlines.radii)
        of[:, 2] = distances
        of[:, 4], of[:, 5] = self.grid[:, 1], outlines.orders
        of[:, 3] = of[:, 4] * of[:, 5] / (2.0 * np.pi)
        of[:, 6] = 1.0 / (of[:, 4] * of[:, 5])
        of[:, 7], of[:, 8] = self.grid[:, 2], outlines.hull[:-1]
        of[:, 9] = np.diff(outlines.hull) / 2 / outlines.orders
        of[:, 10] = [isinstance(shape, Circle) for shape in self.shapes]
        phases = self.density.phases
        return of, self.start, self.cell, self.rows, phases.bit_length() - 1, outlines.hulls

    @property
    def memory(self) -> int:
        """Memory of the table [bytes]."""
        return sum(a.nbytes for a in (self.grid, self.start, self.cell, self.rows))

    def dump(self) -> bytes:
        """The table as the content of an `.npz` file that can be mapped."""
        arrays: dict[str, NDArray[Any]] = {
            "about": np.frombuffer(self._about().encode(), np.uint8),
            "grid": self.grid,
            "start": self.start,
            "cell": self.cell,
            "rows": self.rows,
        }
        return npz_bytes(arrays, packed=False)

    def _about(self) -> str:
        shapes = SHAPES.dump_python(self.shapes, mode="json")
        return json.dumps({"shapes": shapes, "density": self.density.model_dump()})

    @classmethod
    def load(cls, path: Path, checksum: str | None = None) -> LidarTable:
        """Maps a table that `dump` made into memory; processes that do so share it.

        Args:
            path: of the file.
            checksum: SHA-256 that the file must have, in hexadecimal.

        Raises:
            ModelError: the file can't be read, is another one, damaged, or no table.
        """
        try:
            if checksum is not None and sha256(path.read_bytes()) != checksum:
                raise ModelError(f"{path}: does not match its checksum; generate the model anew.")
            arrays = npz_mapped(path)
            about = json.loads(arrays.pop("about").tobytes())
            shapes = SHAPES.validate_python(about["shapes"])
            table = cls(shapes, Density(**about["density"]), **arrays)
            table._check()
        except OSError as error:
            raise ModelError(
                f"{path}: can't be read ({error.strerror}); generate the model anew."
            ) from None
        except (AttributeError, KeyError, TypeError, ValueError) as error:
            reason = " ".join(str(error).split())
            raise ModelError(
                f"{path}: is no lidar table ({reason}); generate the model anew."
            ) from None
        return table

    def _check(self) -> None:
        """Raises ValueError when the kernels would read beyond an array."""
        cells = int(self.grid[:, 1].sum()) * self.density.distances
        arrays: tuple[NDArray[Any], ...] = (self.grid, self.start, self.cell, self.rows)
        if [array.dtype for array in arrays] != [np.float64, np.int32, np.int16, np.float32]:
            raise ValueError("an array has another type of number")
        if self.grid.shape != (len(self.shapes), 3) or self.start.shape != (cells,):
            raise ValueError("the number of cells does not fit the shapes")
        if self.cell.shape != (cells, 6) or self.rows.ndim != 1:
            raise ValueError("an array has another shape")
        widths = self.cell[:, 1].astype(np.int64) * self.density.phases
        ends = self.start + widths
        if cells and (self.start.min() < 0 or widths.min() < 1 or ends.max() > len(self.rows)):
            raise ValueError("a row lies outside of the table")
        corners = np.diff(self.outlines.hull) // 2
        first = self.grid[:, 2].astype(np.int64)
        for h, count in enumerate(self.grid[:, 1].astype(np.int64) * self.density.distances):
            part = self.cell[first[h] : first[h] + count, 2:]
            if len(part) != count or part.min() < 0 or part.max() >= corners[h]:
                raise ValueError("a cell names a corner that its shape has not")
