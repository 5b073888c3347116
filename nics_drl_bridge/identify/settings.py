"""Settings of an identification."""

from contextlib import suppress
from dataclasses import dataclass
from typing import Literal

from nics_drl_bridge import defaults
from nics_drl_bridge.errors import ConfigError

Alpha = float | Literal["auto"]
Order = int | Literal["auto"]


@dataclass(frozen=True)
class Settings:
    """Options of an identification."""

    order: Order = defaults.TAYLOR_ORDER  # of the Taylor expansion (Eq. 1), or `auto`
    alpha: Alpha = defaults.PRUNING  # of the pruning (Eq. 2), or `auto`
    # end of the training part, measured from the first pose
    train_until_s: float = float("inf")
    # complete the model by the textbook for inputs that never moved
    assume: bool = False
    strict: bool = False  # refuse a drive that did not move every input independently
    control_period_s: float = 0.1  # the model's step must divide this


def parse_alpha(text: str) -> Alpha:
    """Parses a pruning threshold: a number from 0 to 1, or `auto`; else ConfigError."""
    if text == "auto":
        return "auto"
    with suppress(ValueError):
        value = float(text)
        if 0.0 <= value <= 1.0:
            return value
    raise ConfigError(f"alpha is {text!r}; it must be a number from 0 to 1, or auto.")


def parse_order(text: str) -> Order:
    """Parses the order of a model: 1 to 4, or `auto`; else ConfigError."""
    if text not in ("auto", "1", "2", "3", "4"):
        raise ConfigError(f"order is {text!r}; it must be 1, 2, 3 or 4, or auto.")
    return "auto" if text == "auto" else int(text)
