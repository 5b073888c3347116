"""Pattern: a drive as it is expected, and the space it has to keep within."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.errors import ConfigError

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Space:
    """A rectangle around the start, its sides along and across the robot's first heading.

    Attributes:
        length: along [m].
        width: across [m].
    """

    length: float
    width: float

    def excess(self, pose: Array, keep: float = 0.0) -> Array:
        """How far poses (..., 3) are outside of the space less `keep` on each side [m]."""
        half = np.array([self.length, self.width]) / 2.0 - keep
        return np.asarray((np.abs(pose[..., :2]) - half).max(axis=-1))


def parse_space(text: str) -> Space:
    """Reads `4x3` [m].

    Raises:
        ConfigError: it is not two lengths.
    """
    try:
        length, width = (float(part) for part in text.lower().split("x"))
    except ValueError:
        length = width = float("nan")
    if not (0.0 < length < np.inf and 0.0 < width < np.inf):
        raise ConfigError(f"--space {text!r}: must be LENGTHxWIDTH in metres, as in 4x4.")
    return Space(length, width)


@dataclass(frozen=True)
class Pattern:
    """A drive as it is expected.

    Attributes:
        t: (T,) [s].
        command: (T, C) from each time to the next.
        pose: (T, 3) where the robot then is, seen from the start.
        space: that it is to keep within.
        slower: share of the greatest speeds that fits into the space.
    """

    t: Array
    command: Array
    pose: Array
    space: Space
    slower: float

    def box(self, radius: float) -> tuple[float, float, float, float]:
        """Least x and y, greatest x and y [m] of a body of a radius [m] around `base_link`."""
        (x1, y1), (x2, y2) = self.pose[:, :2].min(axis=0), self.pose[:, :2].max(axis=0)
        return float(x1 - radius), float(y1 - radius), float(x2 + radius), float(y2 + radius)

    @property
    def fastest(self) -> float:
        """Greatest speed [m/s]."""
        step = np.diff(self.pose[:, :2], axis=0)
        return float((np.hypot(*step.T) / np.diff(self.t)).max())
