"""Growth of the uncertainty of a pose estimate over time."""

import math
from typing import NamedTuple

import numpy as np

from nics_drl_bridge.geometry import Array


class Uncertainty(NamedTuple):
    """Standard deviations that an estimated pose has gained."""

    position_m: float  # along its most uncertain direction
    heading_rad: float

    def describe_since(self, since: str) -> str:
        """Returns the uncertainty in words."""
        return (
            f"position uncertain by {self.position_m:.2g} m, heading by {self.heading_rad:.2g} rad "
            f"since {since}"
        )


def compute_uncertainty_gain(before: Array, after: Array) -> Uncertainty:
    """Returns the uncertainty that a pose gained between two of its covariances (3, 3)."""
    gained = after - before
    position = max(float(np.linalg.eigvalsh(gained[:2, :2])[-1]), 0.0)
    return Uncertainty(math.sqrt(position), math.sqrt(max(float(gained[2, 2]), 0.0)))
