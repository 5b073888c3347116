"""Intake of the gate. Malformed data are refused, and feed no watchdog."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from nics_drl_bridge.gate import frozen, moving, shield, stops
from nics_drl_bridge.gate.frozen import NOISE
from nics_drl_bridge.gate.inputs import Command, Estimate, EStop, Input, Odometry, Press, Scan
from nics_drl_bridge.gate.limits import greatest, implausible
from nics_drl_bridge.gate.records import replace
from nics_drl_bridge.gate.state import GateConfig, GateState
from nics_drl_bridge.gate.stops import ODOM, SCAN, arrived
from nics_drl_bridge.geometry import between
from nics_drl_bridge.interface import S_PER_NS

GREATEST_SPEED = 100.0
"""Greatest speed that the odometry of a mobile robot can show [m/s, rad/s]."""
SLIP = 2.0
"""Factor by which a robot may exceed its limits, downhill or pushed."""
SLIP_SPEED, SLIP_TURN = 0.5, 1.0
"""Further excess on top of that factor [m/s, rad/s]."""
CAR_TURN = 4.0
"""Greatest turn rate of a robot that is commanded by steering angle [rad/s]."""
LEAP, LEAP_TURN = 0.1, 0.2
"""Jump of an odometry pose that may come from imprecision [m, rad]."""
ANGLE_TOLERANCE = 1e-3
"""Greatest deviation of the last beam from its declared angle [rad]."""


@dataclass(frozen=True)
class Refusal:
    """A rule that refuses inputs.

    Attributes:
        name: of the rule.
        kind: type of the inputs that it judges.
        judge: returns what is wrong; empty if nothing is.
    """

    name: str
    kind: type
    judge: Callable[[GateConfig, GateState, Input], str]


def scan_malformed(config: GateConfig, state: GateState, scan: Input) -> str:
    """The scan is from another lidar than the declared one, or every range is NaN."""
    if not isinstance(scan, Scan):
        return ""
    beams, angles = len(config.beam_angles), config.beam_angles
    if scan.ranges.shape != (beams,):
        return f"scan: {scan.ranges.size} beams, not {beams}"
    first, step = scan.angles
    increment = float(angles[1] - angles[0]) if beams > 1 else step
    last_off = abs(first - angles[0]) + abs(step - increment) * (beams - 1)
    if not last_off <= ANGLE_TOLERANCE:
        return "scan: its angles are not those of the declared lidar"
    if np.isnan(scan.ranges).all():
        return "scan: every range is NaN"
    return ""


def odom_malformed(config: GateConfig, state: GateState, odometry: Input) -> str:
    """The odometry is not finite, or too fast for a mobile robot."""
    if not isinstance(odometry, Odometry):
        return ""
    if not (np.isfinite(odometry.pose).all() and np.isfinite(odometry.twist).all()):
        return "odom: NaN, inf, or no rotation"
    if np.abs(odometry.twist).max() > GREATEST_SPEED:
        return f"odom: faster than {GREATEST_SPEED:g} m/s or rad/s"
    return ""


def estimate_malformed(config: GateConfig, state: GateState, estimate: Input) -> str:
    """The estimate is not finite."""
    if not isinstance(estimate, Estimate):
        return ""
    finite = np.isfinite(estimate.twist).all() and np.isfinite(estimate.std).all()
    return "" if finite else "odometry/filtered: NaN or inf"


def command_not_finite(config: GateConfig, state: GateState, command: Input) -> str:
    """The command is not finite."""
    if not isinstance(command, Command) or np.isfinite(command.twist).all():
        return ""
    return "cmd_vel_raw: NaN or inf"


def command_implausible(config: GateConfig, state: GateState, command: Input) -> str:
    """The command is so far out of range that the policy must be broken."""
    if not isinstance(command, Command) or config.limits is None:
        return ""
    if implausible(command.twist[list(config.fields)], config.limits):
        return f"cmd_vel_raw: {command.twist.tolist()} is far out of range"
    return ""


REFUSALS: tuple[Refusal, ...] = (
    Refusal("scan_malformed", Scan, scan_malformed),
    Refusal("odom_malformed", Odometry, odom_malformed),
    Refusal("estimate_malformed", Estimate, estimate_malformed),
    Refusal("command_not_finite", Command, command_not_finite),
    Refusal("command_implausible", Command, command_implausible),
)


def take(config: GateConfig, state: GateState, given: Input, now: float) -> tuple[GateState, str]:
    """Takes an input into the state, or returns the reason why not."""
    state = replace(state, jumped="", leap="")
    for refusal in REFUSALS:
        reason = refusal.judge(config, state, given) if isinstance(given, refusal.kind) else ""
        if reason:
            if isinstance(given, Command):
                state = replace(state, malformed=reason)
            return state, reason
    if isinstance(given, Scan):
        return _take_scan(config, state, given, now)
    if isinstance(given, Odometry):
        return _take_odometry(config, state, given, now)
    if isinstance(given, Estimate):
        state = replace(state, estimate=given, estimate_s=now)
    elif isinstance(given, Command):
        state = _take_command(state, given, now)
    elif isinstance(given, EStop):
        state = replace(state, e_stop=stops.hear(state.e_stop, given.pressed, now))
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
    arrivals, fault = arrived(
        config, state.scans, scan.stamp_ns, now, config.scan_age_s, state.armed
    )
    if fault:
        jumped = SCAN if fault == "jumped" else ""
        return replace(state, scans=arrivals, jumped=jumped), f"scan: its stamp {fault}"
    pose = None if state.odometry is None else state.odometry.pose
    seen, why = frozen.look(config, state.seen, scan.ranges, pose)
    views = moving.remember(config, state, scan)
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
    arrivals, fault = arrived(
        config, state.odometries, odometry.stamp_ns, now, config.odom_age_s, state.armed
    )
    if fault:
        jumped = ODOM if fault == "jumped" else ""
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
    slip, turned = (NOISE * std * passed for std in config.odom_std)
    turn = CAR_TURN if not limits.turn.any() else greatest(limits, limits.turn)
    speed = float(np.hypot.reduce(np.maximum(-limits.low, limits.high)[limits.linear]))
    far = LEAP + (SLIP * speed + SLIP_SPEED) * passed + slip
    round_ = LEAP_TURN + (SLIP * turn + SLIP_TURN) * passed + turned
    x, y, heading = between(before.pose, odometry.pose)
    path = float(np.hypot(x, y))
    if path <= far and abs(heading) <= round_:
        return ""
    return f"its pose jumped by {path:.2f} m and {abs(heading):.2f} rad in {passed:.3f} s"
