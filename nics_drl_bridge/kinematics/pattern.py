"""Pattern: a drive for a recording as it is expected, before the robot moves."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge import geometry

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Pattern:
    """A drive as it is expected; the robot starts at the origin and looks along x.

    Attributes:
        period: how long each command is held [s].
        command: (T, C).
        pose: (T + 1, 3) at the start of each period, and at the end.
        bound: radius of the circle around the start that the whole robot keeps within [m].
        footprint: radius of the robot [m].
    """

    period: float
    command: Array
    pose: Array
    bound: float
    footprint: float

    @property
    def duration(self) -> float:
        """Of the drive [s]."""
        return self.period * len(self.command)

    @property
    def box(self) -> Array:
        """(2, 2) least and greatest x and y [m] that the robot's body reaches."""
        place = self.pose[:, :2]
        return np.array([place.min(axis=0) - self.footprint, place.max(axis=0) + self.footprint])

    @property
    def reach(self) -> float:
        """Greatest distance of the robot's body from the start [m]."""
        return float(np.hypot(*self.pose[:, :2].T).max()) + self.footprint

    @property
    def twist(self) -> Array:
        """(T, 3) mean body twist of each period [m/s, m/s, rad/s]."""
        moved = geometry.log(geometry.between(self.pose[:-1], self.pose[1:]))
        return np.asarray(moved / self.period)

    @property
    def speed(self) -> Array:
        """(T,) speed of each period [m/s]."""
        return np.asarray(np.hypot(*self.twist[:, :2].T))

    def lines(self) -> tuple[str, ...]:
        """What somebody has to know before the robot moves, for people."""
        (left, low), (right, high) = self.box
        return (
            f"preview of {self.duration:.0f} s: a path of {self.speed.sum() * self.period:.1f} m, "
            f"up to {self.speed.max():.2f} m/s and {np.abs(self.twist[:, 2]).max():.2f} rad/s",
            f"the robot's body needs x {left:+.2f} to {right:+.2f} m and y {low:+.2f} to "
            f"{high:+.2f} m, seen from where it stands and looks along x",
            f"it is stopped where its odometry says that it leaves the circle of "
            f"{self.bound:g} m around its start; it looks out for nothing else: clear that "
            "circle, and keep an emergency stop at hand",
        )
