"""Adds the inputs of the gate to its state, or refuses those that can't be used.

`take` goes through these steps for each input:

1. Clear the faults of the previous input, which last for one input only.
2. Refuse it if a row of `REFUSALS` finds it malformed, or if its stamp repeats or
   jumps. Refused data do not feed a watchdog.
3. Record it and everything derived from it: a new scan, for example, shows obstacles
   and ground.
"""

from collections.abc import Callable
from typing import Any

import numpy as np

from nics_drl_bridge.gate import estimate as estimates
from nics_drl_bridge.gate import evidence, frozen, inputs, limits, scan_motion, stops
from nics_drl_bridge.gate import ground as grounds
from nics_drl_bridge.gate.arrivals import JUMPED, account_for_arrival
from nics_drl_bridge.gate.state import (
    GateConfig,
    GateState,
    ScanMotion,
    SensorState,
    replace,
)
from nics_drl_bridge.geometry import between
from nics_drl_bridge.interface import S_PER_NS
from nics_drl_bridge.middleware.measurement import ODOM, SCAN

Taken = tuple[GateState, str]
"""The state after an input, and the reason why the input is refused, or ""."""
# maximum speed that the odometry of a mobile robot can show [m/s, rad/s]
MAX_SPEED = 100.0
# maximum deviation of the last beam from its declared angle [rad]
ANGLE_TOLERANCE = 1e-3
# Downhill or when pushed, a robot may exceed its limits by this factor plus this [m/s], [rad/s].
EXCESS_FACTOR = 2.0
EXCESS = np.array([0.5, 1.0])
# jump of an odometry pose that may be due to imprecision [m], [rad]
SMALL_JUMP = np.array([0.1, 0.2])


def take(
    config: GateConfig, state: GateState, event: inputs.Input, now: float
) -> Taken:
    """Adds an input at a steady time [s] to the state, or returns the reason for a refusal."""
    state = replace(state, jumped="", leap="", mixed="")
    if state.estimates.fault:
        state = replace(state, estimates=replace(state.estimates, fault=""))
    if isinstance(event, inputs.Command):
        state = stops.watch_source(state, event, now)
    for kind, judge in REFUSALS:
        reason = judge(config, event) if isinstance(event, kind) else ""
        if not reason:
            continue
        reason = f"{inputs.get_topic(event)}: {reason}"
        if isinstance(event, inputs.Command):
            # An earlier command that waits for its scan must no longer take effect.
            state = replace(state, malformed=reason, pending=None, pending_s=None)
        return state, reason
    if isinstance(event, inputs.Scan):
        return _take_scan(config, state, event, now)
    if isinstance(event, inputs.Odometry):
        return _take_odometry(config, state, event, now)
    if isinstance(event, inputs.SensorReading):
        return _take_reading(config, state, event, now)
    if isinstance(event, inputs.Estimate):
        track = estimates.track_estimate(config, state, event, now)
        state = replace(state, estimate=event, estimate_s=now, estimates=track)
    elif isinstance(event, inputs.Command):
        state = _take_command(state, event, now)
    elif isinstance(event, inputs.EStop):
        stop = replace(
            state.e_stop,
            latched=state.e_stop.latched or event.pressed,
            held=event.pressed,
            heard_s=now,
        )
        state = replace(state, e_stop=stop)
    elif isinstance(event, inputs.Press):
        stop = replace(state.e_stop, latched=True, reason=event.reason)
        state = replace(state, e_stop=stop)
    return state, ""


def _take_command(
    state: GateState, command: inputs.Command, arrival_s: float
) -> GateState:
    """Takes a command once its scan has arrived; until then the previous one stays in effect."""
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
    arrivals, fault = account_for_arrival(
        config, state.scans, scan.stamp_ns, now, config.scan_age_s, state.armed
    )
    if fault:
        return _refuse_stamp(replace(state, scans=arrivals), SCAN, fault)
    pose = None if state.odometry is None else state.odometry.pose
    seen, frozen_fault = frozen.watch_pictures(config, state.seen, scan.ranges, pose)
    views = evidence.add_view(config, state, scan)
    ground = grounds.update_ground(config, views, state.ground)
    state = replace(
        state,
        scans=arrivals,
        scan=scan,
        seen=seen,
        frozen=frozen_fault,
        views=views,
        ground=ground,
        scan_motion=scan_motion.watch_scan(config, state, scan),
        obstacles=evidence.find_obstacles(config, scan.ranges, views, ground),
    )
    if state.pending is not None and state.pending.stamp_ns == scan.stamp_ns:
        state = _take_command(state, state.pending, state.pending_arrival_s)
    return state, ""


