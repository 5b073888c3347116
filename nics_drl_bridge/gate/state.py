"""Configuration, state and decisions of the gate: frozen records, and `replace` for copies."""

import math
from dataclasses import dataclass, field
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.gate.inputs import Command, Estimate, Odometry, Scan
from nics_drl_bridge.gate.limits import Limits
from nics_drl_bridge.geometry import Bicycle
from nics_drl_bridge.interface import Array
from nics_drl_bridge.robot.braking import NO_DRIFT, Drift, TurnBraking

Ranges = NDArray[np.float32]
Record = TypeVar("Record")
INF = float("inf")
NAN = float("nan")
NO_NOISE = (0.0, 0.0)  # of a lidar's ranges


def replace(record: Record, **changes: Any) -> Record:
    """Copies a frozen record without slots with changes, faster than `dataclasses.replace`."""
    values = vars(record)
    if not changes.keys() <= values.keys():
        raise TypeError(
            f"{type(record).__name__} has no {sorted(changes.keys() - values.keys())}"
        )
    copy = object.__new__(type(record))
    vars(copy).update(values, **changes)
    return copy


@dataclass(frozen=True)
class ShieldConfig:
    """Stopping behaviour of the robot, and the clearance it keeps."""

    latency_s: float  # time from a command until the robot follows it, including lags
    deceleration: float  # deceleration of the braking [m/s^2]
    margin: float  # clearance kept around the footprint [m]
    hold_s: float  # longest time until the next decision
    footprint_radius: float  # of the circle around the robot [m]
    # of a car, which is commanded by steering angle [m]; 0 for others
    wheelbase: float = 0.0
    # of moving obstacles that approach [m/s]; 0: all are static
    obstacle_speed: float = field(kw_only=True)
    range_max: float = INF  # of the lidar [m]
    # standard deviation, in metres and as a fraction of the range
    range_noise: tuple[float, float] = NO_NOISE
    # fraction of unknown beams from which a direction counts as blocked
    unknown_share: float = 0.5
    unknown_width: float = 0.35  # angle over which that fraction is taken [rad]
    # Corners of the footprint in `base_link`, in order [m]; none of a robot that is a circle.
    outline: tuple[tuple[float, float], ...] = ()
    lever: float = 0.0  # factor by which a turn rate adds to the speed to brake [m]
    order: float = 2.0  # of the norm of forward and sideways speed, see `Braking.order`
    drift: Drift = NO_DRIFT  # deviation from its arc while it brakes; unused for a car
    turn: TurnBraking | None = (
        None  # of a robot whose turn brakes independently of its speed
    )


@dataclass(frozen=True)
class GateConfig:
    """Fixed configuration of a gate."""

    # (C,) index of each command in linear.x, linear.y, angular.z. For a car that takes turn rates,
    # angular.z is the turn rate of a `bicycle` at its steering angle.
    fields: tuple[int, ...]
    limits: Limits | None  # of the commands; None: no command passes
    beam_angles: Array  # (B,) of the lidar [rad]
    # of the lidar in `base_link`: x [m], y [m], heading [rad]
    mount: tuple[float, float, float]
    range_min: float  # of the lidar [m]
    scan_rate: float  # declared [Hz]
    odom_rate: float  # declared [Hz]
    # False: it is the minimum that the model needs, and may be exceeded
    odom_rate_declared: bool = True
    range_max: float = 0.0  # of the lidar [m]; 0 if unknown
    # maximum age of the newest scan, and of the scan behind a command
    scan_age_s: float = 0.30
    odom_age_s: float = 0.30  # maximum age of the newest odometry
    command_age_s: float = 0.30  # maximum age of the newest command
    race_s: float = 0.05  # time by which a command may overtake its scan
    # time for which data must be fresh and the robot at rest before arming
    settle_s: float = 1.0
    rate_tolerance: float = 0.3  # relative deviation of a rate from the declared one
    # A stamp this far back, or before arming this far ahead, is a jump; if armed, see `AHEAD_S`.
    clock_jump_s: float = 0.5
    # rate of the stamps [s/s]; differs from 1 only in a simulation that is not in real
    # time
    clock_rate: float = 1.0
    # stamps come from a simulator, which may fall behind real time
    simulated: bool = False
    # longest time between two ticks, and length of the stop after a longer one
    gap_s: float = 0.2
    e_stop_required: bool = True  # an e-stop that was never heard counts as pressed
    e_stop_silence_s: float = 0.25  # silence after which the e-stop counts as pressed
    estimate_required: bool = True  # arming needs an estimator that has converged
    # Maximum standard deviation that the estimate may gain within some seconds, see
    # `estimate`.
    estimate_position: float = 0.5  # [m]
    estimate_heading: float = 0.3  # [rad]
    estimate_silence_s: float = 0.5  # maximum age of the estimate for this check
    # path or turn over which identical scans count as frozen [m or rad]
    frozen_distance: float = 0.2
    stuck_s: float = 1.0  # time without motion while commanded that causes a stop
    # stop when scans show none of the motion that odometry shows
    stop_when_held: bool = True
    odom_std: tuple[float, float] = (0.0, 0.0)  # of odometry's twist [m/s, rad/s]
    # standard deviation, in metres and as a fraction of the range
    range_noise: tuple[float, float] = NO_NOISE
    shield: ShieldConfig | None = None
    sensors: tuple[str, ...] = ()  # additional ones, which must be as fresh as the scan
    bicycle: Bicycle | None = None

    def command(self, twist: Array) -> Array:
        """Returns the command (C,) of a `cmd_vel` (3,)."""
        if self.bicycle is not None:
            speed, angle = self.bicycle.command(twist)
            twist = np.array([speed, twist[1], angle])
        return np.asarray(twist[list(self.fields)], dtype=np.float64)

    def cmd_vel(self, command: Array) -> Array:
        """Returns the `cmd_vel` (3,) of a command (C,)."""
        twist = np.zeros(3)
        twist[list(self.fields)] = command
        return twist if self.bicycle is None else self.bicycle.twist(twist[0], twist[2])


