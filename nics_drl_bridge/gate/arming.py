"""Arming: the gate lets commands pass only after all of these checks."""

from __future__ import annotations

from collections.abc import Callable

from nics_drl_bridge.gate import stops
from nics_drl_bridge.gate.frozen import stands_still
from nics_drl_bridge.gate.inputs import Arm
from nics_drl_bridge.gate.state import Arrivals, GateConfig, GateState
from nics_drl_bridge.gate.stops import ODOM, SCAN
from nics_drl_bridge.interface import S_PER_NS

BEHIND_S = 0.2  # by which irregular stamps may fall behind while the gate settles
Check = Callable[[GateConfig, GateState, Arm, float], str]  # what is wrong; empty if nothing is


def _fresh(topic: str, arrivals: Arrivals, limit_s: float, config: GateConfig, now: float) -> str:
    fresh = stops.gap_free(arrivals, now, config.settle_s, limit_s)
    return "" if fresh else f"{topic} has not been fresh for {config.settle_s} s"


def _rate(topic: str, arrivals: Arrivals, declared: float, config: GateConfig, now: float) -> str:
    """Judges a rate: by stamps too few and too many data are wrong, by arrival only too few."""
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
    estimate = state.estimate
    if not config.estimate_required:
        return ""
    if estimate is None or now - state.estimate_s > config.estimate_silence_s:
        return "odometry/filtered is silent, start the middleware_node"
    if (worst := float(estimate.std.max())) > config.estimate_std:
        return f"odometry/filtered is uncertain by {worst:.2f}, the limit is {config.estimate_std}"
    return "" if stands_still(config, estimate.twist) else "odometry/filtered shows motion"


def _publishers(config: GateConfig, state: GateState, request: Arm, now: float) -> str:
    count = request.publishers
    return "" if count == 1 else f"cmd_vel has {count} publishers, not this gate alone"


def _standing(config: GateConfig, state: GateState, request: Arm, now: float) -> str:
    still = state.odometry is not None and now - state.restless_s >= config.settle_s
    return "" if still else f"the robot has not stood still for {config.settle_s} s"


def _limits(config: GateConfig, state: GateState, request: Arm, now: float) -> str:
    return "" if config.limits is not None else "no limits are set, name their file in `limits`"


def _latched(config: GateConfig, state: GateState, request: Arm, now: float) -> str:
    return "" if state.latched is None else f"call ~/reset first: {state.latched.line}"


def _e_stop(config: GateConfig, state: GateState, request: Arm, now: float) -> str:
    cause = stops.e_stop_pressed(config, state, now) or stops.e_stop_silent(config, state, now)
    return "" if cause is None else cause.line


CHECKS: tuple[tuple[str, Check], ...] = (
    ("limits_set", _limits),
    ("nothing_latched", _latched),
    ("e_stop_released", _e_stop),
    ("scan_fresh", lambda c, s, _, now: _fresh(SCAN, s.scans, c.scan_age_s, c, now)),
    ("scan_rate", lambda c, s, _, now: _rate(SCAN, s.scans, c.scan_rate, c, now)),
    ("odom_fresh", lambda c, s, _, now: _fresh(ODOM, s.odometries, c.odom_age_s, c, now)),
    ("odom_rate", lambda c, s, _, now: _rate(ODOM, s.odometries, c.odom_rate, c, now)),
    ("clocks_agree", _clocks),
    ("estimator_converged", _estimator),
    ("one_publisher", _publishers),
    ("standing_still", _standing),
)


def failures(config: GateConfig, state: GateState, request: Arm, now: float) -> list[str]:
    """Returns a sentence for each failed check, with the check's name in front."""
    answers = ((name, check(config, state, request, now)) for name, check in CHECKS)
    return [f"{name}: {answer}" for name, answer in answers if answer]
