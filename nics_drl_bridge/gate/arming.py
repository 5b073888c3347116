"""Arming: the gate lets commands pass only after all of these checks."""

from __future__ import annotations

from collections.abc import Callable

from nics_drl_bridge.gate.frozen import stands_still
from nics_drl_bridge.gate.inputs import Arm
from nics_drl_bridge.gate.state import Arrivals, GateConfig, GateState
from nics_drl_bridge.gate.stops import AHEAD_S, creep, e_stop_pressed, e_stop_silent, gap_free, rate
from nics_drl_bridge.interface import S_PER_NS

BEHIND_S = 0.2
"""Stamps may fall behind by this much while the gate settles, because they are irregular [s]."""
Check = Callable[[GateConfig, GateState, Arm, float], str]


def _fresh(topic: str, arrivals: Arrivals, config: GateConfig, now: float, limit: float) -> str:
    if gap_free(arrivals, now, config.settle_s, limit):
        return ""
    return f"{topic} has not been fresh for {config.settle_s} s"


def _rate(topic: str, arrivals: Arrivals, config: GateConfig, now: float, declared: float) -> str:
    """Judges a rate: by stamps too few and too many data are wrong, by arrival only too few."""
    arriving, stamped = rate(arrivals, now, config.settle_s)
    low = declared * (1.0 - config.rate_tolerance)
    high = declared * (1.0 + config.rate_tolerance)
    if arriving >= low and low <= stamped <= high:
        return ""
    return (
        f"{topic} comes at {arriving:.1f} Hz, by its stamps {stamped:.1f} Hz, declared are "
        f"{declared:.1f} Hz"
    )


def scan_fresh(config: GateConfig, state: GateState, request: Arm, now: float) -> str:
    """Scans have arrived without a gap."""
    return _fresh("scan", state.scans, config, now, config.scan_age_s)


def odom_fresh(config: GateConfig, state: GateState, request: Arm, now: float) -> str:
    """Odometry has arrived without a gap."""
    return _fresh("odom", state.odometries, config, now, config.odom_age_s)


def scan_rate(config: GateConfig, state: GateState, request: Arm, now: float) -> str:
    """Scans arrive at the declared rate of the lidar."""
    return _rate("scan", state.scans, config, now, config.scan_rate)


def odom_rate(config: GateConfig, state: GateState, request: Arm, now: float) -> str:
    """Odometry arrives at the declared rate."""
    return _rate("odom", state.odometries, config, now, config.odom_rate)


def clocks_agree(config: GateConfig, state: GateState, request: Arm, now: float) -> str:
    """The clocks that stamp scan and odometry agree, and keep pace with this machine's clock."""
    scans, odometries = state.scans, state.odometries
    if not (scans.times and odometries.times):
        return "scan and odom have not both come"
    stamped = (scans.stamps_ns[-1] - odometries.stamps_ns[-1]) * S_PER_NS / config.clock_rate
    apart = stamped - (scans.times[-1] - odometries.times[-1])
    if abs(apart) > config.clock_jump_s:
        return f"the stamps of scan are {apart:.3f} s ahead of those of odom"
    for topic, arrivals in (("scan", scans), ("odom", odometries)):
        ahead = creep(arrivals)
        behind = 0.0 if config.simulated else -ahead
        if ahead > AHEAD_S or behind > BEHIND_S:
            return (
                f"the stamps of {topic} run away from this machine's clock, by {ahead:+.3f} s in a "
                "moment; a simulation that is not in real time needs the parameter 'clock_rate'"
            )
    return ""


def estimator_converged(config: GateConfig, state: GateState, request: Arm, now: float) -> str:
    """The middleware knows where the robot is, and that it stands still."""
    if not config.estimate_required:
        return ""
    if state.estimate is None or now - state.estimate_s > config.estimate_silence_s:
        return "odometry/filtered is silent, start the middleware_node"
    if state.estimate.std.max() > config.estimate_std:
        worst = float(state.estimate.std.max())
        return f"odometry/filtered is uncertain by {worst:.2f}, the limit is {config.estimate_std}"
    return "" if stands_still(config, state.estimate.twist) else "odometry/filtered shows motion"


def one_publisher(config: GateConfig, state: GateState, request: Arm, now: float) -> str:
    """The gate is the only publisher of `cmd_vel`."""
    if request.publishers == 1:
        return ""
    return f"cmd_vel has {request.publishers} publishers, not this gate alone"


def standing_still(config: GateConfig, state: GateState, request: Arm, now: float) -> str:
    """The robot has stood still."""
    if state.odometry is not None and now - state.restless_s >= config.settle_s:
        return ""
    return f"the robot has not stood still for {config.settle_s} s"


def limits_set(config: GateConfig, state: GateState, request: Arm, now: float) -> str:
    """The limits of the commands are known."""
    return "" if config.limits is not None else "no limits are set, name their file in `limits`"


def e_stop_released(config: GateConfig, state: GateState, request: Arm, now: float) -> str:
    """The emergency stop is not pressed and not silent."""
    cause = e_stop_pressed(config, state, now) or e_stop_silent(config, state, now)
    return "" if cause is None else cause.line


def nothing_latched(config: GateConfig, state: GateState, request: Arm, now: float) -> str:
    """No latched stop waits for a reset."""
    return "" if state.latched is None else f"call ~/reset first: {state.latched.line}"


CHECKS: tuple[Check, ...] = (
    limits_set,
    nothing_latched,
    e_stop_released,
    scan_fresh,
    scan_rate,
    odom_fresh,
    odom_rate,
    clocks_agree,
    estimator_converged,
    one_publisher,
    standing_still,
)


def failures(config: GateConfig, state: GateState, request: Arm, now: float) -> list[str]:
    """Returns a sentence for each failed check, with the check's name in front."""
    answers = ((check.__name__, check(config, state, request, now)) for check in CHECKS)
    return [f"{name}: {answer}" for name, answer in answers if answer]
