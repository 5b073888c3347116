"""Intake of the gate. Malformed data are refused, and feed no watchdog."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from nics_drl_bridge.gate import frozen, shield, stops
from nics_drl_bridge.gate.inputs import Command, Estimate, EStop, Input, Odometry, Press, Scan
from nics_drl_bridge.gate.limits import greatest, implausible
from nics_drl_bridge.gate.state import EStopState, GateConfig, GateState, replace
from nics_drl_bridge.geometry import between
from nics_drl_bridge.interface import S_PER_NS

GREATEST_SPEED = 100.0  # greatest speed that the odometry of a mobile robot can show [m/s, rad/s]
SLIP, SLIP_SPEED, SLIP_TURN = 2.0, 0.5, 1.0
"""A robot may exceed its limits by this factor, downhill or pushed, plus [m/s] and [rad/s]."""
CAR_TURN = 4.0  # greatest turn rate of a robot that is commanded by steering angle [rad/s]
LEAP, LEAP_TURN = 0.1, 0.2  # jump of an odometry pose that may come from imprecision [m, rad]
ANGLE_TOLERANCE = 1e-3  # greatest deviation of the last beam from its declared angle [rad]


def scan_malformed(config: GateConfig, scan: Scan) -> str:
    """The scan is from another lidar than the declared one, or every range is NaN."""
    angles, (first, step) = config.beam_angles, scan.angles
    if scan.ranges.shape != angles.shape:
        return f"scan: {scan.ranges.size} beams, not {len(angles)}"
    increment = float(angles[1] - angles[0]) if len(angles) > 1 else step
    last_off = abs(first - angles[0]) + abs(step - increment) * (len(angles) - 1)
    if not last_off <= ANGLE_TOLERANCE:
        return "scan: its angles are not those of the declared lidar"
    return "scan: every range is NaN" if np.isnan(scan.ranges).all() else ""


def odom_malformed(config: GateConfig, odometry: Odometry) -> str:
    """The odometry is not finite, or too fast for a mobile robot."""
    if not (np.isfinite(odometry.pose).all() and np.isfinite(odometry.twist).all()):
        return "odom: NaN, inf, or no rotation"
    fast = np.abs(odometry.twist).max() > GREATEST_SPEED
    return f"odom: faster than {GREATEST_SPEED:g} m/s or rad/s" if fast else ""


def estimate_malformed(config: GateConfig, estimate: Estimate) -> str:
    """The estimate is not finite."""
    finite = np.isfinite(estimate.twist).all() and np.isfinite(estimate.std).all()
    return "" if finite else "odometry/filtered: NaN or inf"


def command_not_finite(config: GateConfig, command: Command) -> str:
    """The command is not finite."""
    return "" if np.isfinite(command.twist).all() else "cmd_vel_raw: NaN or inf"


def command_implausible(config: GateConfig, command: Command) -> str:
    """The command is so far out of range that the policy must be broken."""
    limits, twist = config.limits, command.twist
    if limits is None or not implausible(twist[list(config.fields)], limits):
        return ""
    return f"cmd_vel_raw: {twist.tolist()} is far out of range"


REFUSALS: tuple[tuple[type, Callable[[GateConfig, Any], str]], ...] = (
    (Scan, scan_malformed),
    (Odometry, odom_malformed),
    (Estimate, estimate_malformed),
    (Command, command_not_finite),
    (Command, command_implausible),
)
"""By the type of the input, in order: what is wrong with it; empty if nothing is."""


def take(config: GateConfig, state: GateState, given: Input, now: float) -> tuple[GateState, str]:
    """Takes an input into the state, or returns the reason why not."""
    state = replace(state, jumped="", leap="")
    for kind, judge in REFUSALS:
        reason = judge(config, given) if isinstance(given, kind) else ""
        if reason:
            return replace(state, malformed=reason) if kind is Command else state, reason
    if isinstance(given, Scan):
        return _take_scan(config, state, given, now)
    if isinstance(given, Odometry):
        return _take_odometry(config, state, given, now)
    if isinstance(given, Estimate):
        state = replace(state, estimate=given, estimate_s=now)
    elif isinstance(given, Command):
        state = _take_command(state, given, now)
    elif isinstance(given, EStop):
        pressed = given.pressed
        stop = EStopState(latched=state.e_stop.latched or pressed, held=pressed, heard_s=now)
        state = replace(state, e_stop=stop)
    elif isinstance(given, Press):
        state = replace(state, e_stop=replace(state.e_stop, latched=True))
    return state, ""


def _take_command(state: GateState, command: Command, now: float) -> GateState:
    """Takes a command once its scan has arrived; until then the previous one stays in force."""
    scans = state.scans
    if command.stamp_ns not in scans.stamps_ns:
        since = now if state.pending_s is None else state.pending_s
        return replace(state, pending=command, pending_s=since)
    behind = scans.stamps_ns.index(command.stamp_ns)
    return replace(
        state, command=command, command_s=now, behind_s=scans.times[behind] - scans.late[behind],
        malformed="", pending=None, pending_s=None,
    )  # fmt: skip


def _take_scan(
    config: GateConfig, state: GateState, scan: Scan, now: float
) -> tuple[GateState, str]:
    arrivals, fault = stops.arrived(
        config, state.scans, scan.stamp_ns, now, config.scan_age_s, state.armed
    )
    if fault:
        jumped = stops.SCAN if fault == "jumped" else ""
        return replace(state, scans=arrivals, jumped=jumped), f"scan: its stamp {fault}"
    pose = None if state.odometry is None else state.odometry.pose
    seen, why = frozen.look(config, state.seen, scan.ranges, pose)
    views = shield.remember(config, state, scan)
    state = replace(
        state, scans=arrivals, scan=scan, seen=seen, frozen=why, views=views,
        obstacles=shield.obstacles(config, scan.ranges, views),
    )  # fmt: skip
    if state.pending is not None and state.pending.stamp_ns == scan.stamp_ns:
        state = _take_command(state, state.pending, now)
    return state, ""


def _take_odometry(
    config: GateConfig, state: GateState, odometry: Odometry, now: float
) -> tuple[GateState, str]:
    arrivals, fault = stops.arrived(
        config, state.odometries, odometry.stamp_ns, now, config.odom_age_s, state.armed
    )
    if fault:
        jumped = stops.ODOM if fault == "jumped" else ""
        return replace(state, odometries=arrivals, jumped=jumped), f"odom: its stamp {fault}"
    leap = _leap(config, state, odometry, now)
    if leap:  # later poses are judged relative to this one
        return replace(state, odometry=odometry, leap=leap, push=None, seen=()), f"odom: {leap}"
    restless = state.restless_s if frozen.stands_still(config, odometry.twist) else now
    return replace(state, odometries=arrivals, odometry=odometry, restless_s=restless), ""


def _leap(config: GateConfig, state: GateState, odometry: Odometry, now: float) -> str:
    """Returns what is wrong with a pose that the robot can't have reached; empty if nothing is."""
    before, limits = state.odometry, config.limits
    if before is None or limits is None:
        return ""
    stamped = (odometry.stamp_ns - before.stamp_ns) * S_PER_NS
    passed = max(stamped, now - state.odometries.times[-1])  # either of them may jitter
    slip, turned = (frozen.NOISE * std * passed for std in config.odom_std)
    turn = CAR_TURN if not limits.turn.any() else greatest(limits, limits.turn)
    speed = float(np.hypot.reduce(np.maximum(-limits.low, limits.high)[limits.linear]))
    far = LEAP + (SLIP * speed + SLIP_SPEED) * passed + slip
    round_ = LEAP_TURN + (SLIP * turn + SLIP_TURN) * passed + turned
    x, y, heading = between(before.pose, odometry.pose)
    path = float(np.hypot(x, y))
    if path <= far and abs(heading) <= round_:
        return ""
    return f"its pose jumped by {path:.2f} m and {abs(heading):.2f} rad in {passed:.3f} s"
