"""Arming: the gate lets commands pass only after all of these checks."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from nics_drl_bridge.gate import stops
from nics_drl_bridge.gate.frozen import stands_still
from nics_drl_bridge.gate.inputs import Arm
from nics_drl_bridge.gate.state import Arrivals, GateConfig, GateState
from nics_drl_bridge.gate.stops import ODOM, SCAN
from nics_drl_bridge.interface import S_PER_NS

BEHIND_S = 0.2
"""Stamps may fall behind by this much while the gate settles, because they are irregular [s]."""
Check = Callable[[GateConfig, GateState, Arm, float], str]
"""Returns what is wrong; empty if nothing is."""


def _topic(config: GateConfig, state: GateState, topic: str) -> tuple[Arrivals, float, float]:
    """Returns a topic's arrivals, greatest age [s] and declared rate [Hz]."""
    if topic == SCAN:
        return state.scans, config.scan_age_s, config.scan_rate
    return state.odometries, config.odom_age_s, config.odom_rate


def _fresh(topic: str, config: GateConfig, state: GateState, request: Arm, now: float) -> str:
    arrivals, age_s, _ = _topic(config, state, topic)
    fresh = stops.gap_free(arrivals, now, config.settle_s, age_s)
    return "" if fresh else f"{topic} has not been fresh for {config.settle_s} s"


def _sensors(config: GateConfig, state: GateState, request: Arm, now: float) -> str:
    """All further sensors are fresh."""
    both = zip(config.sensors, state.sensors, strict=True)
    for name, sensor in both:
        if not stops.gap_free(sensor.arrivals, now, config.settle_s, config.scan_age_s):
            return f"{name} has not been fresh for {config.settle_s} s"
    return ""


def _rate(topic: str, config: GateConfig, state: GateState, request: Arm, now: float) -> str:
    """Judges a rate: by stamps too few and too many data are wrong, by arrival only too few."""
    arrivals, _, declared = _topic(config, state, topic)
    arriving, stamped = stops.rate(arrivals, now, config.settle_s)
    low = declared * (1.0 - config.rate_tolerance)
    high = declared * (1.0 + config.rate_tolerance)
    if arriving >= low and low <= stamped <= high:
        return ""
    return (
        f"{topic} comes at {arriving:.1f} Hz, by its stamps {stamped:.1f} Hz, declared are "
        f"{declared:.1f} Hz"
    )


def _clocks(config: GateConfig, state: GateState, request: Arm, now: float) -> str:
    """The clocks that stamp scan and odometry agree, and keep pace with this machine's clock."""
    scans, odometries = state.scans, state.odometries
    if not (scans.times and odometries.times):
        return "scan and odom have not both come"
    stamped = (scans.stamps_ns[-1] - odometries.stamps_ns[-1]) * S_PER_NS / config.clock_rate
    apart = stamped - (scans.times[-1] - odometries.times[-1])
    if abs(apart) > config.clock_jump_s:
        return f"the stamps of scan are {apart:.3f} s ahead of those of odom"
    for topic, arrivals in ((SCAN, scans), (ODOM, odometries)):
        ahead = stops.creep(arrivals)
        behind = 0.0 if config.simulated else -ahead
        if ahead > stops.AHEAD_S or behind > BEHIND_S:
            return (
                f"the stamps of {topic} run away from this machine's clock, by {ahead:+.3f} s in a "
                "moment; a simulation that is not in real time needs the parameter 'clock_rate'"
            )
    return ""


def _estimator(config: GateConfig, state: GateState, request: Arm, now: float) -> str:
    """The middleware knows where the robot is, and that it stands still."""
    if not config.estimate_required:
        return ""
    if state.estimate is None or now - state.estimate_s > config.estimate_silence_s:
        return "odometry/filtered is silent, start the middleware_node"
    if state.estimate.std.max() > config.estimate_std:
        worst = float(state.estimate.std.max())
        return f"odometry/filtered is uncertain by {worst:.2f}, the limit is {config.estimate_std}"
    return "" if stands_still(config, state.estimate.twist) else "odometry/filtered shows motion"


def _publishers(config: GateConfig, state: GateState, request: Arm, now: float) -> str:
    count = request.publishers
    return "" if count == 1 else f"cmd_vel has {count} publishers, not this gate alone"


def _standing(config: GateConfig, state: GateState, request: Arm, now: float) -> str:
    still = state.odometry is not None and now - state.restless_s >= config.settle_s
    return "" if still else f"the robot has not stood still for {config.settle_s} s"


def _limits(config: GateConfig, state: GateState, request: Arm, now: float) -> str:
    return "" if config.limits is not None else "no limits are set, name their file in `limits`"


def _e_stop(config: GateConfig, state: GateState, request: Arm, now: float) -> str:
    cause = stops.e_stop_pressed(config, state, now) or stops.e_stop_silent(config, state, now)
    return "" if cause is None else cause.line


def _latched(config: GateConfig, state: GateState, request: Arm, now: float) -> str:
    return "" if state.latched is None else f"call ~/reset first: {state.latched.line}"


CHECKS: tuple[tuple[str, Check], ...] = (
    ("limits_set", _limits),
    ("nothing_latched", _latched),
    ("e_stop_released", _e_stop),
    ("scan_fresh", partial(_fresh, SCAN)),
    ("scan_rate", partial(_rate, SCAN)),
    ("sensors_fresh", _sensors),
    ("odom_fresh", partial(_fresh, ODOM)),
    ("odom_rate", partial(_rate, ODOM)),
    ("clocks_agree", _clocks),
    ("estimator_converged", _estimator),
    ("one_publisher", _publishers),
    ("standing_still", _standing),
)


def failures(config: GateConfig, state: GateState, request: Arm, now: float) -> list[str]:
    """Returns a sentence for each failed check, with the check's name in front."""
    answers = ((name, check(config, state, request, now)) for name, check in CHECKS)
    return [f"{name}: {answer}" for name, answer in answers if answer]
