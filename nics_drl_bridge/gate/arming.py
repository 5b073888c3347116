"""Arming and reset: the checks that must pass before commands may pass.

A request to arm is granted if all `CHECKS` pass; the answer names those that fail.
"""

from collections.abc import Callable

from nics_drl_bridge.gate import estimate as estimates
from nics_drl_bridge.gate import evidence, frozen, inputs, stops
from nics_drl_bridge.gate import ground as grounds
from nics_drl_bridge.gate.state import (
    Arrivals,
    GateConfig,
    GateState,
    ScanMotion,
    replace,
)
from nics_drl_bridge.gate.stops import reset_envelope
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
    for name, check in CHECKS:
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
        fault = _judge_freshness(name, sensor.arrivals, config.scan_age_s, config, now)
        if fault:
            return fault
    return ""


def _check_odometry_rate(
    config: GateConfig, state: GateState, request: inputs.Arm, now: float
) -> str:
    """Odometry arrives at its declared rate, or by default at least as often as needed."""
    arrivals = state.odometries
    if config.odom_rate_declared:
        return _judge_rate(ODOM, arrivals, config.odom_rate, config, now)
    arriving, stamped = stops.measure_rate(arrivals, now, config.settle_s)
    if min(arriving, stamped) >= config.odom_rate * (1.0 - config.rate_tolerance):
        return ""
    rates = f"{arriving:.1f} Hz, by its stamps {stamped:.1f} Hz"
    needed = f"one per control period is needed, {config.odom_rate:.1f} Hz"
    return f"odom comes at {rates}, {needed}, unless the parameter 'odom_rate' declares less"


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
        ahead = stops.measure_creep(arrivals)
        behind = 0.0 if config.simulated else -ahead
        if ahead > stops.AHEAD_S or behind > BEHIND_S:
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


def _check_publishers(
    config: GateConfig, state: GateState, request: inputs.Arm, now: float
) -> str:
    if request.publishers == 1:
        return ""
    return f"cmd_vel has {request.publishers} publishers, not this gate alone"


def _check_policies(
    config: GateConfig, state: GateState, request: inputs.Arm, now: float
) -> str:
    return state.last_mixed if now - state.mixed_s < config.settle_s else ""


def _check_standing(
    config: GateConfig, state: GateState, request: inputs.Arm, now: float
) -> str:
    if state.odometry is not None and now - state.restless_s >= config.settle_s:
        return ""
    return f"the robot has not stood still for {config.settle_s} s"


def _check_e_stop(
    config: GateConfig, state: GateState, request: inputs.Arm, now: float
) -> str:
    cause = stops.e_stop_pressed(config, state, now) or stops.e_stop_silent(
        config, state, now
    )
    if cause is None:
        return ""
    if cause.rule == "e_stop_silent" and state.e_stop.heard_s is None:
        return NEVER_HEARD
    return cause.line


def _check_limits(
    config: GateConfig, state: GateState, request: inputs.Arm, now: float
) -> str:
    return UNLIMITED if config.limits is None else ""


def _check_latch(
    config: GateConfig, state: GateState, request: inputs.Arm, now: float
) -> str:
    return "" if state.latched is None else f"call ~/reset first: {state.latched.line}"


def _check_scan_freshness(
    config: GateConfig, state: GateState, request: inputs.Arm, now: float
) -> str:
    return _judge_freshness(SCAN, state.scans, config.scan_age_s, config, now)


def _check_scan_rate(
    config: GateConfig, state: GateState, request: inputs.Arm, now: float
) -> str:
    return _judge_rate(SCAN, state.scans, config.scan_rate, config, now)


def _check_odometry_freshness(
    config: GateConfig, state: GateState, request: inputs.Arm, now: float
) -> str:
    return _judge_freshness(ODOM, state.odometries, config.odom_age_s, config, now)


CHECKS: tuple[tuple[str, Check], ...] = (
    ("limits_set", _check_limits),
    ("nothing_latched", _check_latch),
    ("e_stop_released", _check_e_stop),
    ("scan_fresh", _check_scan_freshness),
    ("scan_rate", _check_scan_rate),
    ("sensors_fresh", _check_sensors),
    ("odom_fresh", _check_odometry_freshness),
    ("odom_rate", _check_odometry_rate),
    ("clocks_agree", _check_clocks),
    ("estimator_converged", _check_estimator),
    ("one_publisher", _check_publishers),
    ("standing_still", _check_standing),
    ("one_policy", _check_policies),
)
"""Checks before the gate is armed, by name."""


def _judge_freshness(
    topic: str, arrivals: Arrivals, limit_s: float, config: GateConfig, now: float
) -> str:
    """Data must have arrived without a gap for the settling time."""
    unbroken = now - arrivals.unbroken_s >= config.settle_s
    if arrivals.times and unbroken and now - arrivals.times[-1] <= limit_s:
        return ""
    return f"{topic} has not been fresh for {config.settle_s} s"


def _judge_rate(
    topic: str, arrivals: Arrivals, declared: float, config: GateConfig, now: float
) -> str:
    """Judges a rate: by stamps it may be too low or too high, by arrival only too low."""
    arriving, stamped = stops.measure_rate(arrivals, now, config.settle_s)
    low = declared * (1.0 - config.rate_tolerance)
    high = declared * (1.0 + config.rate_tolerance)
    if arriving >= low and low <= stamped <= high:
        return ""
    rates = f"{arriving:.1f} Hz, by its stamps {stamped:.1f} Hz"
    return f"{topic} comes at {rates}, declared are {declared:.1f} Hz"