@dataclass(frozen=True)
class Cause:
    """Cause of a stop."""

    rule: str
    topic: str  # topic of the cause; empty for the gate itself
    detail: str
    age_s: float = float("nan")  # age of data that are too old, otherwise NaN
    limit_s: float = float("nan")

    @property
    def line(self) -> str:
        """One line for a log."""
        words = [f"{self.rule}:"]
        if self.topic:
            words.append(f"topic={self.topic}")
        if not math.isnan(self.limit_s):
            words.append(f"age={self.age_s:.3f}s limit={self.limit_s:.3f}s")
        return " ".join([*words, self.detail])


Mark = tuple[float, int, int, float]
"""Arrival [s], stamp [ns] and number of a datum, and the maximum lead until the next mark [s]."""


@dataclass(frozen=True)
class Arrivals:
    """Arrivals of a topic's data, oldest first; lead: a stamp's advance over the steady clock."""

    stamps_ns: tuple[int, ...] = ()  # of the latest headers
    times: tuple[float, ...] = ()  # their arrivals on the steady clock [s]
    late: tuple[float, ...] = ()  # their delays beyond the minimum possible one [s]
    origin: tuple[int, float] = (0, 0.0)  # stamp [ns] and arrival [s] of the first
    count: int = 0  # number of data since the first
    envelope: float = 0.0  # lead of the fastest data [s]
    unbroken_s: float = INF  # start of the time without a gap that is too long
    marks: tuple[Mark, ...] = ()  # taken at intervals, as far back as arming requires


@dataclass(frozen=True)
class Sameness:
    """A scan that the lidar has repeated, and where the robot first saw it."""

    ranges: Ranges  # (B,) of the first scan that showed it [m]
    count: int  # number of scans that showed it
    # (3,) odometry pose at the first; None if there was no odometry yet
    first: Array | None


@dataclass(frozen=True)
class View:
    """A scan, and the pose it was taken from."""

    stamp_ns: int  # of its header
    pose: Array  # (3,) of the robot at that time, by odometry
    ranges: Ranges  # (B,) [m], REP-117


@dataclass(frozen=True)
class EstimateMark:
    """An earlier estimate, relative to which uncertainty is measured."""

    time_s: float  # of its arrival
    pose: Array  # (3,) in `map`
    covariance: Array  # (3, 3) of that pose


@dataclass(frozen=True)
class EstimateTrack:
    """Recent estimates, and whether the newest continues them."""

    # recent ones, oldest first; the first is the origin
    marks: tuple[EstimateMark, ...] = ()
    # why the newest estimate does not continue them; if set, it is the new origin
    fault: str = ""
    last_fault: str = ""  # the newest such reason


@dataclass(frozen=True)
class ScanMotion:
    """Recent scans, and how much of the motion by odometry they show."""

    # recent ones, oldest first, with ranges (K,): medians around few directions [m]; NaN where few
    # beams return
    views: tuple[View, ...] = ()
    # stamp of the first scan that contradicts odometry
    held_since_ns: int | None = None
    held: str = ""  # what the newest scan contradicts, once earlier ones did too
    # fraction of the motion by odometry that the newest scan shows; NaN: undecided
    share: float = NAN
    push_s: float | None = None  # start of the push that was judged; None without one


@dataclass(frozen=True)
class Ground:
    """Ground around a robot whose lidar does not cover the full circle."""

    since_ns: int  # stamp from which times count
    # cells from the origin of odometry to the first: along x, along y
    corner: tuple[int, int]
    # (n, n), rows along y: when a cell was last known to be free [s]; -inf: unknown
    times: Ranges
    unseen: Array  # (Q, 2) centres of the cells at the border of known ground, in `base_link` [m]


