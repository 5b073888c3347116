"""The gate: a pure function from (time, state, input) to (state, decision), replayed to the bit."""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from nics_drl_bridge.gate import estimate as estimates
from nics_drl_bridge.gate import frozen, inputs, limits, scan_motion, shield, stops
from nics_drl_bridge.gate import state as records
from nics_drl_bridge.gate.state import (
    Arrivals,
    Cause,
    GateConfig,
    GateState,
    Motion,
    ScanMotion,
    replace,
)
from nics_drl_bridge.gate.stops import ODOM, SCAN, reset_envelope
from nics_drl_bridge.geometry import between
from nics_drl_bridge.interface import S_PER_NS

Taken = tuple[GateState, str]  # and the reason why an input is not taken, or ""
# maximum speed that the odometry of a mobile robot can show [m/s, rad/s]
MAX_SPEED = 100.0
# Downhill or pushed, a robot may exceed its limits by this factor, plus [m/s] and [rad/s].
SLIP = 2.0
SLIP_SPEED = 0.5
SLIP_TURN = 1.0
# jump of an odometry pose that may come from imprecision [m, rad]
LEAP = 0.1
LEAP_TURN = 0.2
# maximum deviation of the last beam from its declared angle [rad]
ANGLE_TOLERANCE = 1e-3
BEHIND_S = 0.2  # by which irregular stamps may fall behind while the gate settles
Check = Callable[
    [GateConfig, GateState, inputs.Arm, float], str
]  # what is wrong; or empty


def decide(
    config: GateConfig, state: GateState, given: inputs.Input, now: float
) -> tuple[GateState, records.Decision]:
    """Decides on an input at a steady time [s]; returns the state after it, and the decision."""
    # Only a tick publishes a motion; a stop is published at the input that causes it, and at every
    # tick while it lasts. A stop is an immediate zero: limits of rate and jerk apply to motion.
    state = stops.take_time(config, state, given, now)
    if state.clock_fault:
        now = state.now_s  # the last plausible time
    state, refused = take(config, state, given, now)
    state, answer, granted = _serve(config, state, given, now)
    was_moving = bool(state.value.any())
    cause, latching_cause = _find_causes(config, state, now)
    publish = shielded = False
    if cause is not None:
        if latching_cause is not None and state.armed:
            state = replace(state, latched=latching_cause)
        publish = was_moving or isinstance(given, inputs.Tick)
        stopped_s = now if publish else state.moved_s
        state = _stop(config, state, stopped_s, disarm=latching_cause is not None)
    elif isinstance(given, inputs.Tick) and not now - state.moved_s < limits.MIN_STEP_S:
        publish = True
        zero = np.zeros(len(config.fields))
        target = zero
        if state.command is not None:
            target = config.command(state.command.twist)
        motion = Motion(target, zero)
        for shape in SHAPERS:
            motion = shape(config, state, motion, now)
        if motion.fault:
            cause = Cause("motion_unfit", "", motion.fault)
            state = _stop(config, replace(state, latched=cause), now, disarm=True)
        else:
            value = motion.value
            recent = shield.append_command(config, state, motion.value, now)
            state = replace(
                state,
                value=value,
                slope=motion.slope,
                moved_s=now,
                recent=recent,
                shielded=motion.shielded,
            )
            state = frozen.watch_motion(config, state, now)
            shielded = motion.shielded
    twist = limits.flush_denormals(config.cmd_vel(state.value))
    return state, records.Decision(
        twist, publish, cause, refused, answer, granted, shielded
    )


def _find_causes(
    config: GateConfig, state: GateState, now: float
) -> tuple[Cause | None, Cause | None]:
    """Returns the first cause of a stop, which names it, and the first one that latches."""
    first = None
    # A fault may live for one input only, so a latching rule counts behind any other one.
    for rule in STOPS:
        if rule.needs_clock and state.clock_fault:
            continue
        cause = rule.judge(config, state, now)
        if cause is not None and rule.latches:
            return first or cause, cause
        first = first or cause
    return first, None


