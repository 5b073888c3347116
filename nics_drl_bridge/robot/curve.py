"""InputCurve: what a motor makes of a command, and when, before the kinematics."""

from collections.abc import Sequence
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike
from pydantic import AllowInfNan, Field

from nics_drl_bridge.config import Schema
from nics_drl_bridge.geometry import Array

LONGEST_DELAY_S = 60.0  # simulators and estimators keep all commands of such a time
End = Annotated[float, AllowInfNan(), Field(ge=-np.inf)]  # infinite maybe, but not NaN


class InputCurve(Schema):
    """A dead zone about zero, unequal gains, and saturation: a monotone curve of one command."""

    command: str
    # a smaller command moves nothing, in its unit; below 0, any command does so much more
    dead: float = Field(default=0.0, allow_inf_nan=False)
    # smaller and greater commands do no more than these, in its unit; 0 never does anything
    least: End = -np.inf
    most: End = np.inf
    back: float = Field(
        default=1.0, ge=0.0
    )  # gain of negative commands; that of positive ones: 1
    # after the latency of all commands [s]
    delay: float = Field(default=0.0, ge=0.0, le=LONGEST_DELAY_S)

    @property
    def bends(self) -> bool:
        """True if it does more than to delay the command."""
        return self != InputCurve(command=self.command, delay=self.delay)

    @property
    def equation(self) -> str:
        """The curve as text: `throttle' = 0 within +-0.12, else throttle -+ 0.12`."""
        name = self.command
        dead = f"{abs(self.dead):.4g}"
        text = f"0 within +-{dead}, else {name} -+ {dead}" if self.dead > 0.0 else name
        text += f" +- {dead}, 0 at 0" * (self.dead < 0.0)
        text += ends(self.least, self.most, name)
        text += f", backwards times {self.back:.4g}" * (self.back != 1.0)
        return f"{name}' = {text}" + f", {self.delay:.3f} s later" * (self.delay > 0.0)

    def of(self, command: ArrayLike) -> Array:
        """Returns the commands in effect (...): beyond the dead zone, in proportion."""
        held = np.clip(
            np.asarray(command, np.float64), min(self.least, 0.0), max(self.most, 0.0)
        )
        beyond = np.sign(held) * np.maximum(np.abs(held) - self.dead, 0.0)
        return np.where(beyond < 0.0, self.back * beyond, beyond)

    def invert(self, effect: ArrayLike) -> Array:
        """Returns the commands (...) of effects; infinite where greater ones do no more."""
        effect = np.asarray(effect, dtype=np.float64)
        gain = np.where((effect < 0.0) & (self.back > 0.0), self.back, 1.0)
        command = np.sign(effect) * np.maximum(np.abs(effect) / gain + self.dead, 0.0)
        command = np.where(effect <= self.of(-np.inf), -np.inf, command)
        return np.where(effect >= self.of(np.inf), np.inf, command)


def ends(least: float, most: float, name: str = "") -> str:
    """Returns those of two ends that are finite, as text: `, throttle at most 0.8`."""
    both = (("at least", least), ("at most", most))
    named = f"{name} " if name else ""
    return "".join(
        f", {named}{word} {end:.4g}" for word, end in both if np.isfinite(end)
    )


def apply_curves(
    command: ArrayLike, names: Sequence[str], curves: tuple[InputCurve, ...]
) -> Array:
    """Returns the commands in effect (..., C) of commands with C names."""
    values = np.array(command, dtype=np.float64)
    for curve in curves:
        place = names.index(curve.command)
        values[..., place] = curve.of(values[..., place])
    return values


def delays(names: Sequence[str], curves: tuple[InputCurve, ...]) -> Array:
    """Returns the delays (C,) of commands with C names beyond their common latency [s]."""
    known = {curve.command: curve.delay for curve in curves}
    return np.array([known.get(name, 0.0) for name in names])