@dataclass(frozen=True)
class Push:
    """Motion commanded without a pause."""

    since_s: float  # start
    last_s: float  # last integration
    moving_s: float  # last time that motion was commanded
    # (3,) integral of the commanded twists [m, m, rad]; back and forth cancel out
    commanded: Array
    # Times [s], `commanded` at those times, and poses (3,) by odometry, oldest first.
    marks: tuple[tuple[float, Array, Array], ...] = ()


@dataclass(frozen=True)
class EStopState:
    """Known state of the emergency stop."""

    latched: bool = False  # pressed and not reset since
    held: bool = False  # its topic last reported it as pressed
    # time of the last message on its topic; None if there was none
    heard_s: float | None = None
    reason: str = ""  # why a press may have been missed; empty if it was heard


@dataclass(frozen=True)
class SensorState:
    """Known state of an additional sensor."""

    arrivals: Arrivals = Arrivals()  # of its accepted readings
    # (Q, 2) of the newest
    points: Array = field(default_factory=lambda: np.zeros((0, 2)))


@dataclass(frozen=True)
class GateState:
    """Memory of the gate. It starts disarmed."""

    value: Array  # (C,) last published command
    slope: Array  # (C,) its change per second
    published_s: float = -INF  # time of that publication
    shielded: bool = False  # the shield reduced it
    now_s: float = -INF  # latest time of any input
    tick_s: float | None = None  # of the last tick
    awake_s: float = -INF  # of the last wake-up after a gap in the ticks
    still_ticks: int = 0  # consecutive inputs at which the clock did not advance
    clock_fault: str = ""  # at this input
    armed: bool = False  # commands pass
    latched: Cause | None = None  # the stop that only a reset clears
    scans: Arrivals = Arrivals()  # of accepted data
    odometries: Arrivals = Arrivals()
    jumped: str = ""  # the topic whose stamps have just jumped, or run ahead
    leap: str = ""  # what is wrong with the newest odometry pose
    sensors: tuple[SensorState, ...] = ()  # in the order of the configuration
    scan: Scan | None = None  # the newest accepted one, as in the next three
    odometry: Odometry | None = None
    estimate: Estimate | None = None
    command: Command | None = None
    estimate_s: float = -INF  # arrivals of these
    estimates: EstimateTrack = EstimateTrack()
    command_s: float = -INF
    pending: Command | None = None  # whose scan has not arrived yet
    # since when commands refer to such scans; None: the newest does not
    pending_s: float | None = None
    pending_arrival_s: float = -INF  # arrival of the pending command
    # recent ones, for the detection of motion; empty without shield
    views: tuple[View, ...] = ()
    # None if the lidar covers the full circle, or without shield
    ground: Ground | None = None
    # (P, 3) in the newest scan: x, y in `base_link` [m], and maximum speed of each
    # [m/s].
    obstacles: Array | None = None
    # arrival of the scan behind the newest command, minus its delay
    behind_s: float = -INF
    malformed: str = ""  # what is wrong with the newest command
    source: str = ""  # the publisher of the newest command that named one
    source_s: float = -INF  # its arrival
    mixed: str = ""  # at this input: two publishers command the robot alternately
    last_mixed: str = ""  # the newest such sentence
    mixed_s: float = -INF  # its time
    seen: tuple[Sameness, ...] = ()  # pictures that the lidar has shown, newest last
    frozen: str = ""  # why the newest scan counts as frozen
    scan_motion: ScanMotion = ScanMotion()
    restless_s: float = -INF  # last time that odometry showed motion
    push: Push | None = None  # recent commanded motion; None if the robot was stopped
    # Times and values of the commands that the newest scan may not show yet.
    recent: tuple[tuple[float, Array], ...] = ()
    e_stop: EStopState = EStopState()


def begin(config: GateConfig) -> GateState:
    """Returns the state of a gate that has no data yet."""
    size = len(config.fields)
    sensors = tuple(SensorState() for _ in config.sensors)
    return GateState(value=np.zeros(size), slope=np.zeros(size), sensors=sensors)


@dataclass(frozen=True)
class Motion:
    """A command on its way through the gate."""

    value: Array  # (C,)
    slope: Array  # (C,) its change per second
    shielded: bool = False  # the shield reduced it
    fault: str = ""  # why it must not be published


@dataclass(frozen=True)
class Decision:
    """Response of the gate to an input."""

    twist: Array  # (3,) for `cmd_vel`
    publish: bool  # now
    cause: Cause | None  # of the stop; None when commands pass
    refused: str = ""  # why the input was not used
    answer: str = ""  # to Arm and Reset
    granted: bool = False  # that request
    shielded: bool = False  # the shield reduced the command
