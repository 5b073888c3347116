"""From the policy's command to the motion that is published: saturate, follow, shield."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.gate import limits
from nics_drl_bridge.gate.records import replace
from nics_drl_bridge.gate.state import GateConfig, GateState

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Motion:
    """A command on its way through the gate.

    Attributes:
        value: (C,) of the command.
        slope: (C,) its change per second.
        shielded: whether the shield reduced it.
        fault: why it must not be published; usually empty.
    """

    value: Array
    slope: Array
    shielded: bool = False
    fault: str = ""


def asked(config: GateConfig, state: GateState) -> Motion:
    """Returns the motion that the policy requests."""
    size = len(config.fields)
    wish = np.zeros(size) if state.command is None else state.command.twist[list(config.fields)]
    return Motion(wish.astype(np.float64), np.zeros(size))


def saturate(config: GateConfig, state: GateState, motion: Motion, now: float) -> Motion:
    """Brings the value within its limits, see `limits.saturate`."""
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
