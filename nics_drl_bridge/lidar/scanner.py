"""Scanner: a batch of scans in one call, exact or baked."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike

from nics_drl_bridge.errors import ConfigError, ModelError, suggest
from nics_drl_bridge.lidar import scan_kernels
from nics_drl_bridge.lidar.arrays import Array, Singles
from nics_drl_bridge.lidar.bake import bake
from nics_drl_bridge.lidar.beam_kernels import make_beams
from nics_drl_bridge.lidar.exact_kernels import SHAPE
from nics_drl_bridge.lidar.lookup_error import find_lookup_distances
from nics_drl_bridge.lidar.map_kernels import Fixtures
from nics_drl_bridge.lidar.maps import GridMap, stack_fixtures
from nics_drl_bridge.lidar.shapes import BODY, Shape, place
from nics_drl_bridge.lidar.spec import LidarSpec
from nics_drl_bridge.lidar.table import LidarTable

Renderer = Literal["auto", "baked", "exact"]
RENDERERS = get_args(Renderer)
DEFAULT_RENDERER: Renderer = "auto"
NO_WALLS = np.zeros((0, 4))
# `auto` looks up at distances where the ranges' RMSE is at most this [m]
GREATEST_ERROR = 0.01
# cache of `find_lookup_distances`
_MEASURED: dict[tuple[Any, ...], tuple[float, float]] = {}
# `auto` scans beams farther apart exactly, because rows of few points are inaccurate
# [rad]
WIDEST_BEAMS = 0.2


@dataclass(frozen=True)
class Scanner:
    """A lidar with its table, ready to scan.

    The renderer `baked` looks up every shape; `exact` computes every ray; `auto` looks
    shapes up, with three exceptions: shapes larger than the range, whose circle nearly
    always contains the lidar; distances at which a shape has an error above
    `GREATEST_ERROR` (any shape when very near; long thin shapes and deep notches at
    larger or all distances); and beams wider than `WIDEST_BEAMS`. All renderers scan
    straight walls exactly, and also bodies whose circle contains the lidar.
    """

    spec: LidarSpec
    table: LidarTable  # of the shapes that may occur
    renderer: Renderer = DEFAULT_RENDERER
    grid: GridMap | None = None  # a static map of every world that `scan` sees

    def __post_init__(self) -> None:
        """Raise ConfigError for an unknown renderer, ModelError for another lidar's table."""
        table = self.table
        spec = self.spec
        if self.renderer not in RENDERERS:
            fix = suggest(str(self.renderer), RENDERERS)
            raise ConfigError(f"unknown renderer {self.renderer!r}; {fix}")
        if self.renderer == "exact" or not table.shapes:
            return
        reach = float((table.grid[:, 0] - table.outlines.radii).min())
        reason = ""
        if not table.has_rows:
            reason = f"has no rows to look up with the renderer {self.renderer!r}"
        elif not math.isclose(table.beam_angle, spec.angle_increment, rel_tol=1e-9):
            reason = (
                f"is for beams that are {table.beam_angle:.6g} rad apart, not "
                f"{spec.angle_increment:.6g} rad"
            )
        elif reach < spec.range_max * (1.0 - 1e-9):
            reason = f"reaches {reach:g} m, not {spec.range_max:g} m"
        if reason:
            raise ModelError(
                f"the lidar table {reason}; bake one for the lidar "
                f"{spec.name!r}, or scan with `exact`."
            )

    @cached_property
    def arguments(self) -> scan_kernels.LidarArrays:
        """Lidar and table for the kernels."""
        spec = self.spec
        table = self.table
        return scan_kernels.LidarArrays(
            np.array(spec.mount),
            make_beams(
                np.ascontiguousarray(spec.directions.T),
                spec.angle_min,
                spec.angle_increment,
            ),
            spec.range_min,
            spec.range_max,
            spec.sweep_time,
            self._find_lookup_limits(),
            table.outlines.arguments,
            table.arrays,
            self.renderer == "exact",
        )

    @cached_property
    def _without_walls(self) -> Fixtures:
        return stack_fixtures([NO_WALLS], [self.grid], np.zeros(1, np.int64))

    def _find_lookup_limits(self) -> Array:
        spec = self.spec
        table = self.table
        radii = self.table.outlines.radii
        between = np.full((len(radii), 2), np.inf)
        if self.renderer == "baked":
            between[:, 0] = radii
        elif self.renderer == "auto" and spec.angle_increment <= WIDEST_BEAMS:
            for h in np.flatnonzero(radii < spec.range_max).tolist():
                farthest = float(table.grid[h, 0])
                key = spec.model_dump_json(), table.shapes[h], table.density, farthest
                if key not in _MEASURED:  # once per process
                    exact = replace(self, renderer="exact", grid=None)
                    baked = replace(self, renderer="baked", grid=None)
                    _MEASURED[key] = find_lookup_distances(
                        exact.arguments,
                        baked.arguments,
                        h,
                        float(radii[h]),
                        GREATEST_ERROR,
                    )
                between[h] = _MEASURED[key]
        return np.asarray(np.square(between))

    def place(self, shapes: Sequence[Shape], poses: ArrayLike) -> Array:
        """Return bodies (..., K, 7) of K shapes at poses (..., K, 3); ModelError if not baked."""
        index = [self.table.outlines.index_of(shape) for shape in shapes]
        return place(poses, self.table.outlines.radii[index], index)

    def scan(
        self,
        poses: ArrayLike,
        bodies: ArrayLike,
        walls: ArrayLike = NO_WALLS,
        out: Singles | None = None,
    ) -> Singles:
        """Scan (N, B) [m], REP-117, from poses (N, 3) of robots, each in a separate world.

        The bodies (N, K, 7) are from `place`; walls (W, 4) x1, y1, x2, y2 [m] are the same in every
        world; the ranges are written to `out` if it is given. Raises ConfigError for an array of a
        wrong shape, ModelError for a body of a shape that is not in the table.
        """
        poses, bodies, walls = self._check_scene(poses, bodies, walls)
        shape = (len(poses), self.spec.beams)
        if out is None:
            out = np.empty(shape, np.float32)
        is_float32 = out.dtype == np.float32 and out.flags.c_contiguous
        if out.shape != shape or not is_float32:
            raise ConfigError(
                f"out is {out.shape} {out.dtype}; it must be {shape} float32, contiguous."
            )
        worlds = np.arange(len(poses))
        scratch = scan_kernels.scan_scratch(self.spec.beams)
        member = np.zeros(len(poses), np.int64)
        first = np.array([0, len(walls)])
        around = self._without_walls._replace(member=member, walls=walls, first=first)
        scan_kernels.scan_worlds(
            out[:, None],
            poses[:, None],
            worlds,
            bodies,
            np.arange(bodies.shape[1], dtype=np.int32),
            -1,
            around,
            self.arguments,
            scratch,
        )
        return out

    def _check_scene(
        self, poses: ArrayLike, bodies: ArrayLike, walls: ArrayLike
    ) -> tuple[Array, ...]:
        poses = np.atleast_2d(np.asarray(poses, np.float64))
        bodies = np.asarray(bodies, np.float64)
        if bodies.size == 0:
            bodies = np.zeros((len(poses), 0, BODY))
        elif bodies.ndim == 2:
            bodies = bodies[None]
        if np.size(walls) == 0:
            walls = NO_WALLS
        walls = np.array(walls, np.float64, order="C", ndmin=2)
        if poses.shape[1:] != (3,) or bodies.shape != (
            len(poses),
            bodies.shape[1],
            BODY,
        ):
            raise ConfigError(
                f"poses {poses.shape} and bodies {bodies.shape} must be (N, 3) and (N, K, {BODY})."
            )
        if walls.shape != (len(walls), 4):
            raise ConfigError(f"walls {walls.shape} must be (W, 4).")
        index = bodies[..., SHAPE]
        count = len(self.table.shapes)
        if index.size and not (index.min() >= 0 and index.max() < count):
            reason = f"none of the {count} in the lidar table"  # kernels don't check
            raise ModelError(
                f"a body's shape is {reason}; make bodies by `place` of its scanner."
            )
        return poses, bodies, walls


def make_scanner(
    spec: LidarSpec,
    shapes: Sequence[Shape],
    renderer: Renderer = DEFAULT_RENDERER,
    grid: GridMap | None = None,
) -> Scanner:
    """Return a scanner of shapes and bake them if needed. Raises ConfigError."""
    if renderer == "exact":
        table = LidarTable.without_rows(spec, shapes)
    else:
        table = bake(spec, shapes)
    return Scanner(spec, table, renderer, grid)
