"""Configuration, state and decisions of the gate."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.gate.inputs import Command, Estimate, Odometry, Scan
from nics_drl_bridge.gate.limits import Limits

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ShieldConfig:
    """Stopping behaviour of the robot, and the clearance it keeps.

    Attributes:
        latency_s: time from a command until the robot follows it, lags included [s].
        deceleration: of the braking that follows [m/s^2].
        margin: clearance kept around the footprint [m].
        hold_s: longest time until the next decision [s].
        footprint_radius: of the robot [m].
        wheelbase: of a car, which is commanded by steering angle [m]; 0 for others.
        obstacle_speed: at which moving obstacles may approach [m/s]; 0 treats all as static.
        range_max: of the lidar [m].
        range_noise: standard deviation of its ranges, in metres and as a share of the range.
        unknown_share: share of unknown beams from which a direction counts as blocked.
        unknown_width: angle over which that share is taken [rad].
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
    """Fixed configuration of a gate.

    Attributes:
        fields: (C,) index of each command in linear.x, linear.y, angular.z of `cmd_vel`.
        limits: of the commands; None lets nothing pass.
        beam_angles: (B,) of the lidar [rad].
        mount: (3,) pose of the lidar in `base_link`: x [m], y [m], heading [rad].
        range_min: of the lidar [m].
        scan_rate, odom_rate: declared rates [Hz].
        range_max: of the lidar [m]; 0 if unknown.
        scan_age_s: greatest age of the newest scan, and of the scan behind a command [s].
        odom_age_s: greatest age of the newest odometry [s].
        command_age_s: greatest age of the newest command [s].
        race_s: time by which a command may overtake its scan [s].
        settle_s: time for which data must be fresh and the robot at rest before arming [s].
        rate_tolerance: relative deviation of a rate from the declared one.
        clock_jump_s: a stamp this far back, or before arming this far ahead, is a jump [s]; for an
            armed gate see `freshness`.
        clock_rate: seconds of the stamps' clock per steady second; not 1 only in a simulation that
            does not run in real time.
        simulated: whether the stamps are those of a simulator, which may fall behind real time.
        gap_s: longest time between two ticks, and duration of the stop after a longer one [s].
        e_stop_required: whether an emergency stop that was never heard counts as pressed; one that
            was heard and falls silent always does.
        e_stop_silence_s: silence after which it counts as pressed [s].
        estimate_required: whether arming needs an estimator that has converged.
        estimate_std: greatest standard deviation of position [m] and heading [rad] for that.
        estimate_silence_s: greatest age of the estimate for that [s].
        frozen_distance: path over which identical scans are frozen [m, or rad of turning].
        stuck_s: time without motion while commanded that causes a stop [s].
        odom_std: noise of the odometry's twist, linear [m/s] and angular [rad/s].
        shield: see `ShieldConfig`; None for no shield.
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
    """Cause of a stop.

    Attributes:
        rule: name of the rule.
        topic: topic concerned; empty for the gate itself.
        detail: what is wrong.
        age_s, limit_s: of data that are too old, otherwise NaN [s].
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
    """Arrivals of the data of a topic, oldest first.

    The lead of a datum is how far its stamp is ahead of the steady clock, counted from the first
    datum: the offset of the two clocks minus the time the datum took to arrive.

    Attributes:
        stamps_ns: of the latest headers [ns].
        times: their arrivals on the steady clock [s].
        late: their delays beyond the least possible one [s].
        origin: stamp [ns] and arrival [s] of the first.
        count: number of data since the first.
        envelope: lead of the fastest data [s].
        unbroken_s: time since which no gap was too long [s].
        marks: taken at intervals, as far back as arming needs.
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
    """A picture that the lidar has shown, and where the robot first saw it.

    Attributes:
        ranges: (B,) of the first scan that showed it [m].
        count: number of scans that showed it.
        first: (3,) odometry pose when it was first seen; None if there was no odometry yet.
    """

    ranges: NDArray[np.float32]
    count: int
    first: Array | None


@dataclass(frozen=True)
class View:
    """A scan, and the pose it was taken from.

    Attributes:
        stamp_ns: time stamp of its header [ns].
        pose: (3,) of the robot at that time, by odometry.
        ranges: (B,) [m], REP-117.
    """

    stamp_ns: int
    pose: Array
    ranges: NDArray[np.float32]


@dataclass(frozen=True)
class Push:
    """Motion commanded without a pause.

    Attributes:
        since_s, last_s, moving_s: its start, its last integration, and the last time that motion
            was commanded [s].
        told: (3,) commanded motion, the sum of its body twists x time [m, m, rad]; there and back
            again cancels out.
        marks: times [s], `told` at those times, and poses (3,) by odometry, oldest first.
    """

    since_s: float
    last_s: float
    moving_s: float
    told: Array
    marks: tuple[tuple[float, Array, Array], ...] = ()


@dataclass(frozen=True)
class EStopState:
    """Known state of the emergency stop.

    Attributes:
        latched: it was pressed, and not reset since.
        held: its topic last reported it as pressed.
        heard_s: time of the last message on its topic [s]; None if there was none.
    """

    latched: bool = False
    held: bool = False
    heard_s: float | None = None


@dataclass(frozen=True)
class GateState:
    """Memory of the gate. It starts disarmed.

    Attributes:
        value: (C,) last published command.
        slope: (C,) its change per second.
        moved_s: time of that publication [s].
        now_s: greatest time seen [s].
        tick_s: time of the last tick [s].
        awake_s: time of the last wake-up after a gap in the ticks [s].
        still_ticks: inputs in a row at which the clock stood still.
        clock_fault: what is wrong with the clock at this input.
        armed: whether commands pass.
        latched: the stop that only a reset clears.
        scans, odometries: arrivals of accepted data.
        jumped: the topic whose stamps have just jumped, or run ahead.
        leap: what is wrong with the newest odometry pose; empty if nothing is.
        scan, odometry, estimate, command: the newest accepted one of each.
        estimate_s, command_s: their arrivals [s].
        pending: a command whose scan has not arrived yet.
        pending_s: time since which commands have named such scans [s]; None if the newest does not.
        views: recent views, for the detection of motion; empty without shield.
        obstacles: (P, 3) obstacles in the newest scan: x, y in `base_link` [m], and greatest speed
            of each [m/s].
        behind_s: arrival of the scan behind the newest command, less its delay [s].
        malformed: what is wrong with the newest command; empty if nothing is.
        seen: pictures that the lidar has shown, newest last.
        frozen: why the newest scan is an old one; empty if it is not.
        restless_s: last time that odometry showed motion [s].
        push: recent commanded motion; None if the robot was stopped.
        recent: times and values of the commands that the newest scan may not show yet.
        e_stop: see `EStopState`.
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
    """Returns the state of a gate that has no data yet."""
    size = len(config.fields)
    return GateState(value=np.zeros(size), slope=np.zeros(size))


@dataclass(frozen=True)
class Decision:
    """Response of the gate to an input.

    Attributes:
        twist: (3,) for `cmd_vel`.
        publish: whether to publish it now.
        cause: of the stop; None when commands pass.
        refused: why the input was not used; empty if it was.
        answer: reply to Arm and Reset.
        granted: whether these requests were granted.
        shielded: whether the shield reduced the command.
    """

    twist: Array
    publish: bool
    cause: Cause | None
    refused: str = ""
    answer: str = ""
    granted: bool = False
    shielded: bool = False