def _serve(
    config: GateConfig, state: GateState, given: inputs.Input, now: float
) -> tuple[GateState, str, bool]:
    """Arms or resets, if requested; returns also the answer, and whether it was granted."""
    if isinstance(given, inputs.Arm):
        answers = ((name, check(config, state, given, now)) for name, check in CHECKS)
        if failed := [f"{name}: {answer}" for name, answer in answers if answer]:
            return state, "; ".join(failed), False
        sensors = tuple(
            replace(sensor, arrivals=reset_envelope(sensor.arrivals))
            for sensor in state.sensors
        )
        # Earlier views and known ground are forgotten: somebody may have carried the robot here.
        ground = shield.update_ground(config, state.views, None)
        if ground is not None:
            obstacles = shield.find_obstacles(
                config, state.views[-1].ranges, state.views, ground
            )
            state = replace(state, ground=ground, obstacles=obstacles)
        return (
            replace(
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
                estimates=estimates.begin_anew(state),
            ),
            "armed",
            True,
        )
    if isinstance(given, inputs.Reset):
        # The latch is cleared, unless the emergency stop is still pressed.
        stop = replace(state.e_stop, latched=state.e_stop.held, reason="")
        state = replace(state, e_stop=stop, latched=None, armed=False)
        if stop.latched:
            return state, "the e-stop is still pressed", False
        return state, "reset; call ~/arm to let commands pass", True
    return state, "", False


def _stop(
    config: GateConfig, state: GateState, moved_s: float, disarm: bool
) -> GateState:
    zero = np.zeros_like(state.value)
    recent = state.recent
    if moved_s > state.moved_s:  # the stop is published
        recent = shield.append_command(config, state, zero, moved_s)
    return replace(
        state,
        value=zero,
        slope=zero,
        moved_s=moved_s,
        push=None,
        shielded=False,
        recent=recent,
        armed=state.armed and not disarm,
    )


def scan_malformed(config: GateConfig, scan: inputs.Scan) -> str:
    """The scan is from another lidar than the declared one, or every range is NaN."""
    angles, (first, step) = config.beam_angles, scan.angles
    if scan.ranges.shape != angles.shape:
        return f"scan: {scan.ranges.size} beams, not {len(angles)}"
    increment = float(angles[1] - angles[0]) if len(angles) > 1 else step
    last_off = abs(first - angles[0]) + abs(step - increment) * (len(angles) - 1)
    if not last_off <= ANGLE_TOLERANCE:
        return "scan: its angles are not those of the declared lidar"
    if np.isnan(scan.ranges).all():
        return "scan: every range is NaN"
    return ""


def check_reading(config: GateConfig, reading: inputs.SensorReading) -> str:
    """The reading is of an unknown sensor, or not finite."""
    if reading.name not in config.sensors:
        return f"{reading.name}: there is no such sensor"
    if not np.isfinite(reading.points).all():
        return f"{reading.name}: NaN or inf"
    return ""


def check_odometry(config: GateConfig, odometry: inputs.Odometry) -> str:
    """The odometry is not finite, or too fast for a mobile robot."""
    if not (np.isfinite(odometry.pose).all() and np.isfinite(odometry.twist).all()):
        return "odom: NaN, inf, or no rotation"
    if np.abs(odometry.twist).max() > MAX_SPEED:
        return f"odom: faster than {MAX_SPEED:g} m/s or rad/s"
    return ""


def estimate_malformed(config: GateConfig, estimate: inputs.Estimate) -> str:
    """The estimate is not finite, or its covariance has a negative variance."""
    parts = (estimate.twist, estimate.pose, estimate.covariance)
    if not all(np.isfinite(part).all() for part in parts):
        return "odometry/filtered: NaN or inf"
    if (np.diag(estimate.covariance) < 0.0).any():
        return "odometry/filtered: a variance is negative"
    return ""


def check_finite(config: GateConfig, command: inputs.Command) -> str:
    """The command is not finite."""
    if not np.isfinite(command.twist).all():
        return "cmd_vel_raw: NaN or inf"
    return ""


def check_plausible(config: GateConfig, command: inputs.Command) -> str:
    """The command is so far out of range that the policy must be broken."""
    bounds = config.limits
    twist = command.twist
    if bounds is None or not limits.is_implausible(config.command(twist), bounds):
        return ""
    return f"cmd_vel_raw: {twist.tolist()} is far out of range"


REFUSALS: tuple[tuple[type, Callable[[GateConfig, Any], str]], ...] = (
    (inputs.Scan, scan_malformed),
    (inputs.Odometry, check_odometry),
    (inputs.SensorReading, check_reading),
    (inputs.Estimate, estimate_malformed),
    (inputs.Command, check_finite),
    (inputs.Command, check_plausible),
)
"""By the type of the input, in order: what is wrong with it; empty if nothing is."""


