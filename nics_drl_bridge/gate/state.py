"""What the gate knows, what it was told once, and what it says."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.gate.inputs import Command, Estimate, Odometry, Scan
from nics_drl_bridge.gate.limits import Limits

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ShieldConfig:
    """How the robot stops, measured, and how much room it is to keep.

    Attributes:
        latency_s: from a command until the robot has taken it up, lags included [s].
        deceleration: with which it then brakes [m/s^2].
        margin: kept free around the footprint [m].
        hold_s: until the next decision at the latest [s].
        footprint_radius: of the robot [m].
        wheelbase: of a car, whose command holds a steering angle [m]; 0 for the others.
        obstacle_speed: at which what was seen to move may come on [m/s]; 0 to take all to stand.
        range_max: of the lidar [m].
        range_noise: standard deviation of its ranges, in metres and in parts of the range.
        unknown_share: of unknown beams in a direction, from which on it counts as blocked.
        unknown_width: over which that share is taken [rad].
    """

    latency_s: float
    deceleration: float
    margin: float
    hold_s: float
    footprint_radius: float
    wheelbase: float = 0.0
    obstacle_speed: float = 0.0
    range_max: float = float("inf")
    range_noise: tuple[float, float] = (0.0, 0.0)
    unknown_share: float = 0.5
    unknown_width: float = 0.35


@dataclass(frozen=True)
class GateConfig:
    """What a gate is told when it starts.

    Attributes:
        fields: (C,) place of each command in linear.x, linear.y, angular.z of `cmd_vel`.
        limits: of the commands; None lets nothing pass.
        beam_angles: (B,) of the lidar [rad].
        mount: (3,) x [m], y [m], heading [rad] of the lidar in `base_link`.
        range_min: of the lidar [m].
        scan_rate, odom_rate: as declared [Hz].
        range_max: of the lidar [m]; 0 when it is not known.
        scan_age_s: of the newest scan, and of the scan behind a command, at most [s].
        odom_age_s: of the newest odometry, at most [s].
        command_age_s: of the newest command, at most [s].
        race_s: by how much a command may overtake its scan on the way here [s].
        settle_s: how long data must be fresh and the robot stand still before it is armed [s].
        rate_tolerance: share by which a rate may differ from the declared one.
        clock_jump_s: a stamp this far back, or before arming this far ahead, is a jump [s]; for
            one armed see `freshness`.
        clock_rate: seconds of the stamps' clock per second of the steady one; not 1 only in a
            simulation that does not run in real time.
        simulated: whether the stamps are those of a simulator, which may fall behind real time.
        gap_s: the longest time between two ticks, and how long it stops after a longer one [s].
        e_stop_required: whether an emergency stop that was never heard counts as pressed; one that
            was heard and falls silent always does.
        e_stop_silence_s: such a silence [s].
        estimate_required: whether arming needs an estimator that has converged.
        estimate_std: greatest standard deviation of position [m] and heading [rad] for that.
        estimate_silence_s: greatest age of the estimate for that [s].
        frozen_distance: identical scans over such a path are frozen [m, or rad of turning].
        stuck_s: no motion within such a time while commanded is a stop [s].
        odom_std: noise of a twist by odometry, linear [m/s] and angular [rad/s].
        shield: see there; None for none.
    """

    fields: tuple[int, ...]
    limits: Limits | None
    beam_angles: Array
    mount: tuple[float, float, float]
    range_min: float
    scan_rate: float
    odom_rate: float
    range_max: float = 0.0
    scan_age_s: float = 0.30
    odom_age_s: float = 0.30
    command_age_s: float = 0.30
    race_s: float = 0.05
    settle_s: float = 1.0
    rate_tolerance: float = 0.3
    clock_jump_s: float = 0.5
    clock_rate: float = 1.0
    simulated: bool = False
    gap_s: float = 0.2
    e_stop_required: bool = True
    e_stop_silence_s: float = 0.25
    estimate_required: bool = True
    estimate_std: float = 0.5
    estimate_silence_s: float = 0.5
    frozen_distance: float = 0.2
    stuck_s: float = 1.0
    odom_std: tuple[float, float] = (0.0, 0.0)
    shield: ShieldConfig | None = None


@dataclass(frozen=True)
class Cause:
    """Why the gate stops.

    Attributes:
        rule: its name.
        topic: that it is about; empty for the gate itself.
        detail: what is wrong.
        age_s, limit_s: of data that are too old, else NaN [s].
    """

    rule: str
    topic: str
    detail: str
    age_s: float = float("nan")
    limit_s: float = float("nan")

    @property
    def line(self) -> str:
        """One line for a log."""
        topic = f" topic={self.topic}" if self.topic else ""
        old = self.limit_s == self.limit_s
        age = f" age={self.age_s:.3f}s limit={self.limit_s:.3f}s" if old else ""
        return f"{self.rule}:{topic}{age} {self.detail}"


Mark = tuple[float, int, int, float]
"""Arrival [s], stamp [ns] and number of a datum, and the greatest lead until the next mark [s]."""


@dataclass(frozen=True)
class Arrivals:
    """When the data of a topic arrived, oldest first.

    The lead of a datum is how far its stamp is ahead of the steady clock, counted from the first
    datum: the offset of two clocks, less the time that it took to get here.

    Attributes:
        stamps_ns: of the headers of the last ones [ns].
        times: of those on the steady clock [s].
        late: by how much each of those came later than it could have [s].
        origin: stamp [ns] and arrival [s] of the first.
        count: of all since the first.
        envelope: the lead of data that come as fast as they can [s].
        unbroken_s: since when there was no gap that is too long [s].
        marks: one in a while, as far back as arming asks.
    """

    stamps_ns: tuple[int, ...] = ()
    times: tuple[float, ...] = ()
    late: tuple[float, ...] = ()
    origin: tuple[int, float] = (0, 0.0)
    count: int = 0
    envelope: float = 0.0
    unbroken_s: float = float("inf")
    marks: tuple[Mark, ...] = ()


@dataclass(frozen=True)
class Sameness:
    """A picture that the lidar has shown, and how far the robot moved while it stayed the same.

    Attributes:
        ranges: (B,) of the scan that showed it first [m].
        count: of scans that showed it.
        first: (3,) pose by odometry when it was seen first; None when there was no odometry yet.
    """

    ranges: NDArray[np.float32]
    count: int
    first: Array | None


@dataclass(frozen=True)
class View:
    """A scan, and from where it was made.

    Attributes:
        stamp_ns: of its header [ns].
        pose: (3,) of the robot then, by odometry.
        ranges: (B,) [m], REP-117.
    """

    stamp_ns: int
    pose: Array
    ranges: NDArray[np.float32]


@dataclass(frozen=True)
class Push:
    """What the robot was told without a pause.

    Attributes:
        since_s, last_s, moving_s: when it began, when it was summed up last, and when the robot
            was last told to move [s].
        told: (3,) the way that it was told, the sum of its body twists x time [m, m, rad]; what
            goes there and back again adds up to nothing.
        marks: times [s], `told` then, and poses (3,) by odometry, oldest first.
    """

    since_s: float
    last_s: float
    moving_s: float
    told: Array
    marks: tuple[tuple[float, Array, Array], ...] = ()


@dataclass(frozen=True)
class EStopState:
    """What is known of the emergency stop.

    Attributes:
        latched: it was pressed, and not reset since.
        held: it is pressed now, by what its topic said last.
        heard_s: when its topic spoke last [s]; None when it never did.
    """

    latched: bool = False
    held: bool = False
    heard_s: float | None = None


@dataclass(frozen=True)
class GateState:
    """All that the gate remembers. It starts disarmed.

    Attributes:
        value: (C,) command published last.
        slope: (C,) its change per second.
        moved_s: when it was published [s].
        now_s: greatest time seen [s].
        tick_s: time of the last tick [s].
        awake_s: when it last went on after it had been asleep [s].
        still_ticks: inputs in a row at which the clock stood still.
        clock_fault: what is wrong with the clock at this input.
        armed: whether commands pass.
        latched: the stop that only a reset clears.
        scans, odometries: arrivals of accepted data.
        jumped: the topic whose stamps have just jumped, or ran ahead.
        leap: what is wrong with the newest pose by odometry; empty when nothing is.
        scan, odometry, estimate, command: the newest accepted of each.
        estimate_s, command_s: when those arrived [s].
        pending: a command whose scan has not arrived here yet.
        pending_s: since when commands have named such scans [s]; None when the newest does not.
        views: of the last moments, for what moves; empty without shield.
        obstacles: (P, 3) what the newest scan shows: x, y in `base_link` [m], and how fast each
            may move [m/s].
        behind_s: when the scan behind the newest command was as new as can be [s].
        malformed: what is wrong with the newest command; empty when nothing is.
        seen: what the lidar has shown last, the newest last.
        frozen: why the newest scan is no new one; empty when it is.
        restless_s: when odometry last showed motion [s].
        push: what the robot was told lately; None when it was stopped.
        recent: times and values of the commands that the newest scan may not show yet.
        e_stop: see there.
    """

    value: Array
    slope: Array
    moved_s: float = float("-inf")
    now_s: float = float("-inf")
    tick_s: float | None = None
    awake_s: float = float("-inf")
    still_ticks: int = 0
    clock_fault: str = ""
    armed: bool = False
    latched: Cause | None = None
    scans: Arrivals = Arrivals()
    odometries: Arrivals = Arrivals()
    jumped: str = ""
    leap: str = ""
    scan: Scan | None = None
    odometry: Odometry | None = None
    estimate: Estimate | None = None
    command: Command | None = None
    estimate_s: float = float("-inf")
    command_s: float = float("-inf")
    pending: Command | None = None
    pending_s: float | None = None
    views: tuple[View, ...] = ()
    obstacles: Array | None = None
    behind_s: float = float("-inf")
    malformed: str = ""
    seen: tuple[Sameness, ...] = ()
    frozen: str = ""
    restless_s: float = float("-inf")
    push: Push | None = None
    recent: tuple[tuple[float, Array], ...] = ()
    e_stop: EStopState = EStopState()


def begin(config: GateConfig) -> GateState:
    """The state of a gate that knows nothing."""
    size = len(config.fields)
    return GateState(value=np.zeros(size), slope=np.zeros(size))


@dataclass(frozen=True)
class Decision:
    """What the gate does after an input.

    Attributes:
        twist: (3,) of `cmd_vel`.
        publish: whether to publish it now.
        cause: of the stop; None when commands pass.
        refused: why the input was not used; empty when it was.
        answer: to Arm and Reset.
        granted: whether they got what they asked for.
        shielded: whether the shield cut the command down.
    """

    twist: Array
    publish: bool
    cause: Cause | None
    refused: str = ""
    answer: str = ""
    granted: bool = False
    shielded: bool = False
