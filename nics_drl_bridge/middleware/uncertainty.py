"""How much certainty an estimate of the pose has lost over a while."""

import math
from typing import NamedTuple

import numpy as np

from nics_drl_bridge.geometry import Array


class Uncertainty(NamedTuple):
    """Standard deviations that a pose by the estimate has gained."""

    position_m: float  # along the direction in which it is the greatest
    heading_rad: float

    def told_since(self, since: str) -> str:
        """Returns the uncertainty in words."""
        return (
            f"position uncertain by {self.position_m:.2g} m, heading by {self.heading_rad:.2g} rad "
            f"since {since}"
        )


def compute_uncertainty_gain(before: Array, after: Array) -> Uncertainty:
    """Returns what a pose has lost in certainty between two of its covariances (3, 3)."""
    gained = after - before
    position = max(float(np.linalg.eigvalsh(gained[:2, :2])[-1]), 0.0)
    return Uncertainty(math.sqrt(position), math.sqrt(max(float(gained[2, 2]), 0.0)))
