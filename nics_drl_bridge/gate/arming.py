"""Arming and reset: the checks that must pass before commands may pass.

A request to arm is granted if all `CHECKS` pass; the answer names those that fail.
"""

import math
from collections.abc import Callable

from nics_drl_bridge.gate import estimate as estimates
from nics_drl_bridge.gate import evidence, frozen, inputs, stops
from nics_drl_bridge.gate import ground as grounds
from nics_drl_bridge.gate.arrivals import (
    AHEAD_S,
    measure_creep,
    measure_rate,
    reset_envelope,
)
from nics_drl_bridge.gate.state import (
    Arrivals,
    GateConfig,
    GateState,
    ScanMotion,
    replace,
)
from nics_drl_bridge.interface import S_PER_NS
from nics_drl_bridge.middleware.measurement import ODOM, SCAN

Check = Callable[[GateConfig, GateState, inputs.Arm, float], str]
"""Returns the fault at a request to arm, or ""."""
BEHIND_S = 0.2  # tolerated lag of irregular stamps while the gate settles [s]
NEVER_HEARD = (
    "e_stop_silent: no e_stop was ever heard, which counts as pressed: publish it at 10 Hz or "
    "more, or in a simulation start the gate with e_stop_required:=false"
)
UNLIMITED = "no limits are set, name their file in `limits`"


def arm(
    config: GateConfig, state: GateState, request: inputs.Arm, now: float
) -> tuple[GateState, str, bool]:
    """Arms the gate if all checks pass; returns the state, the answer, and if it was granted."""
    faults = []
    for name, check in CHECKS.items():
        fault = check(config, state, request, now)
        if fault:
            faults.append(f"{name}: {fault}")
    if faults:
        return state, "; ".join(faults), False
    return _begin_drive(config, state), "armed", True


def _begin_drive(config: GateConfig, state: GateState) -> GateState:
    """Returns the armed state, without what was learned before.

    Earlier views and known ground are forgotten, as somebody may have carried the robot here.
    """
    sensors = tuple(
        replace(sensor, arrivals=reset_envelope(sensor.arrivals))
        for sensor in state.sensors
    )
    ground = grounds.update_ground(config, state.views, None)
    if ground is not None:
        obstacles = evidence.find_obstacles(
            config, state.views[-1].ranges, state.views, ground
        )
        state = replace(state, ground=ground, obstacles=obstacles)
    return replace(
        state,
        armed=True,
        scans=reset_envelope(state.scans),
        odometries=reset_envelope(state.odometries),
        sensors=sensors,
        seen=(),
        views=state.views[-1:],
        frozen="",
        push=None,
        scan_motion=ScanMotion(),
        estimates=estimates.restart_track(state),
    )


def reset(state: GateState) -> tuple[GateState, str, bool]:
    """Clears the latch and disarms; returns the state, the answer, and if it was granted.

    An emergency stop that is still pressed stays latched.
    """
    stop = replace(state.e_stop, latched=state.e_stop.held, reason="")
    state = replace(state, e_stop=stop, latched=None, armed=False)
    if stop.latched:
        return state, "the e-stop is still pressed", False
    return state, "reset; call ~/arm to let commands pass", True


def _check_sensors(
    config: GateConfig, state: GateState, request: inputs.Arm, now: float
) -> str:
    for name, sensor in zip(config.sensors, state.sensors, strict=True):
        fault = _judge_freshness(config, name, sensor.arrivals, config.scan_age_s, now)
        if fault:
            return fault
    return ""


def _check_clocks(
    config: GateConfig, state: GateState, request: inputs.Arm, now: float
) -> str:
    """The clocks that stamp scan and odometry agree and keep pace with this machine's clock."""
    scans = state.scans
    odometries = state.odometries
    if not (scans.times and odometries.times):
        return "scan and odom have not both come"
    stamped = (
        (scans.stamps_ns[-1] - odometries.stamps_ns[-1]) * S_PER_NS / config.clock_rate
    )
    lead = stamped - (scans.times[-1] - odometries.times[-1])
    if abs(lead) > config.clock_jump_s:
        return f"the stamps of scan are {lead:.3f} s ahead of those of odom"
    for topic, arrivals in ((SCAN, scans), (ODOM, odometries)):
        ahead = measure_creep(arrivals)
        behind = 0.0 if config.simulated else -ahead
        if ahead > AHEAD_S or behind > BEHIND_S:
            away = f"run away from this machine's clock, by {ahead:+.3f} s in a moment"
            advice = (
                "a simulation that is not in real time needs the parameter 'clock_rate'"
            )
            return f"the stamps of {topic} {away}; {advice}"
    return ""


