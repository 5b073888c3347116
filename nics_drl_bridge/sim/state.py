"""Everything that the simulator's kernels take, by name: NamedTuples of arrays.

N worlds, n of them in one part, M robots, S state, C command, T kinematic terms, H periods of
command history, K obstacles, W walls, B beams, L lanes, R periods of the past.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.geometry import Array as Array
from nics_drl_bridge.lidar.baked_kernels import LidarArrays
from nics_drl_bridge.lidar.cell_kernels import BodyCells
from nics_drl_bridge.lidar.exact_kernels import OutlineArrays
from nics_drl_bridge.lidar.fixture_kernels import Fixtures
from nics_drl_bridge.lidar.scan_kernels import ScanLanes
from nics_drl_bridge.robot.kernels import Terms

Integers = NDArray[np.int64]


class State(NamedTuple):
    """All that changes in a simulation. A reset keeps the parameters of each robot."""

    pose: Array  # (N, M, 3) true pose of `base_link` in `map`
    state: Array  # (N, M, S) true state
    history: Array  # (N, M, H, C) commands in effect, newest first
    bodies: Array  # (N, K + M, 7) obstacles, then robots, columns as in `lidar.exact_kernels`
    odom: Array  # (N, M, 3) pose by odometry, which drifts; it begins at the start pose
    twist: Array  # (N, M, 3) measured body twist
    ranges: NDArray[np.float32]  # (N, M, B) scan, REP-117
    collided: NDArray[np.uint8]  # (N, M) 1 once a robot has touched something
    steps: Integers  # (N,) control periods since the reset
    seeds: Integers  # (N,) of the episode
    member: Integers  # (N,) world of a set in which the episode is
    faults: (
        Array  # (N, M, P) of each robot's lidar, columns as in `lidar.fault_kernels`
    )
    coefficient: Array  # (N, M, T), in the order of `robot.kernels.term_arrays`
    delay: Integers  # (N, M) common latency of the commands [substeps], at most `longest_delay`
    age: Integers  # (N, M) of scan and odometry when reported [substeps], at most `longest_age`
    # (N, M, 2 + 3 + S) std of odometry [m/s, rad/s]; after a second, of x, y, heading, state
    noise: Array
    velocity: (
        Array  # (N, K, 3) of the obstacles in `map`, for a period [m/s, m/s, rad/s]
    )
    past: Array  # (N, M, R, 12) of the last periods, see `sensing_kernels`
    marks: Array  # (N, K, F) memory of moving obstacles, columns as in `separation_kernels`


class MapField(NamedTuple):
    """Distances from the centres of square cells to what is solid; no cells without a map."""

    distances: NDArray[np.float32]  # (rows, columns) [m]
    x: float  # outer corner of cell (0, 0) [m]
    y: float
    cos: float  # of the heading of the rows
    sin: float
    cell: float  # side of a cell [m]


NO_FIELD = MapField(np.zeros((0, 0), np.float32), 0.0, 0.0, 1.0, 0.0, 1.0)


class Movers(NamedTuple):
    """Motion of the obstacles."""

    moves: bool  # True if any obstacle moves
    plans: Array  # (K, P) see `obstacles.plan_arrays`
    waypoints: Array  # (Q, 2) of all patrols [m]
    field: Array  # (4,) minimum x, y and maximum x, y of the field [m]


class Surroundings(NamedTuple):
    """Everything that stands in one world, and how its bodies are searched."""

    walls: Array  # (W, 4) x1, y1, x2, y2 [m]
    grid: MapField
    outlines: OutlineArrays
    crowded: bool  # True if all bodies are sorted into cells in each period
    standing: bool  # True if the obstacles are put in the order of cells: none may get a velocity
    movers: Movers


class Members(NamedTuple):
    """The surroundings of P worlds, one after the other; see `step_kernels.surroundings_of`."""

    fixtures: Fixtures
    distances: NDArray[np.float32]  # of all maps, see `MapField`
    fields: Integers  # (P, 3) first distance, rows and columns of each map
    outlines: OutlineArrays
    crowded: bool  # `crowded`, `standing`, `moves`: as in `Surroundings` and `Movers`
    standing: bool
    moves: bool
    plans: Array  # (P, K, L)
    waypoints: Array  # (Q, 2) of all patrols in all worlds [m]
    field: Array  # (P, 4)


class Dynamics(NamedTuple):
    """Kinematics of the robots."""

    terms: (
        Terms  # with the model's coefficients; those of a robot are `State.coefficient`
    )
    series: Array  # see `robot.kernels`
    dt: float  # length of a substep [s]
    substeps: int  # in a control period


class Lanes(NamedTuple):
    """Robots side by side, see `robot.kernels.run`."""

    pose: Array  # (6, L)
    x: Array  # (V + 1, L)
    dq: Array  # (D, L)
    coefficient: Array  # (T, L)
    late: Integers  # (C, L) substep at which a command of each changes


class Single(NamedTuple):
    """Scratch memory of one world whose robots move carefully."""

    x: Array  # of one robot, see `robot.kernels.scratch`
    dq: Array
    trial: Array  # (7,) a body
    spare: Array  # (V, 2) corners
    start: Array  # (K, 3) poses of the obstacles, as if they had always moved by their velocity
    began: Array  # (K, 3) their poses at the start of the period
    flights: Array  # (K + M, FLIGHT) see `impact_kernels`
    events: Array  # (M, EVENT) see `impact_kernels`


class Nearby(NamedTuple):
    """Bodies and walls that the robots of one world may meet in the period."""

    near: Integers  # (M, 1 + SEVERAL) number and indices of the bodies near each robot
    meets: Integers  # (M,) flags of `contact_kernels`
    way: Array  # (M,) upper bound on the length of each robot's path [m]
    reach: Array  # (K + M,) how far each body may reach from its present centre [m]
    speeds: Array  # (M, 2) velocity in `map` [m/s]


class Scans(NamedTuple):
    """Scratch memory of the scans."""

    before: Array  # (L, 3) poses at the start of the period
    waiting: Integers  # (n,) worlds that are scanned together
    seen: Array  # (K + M + 1, 7) bodies around one robot
    spot: Array  # (1, 1, 3) pose of one robot
    slices: Array  # (G, 3) poses during a sweep
    part: NDArray[np.float32]  # (1, 1, B) scan of a slice
    drive: Array  # (3,) twist of one robot
    none: Integers  # (1,) index of the only world of one robot
    every: BodyCells  # of no worlds: all bodies that are seen
    lookup: ScanLanes  # of the lidar


class Scratch(NamedTuple):
    """Memory that one thread needs to itself."""

    lanes: Lanes
    single: Single
    nearby: Nearby
    cells: BodyCells  # those of all parts, with places of its own for what is found
    scans: Scans


class Part(NamedTuple):
    """Everything that the kernels need to step the worlds of one part."""

    state: State
    members: Members
    lidar: LidarArrays
    motion: Dynamics
    scratch: Scratch