def _take_odometry(
    config: GateConfig, state: GateState, odometry: inputs.Odometry, now: float
) -> Taken:
    arrivals, fault = account_for_arrival(
        config, state.odometries, odometry.stamp_ns, now, config.odom_age_s, state.armed
    )
    if fault:
        return _refuse_stamp(replace(state, odometries=arrivals), ODOM, fault)
    leap = _find_leap(config, state, odometry, now)
    if leap:
        # Later poses are judged relative to this one; earlier ones no longer matter.
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
        return state, f"{ODOM}: {leap}"
    state = replace(state, odometries=arrivals, odometry=odometry)
    if not frozen.is_at_rest(config, odometry.twist):
        state = replace(state, restless_s=now)
    return state, ""


def _take_reading(
    config: GateConfig, state: GateState, reading: inputs.SensorReading, now: float
) -> Taken:
    index = config.sensors.index(reading.name)
    sensors = list(state.sensors)
    arrivals, fault = account_for_arrival(
        config,
        sensors[index].arrivals,
        reading.stamp_ns,
        now,
        config.scan_age_s,
        state.armed,
    )
    points = sensors[index].points if fault else reading.points
    sensors[index] = SensorState(arrivals, points)
    state = replace(state, sensors=tuple(sensors))
    return _refuse_stamp(state, reading.name, fault) if fault else (state, "")


def _refuse_stamp(state: GateState, topic: str, fault: str) -> Taken:
    """Refuses data whose stamp repeated or jumped."""
    if fault == JUMPED:
        state = replace(state, jumped=topic)
    return state, f"{topic}: its stamp {fault}"


def _find_leap(
    config: GateConfig, state: GateState, odometry: inputs.Odometry, now: float
) -> str:
    """Returns the fault of a pose that the robot can't have reached, or ""."""
    before = state.odometry
    bounds = config.limits
    if before is None or bounds is None:
        return ""
    stamped = (odometry.stamp_ns - before.stamp_ns) * S_PER_NS
    passed = max(stamped, now - state.odometries.times[-1])  # either time may jitter
    noise = frozen.NOISE * np.array(config.odom_std)
    fastest = EXCESS_FACTOR * np.array(limits.get_maximum_speeds(bounds)) + EXCESS
    moved = frozen.measure_motion(between(before.pose, odometry.pose))
    if (moved <= SMALL_JUMP + (fastest + noise) * passed).all():
        return ""
    path, turn = moved
    return f"its pose jumped by {path:.3g} m and {turn:.3g} rad in {passed:.3f} s"


def scan_malformed(config: GateConfig, scan: inputs.Scan) -> str:
    """The scan is not from the declared lidar, or every range is NaN."""
    angles = config.beam_angles
    first, step = scan.angles
    if scan.ranges.shape != angles.shape:
        return f"{scan.ranges.size} beams, not {len(angles)}"
    increment = float(angles[1] - angles[0]) if len(angles) > 1 else step
    last_off = abs(first - angles[0]) + abs(step - increment) * (len(angles) - 1)
    if not last_off <= ANGLE_TOLERANCE:
        return "its angles are not those of the declared lidar"
    if np.isnan(scan.ranges).all():
        return "every range is NaN"
    return ""


def check_reading(config: GateConfig, reading: inputs.SensorReading) -> str:
    """The reading is from an unknown sensor, or not finite."""
    if reading.name not in config.sensors:
        return "there is no such sensor"
    if not np.isfinite(reading.points).all():
        return "NaN or inf"
    return ""


def check_odometry(config: GateConfig, odometry: inputs.Odometry) -> str:
    """The odometry is not finite, or too fast for a mobile robot."""
    if not (np.isfinite(odometry.pose).all() and np.isfinite(odometry.twist).all()):
        return "NaN, inf, or no rotation"
    if np.abs(odometry.twist).max() > MAX_SPEED:
        return f"faster than {MAX_SPEED:g} m/s or rad/s"
    return ""


def estimate_malformed(config: GateConfig, estimate: inputs.Estimate) -> str:
    """The estimate is not finite, or its covariance has a negative variance."""
    parts = (estimate.twist, estimate.pose, estimate.covariance)
    if not all(np.isfinite(part).all() for part in parts):
        return "NaN or inf"
    if (np.diag(estimate.covariance) < 0.0).any():
        return "a variance is negative"
    return ""


def check_finite(config: GateConfig, command: inputs.Command) -> str:
    """The command is not finite."""
    if not np.isfinite(command.twist).all():
        return "NaN or inf"
    return ""


def check_plausible(config: GateConfig, command: inputs.Command) -> str:
    """The command is so far out of range that the policy must be broken."""
    bounds = config.limits
    twist = command.twist
    if bounds is None or not limits.is_implausible(config.command(twist), bounds):
        return ""
    return f"{twist.tolist()} is far out of range"


REFUSALS: tuple[tuple[type, Callable[[GateConfig, Any], str]], ...] = (
    (inputs.Scan, scan_malformed),
    (inputs.Odometry, check_odometry),
    (inputs.SensorReading, check_reading),
    (inputs.Estimate, estimate_malformed),
    (inputs.Command, check_finite),
    (inputs.Command, check_plausible),
)
"""Checks by type of input, in order; each returns the fault of an input, or ""."""