def take(
    config: GateConfig, state: GateState, given: inputs.Input, now: float
) -> Taken:
    """Takes an input into the state, or returns the reason why not."""
    state = replace(state, jumped="", leap="", mixed="")
    if state.estimates.fault:
        state = replace(state, estimates=replace(state.estimates, fault=""))
    if isinstance(given, inputs.Command):
        state = stops.watch_source(state, given, now)
    for kind, judge in REFUSALS:
        reason = judge(config, given) if isinstance(given, kind) else ""
        if reason and kind is inputs.Command:
            # An earlier command that waits for its scan must not come into force any more.
            state = replace(state, malformed=reason, pending=None, pending_s=None)
        if reason:
            return state, reason
    if isinstance(given, inputs.Scan):
        return _take_scan(config, state, given, now)
    if isinstance(given, inputs.Odometry):
        return _take_odometry(config, state, given, now)
    if isinstance(given, inputs.SensorReading):
        return _take_reading(config, state, given, now)
    if isinstance(given, inputs.Estimate):
        track = estimates.track_estimate(config, state, given, now)
        state = replace(state, estimate=given, estimate_s=now, estimates=track)
    elif isinstance(given, inputs.Command):
        state = _take_command(state, given, now)
    elif isinstance(given, inputs.EStop):
        pressed = given.pressed
        latched = state.e_stop.latched or pressed
        stop = replace(state.e_stop, latched=latched, held=pressed, heard_s=now)
        state = replace(state, e_stop=stop)
    elif isinstance(given, inputs.Press):
        stop = replace(state.e_stop, latched=True, reason=given.reason)
        state = replace(state, e_stop=stop)
    return state, ""


def _take_command(
    state: GateState, command: inputs.Command, arrival_s: float
) -> GateState:
    """Takes a command once its scan has arrived; until then the previous one stays in force."""
    scans = state.scans
    if command.stamp_ns not in scans.stamps_ns:
        since = arrival_s if state.pending_s is None else state.pending_s
        return replace(
            state, pending=command, pending_s=since, pending_arrival_s=arrival_s
        )
    behind = scans.stamps_ns.index(command.stamp_ns)
    return replace(
        state,
        command=command,
        command_s=arrival_s,
        behind_s=scans.times[behind] - scans.late[behind],
        malformed="",
        pending=None,
        pending_s=None,
    )


def _take_scan(
    config: GateConfig, state: GateState, scan: inputs.Scan, now: float
) -> Taken:
    arrivals, fault = stops.account_for_arrival(
        config, state.scans, scan.stamp_ns, now, config.scan_age_s, state.armed
    )
    if fault:
        return _refuse_stamp(replace(state, scans=arrivals), SCAN, fault)
    pose = None if state.odometry is None else state.odometry.pose
    seen, frozen_fault = frozen.look(config, state.seen, scan.ranges, pose)
    views = shield.add_view(config, state, scan)
    ground = shield.update_ground(config, views, state.ground)
    state = replace(
        state,
        scans=arrivals,
        scan=scan,
        seen=seen,
        frozen=frozen_fault,
        views=views,
        ground=ground,
        scan_motion=scan_motion.watch_scan(config, state, scan),
        obstacles=shield.find_obstacles(config, scan.ranges, views, ground),
    )
    if state.pending is not None and state.pending.stamp_ns == scan.stamp_ns:
        state = _take_command(state, state.pending, state.pending_arrival_s)
    return state, ""


def _take_odometry(
    config: GateConfig, state: GateState, odometry: inputs.Odometry, now: float
) -> Taken:
    arrivals, fault = stops.account_for_arrival(
        config, state.odometries, odometry.stamp_ns, now, config.odom_age_s, state.armed
    )
    if fault:
        return _refuse_stamp(replace(state, odometries=arrivals), ODOM, fault)
    leap = _find_leap(config, state, odometry, now)
    if leap:
        # Later poses are judged relative to this one, and earlier ones say nothing any more.
        state = replace(
            state,
            odometry=odometry,
            leap=leap,
            push=None,
            seen=(),
            views=(),
            ground=None,
            scan_motion=ScanMotion(),
        )
        return state, f"odom: {leap}"
    restless = state.restless_s if frozen.is_at_rest(config, odometry.twist) else now
    return replace(
        state, odometries=arrivals, odometry=odometry, restless_s=restless
    ), ""


def _take_reading(
    config: GateConfig, state: GateState, reading: inputs.SensorReading, now: float
) -> Taken:
    index = config.sensors.index(reading.name)
    sensors = list(state.sensors)
    arrivals, fault = stops.account_for_arrival(
        config,
        sensors[index].arrivals,
        reading.stamp_ns,
        now,
        config.scan_age_s,
        state.armed,
    )
    points = sensors[index].points if fault else reading.points
    sensors[index] = records.SensorState(arrivals, points)
    state = replace(state, sensors=tuple(sensors))
    if fault:
        return _refuse_stamp(state, reading.name, fault)
    return state, ""


