"""The policy's commands: are there any, are they numbers, and of what age is the scan behind?"""

from __future__ import annotations

from nics_drl_bridge.safety.freshness import SCAN
from nics_drl_bridge.safety.state import Cause, GateConfig, GateState

RAW = "cmd_vel_raw"


def command_malformed(config: GateConfig, state: GateState, now: float) -> Cause | None:
    """The newest command is no command."""
    return Cause("command_malformed", RAW, state.malformed) if state.malformed else None


def command_missing(config: GateConfig, state: GateState, now: float) -> Cause | None:
    """The policy has not spoken yet."""
    if state.command is not None or state.pending is not None:
        return None
    return Cause("command_missing", RAW, "no command yet")


def command_silent(config: GateConfig, state: GateState, now: float) -> Cause | None:
    """The policy has stopped, or hangs."""
    old, limit = now - state.command_s, config.command_age_s
    if old <= limit or state.command is None:
        return None
    return Cause("command_silent", RAW, "no fresh command", old, limit)


def scan_behind_unknown(config: GateConfig, state: GateState, now: float) -> Cause | None:
    """Commands name scans that do not arrive; from the future, perhaps. One may be on its way."""
    if state.pending is None or state.pending_s is None:
        return None
    if now - state.pending_s <= config.race_s and state.command is not None:
        return None
    return Cause(
        "scan_behind_unknown", RAW, f"the scan behind it ({state.pending.stamp_ns}) never arrived"
    )


def scan_behind_old(config: GateConfig, state: GateState, now: float) -> Cause | None:
    """The scan behind the command is old, however fresh the command: a republisher, or a hang."""
    if state.command is None:
        return None
    old, limit = now - state.behind_s, config.scan_age_s
    if old <= limit:
        return None
    return Cause("scan_behind_old", SCAN, f"the scan behind {RAW} is old", old, limit)
