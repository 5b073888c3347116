"""Everything that the simulator's kernels take, by name: NamedTuples of arrays.

numba reads their fields by name, so that no order lives in a docstring. N worlds, n of them in one
part, M robots, S state, C command, T kinematic terms, H periods of command history, K obstacles,
W walls, B beams, L lanes, R periods of the past.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.lidar.baked_kernels import LidarArrays
from nics_drl_bridge.lidar.exact_kernels import OutlineArrays
from nics_drl_bridge.lidar.map_kernels import GridArrays
from nics_drl_bridge.lidar.scan_kernels import ScanLanes
from nics_drl_bridge.robot.kernels import Terms

Array = NDArray[np.float64]
Integers = NDArray[np.int64]


class State(NamedTuple):
    """All that changes in a simulation.

    `faults`, `coefficient`, `delay`, `age` and `noise` are parameters of each robot: those of the
    model unless written to, as domain randomisation does. A reset keeps them.

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
        age: (N, M) age of scan and odometry when they are reported [substeps], at most the
            simulator's `longest_age`.
        noise: (N, M, 2 + 3 + S) standard deviation of the odometry, linear [m/s] and angular
            [rad/s]; and, after a second, of the drift along x, y [m], heading [rad], and state.
        velocity: (N, K, 3) of the obstacles in `map`, constant for a period [m/s, m/s, rad/s].
        past: (N, M, R, 12) of the last periods, see `sensing_kernels`.
        marks: (N, K, F) memory of moving obstacles, columns as in `separation_kernels`.
    """

    pose: Array
    state: Array
    history: Array
    bodies: Array
    odom: Array
    twist: Array
    ranges: NDArray[np.float32]
    collided: NDArray[np.uint8]
    steps: Integers
    seeds: Integers
    faults: Array
    coefficient: Array
    delay: Integers
    age: Integers
    noise: Array
    velocity: Array
    past: Array
    marks: Array


class MapField(NamedTuple):
    """The static map, see `collision_kernels`; without cells where there is none.

    Attributes:
        distances: (rows, columns) to the nearest solid cell [m], float32.
        frame: (5,) x, y [m], cosine, sine of its origin, resolution [m].
    """

    distances: NDArray[np.float32]
    frame: Array


class Movers(NamedTuple):
    """Motion of the obstacles.

    Attributes:
        moves: whether any obstacle moves.
        plans: rows and waypoints, see `obstacles.plan_arrays`.
        half: (2,) half the size of the field [m].
        distances: of a static map, see `obstacles.distance_arrays`.
    """

    moves: bool
    plans: tuple[Array, Array]
    half: Array
    distances: tuple[NDArray[np.float32], Array]


class Surroundings(NamedTuple):
    """Everything that stands in every world, and how its bodies are searched.

    Attributes:
        walls: (W, 4).
        grid: the static map.
        outlines: of all shapes.
        crowded: whether the bodies of a world are sorted into cells.
        scattered: whether scans use the cells too.
        movers: motion of the obstacles.
    """

    walls: Array
    grid: MapField
    outlines: OutlineArrays
    crowded: bool
    scattered: bool
    movers: Movers


class LidarView(NamedTuple):
    """The lidar.

    Attributes:
        sensor: the lidar and its table.
        grid: the static map as scanned.
        exact: whether the map is scanned exactly.
        mount: (3,) pose of the lidar on the robot.
        limits: (2,) least and greatest range [m].
        sweep_time: duration of a sweep [s].
    """

    sensor: LidarArrays
    grid: GridArrays
    exact: bool
    mount: Array
    limits: Array
    sweep_time: float


class Dynamics(NamedTuple):
    """Kinematics of the robots.

    Attributes:
        terms: with the model's coefficients, for those of a robot see `State.coefficient`.
        series: see `robot.kernels`.
        dt: length of a substep [s].
        substeps: in a control period.
    """

    terms: Terms
    series: Array
    dt: float
    substeps: int


class Lanes(NamedTuple):
    """Robots side by side, see `robot.kernels.run`.

    Attributes:
        pose: (6, L); x: (V + 1, L); dq: (D, L); coefficient: (T, L); late: (L,) substep at which
            the command of each changes.
    """

    pose: Array
    x: Array
    dq: Array
    coefficient: Array
    late: Integers


class Single(NamedTuple):
    """Scratch memory of one world whose robots move carefully.

    Attributes:
        x, dq: of one robot, see `robot.kernels.scratch`.
        trial: (7,) a body.
        spare: (V, 2) corners.
        start: (K, 3) poses of the obstacles, as if they had always moved by their velocity.
        began: (K, 3) their poses at the start of the period.
        flights: (K + M, FLIGHT), see `impact_kernels`.
        events: (M, EVENT), see `impact_kernels`.
    """

    x: Array
    dq: Array
    trial: Array
    spare: Array
    start: Array
    began: Array
    flights: Array
    events: Array


class Nearby(NamedTuple):
    """Bodies and walls that the robots of one world may meet in the period, see `contact_kernels`.

    Attributes:
        near: (M, 1 + SEVERAL) number and indices of the bodies near each robot.
        meets: (M,) flags.
        way: (M,) upper bound on the length of each robot's path [m].
        reach: (K + M,) how far each body may reach from its present centre [m].
        speeds: (M, 2) velocity in `map` [m/s].
    """

    near: Integers
    meets: Integers
    way: Array
    reach: Array
    speeds: Array


class Cells(NamedTuple):
    """The bodies of one crowded world in square cells, see `contact_kernels`.

    Attributes:
        begin: (G^2 + 2,) index in `order` of the first body of each cell, the last cell being
            that of the large bodies.
        order: (K + M,) the bodies, cell by cell.
        cell_of: (K + M,) cell of each body.
        frame: (5,) x, y [m] of the first cell, cells per metre, greatest radius of the bodies in
            cells [m], and greatest distance moved since by any body [m].
        found: (K + M,) bodies found around a point.
    """

    begin: Integers
    order: Integers
    cell_of: Integers
    frame: Array
    found: Integers


class Scans(NamedTuple):
    """Scratch memory of the scans.

    Attributes:
        before: (L, 3) poses at the start of the period.
        waiting: (n,) worlds that are scanned together.
        seen: ((K + M + 1) * 7,) bodies around one robot.
        spot: (1, 1, 3) pose of one robot.
        slices: (G, 3) poses during a sweep.
        part: (1, 1, B) scan of a slice.
        drive: (3,) twist of one robot.
        none: (1,) index of the only world of one robot.
        lookup: of the lidar.
    """

    before: Array
    waiting: Integers
    seen: Array
    spot: Array
    slices: Array
    part: NDArray[np.float32]
    drive: Array
    none: Integers
    lookup: ScanLanes


class Scratch(NamedTuple):
    """Memory that one thread needs to itself."""

    lanes: Lanes
    single: Single
    nearby: Nearby
    cells: Cells
    scans: Scans


class Part(NamedTuple):
    """Everything that the kernels need to step the worlds of one part."""

    state: State
    scene: Surroundings
    lidar: LidarView
    motion: Dynamics
    scratch: Scratch
