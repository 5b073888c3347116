"""Arguments of the simulator's kernels: NamedTuples of arrays.

A simulation runs N worlds. Each is a copy of one of the P members of a world set and
contains M robots and K obstacles. `State` changes in each period, `WorldSetArrays` and
`Dynamics` never change, and scratch memory holds no information between calls. One
thread steps one `Part` of the worlds.

Other dimensions: S state, C commands, T kinematic terms, H periods of command history,
R periods of the past, W walls, B beams, L lanes, G groups of beams, n a subset of the
worlds.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.lidar.arrays import Array as Array
from nics_drl_bridge.lidar.arrays import Integers as Integers
from nics_drl_bridge.lidar.arrays import ShortIntegers, Singles, structure_of
from nics_drl_bridge.lidar.exact_kernels import OutlineArrays
from nics_drl_bridge.lidar.map_kernels import Fixtures
from nics_drl_bridge.lidar.scan_kernels import LidarArrays, ScanScratch
from nics_drl_bridge.robot.kernels import Terms

# Columns of `State.noise`: standard deviations of the odometry's linear velocity [m/s] and turn
# rate [rad/s]; then of the drift of x, y [m/sqrt(s)], heading [rad/sqrt(s)], each state variable.
ODOM_LINEAR = 0
ODOM_ANGULAR = 1
DRIFT_X = 2
DRIFT_Y = 3
DRIFT_STATE = 5

# Columns of `State.past`. The true twist is the model's at the end of a period. For a
# robot that drives against a wall, it is the twist at which the wheels turn, although
# the wall holds the robot.
POSE = 0  # true pose: x, y, heading
TRUE_TWIST = 3
ODOM = 6  # pose by odometry
ODOM_TWIST = 9  # measured twist
PAST_COLUMNS = 12

BODY_COLUMNS = 7  # of `State.bodies`, see `lidar.exact_kernels`

# Rows of `Lanes.pose`, as `robot.kernels.run` takes them.
LANE_X = 0
LANE_Y = 1
LANE_COS = 2
LANE_SIN = 3
LANE_HEADING = 4  # unwrapped
LANE_PATH = 5  # upper bound on the length of the path in the period [m]
LANE_ROWS = 6

# Maximum number of touches that deflect a robot; with more, it may get stuck
MOST_TOUCHES = 512


Records = NDArray[Any]  # structured array
Record = Any  # element of `Records`; mypy does not know its fields

# How an obstacle moves
STILL = 0
PATROL = 1
PEDESTRIAN = 2


class ObstaclePlan:
    """Motion of an obstacle."""

    kind: int
    # range of the desired speed, which is drawn per episode [m/s]
    slowest: float
    fastest: float
    # patrol: its waypoints and their order
    first: int
    count: int
    loop: bool
    pause: float
    # pedestrian, see `world.Pedestrian`
    relaxation: float
    repulsion: float
    range: float
    wall_repulsion: float
    wall_range: float
    foresight: float
    cos_view: float  # cosine of half the field of view
    behind: float
    fluctuation: float


PLAN = structure_of(ObstaclePlan)


class ObstacleMark:
    """Memory of a moving obstacle."""

    speed: float  # desired in this episode [m/s]
    vx: float  # velocity in the last period [m/s]
    vy: float
    goal_x: float  # goal of a pedestrian [m]
    goal_y: float
    until: float  # step at which it abandons this goal
    index: int  # next waypoint of a patrol
    way: int  # 1 for forwards through the waypoints, -1 for backwards
    rest: float  # remaining waiting time [s]


MARK = structure_of(ObstacleMark)


class State(NamedTuple):
    """Everything that changes in a simulation; `FastSimulator.data`.

    A reset keeps the properties of each robot: faults, coefficient, delay, age and
    noise.
    """

    pose: Array  # (N, M, 3) true pose of `base_link` in `map`
    state: Array  # (N, M, S) true state of the robot's model
    history: Array  # (N, M, H, C) commands in effect, newest first
    # (N, K + M, BODY_COLUMNS) obstacles, then robots; columns as in `lidar.exact_kernels`
    bodies: Array
    odom: Array  # (N, M, 3) pose by odometry, which starts at the true pose and drifts
    twist: Array  # (N, M, 3) measured body twist
    ranges: Singles  # (N, M, B) scan, REP-117
    collided: NDArray[np.uint8]  # (N, M) 1 once a robot has touched something
    steps: Integers  # (N,) control periods since the reset
    seeds: Integers  # (N,) seed of the episode
    member: Integers  # (N,) member of the world set in which the episode takes place
    # (N, M, PARAMETERS) of each robot's lidar; columns as in `lidar.fault_kernels`
    faults: Array
    coefficient: Array  # (N, M, T) of each robot's terms, see `robot.kernels.Terms`
    delay: Integers  # (N, M) common latency of the commands [substeps], at most `longest_delay`
    age: Integers  # (N, M) age of scan and odometry [substeps], at most `longest_age`
    noise: Array  # (N, M, 2 + 3 + S) standard deviations, columns `ODOM_LINEAR` to `DRIFT_STATE`
    # (N, K, 3) velocity of the obstacles in `map` in this period [m/s, m/s, rad/s]
    velocity: Array
    past: Array  # (N, M, R, PAST_COLUMNS) ring buffer: the end of period i is in row i % R
    marks: Records  # (N, K) of `MARK`


class MapField(NamedTuple):
    """Distances from the centres of square cells to solid ones; empty without a map."""

    distances: Singles  # (rows, columns) [m]
    x: float  # outer corner of cell (0, 0) [m]
    y: float
    cos: float  # of the heading of the rows
    sin: float
    cell: float  # side of a cell [m]


NO_FIELD = MapField(np.zeros((0, 0), np.float32), 0.0, 0.0, 1.0, 0.0, 1.0)


class Surroundings(NamedTuple):
    """The static part of one world, and how its bodies are searched."""

    walls: Array  # (W, 4) x1, y1, x2, y2 [m]
    grid: MapField
    outlines: OutlineArrays
    crowded: bool  # True if all bodies are sorted into cells in each period
    standing: bool  # True if static obstacles are sorted by cell; none may then move
    plans: Records  # (K,) of `PLAN`, the motions of the obstacles
    waypoints: Array  # (Q, 2) of all patrols [m]
    bounds: Array  # (4,) minimum x, y and maximum x, y that obstacles stay in [m]


class WorldSetArrays(NamedTuple):
    """The surroundings of the P members of a world set, stacked.

    `step_kernels.get_surroundings` returns those of one world.
    """

    fixtures: Fixtures
    distances: Singles  # of all maps one after the other, see `MapField`
    map_places: Integers  # (P, 3) first distance, rows and columns of each map
    outlines: OutlineArrays
    crowded: bool  # `crowded`, `standing`: as in `Surroundings`
    standing: bool
    moves: bool  # True if an obstacle of any member moves
    plans: Records  # (P, K) of `PLAN`
    waypoints: Array  # (Q, 2) of all patrols of all members [m]
    bounds: Array  # (P, 4) as in `Surroundings`


class Dynamics(NamedTuple):
    """Kinematics of the robots."""

    terms: (
        Terms  # with the model's coefficients; each robot's are in `State.coefficient`
    )
    series: Array  # `robot.kernels.SERIES`
    dt: float  # length of a substep [s]
    substeps: int  # in a control period


class Lanes(NamedTuple):
    """Robots moved side by side, one per column; see `robot.kernels.run`."""

    pose: Array  # (LANE_ROWS, L) rows `LANE_X` to `LANE_PATH`
    x: Array  # (S + C + 1, L)
    dq: Array  # (3 + S, L)
    coefficient: Array  # (T, L)
    change: Integers  # (C, L) substep of the period at which each command changes


class RobotMotion:
    """Motion of a robot that may touch something, see `contact_kernels`."""

    # pose of the robot when its current twist began, and time in the interval [s]
    x: float
    y: float
    heading: float
    cos: float
    sin: float
    since: float
    # twist in the robot's frame [m/s, m/s, rad/s]; twist without contacts
    vx: float
    vy: float
    turn: float
    wish_x: float
    wish_y: float
    wish_turn: float
    bound: float  # bound on the speed of any of its points [m/s]
    safe_until: float  # time in the interval until which it cannot touch anything [s]
    room: float  # clearance that is certainly left when the interval ends [m]
    gap: float  # its latest clearance, negative where it overlaps [m]
    is_close: bool  # True if it may touch something before `safe_until`
    freedom: int  # what it may still do in this interval, see `contact_kernels`


MOTION = structure_of(RobotMotion)


class Touch:
    """A point of a robot that nearly touches something."""

    x: float  # nearest point of the robot [m]
    y: float
    nx: float  # unit vector from the touched object to it
    ny: float
    gap: float  # [m]
    other_speed: (
        float  # velocity of the touched object along the unit vector, 0 or less [m/s]
    )
    other: int  # body that it touches; -1 for a wall or the map


TOUCH = structure_of(Touch)


class Touches(NamedTuple):
    """Scratch memory of the touches of one robot."""

    touches: Records  # (T,) of `TOUCH`
    number: Integers  # (1,) number of listed touches
    square: Array  # (4, 2) corners of a cell of a map [m]


def allocate_touches() -> Touches:
    """Allocate memory for the touches of a robot."""
    touches = np.zeros(MOST_TOUCHES, TOUCH)
    return Touches(touches, np.zeros(1, np.int64), np.zeros((4, 2)))


class BodyCells(NamedTuple):
    """The bodies of N worlds, in G x G cells each. No rows: find all."""

    # (N, G^2 + 2) index in `then` of each cell's first body; bodies in no cell come
    # last
    first: ShortIntegers
    # (N, K) the bodies in the order of cells. One row if the bodies themselves are
    # sorted
    then: ShortIntegers
    ordered: bool  # True if the bodies themselves are sorted
    frame: Array  # (N, FRAME)
    found: ShortIntegers  # (K,) scratch for one thread: the bodies around a point


class Single(NamedTuple):
    """Scratch memory of one robot, see `robot.kernels.allocate_scratch`."""

    x: Array  # (S + C + 1,)
    dq: Array  # (3 + S,) rates


class ContactScratch(NamedTuple):
    """Scratch memory of the contacts in one world, see `contact_kernels`."""

    motions: Records  # (M,) of `MOTION`
    listed: Touches
    start: Array  # (K, 3) poses of the obstacles at the start of the period
    stops: Array  # (K,) time in the period at which each obstacle stops [s]
    fastest: Array  # (1,) speed of the fastest other body [m/s]
    near: Integers  # (M, 1 + SEVERAL) number and indices of the bodies near each robot
    may_touch: Integers  # (M,) flags of what each robot may touch in the period
    reach: Array  # (K + M,) maximum reach of each body from its current centre [m]
    speeds: Array  # (M, 2) velocity of the robots in `map` [m/s]


class Scans(NamedTuple):
    """Scratch memory of the scans."""

    start_poses: Array  # (L, 3) poses of the robots at the start of the period
    waiting: Integers  # (n,) worlds that are scanned together
    bodies: Array  # (K + M + 1, 7) bodies that one robot may see, at their past poses
    pose: Array  # (3,) pose from which one robot scans
    twist: Array  # (3,) twist of that robot during the sweep
    slice_poses: Array  # (G, 3) poses during a sweep
    slice_ranges: Singles  # (B,) scan from one of those poses
    everybody: ShortIntegers  # (K + M + 1,) indices of `bodies`
    scratch: ScanScratch


class Part(NamedTuple):
    """Everything that kernels need to step the worlds of one part."""

    data: State
    world_set: WorldSetArrays
    lidar: LidarArrays
    motion: Dynamics
    # scratch memory of the thread
    lanes: Lanes
    single: Single
    contact: ContactScratch
    cells: BodyCells  # cells of all worlds, with the thread's own list `found`
    scans: Scans
