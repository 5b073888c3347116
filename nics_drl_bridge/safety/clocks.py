"""The gate's own clock: a time that jumps, freezes or was slept through stops the robot."""

from __future__ import annotations

import math

from nics_drl_bridge.safety.inputs import Input, Tick
from nics_drl_bridge.safety.records import replace
from nics_drl_bridge.safety.state import Cause, GateConfig, GateState

FROZEN_INPUTS = 20
"""So many inputs in a row at one and the same time do not happen with a clock that runs."""


def take_time(config: GateConfig, state: GateState, given: Input, now: float) -> GateState:
    """Notes the time of an input, and what is wrong with it."""
    if not math.isfinite(now) or now < state.now_s:
        return replace(state, clock_fault=f"the steady clock went from {state.now_s} to {now} s")
    still = state.still_ticks + 1 if now == state.now_s else 0
    fault = ""
    if still >= FROZEN_INPUTS:
        fault = f"the steady clock stands still at {now} s"
    ticked, awake = state.tick_s, state.awake_s
    if ticked is not None and now - ticked > config.gap_s:  # whatever wakes it up first
        fault, awake = f"no decision for {now - ticked:.3f} s, the limit is {config.gap_s} s", now
    elif now - awake <= config.gap_s:  # one zero alone may be lost, the newest command counts
        fault = f"awake again for only {now - awake:.3f} s"
    if isinstance(given, Tick):
        ticked = now
    return replace(
        state, now_s=now, tick_s=ticked, awake_s=awake, still_ticks=still, clock_fault=fault
    )


def own_clock(config: GateConfig, state: GateState, now: float) -> Cause | None:
    """The gate can't tell the time, or was asleep."""
    return Cause("own_clock", "", state.clock_fault) if state.clock_fault else None