def _check_estimator(
    config: GateConfig, state: GateState, request: inputs.Arm, now: float
) -> str:
    """The middleware has a valid estimate of a robot at rest."""
    estimate = state.estimate
    if not config.estimate_required:
        return ""
    if estimate is None or now - state.estimate_s > config.estimate_silence_s:
        return f"{inputs.ESTIMATE} is silent, start the middleware_node"
    doubt = estimates.explain_unsteadiness(config, state, now)
    if doubt:
        return doubt
    if frozen.is_at_rest(config, estimate.twist):
        return ""
    return f"{inputs.ESTIMATE} shows motion"


def _check_standing(
    config: GateConfig, state: GateState, request: inputs.Arm, now: float
) -> str:
    if state.odometry is not None and now - state.restless_s >= config.settle_s:
        return ""
    return f"the robot has not stood still for {config.settle_s} s"


def _check_e_stop(
    config: GateConfig, state: GateState, request: inputs.Arm, now: float
) -> str:
    for rule in stops.STOPS:
        cause = rule.judge(config, state, now) if rule.topic == inputs.E_STOP else None
        if cause is not None:
            is_known = state.e_stop.latched or state.e_stop.heard_s is not None
            return cause.line if is_known else NEVER_HEARD
    return ""


CHECKS: dict[str, Check] = {
    "limits_set": lambda config, state, request, now: (
        UNLIMITED if config.limits is None else ""
    ),
    "nothing_latched": lambda config, state, request, now: (
        "" if state.latched is None else f"call ~/reset first: {state.latched.line}"
    ),
    "e_stop_released": _check_e_stop,
    "scan_fresh": lambda config, state, request, now: _judge_freshness(
        config, SCAN, state.scans, config.scan_age_s, now
    ),
    "scan_rate": lambda config, state, request, now: _judge_rate(
        config, SCAN, state.scans, config.scan_rate, now
    ),
    "sensors_fresh": _check_sensors,
    "odom_fresh": lambda config, state, request, now: _judge_freshness(
        config, ODOM, state.odometries, config.odom_age_s, now
    ),
    "odom_rate": lambda config, state, request, now: _judge_rate(
        config,
        ODOM,
        state.odometries,
        config.odom_rate,
        now,
        config.odom_rate_declared,
    ),
    "clocks_agree": _check_clocks,
    "estimator_converged": _check_estimator,
    "one_publisher": lambda config, state, request, now: (
        ""
        if request.publishers == 1
        else f"cmd_vel has {request.publishers} publishers, not this gate alone"
    ),
    "standing_still": _check_standing,
    "one_policy": lambda config, state, request, now: (
        state.last_mixed if now - state.mixed_s < config.settle_s else ""
    ),
}
"""Checks before the gate is armed, by name."""


def _judge_freshness(
    config: GateConfig, topic: str, arrivals: Arrivals, limit_s: float, now: float
) -> str:
    """Data must have arrived without a gap for the settling time."""
    unbroken = now - arrivals.unbroken_s >= config.settle_s
    if arrivals.times and unbroken and now - arrivals.times[-1] <= limit_s:
        return ""
    return f"{topic} has not been fresh for {config.settle_s} s"


def _judge_rate(
    config: GateConfig,
    topic: str,
    arrivals: Arrivals,
    rate: float,
    now: float,
    is_declared: bool = True,
) -> str:
    """Judges a rate: by arrival it may only be too low.

    By stamps it may be too high as well, unless it is the minimum that is needed.
    """
    arriving, stamped = measure_rate(arrivals, now, config.settle_s)
    low = rate * (1.0 - config.rate_tolerance)
    high = rate * (1.0 + config.rate_tolerance) if is_declared else math.inf
    if arriving >= low and low <= stamped <= high:
        return ""
    needed = f"declared are {rate:.1f} Hz"
    if not is_declared:
        fix = "unless the parameter 'odom_rate' declares less"
        needed = f"one per control period is needed, {rate:.1f} Hz, {fix}"
    measured = f"{arriving:.1f} Hz, by its stamps {stamped:.1f} Hz"
    return f"{topic} comes at {measured}, {needed}"
