"""The emergency stop: latched when pressed, and taken for pressed when silent."""

from __future__ import annotations

from nics_drl_bridge.safety.records import replace
from nics_drl_bridge.safety.state import Cause, EStopState, GateConfig, GateState

TOPIC = "e_stop"


def hear(state: EStopState, pressed: bool, now: float) -> EStopState:
    """Notes what its topic said."""
    return EStopState(latched=state.latched or pressed, held=pressed, heard_s=now)


def reset(state: EStopState) -> EStopState:
    """Forgets that it was pressed, unless it still is."""
    return replace(state, latched=state.held)


def e_stop_pressed(config: GateConfig, state: GateState, now: float) -> Cause | None:
    """Somebody pressed it."""
    if not state.e_stop.latched:
        return None
    return Cause("e_stop_pressed", TOPIC, "pressed" if state.e_stop.held else "was pressed")


def e_stop_silent(config: GateConfig, state: GateState, now: float) -> Cause | None:
    """Its cable may be cut. Where none is required, only one that was heard can fall silent."""
    heard = state.e_stop.heard_s
    if heard is None and not config.e_stop_required:
        return None
    old, limit = float("inf") if heard is None else now - heard, config.e_stop_silence_s
    if old <= limit:
        return None
    return Cause("e_stop_silent", TOPIC, "its heartbeat is silent, as if pressed", old, limit)
