"""The gate: decides on every input whether the policy's command passes, and shapes it.

`decide` is a pure function from (configuration, state, input, time) to (state,
decision), so that a replay is bit-identical. For each input it takes these steps:

1. Take its time, and note whether the gate's own clock is at fault.
2. Add it to the state, or refuse it; see `intake`.
3. Arm or reset, if requested; see `arming`.
4. Stop, if a row of `stops.STOPS` finds a cause. A stop is an immediate zero, since limits of
   rate and jerk apply only to motion. It is published at the input that causes it, and
   at every tick while it lasts.
5. Otherwise, at a tick of the gate's clock, publish the newest command after all `SHAPERS`.
"""

import math
from collections.abc import Callable

import numpy as np

from nics_drl_bridge.gate import arming, frozen, inputs, intake, limits, shield, stops
from nics_drl_bridge.gate.state import (
    Cause,
    Decision,
    GateConfig,
    GateState,
    Motion,
    replace,
)


def decide(
    config: GateConfig, state: GateState, event: inputs.Input, now: float
) -> tuple[GateState, Decision]:
    """Decides on an input at a steady time [s]; returns the state after it, and the decision."""
    state = stops.take_time(config, state, event, now)
    if state.clock_fault:
        now = state.now_s  # the last plausible time
    state, refused = intake.take(config, state, event, now)
    answer = ""
    granted = False
    if isinstance(event, inputs.Arm):
        state, answer, granted = arming.arm(config, state, event, now)
    elif isinstance(event, inputs.Reset):
        state, answer, granted = arming.reset(state)
    is_tick = isinstance(event, inputs.Tick)
    publish = False
    is_shielded = False
    cause, latching_cause = _find_causes(config, state, now)
    if cause is not None:
        publish = is_tick or bool(state.value.any())
        stopped_s = now if publish else state.published_s
        state = _stop(config, state, stopped_s, latching_cause)
    # `not <`: an age of NaN publishes, too
    elif is_tick and not now - state.published_s < limits.MIN_STEP_S:
        publish = True
        state, cause = _move(config, state, now)
        is_shielded = state.shielded
    twist = limits.flush_denormals(config.cmd_vel(state.value))
    return state, Decision(twist, publish, cause, refused, answer, granted, is_shielded)


def _find_causes(
    config: GateConfig, state: GateState, now: float
) -> tuple[Cause | None, Cause | None]:
    """Returns the first cause of a stop, after which it is named, and the first latching one."""
    first = None
    if not state.e_stop.latched:
        first = state.latched  # an earlier stop, which waits for a reset
    # Latching rules are checked even after another cause, because their fault may last
    # for one input only.
    for rule in stops.STOPS:
        if rule.needs_clock and state.clock_fault:
            continue
        cause = rule.judge(config, state, now)
        first = first or cause
        if cause is not None and rule.latches:
            return first, cause
    return first, None


def _stop(
    config: GateConfig, state: GateState, stopped_s: float, latching: Cause | None
) -> GateState:
    """Returns the state of a robot that was stopped at a time [s], that of the last publication.

    A latching cause also disarms the gate. The first one stays, until a reset.
    """
    zero = np.zeros_like(state.value)
    recent = state.recent
    if stopped_s > state.published_s:  # the stop is published
        recent = shield.append_command(config, state, zero, stopped_s)
    if latching is not None and state.armed:
        state = replace(state, latched=latching)
    return replace(
        state,
        value=zero,
        slope=zero,
        published_s=stopped_s,
        push=None,
        shielded=False,
        recent=recent,
        armed=state.armed and latching is None,
    )


def _move(
    config: GateConfig, state: GateState, now: float
) -> tuple[GateState, Cause | None]:
    """Returns the state after the newest command passes, or after a stop and its cause."""
    zero = np.zeros(len(config.fields))
    target = zero
    if state.command is not None:
        target = config.command(state.command.twist)
    motion = Motion(target, zero)
    for shape in SHAPERS:
        motion = shape(config, state, motion, now)
    if motion.fault:
        cause = Cause("motion_unfit", "", motion.fault)
        return _stop(config, state, now, cause), cause
    state = replace(
        state,
        value=motion.value,
        slope=motion.slope,
        published_s=now,
        recent=shield.append_command(config, state, motion.value, now),
        shielded=motion.shielded,
    )
    return frozen.watch_motion(config, state, now), None


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
    dt = now - state.published_s if math.isfinite(state.published_s) else config.gap_s
    # A turn need not wait for a speed that the shield holds back.
    waits = not state.shielded
    value, slope = limits.follow(
        state.value, state.slope, motion.value, dt, config.limits, waits
    )
    return replace(motion, value=value, slope=slope)


def bound(config: GateConfig, state: GateState, motion: Motion, now: float) -> Motion:
    """Replaces a motion that is not finite or beyond its limits by zero, whatever came before.

    Denormal values also become zero.
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


SHAPERS: tuple[Callable[[GateConfig, GateState, Motion, float], Motion], ...] = (
    saturate,
    follow,
    shield.shield,
    bound,
)
"""Stages that a command goes through before it is published, in order."""
