"""What the gate takes in. Data that are no data are refused, and feed no watchdog."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from nics_drl_bridge.safety import e_stop, frozen, moving, shield
from nics_drl_bridge.safety.freshness import ODOM, SCAN, arrived
from nics_drl_bridge.safety.inputs import Command, Estimate, EStop, Input, Odometry, Press, Scan
from nics_drl_bridge.safety.limits import implausible
from nics_drl_bridge.safety.state import GateConfig, GateState

GREATEST_SPEED = 100.0
"""No odometry of a mobile robot shows more [m/s, rad/s]."""
ANGLE_TOLERANCE = 1e-3
"""By which the last beam may point elsewhere than declared [rad]."""


@dataclass(frozen=True)
class Refusal:
    """A reason not to take an input.

    Attributes:
        name: of the rule.
        kind: of the inputs that it judges.
        judge: says what is wrong, or nothing.
    """

    name: str
    kind: type
    judge: Callable[[GateConfig, GateState, Input], str]


def scan_malformed(config: GateConfig, state: GateState, scan: Input) -> str:
    """A scan of another lidar than the declared one, or that knows nothing."""
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
    """An odometry that is no number, or of no mobile robot."""
    if not isinstance(odometry, Odometry):
        return ""
    if not (np.isfinite(odometry.pose).all() and np.isfinite(odometry.twist).all()):
        return "odom: NaN, inf, or no rotation"
    if np.abs(odometry.twist).max() > GREATEST_SPEED:
        return f"odom: faster than {GREATEST_SPEED:g} m/s or rad/s"
    return ""


def estimate_malformed(config: GateConfig, state: GateState, estimate: Input) -> str:
    """An estimate that is no number."""
    if not isinstance(estimate, Estimate):
        return ""
    finite = np.isfinite(estimate.twist).all() and np.isfinite(estimate.std).all()
    return "" if finite else "odometry/filtered: NaN or inf"


def command_not_finite(config: GateConfig, state: GateState, command: Input) -> str:
    """A command that is no number."""
    if not isinstance(command, Command) or np.isfinite(command.twist).all():
        return ""
    return "cmd_vel_raw: NaN or inf"


def command_implausible(config: GateConfig, state: GateState, command: Input) -> str:
    """A command so far out of range that the policy must be broken."""
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
    """Takes an input into the state, or says why not."""
    state = replace(state, jumped="")
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
        state = replace(state, e_stop=e_stop.hear(state.e_stop, given.pressed, now))
    elif isinstance(given, Press):
        state = replace(state, e_stop=replace(state.e_stop, latched=True))
    return state, ""


def _take_command(state: GateState, command: Command, now: float) -> GateState:
    """A command counts once the scan behind it is here, too; the one before holds until then."""
    if command.stamp_ns not in state.scans.stamps_ns:
        since = now if state.pending_s is None else state.pending_s
        return replace(state, pending=command, pending_s=since)
    return replace(
        state, command=command, command_s=now, malformed="", pending=None, pending_s=None
    )


def _take_scan(
    config: GateConfig, state: GateState, scan: Scan, now: float
) -> tuple[GateState, str]:
    arrivals, fault = arrived(state.scans, scan.stamp_ns, now, config.clock_jump_s)
    if fault:
        jumped = SCAN if fault == "jumped" else ""
        return replace(state, scans=arrivals, jumped=jumped), f"scan: its stamp {fault}"
    same, views = frozen.compare(state, scan), moving.remember(config, state, scan)
    state = replace(
        state, scans=arrivals, scan=scan, same=same, views=views,
        obstacles=shield.obstacles(config, scan.ranges, views),
    )  # fmt: skip
    if state.pending is not None and state.pending.stamp_ns == scan.stamp_ns:
        state = _take_command(state, state.pending, now)
    return state, ""


def _take_odometry(
    config: GateConfig, state: GateState, odometry: Odometry, now: float
) -> tuple[GateState, str]:
    arrivals, fault = arrived(state.odometries, odometry.stamp_ns, now, config.clock_jump_s)
    if fault:
        jumped = ODOM if fault == "jumped" else ""
        return replace(state, odometries=arrivals, jumped=jumped), f"odom: its stamp {fault}"
    restless = state.restless_s if frozen.stands_still(config, odometry.twist) else now
    return replace(state, odometries=arrivals, odometry=odometry, restless_s=restless), ""
