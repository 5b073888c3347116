"""The gate: one pure function from (time, state, input) to (state, decision).

It reads no clock, uses no random numbers and has no side effects, so that a recording of its
inputs replays to bit-identical decisions. It does nothing that is not in the tables of rules.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from nics_drl_bridge.gate import arming, frozen, limits, stops
from nics_drl_bridge.gate.inputs import Arm, Input, Reset, Tick
from nics_drl_bridge.gate.intake import take
from nics_drl_bridge.gate.shield import shield
from nics_drl_bridge.gate.state import Cause, Decision, GateConfig, GateState, Motion, replace
from nics_drl_bridge.interface import Array


def decide(
    config: GateConfig, state: GateState, given: Input, now: float
) -> tuple[GateState, Decision]:
    """Decides on an input at a steady time [s]; returns the state after it, and the decision.

    Only a tick publishes a motion; a stop is published at the input that causes it, and at every
    tick while it lasts. A stop is an immediate zero: limits of rate and jerk apply to motion.
    """
    state = stops.take_time(config, state, given, now)
    if state.clock_fault:
        now = state.now_s  # the last plausible time
    state, refused = take(config, state, given, now)
    state, answer, granted = _serve(config, state, given, now)
    was_moving = bool(state.value.any())
    cause, latches = first_cause(config, state, now)
    publish = shielded = False
    if cause is not None:
        if latches and state.armed:
            state = replace(state, latched=cause)
        publish = was_moving or isinstance(given, Tick)
        state = _stopped(config, state, now if publish else state.moved_s, disarm=latches)
    elif isinstance(given, Tick) and not now - state.moved_s < limits.LEAST_STEP_S:
        publish, motion = True, _wish(config, state)
        for shape in SHAPERS:
            motion = shape(config, state, motion, now)
        if motion.fault:
            cause = Cause("motion_unfit", "", motion.fault)
            state = _stopped(config, replace(state, latched=cause), now, disarm=True)
        else:
            recent = _recent(config, state, motion.value, now)
            state = replace(
                state, value=motion.value, slope=motion.slope, moved_s=now, recent=recent
            )
            state, shielded = frozen.watch_motion(config, state, now), motion.shielded
    twist = np.zeros(3)
    twist[list(config.fields)] = state.value
    return state, Decision(twist, publish, cause, refused, answer, granted, shielded)


def _serve(
    config: GateConfig, state: GateState, given: Input, now: float
) -> tuple[GateState, str, bool]:
    """Arms or resets, if requested; returns also the answer, and whether it was granted."""
    if isinstance(given, Arm):
        if failed := arming.failures(config, state, given, now):
            return state, "; ".join(failed), False
        return replace(
            state, armed=True, scans=stops.settled(state.scans),
            odometries=stops.settled(state.odometries), seen=(), frozen="", push=None,
        ), "armed", True  # fmt: skip
    if isinstance(given, Reset):
        # The latch is cleared, unless the emergency stop is still pressed.
        stop = replace(state.e_stop, latched=state.e_stop.held)
        state = replace(state, e_stop=stop, latched=None, armed=False)
        if stop.latched:
            return state, "the e-stop is still pressed", False
        return state, "reset; call ~/arm to let commands pass", True
    return state, "", False


def _stopped(config: GateConfig, state: GateState, moved_s: float, disarm: bool) -> GateState:
    zero, published = np.zeros_like(state.value), moved_s > state.moved_s
    return replace(
        state, value=zero, slope=zero, moved_s=moved_s, push=None,
        recent=_recent(config, state, zero, moved_s) if published else state.recent,
        armed=state.armed and not disarm,
    )  # fmt: skip


def _recent(
    config: GateConfig, state: GateState, value: Array, now: float
) -> tuple[tuple[float, Array], ...]:
    """Returns a new command after those since the newest scan, or within the latency before it."""
    if config.shield is None:
        return ()
    since, sent = now - config.shield.latency_s - config.scan_age_s, (*state.recent, (now, value))
    # A command from before `since` was in force until the next one.
    return tuple(one for one, after in pairwise((*sent, sent[-1])) if after[0] >= since)


class Rule(NamedTuple):
    """A reason to stop; its name is that of the function that returns the cause, or None."""

    judge: Callable[[GateConfig, GateState, float], Cause | None]
    latches: bool = False  # the stop stays until a reset


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


def first_cause(config: GateConfig, state: GateState, now: float) -> tuple[Cause | None, bool]:
    """Returns the first cause to stop the robot, and whether it latches."""
    for rule in STOPS:
        cause = rule.judge(config, state, now)
        if cause is not None:
            return cause, rule.latches
    return None, False


def _wish(config: GateConfig, state: GateState) -> Motion:
    still = np.zeros(len(config.fields))
    wish = still if state.command is None else state.command.twist[list(config.fields)]
    return Motion(wish.astype(np.float64), still)


def saturate(config: GateConfig, state: GateState, motion: Motion, now: float) -> Motion:
    """Brings the value within its limits, see `limits.saturate`; without limits it is zero."""
    if config.limits is None:
        return Motion(np.zeros_like(motion.value), np.zeros_like(motion.slope))
    return replace(motion, value=limits.saturate(motion.value, config.limits))


def follow(config: GateConfig, state: GateState, motion: Motion, now: float) -> Motion:
    """Limits rate and jerk, see `limits.follow`."""
    if config.limits is None:
        return motion
    since = now - state.moved_s if math.isfinite(state.moved_s) else config.gap_s
    value, slope = limits.follow(state.value, state.slope, motion.value, since, config.limits)
    return replace(motion, value=value, slope=slope)


def bounded(config: GateConfig, state: GateState, motion: Motion, now: float) -> Motion:
    """Replaces a motion that is not finite or beyond its limits by zero, whatever came before."""
    good = config.limits is None or limits.within(motion.value, config.limits)
    if good and np.isfinite(motion.value).all() and np.isfinite(motion.slope).all():
        return motion
    zero = np.zeros_like(motion.value)
    return replace(
        motion, value=zero, slope=zero, fault=f"a motion of {motion.value.tolist()} came out"
    )


# Stages that a passing command goes through.
SHAPERS: tuple[Callable[[GateConfig, GateState, Motion, float], Motion], ...] = (
    saturate, follow, shield, bounded,
)  # fmt: skip