def _refuse_stamp(state: GateState, topic: str, fault: str) -> Taken:
    """Refuses data whose stamp repeated or jumped."""
    if fault == stops.JUMPED:
        state = replace(state, jumped=topic)
    return state, f"{topic}: its stamp {fault}"


def _find_leap(
    config: GateConfig, state: GateState, odometry: inputs.Odometry, now: float
) -> str:
    """Returns what is wrong with a pose that the robot can't have reached; empty if nothing is."""
    before = state.odometry
    bounds = config.limits
    if before is None or bounds is None:
        return ""
    stamped = (odometry.stamp_ns - before.stamp_ns) * S_PER_NS
    passed = max(stamped, now - state.odometries.times[-1])  # either of them may jitter
    path_noise, turn_noise = (frozen.NOISE * std * passed for std in config.odom_std)
    speed, turn_rate = limits.get_maximum_speeds(bounds)
    max_path = LEAP + (SLIP * speed + SLIP_SPEED) * passed + path_noise
    max_turn = LEAP_TURN + (SLIP * turn_rate + SLIP_TURN) * passed + turn_noise
    x, y, heading = between(before.pose, odometry.pose)
    path = float(np.hypot(x, y))
    if path <= max_path and abs(heading) <= max_turn:
        return ""
    return (
        f"its pose jumped by {path:.3g} m and {abs(heading):.3g} rad in {passed:.3f} s"
    )


def _check_fresh(
    topic: str, arrivals: Arrivals, limit_s: float, config: GateConfig, now: float
) -> str:
    unbroken = now - arrivals.unbroken_s >= config.settle_s
    if arrivals.times and unbroken and now - arrivals.times[-1] <= limit_s:
        return ""
    return f"{topic} has not been fresh for {config.settle_s} s"


def _check_sensors(
    config: GateConfig, state: GateState, request: inputs.Arm, now: float
) -> str:
    for name, sensor in zip(config.sensors, state.sensors, strict=True):
        fault = _check_fresh(name, sensor.arrivals, config.scan_age_s, config, now)
        if fault:
            return fault
    return ""


def _check_rate(
    topic: str, arrivals: Arrivals, declared: float, config: GateConfig, now: float
) -> str:
    """Judges a rate: by stamps too few and too many data are wrong, by arrival only too few."""
    arriving, stamped = stops.measure_rate(arrivals, now, config.settle_s)
    low = declared * (1.0 - config.rate_tolerance)
    high = declared * (1.0 + config.rate_tolerance)
    if arriving >= low and low <= stamped <= high:
        return ""
    rates = f"{arriving:.1f} Hz, by its stamps {stamped:.1f} Hz"
    return f"{topic} comes at {rates}, declared are {declared:.1f} Hz"


def _check_odometry_rate(
    config: GateConfig, state: GateState, request: inputs.Arm, now: float
) -> str:
    """Odometry comes at its rate; where none was declared, at least as often as is needed."""
    arrivals = state.odometries
    if config.odom_rate_declared:
        return _check_rate(ODOM, arrivals, config.odom_rate, config, now)
    arriving, stamped = stops.measure_rate(arrivals, now, config.settle_s)
    if min(arriving, stamped) >= config.odom_rate * (1.0 - config.rate_tolerance):
        return ""
    rates = f"{arriving:.1f} Hz, by its stamps {stamped:.1f} Hz"
    needed = f"one per control period is needed, {config.odom_rate:.1f} Hz"
    return f"odom comes at {rates}, {needed}, unless the parameter 'odom_rate' declares less"


def _check_clocks(
    config: GateConfig, state: GateState, request: inputs.Arm, now: float
) -> str:
    """The clocks that stamp scan and odometry agree, and keep pace with this machine's clock."""
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
    """The middleware knows where the robot is, and that it stands still."""
    estimate = state.estimate
    if not config.estimate_required:
        return ""
    if estimate is None or now - state.estimate_s > config.estimate_silence_s:
        return "odometry/filtered is silent, start the middleware_node"
    if doubt := estimates.explain_unsteadiness(config, state, now):
        return doubt
    if frozen.is_at_rest(config, estimate.twist):
        return ""
    return "odometry/filtered shows motion"


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


