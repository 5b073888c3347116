"""The tables of all rules. What a table does not hold, the gate does not do."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from nics_drl_bridge.safety import clocks, e_stop, freshness, frozen, motion, watchdogs
from nics_drl_bridge.safety.motion import Motion
from nics_drl_bridge.safety.shield import shield
from nics_drl_bridge.safety.state import Cause, GateConfig, GateState


@dataclass(frozen=True)
class Rule:
    """A reason to stop.

    Attributes:
        judge: gives the cause of a stop, or None; its name is the rule's.
        latches: whether the stop stays until a reset.
    """

    judge: Callable[[GateConfig, GateState, float], Cause | None]
    latches: bool = False


def latched(config: GateConfig, state: GateState, now: float) -> Cause | None:
    """A stop of before waits for a reset."""
    return state.latched


def disarmed(config: GateConfig, state: GateState, now: float) -> Cause | None:
    """Nobody has armed the gate."""
    return None if state.armed else Cause("disarmed", "", "call ~/arm to let commands pass")


STOPS: tuple[Rule, ...] = (
    Rule(e_stop.e_stop_pressed, latches=True),
    Rule(latched),
    Rule(disarmed),
    Rule(clocks.own_clock),
    Rule(e_stop.e_stop_silent, latches=True),
    Rule(freshness.stamps_jumped, latches=True),
    Rule(frozen.odom_jumped, latches=True),
    Rule(frozen.scan_frozen, latches=True),
    Rule(frozen.no_motion, latches=True),
    Rule(freshness.scan_silent),
    Rule(freshness.odom_silent),
    Rule(watchdogs.command_malformed),
    Rule(watchdogs.command_missing),
    Rule(watchdogs.command_silent),
    Rule(watchdogs.scan_behind_unknown),
    Rule(watchdogs.scan_behind_old),
)
"""In the order in which they are asked; the first that speaks names the stop."""

Shaper = Callable[[GateConfig, GateState, Motion, float], Motion]
SHAPERS: tuple[Shaper, ...] = (motion.saturate, motion.follow, shield, motion.bounded)
"""What a command that passes goes through."""


def first_cause(config: GateConfig, state: GateState, now: float) -> tuple[Cause | None, bool]:
    """The first rule that stops the robot, and whether it latches."""
    for rule in STOPS:
        cause = rule.judge(config, state, now)
        if cause is not None:
            return cause, rule.latches
    return None, False
