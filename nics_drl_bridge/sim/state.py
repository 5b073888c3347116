"""Worlds: all mutable state of a simulation, and the other arguments of its kernels."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.generator import SimulatorModel
from nics_drl_bridge.lidar.maps import NO_MAP, GridMap
from nics_drl_bridge.lidar.scanner import Scanner
from nics_drl_bridge.lidar.shapes import BODY
from nics_drl_bridge.robot.kernels import SERIES, scratch, term_arrays
from nics_drl_bridge.sim.contact_kernels import SEVERAL
from nics_drl_bridge.sim.impact_kernels import EVENT, FLIGHT
from nics_drl_bridge.sim.sensing_kernels import PAST
from nics_drl_bridge.sim.separation_kernels import MARK

Array = NDArray[np.float64]
SLICES = 16
"""Number of groups of beams in which a skewed scan is rendered."""
LANES = 256
"""Number of robots moved side by side: their arrays stay in the L1 cache."""
CROWD = 4096
"""Least number of pairs of a robot and a body for sorting the bodies of a world into cells."""
FEWEST_OF_A_CROWD = 8
"""Least number of robots: for fewer, sorting takes longer than testing all bodies."""
SCATTERED = 64
"""Least number of bodies in cells for scanning each robot only among those around it; for fewer,
testing all of them takes less time than a separate scan for each robot."""


@dataclass(frozen=True)
class Worlds:
    """All mutable state of a simulation; the order is that of `kernels.step_worlds`.

    `faults`, `coefficient`, `delay`, `age` and `noise` are parameters of each robot: those of the
    model unless overwritten, as by domain randomisation. A reset keeps them.

    Attributes:
        pose: (N, M, 3) true pose of `base_link` in `map`.
        state: (N, M, S) true state.
        history: (N, M, H, C) commands, newest first.
        bodies: (N, K + M, 7) obstacles, then robots, see `lidar.shapes.BODY`.
        odom: (N, M, 3) pose by odometry, which drifts; it begins at the start pose.
        twist: (N, M, 3) measured body twist.
        ranges: (N, M, B) scan, float32, REP-117.
        collided: (N, M) 1 once a robot has touched something.
        steps: (N,) control periods since the reset.
        seeds: (N,) of the episode.
        faults: (N, M, P) faults of each robot's lidar, columns as in `lidar.fault_kernels`.
        coefficient: (N, M, T) of the kinematic terms, in the order of
            `robot.kernels.term_arrays`.
        delay: (N, M) latency of the commands [substeps], at most the simulator's `longest_delay`.
        age: (N, M) age of scan and odometry when they are observed [substeps], at most the
            simulator's `longest_age`.
        noise: (N, M, 2 + 3 + S) standard deviation of the odometry, linear [m/s] and angular
            [rad/s]; and, after a second, of the drift along x, y [m], heading [rad], and state.
        velocity: (N, K, 3) of the obstacles in `map`, constant for a period [m/s, m/s, rad/s].
        past: (N, M, R, 12) of the last periods, see `sensing_kernels`.
        marks: (N, K, F) memory of moving obstacles, see `separation_kernels`.
    """

    pose: Array
    state: Array
    history: Array
    bodies: Array
    odom: Array
    twist: Array
    ranges: NDArray[np.float32]
    collided: NDArray[np.uint8]
    steps: NDArray[np.int64]
    seeds: NDArray[np.int64]
    faults: Array
    coefficient: Array
    delay: NDArray[np.int64]
    age: NDArray[np.int64]
    noise: Array
    velocity: Array
    past: Array
    marks: Array


@dataclass(frozen=True)
class Sizes:
    """Dimensions of a simulation.

    Attributes:
        worlds: N.
        robots: M in each.
        obstacles: K in each.
        longest_delay: greatest latency of commands [substeps].
        longest_age: greatest age of an observation [substeps].
    """

    worlds: int
    robots: int
    obstacles: int
    longest_delay: int
    longest_age: int

    @property
    def crowded(self) -> bool:
        """True if it pays to sort the bodies of a world into cells."""
        pairs = self.robots * (self.robots + self.obstacles)
        return self.robots >= FEWEST_OF_A_CROWD and pairs >= CROWD

    @property
    def scattered(self) -> bool:
        """True if it pays to scan each robot among the bodies around it only."""
        return self.crowded and self.robots + self.obstacles >= SCATTERED


def allocate(model: SimulatorModel, sizes: Sizes) -> Worlds:
    """Allocates the arrays of worlds before their first reset, with the model's parameters."""
    size, width = len(model.robot.state), len(model.robot.command)
    _, substeps, delay = model.timing
    shape, bodies = (sizes.worlds, sizes.robots), sizes.obstacles + sizes.robots
    noise = [*model.noise.odometry, *model.noise.simulated_drift(model.robot)]
    # One row for the newest; an age within a period needs the end of the period before it, too.
    rows = -(-sizes.longest_age // substeps) + 1
    return Worlds(
        pose=np.zeros((*shape, 3)),
        state=np.zeros((*shape, size)),
        history=np.zeros((*shape, -(-sizes.longest_delay // substeps) + 1, width)),
        bodies=np.zeros((sizes.worlds, bodies, BODY)),
        odom=np.zeros((*shape, 3)),
        twist=np.zeros((*shape, 3)),
        ranges=np.full((*shape, model.lidar.beams), np.inf, np.float32),
        collided=np.zeros(shape, np.uint8),
        steps=np.zeros(sizes.worlds, np.int64),
        seeds=np.zeros(sizes.worlds, np.int64),
        faults=np.tile(model.lidar.fault_parameters, (*shape, 1)),
        coefficient=np.tile(term_arrays(model.kinematics)[1], (*shape, 1)),
        delay=np.full(shape, delay, np.int64),
        age=np.zeros(shape, np.int64),
        noise=np.tile(noise, (*shape, 1)),
        velocity=np.zeros((sizes.worlds, sizes.obstacles, 3)),
        past=np.zeros((*shape, rows, PAST)),
        marks=np.zeros((sizes.worlds, sizes.obstacles, MARK)),
    )


def split(worlds: int, threads: int) -> tuple[slice, ...]:
    """Splits N worlds into contiguous parts of nearly equal size, one per thread."""
    edges = np.arange(min(threads, worlds) + 1) * worlds // min(threads, worlds)
    return tuple(slice(int(a), int(b)) for a, b in itertools.pairwise(edges))


def arguments(
    data: Worlds,
    model: SimulatorModel,
    scanner: Scanner,
    walls: Array,
    movers: tuple[Any, ...],
    sizes: Sizes,
    part: slice,
) -> tuple[Any, ...]:
    """Returns the kernels' arguments for one part: `data`, constants, and its scratch memory.

    Returns:
        The fields of `data`; scene: walls, map (distances, frame), outlines, whether the bodies
        are sorted, whether scans use the cells, and `movers`: whether any obstacle moves, and
        plans, half size and distances of `motion_kernels`; view: the lidar's arguments, its map,
        whether it scans exactly, mount, limits, time of a sweep; motion, see
        `robot_kernels.move_freely`; and scratch, see `_scratch`.
    """
    lidar, grid = model.lidar, scanner.grid
    dof, _, factors, count = term_arrays(model.kinematics)
    dt, substeps, _ = model.timing
    view = (
        scanner.arguments,
        NO_MAP if grid is None else grid.arrays,
        scanner.renderer == "exact",
        np.array(lidar.mount, dtype=np.float64),
        np.array([lidar.range_min, lidar.range_max], dtype=np.float64),
        float(lidar.sweep_time),
    )
    outlines = scanner.table.outlines.arguments
    scene = (walls, _collision_map(grid), outlines, sizes.crowded, sizes.scattered, movers)
    motion = (dof, factors, count, SERIES, (float(dt), int(substeps)))
    room = _scratch(model, scanner, sizes, part.stop - part.start)
    return tuple(vars(data).values()), scene, view, motion, room


def _collision_map(grid: GridMap | None) -> tuple[NDArray[np.float32], Array]:
    """Returns the argument `grid` of `collision_kernels`."""
    if grid is None:
        return np.zeros((0, 0), np.float32), np.zeros(5)
    return np.ascontiguousarray(grid.distance_field), grid.arrays[1]


def _scratch(model: SimulatorModel, scanner: Scanner, sizes: Sizes, worlds: int) -> tuple[Any, ...]:
    """Allocates the scratch memory of one thread for a number of worlds.

    Returns:
        Scratch for the robots that move side by side; for one that moves carefully; for the robots
        of one world; for the cells of a crowded world; for the scans.
    """
    kinematics, robots = model.kinematics, sizes.robots
    bodies = sizes.obstacles + robots
    blocks = -(-worlds * robots // LANES)
    lanes = robots * min(worlds, -(-worlds // blocks))
    x = np.ones((len(kinematics.variables) + 1, lanes))
    side = int(np.sqrt(2.0 * bodies)) if sizes.crowded else 1
    corners = int(np.diff(scanner.table.outlines.corner).max(initial=4))
    return (
        (
            np.zeros((6, lanes)), x, np.zeros((len(kinematics.dofs), lanes)),
            np.zeros((np.count_nonzero(kinematics.coefficients), lanes)), np.zeros(lanes, np.int64),
        ),
        (
            *scratch(kinematics), np.zeros(BODY), np.zeros((max(corners, 4), 2)),
            np.zeros((sizes.obstacles, 3)), np.zeros((sizes.obstacles, 3)),
            np.zeros((bodies, FLIGHT)), np.zeros((robots, EVENT)),
        ),
        (
            np.zeros((robots, 1 + SEVERAL), np.int64), np.zeros(robots, np.int64),
            np.zeros(robots), np.zeros(bodies), np.zeros((robots, 2)),
        ),
        (
            (
                np.zeros(side * side + 2, np.int64), np.zeros(bodies, np.int64),
                np.zeros(bodies, np.int64), np.zeros(5),
            ),
            np.zeros(bodies, np.int64),
        ),
        (
            np.zeros((lanes, 3)), np.zeros(worlds, np.int64), np.zeros((bodies + 1) * BODY),
            np.zeros((1, 1, 3)), np.zeros((SLICES, 3)),
            np.zeros((1, 1, model.lidar.beams), np.float32), np.zeros(3), np.zeros(1, np.int64),
            scanner.room(bodies),
        ),
    )  # fmt: skip