NEVER_HEARD = (
    "e_stop_silent: no e_stop was ever heard, which counts as pressed: publish it at 10 Hz or "
    "more, or in a simulation start the gate with e_stop_required:=false"
)
UNLIMITED = "no limits are set, name their file in `limits`"
CHECKS: tuple[tuple[str, Check], ...] = (
    ("limits_set", lambda c, *_: UNLIMITED if c.limits is None else ""),
    (
        "nothing_latched",
        lambda _, s, *__: (
            "" if s.latched is None else f"call ~/reset first: {s.latched.line}"
        ),
    ),
    ("e_stop_released", _check_e_stop),
    (
        "scan_fresh",
        lambda c, s, _, now: _check_fresh(SCAN, s.scans, c.scan_age_s, c, now),
    ),
    ("scan_rate", lambda c, s, _, now: _check_rate(SCAN, s.scans, c.scan_rate, c, now)),
    ("sensors_fresh", _check_sensors),
    (
        "odom_fresh",
        lambda c, s, _, now: _check_fresh(ODOM, s.odometries, c.odom_age_s, c, now),
    ),
    ("odom_rate", _check_odometry_rate),
    ("clocks_agree", _check_clocks),
    ("estimator_converged", _check_estimator),
    ("one_publisher", _check_publishers),
    ("standing_still", _check_standing),
    ("one_policy", _check_policies),
)


class Rule(NamedTuple):
    """A reason to stop; its name is that of the function that returns the cause, or None."""

    judge: Callable[[GateConfig, GateState, float], Cause | None]
    latches: bool = False  # the stop stays until a reset
    # Judges a time that has passed, which is not known while the gate's clock is at fault.
    needs_clock: bool = False


def latched(config: GateConfig, state: GateState, now: float) -> Cause | None:
    """An earlier stop waits for a reset."""
    return state.latched


def disarmed(config: GateConfig, state: GateState, now: float) -> Cause | None:
    """The gate has not been armed."""
    if state.armed:
        return None
    return Cause("disarmed", "", "call ~/arm to let commands pass")


STOPS: tuple[Rule, ...] = (
    Rule(stops.e_stop_pressed, latches=True),
    Rule(latched),
    Rule(disarmed),
    Rule(stops.own_clock),
    Rule(stops.e_stop_silent, latches=True, needs_clock=True),
    Rule(stops.stamps_jumped, latches=True),
    Rule(frozen.odom_jumped, latches=True),
    Rule(frozen.scan_frozen, latches=True),
    Rule(frozen.no_motion, latches=True, needs_clock=True),
    Rule(scan_motion.body_held, latches=True),
    Rule(estimates.estimate_lost, latches=True),
    Rule(stops.two_policies, latches=True),
    Rule(stops.scan_silent),
    Rule(stops.sensor_silent),
    Rule(stops.odom_silent),
    Rule(stops.command_malformed),
    Rule(stops.command_missing),
    Rule(stops.command_silent),
    Rule(stops.scan_behind_unknown),
    Rule(stops.scan_behind_old),
)
"""The first rule that returns a cause names the stop; the first latching one latches it."""


def saturate(
    config: GateConfig, state: GateState, motion: Motion, now: float
) -> Motion:
    """Clips the value to its limits, see `limits.saturate`; without limits it is zero."""
    if config.limits is None:
        return Motion(np.zeros_like(motion.value), np.zeros_like(motion.slope))
    return replace(motion, value=limits.saturate(motion.value, config.limits))


def follow(config: GateConfig, state: GateState, motion: Motion, now: float) -> Motion:
    """Limits rate and jerk, see `limits.follow`."""
    if config.limits is None:
        return motion
    dt = now - state.moved_s if math.isfinite(state.moved_s) else config.gap_s
    # A turn need not wait for a speed that the shield holds back.
    waits = not state.shielded
    value, slope = limits.follow(
        state.value, state.slope, motion.value, dt, config.limits, waits
    )
    return replace(motion, value=value, slope=slope)


def bound(config: GateConfig, state: GateState, motion: Motion, now: float) -> Motion:
    """Replaces a motion that is not finite or beyond its limits by zero, whatever came before.

    What is denormal becomes zero as well.
    """
    is_within = config.limits is None or limits.is_within(motion.value, config.limits)
    if (
        is_within
        and np.isfinite(motion.value).all()
        and np.isfinite(motion.slope).all()
    ):
        value = limits.flush_denormals(motion.value)
        return replace(motion, value=value, slope=limits.flush_denormals(motion.slope))
    zero = np.zeros_like(motion.value)
    return Motion(
        zero, zero, motion.shielded, f"a motion of {motion.value.tolist()} came out"
    )


# Stages that a passing command goes through.
SHAPERS: tuple[Callable[[GateConfig, GateState, Motion, float], Motion], ...] = (
    saturate,
    follow,
    shield.shield,
    bound,
)
