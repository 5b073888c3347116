"""Velocities of everything that moves on the page, from the frames of any source."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from nics_drl_bridge.env.snapshot import Snapshot
from nics_drl_bridge.geometry import Array
from nics_drl_bridge.lidar.exact_kernels import X, Y

# maximum time between frames for a meaningful velocity [s]
LONGEST_S = 1.0
FASTEST_M_S = 30.0  # anything faster was moved by hand or reset [m/s]


class Velocities(NamedTuple):
    """Velocities in one world, along the axes of `map`; zero if unknown."""

    robots: Array  # (M, 2) [m/s]
    bodies: Array  # (K, 2) obstacles [m/s]

    @staticmethod
    def unknown(shot: Snapshot) -> "Velocities":
        """Returns zeros for each robot and obstacle of a shot."""
        return Velocities(
            np.zeros((len(shot.poses), 2)), np.zeros((len(shot.bodies), 2))
        )


@dataclass(frozen=True)
class _Measurement:
    """The latest frame of one world, with velocities."""

    time_s: float
    shot: Snapshot
    velocities: Velocities


class MotionMeter:
    """Measures velocities as displacement over time between two frames."""

    def __init__(self) -> None:
        self._last: list[_Measurement] = []

    def measure(
        self, times_s: Sequence[float], shots: Sequence[Snapshot]
    ) -> list[Velocities]:
        """Returns the velocities in each world; times are since the start of its episode [s]."""
        if len(shots) != len(self._last):
            self._last = [
                _Measurement(math.inf, shot, Velocities.unknown(shot)) for shot in shots
            ]
        self._last = [
            _Measurement(time_s, shot, _measure_velocities(before, time_s, shot))
            for before, time_s, shot in zip(self._last, times_s, shots, strict=True)
        ]
        return [measurement.velocities for measurement in self._last]


def _measure_velocities(
    before: _Measurement, time_s: float, shot: Snapshot
) -> Velocities:
    passed_s = time_s - before.time_s
    last = before.shot
    if shot.member != last.member or not 0.0 <= passed_s <= LONGEST_S:
        return Velocities.unknown(shot)
    rows = (
        (last.poses[:, :2], shot.poses[:, :2], before.velocities.robots),
        (last.bodies[:, [X, Y]], shot.bodies[:, [X, Y]], before.velocities.bodies),
    )
    return Velocities(*(_compute_rates(passed_s, *row) for row in rows))


def _compute_rates(passed_s: float, before: Array, now: Array, last: Array) -> Array:
    """Returns velocities (n, 2) from points (n, 2); `last` (n, 2) if no time has passed."""
    if before.shape != now.shape:
        return np.zeros_like(now)
    if passed_s == 0.0:
        return last
    rates = (now - before) / passed_s
    possible = np.hypot(rates[:, 0], rates[:, 1]) < FASTEST_M_S  # False for NaN
    return np.where(possible[:, None], rates, 0.0)
