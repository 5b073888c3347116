"""The gate: one pure function from (time, state, input) to (state, decision).

It reads no clock, uses no random numbers and has no side effects, so that a recording of its
inputs replays to bit-identical decisions.

Tables of all rules; the gate does nothing that is not in them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.gate import arming, frozen, motion, stops
from nics_drl_bridge.gate.frozen import watch_motion
from nics_drl_bridge.gate.inputs import Arm, Input, Reset, Tick
from nics_drl_bridge.gate.intake import take
from nics_drl_bridge.gate.limits import LEAST_STEP_S
from nics_drl_bridge.gate.motion import Motion
from nics_drl_bridge.gate.records import replace
from nics_drl_bridge.gate.shield import shield
from nics_drl_bridge.gate.state import Cause, Decision, GateConfig, GateState
from nics_drl_bridge.gate.stops import reset, settled, take_time

Array = NDArray[np.float64]


def decide(
    config: GateConfig, state: GateState, given: Input, now: float
) -> tuple[GateState, Decision]:
    """Decides on an input.

    Only a tick publishes a motion; a stop is published at the input that causes it, and at every
    tick while it lasts. A stop is an immediate zero: limits of rate and jerk apply to motion.

    Args:
        config: of the gate.
        state: before the input.
        given: the input.
        now: steady time [s].

    Returns:
        The state after, and the decision.
    """
    state = take_time(config, state, given, now)
    if state.clock_fault:
        now = state.now_s  # the last plausible time
    state, refused = take(config, state, given, now)
    state, answer = _serve(config, state, given, now)
    was_moving = bool(state.value.any())
    cause, latches = first_cause(config, state, now)
    if cause is not None:
        if latches and state.armed:
            state = replace(state, latched=cause)
        publish = was_moving or isinstance(given, Tick)
        state = _stopped(config, state, now if publish else state.moved_s, disarm=latches)
        return state, _decision(config, state, publish, cause, refused, answer)
    if not isinstance(given, Tick) or now - state.moved_s < LEAST_STEP_S:
        return state, _decision(config, state, False, None, refused, answer)
    moved = _shaped(config, state, now)
    if moved.fault:
        cause = Cause("motion_unfit", "", moved.fault)
        state = _stopped(config, replace(state, latched=cause), now, disarm=True)
        return state, _decision(config, state, True, cause, refused, answer)
    state = _move(config, state, moved, now)
    decision = _decision(config, state, True, None, refused, answer)
    return state, replace(decision, shielded=moved.shielded)


@dataclass(frozen=True)
class _Answer:
    text: str = ""
    granted: bool = False


def _serve(
    config: GateConfig, state: GateState, given: Input, now: float
) -> tuple[GateState, _Answer]:
    """Arms or resets, if requested."""
    if isinstance(given, Arm):
        failed = arming.failures(config, state, given, now)
        if failed:
            return state, _Answer("; ".join(failed))
        scans, odometries = settled(state.scans), settled(state.odometries)
        state = replace(
            state, armed=True, scans=scans, odometries=odometries, seen=(), frozen="", push=None
        )
        return state, _Answer("armed", granted=True)
    if isinstance(given, Reset):
        stop = reset(state.e_stop)
        state = replace(state, e_stop=stop, latched=None, armed=False)
        if stop.latched:
            return state, _Answer("the e-stop is still pressed")
        return state, _Answer("reset; call ~/arm to let commands pass", granted=True)
    return state, _Answer()


def _stopped(config: GateConfig, state: GateState, moved_s: float, disarm: bool) -> GateState:
    zero, told = np.zeros_like(state.value), moved_s > state.moved_s
    return replace(
        state, value=zero, slope=zero, moved_s=moved_s, push=None,
        recent=_recent(config, state, zero, moved_s) if told else state.recent,
        armed=state.armed and not disarm,
    )  # fmt: skip


def _recent(
    config: GateConfig, state: GateState, value: Array, now: float
) -> tuple[tuple[float, Array], ...]:
    """Returns the commands that the newest scan may not show yet, and a new one.

    Those are the ones since the scan was taken, or within the latency before.
    """
    if config.shield is None:
        return ()
    since = now - config.shield.latency_s - config.scan_age_s
    told = (*state.recent, (now, value))
    # A command from before `since` was in force until the next one.
    return tuple(one for one, after in pairwise((*told, told[-1])) if after[0] >= since)


def _shaped(config: GateConfig, state: GateState, now: float) -> motion.Motion:
    """Returns the next motion towards the newest command."""
    moved = motion.asked(config, state)
    for shape in SHAPERS:
        moved = shape(config, state, moved, now)
    return moved


def _move(config: GateConfig, state: GateState, moved: motion.Motion, now: float) -> GateState:
    """Returns the state after a motion is published."""
    state = replace(
        state, value=moved.value, slope=moved.slope, moved_s=now,
        recent=_recent(config, state, moved.value, now),
    )  # fmt: skip
    return watch_motion(config, state, now)


def _decision(
    config: GateConfig,
    state: GateState,
    publish: bool,
    cause: Cause | None,
    refused: str,
    answer: _Answer,
) -> Decision:
    twist = np.zeros(3)
    twist[list(config.fields)] = state.value
    return Decision(twist, publish, cause, refused, answer.text, answer.granted)


@dataclass(frozen=True)
class Rule:
    """A reason to stop.

    Attributes:
        judge: returns the cause of a stop, or None; its name is that of the rule.
        latches: whether the stop stays until a reset.
    """

    judge: Callable[[GateConfig, GateState, float], Cause | None]
    latches: bool = False


def latched(config: GateConfig, state: GateState, now: float) -> Cause | None:
    """An earlier stop waits for a reset."""
    return state.latched


def disarmed(config: GateConfig, state: GateState, now: float) -> Cause | None:
    """The gate has not been armed."""
    return None if state.armed else Cause("disarmed", "", "call ~/arm to let commands pass")


STOPS: tuple[Rule, ...] = (
    Rule(stops.e_stop_pressed, latches=True),
    Rule(latched),
    Rule(disarmed),
    Rule(stops.own_clock),
    Rule(stops.e_stop_silent, latches=True),
    Rule(stops.stamps_jumped, latches=True),
    Rule(frozen.odom_jumped, latches=True),
    Rule(frozen.scan_frozen, latches=True),
    Rule(frozen.no_motion, latches=True),
    Rule(stops.scan_silent),
    Rule(stops.odom_silent),
    Rule(stops.command_malformed),
    Rule(stops.command_missing),
    Rule(stops.command_silent),
    Rule(stops.scan_behind_unknown),
    Rule(stops.scan_behind_old),
)
"""In order of evaluation; the first rule that returns a cause names the stop."""

Shaper = Callable[[GateConfig, GateState, Motion, float], Motion]
SHAPERS: tuple[Shaper, ...] = (motion.saturate, motion.follow, shield, motion.bounded)
"""Stages that a passing command goes through."""


def first_cause(config: GateConfig, state: GateState, now: float) -> tuple[Cause | None, bool]:
    """Returns the first cause to stop the robot, and whether it latches."""
    for rule in STOPS:
        cause = rule.judge(config, state, now)
        if cause is not None:
            return cause, rule.latches
    return None, False
