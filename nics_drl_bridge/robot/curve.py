"""InputCurve: the effect of a command, through its motor's curve and after its delay."""

from collections.abc import Sequence
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike
from pydantic import AllowInfNan, Field

from nics_drl_bridge.config import Schema
from nics_drl_bridge.geometry import Array

LONGEST_DELAY_S = 60.0  # simulators and estimators keep commands for this long
End = Annotated[float, AllowInfNan(), Field(ge=-np.inf)]  # may be infinite, but not NaN


class InputCurve(Schema):
    """A dead zone about zero, unequal gains, and saturation: a monotone curve of one command."""

    command: str
    # dead zone in the command's unit: smaller commands have no effect; a negative value
    # instead increases every effect by its magnitude
    dead: float = Field(default=0.0, allow_inf_nan=False)
    # commands saturate at this minimum, in their unit; the effect of 0 is 0
    least: End = -np.inf
    most: End = np.inf  # commands saturate at this maximum
    back: float = Field(default=1.0, ge=0.0)  # gain of negative commands
    # in addition to the latency of all commands [s]
    delay: float = Field(default=0.0, ge=0.0, le=LONGEST_DELAY_S)

    @property
    def bends(self) -> bool:
        """True if it does more than delay the command."""
        return self != InputCurve(command=self.command, delay=self.delay)

    @property
    def equation(self) -> str:
        """The curve as text: `throttle' = 0 within +-0.12, else throttle -+ 0.12`."""
        name = self.command
        dead = f"{abs(self.dead):.4g}"
        text = f"{name}' = "
        if self.dead > 0.0:
            text += f"0 within +-{dead}, else {name} -+ {dead}"
        elif self.dead < 0.0:
            text += f"{name} +- {dead}, 0 at 0"
        else:
            text += name
        text += ends(self.least, self.most, name)
        if self.back != 1.0:
            text += f", backwards times {self.back:.4g}"
        if self.delay > 0.0:
            text += f", {self.delay:.3f} s later"
        return text

    def of(self, command: ArrayLike) -> Array:
        """Returns the effects (...) of commands (...)."""
        command = np.asarray(command, np.float64)
        clipped = np.clip(command, min(self.least, 0.0), max(self.most, 0.0))
        effect: Array = np.sign(clipped)
        effect = effect * np.maximum(np.abs(clipped) - self.dead, 0.0)
        return np.where(effect < 0.0, self.back * effect, effect)

    def invert(self, effect: ArrayLike) -> Array:
        """Returns the commands (...) of effects (...); infinite beyond saturation."""
        effect = np.asarray(effect, dtype=np.float64)
        gain = np.where((effect < 0.0) & (self.back > 0.0), self.back, 1.0)
        command = np.sign(effect) * np.maximum(np.abs(effect) / gain + self.dead, 0.0)
        command = np.where(effect <= self.of(-np.inf), -np.inf, command)
        return np.where(effect >= self.of(np.inf), np.inf, command)


def ends(least: float, most: float, name: str = "") -> str:
    """Describes two bounds without the infinite ones: `, throttle at most 0.8`."""
    prefix = ", "
    if name:
        prefix += f"{name} "
    text = ""
    if np.isfinite(least):
        text += f"{prefix}at least {least:.4g}"
    if np.isfinite(most):
        text += f"{prefix}at most {most:.4g}"
    return text


def apply_curves(
    command: ArrayLike,
    names: Sequence[str],
    curves: tuple[InputCurve, ...],
) -> Array:
    """Returns the effects (..., C) of commands (..., C) with these names."""
    values = np.array(command, dtype=np.float64)
    for curve in curves:
        column = names.index(curve.command)
        values[..., column] = curve.of(values[..., column])
    return values


def delays(names: Sequence[str], curves: tuple[InputCurve, ...]) -> Array:
    """Returns the delays (C,) of commands with these names beyond their common latency [s]."""
    by_name = {curve.command: curve.delay for curve in curves}
    return np.array([by_name.get(name, 0.0) for name in names])
