"""The gate's records as plain data for JSON, and back to the same bits."""

from __future__ import annotations

import base64
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np

from nics_drl_bridge.safety import inputs, limits, state

KIND = "kind"
KINDS: dict[str, type] = {
    kind.__name__: kind
    for kind in (
        inputs.Scan, inputs.Odometry, inputs.Estimate, inputs.Command, inputs.EStop, inputs.Press,
        inputs.Arm, inputs.Reset, inputs.Tick, limits.Limits, state.ShieldConfig, state.GateConfig,
        state.Cause, state.Arrivals, state.Sameness, state.Push, state.View, state.EStopState,
        state.GateState, state.Decision,
    )
}  # fmt: skip


def to_plain(value: Any) -> Any:
    """A record of the gate as dictionaries, lists, numbers and text.

    Arrays keep their bits; a float in JSON reads back to the same one.
    """
    if is_dataclass(value) and not isinstance(value, type):
        content = {each.name: to_plain(getattr(value, each.name)) for each in fields(value)}
        return {KIND: type(value).__name__, **content}
    if isinstance(value, np.ndarray):
        data = base64.b64encode(np.ascontiguousarray(value).tobytes()).decode()
        return {KIND: "array", "type": value.dtype.str, "shape": list(value.shape), "data": data}
    if isinstance(value, tuple):
        return [to_plain(each) for each in value]
    if isinstance(value, np.generic):
        return value.item()
    return value


def from_plain(value: Any) -> Any:
    """The record that `to_plain` was given. Raises ValueError when it is damaged."""
    if isinstance(value, list):
        return tuple(from_plain(each) for each in value)
    if not isinstance(value, dict):
        return value
    content = dict(value)
    kind = content.pop(KIND, None)
    try:
        if kind == "array":
            data = base64.b64decode(content["data"])
            array = np.frombuffer(data, np.dtype(content["type"])).reshape(content["shape"])
            return array.copy()
        return KINDS[kind](**{name: from_plain(each) for name, each in content.items()})
    except (KeyError, TypeError) as error:
        raise ValueError(f"{kind!r} can't be read ({error})") from None
