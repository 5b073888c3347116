"""Consistency of odometry with its stamps, and the path driven while its stamps were rejected."""

from __future__ import annotations

from collections import deque
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge import geometry
from nics_drl_bridge.interface import NS_PER_S
from nics_drl_bridge.middleware.belief import JITTER_S
from nics_drl_bridge.middleware.cache import CLOCK_JUMP, FUTURE_NS
from nics_drl_bridge.middleware.timeline import HISTORY_NS

Array = NDArray[np.float64]

CONTRADICTED_NS = 200_000_000
"""A smaller error of a stamp [ns] cannot be distinguished from a longer transmission."""
IN_STEP = 5
"""Number of consecutive odometries that arrived in step with their stamps, before arrivals count as
a measure of time."""
SIGMA = 6.0
"""Greatest difference between odometry's pose and twist, in standard deviations."""
LEAST = 0.01
"""Difference between odometry's pose and twist that is always allowed [m, rad]."""
STILL = 0.02
"""Slower motion [m/s, rad/s] gives no information about time."""
NEAR_NS = HISTORY_NS + 2 * NS_PER_S
"""Stamps farther back than this [ns] are all rejected, which `Stamps` detects."""


class ReportedPose(NamedTuple):
    """An odometry as received: stamp and arrival [ns], pose in `odom` (3,), body twist (3,)."""

    stamp_ns: int
    arrival_ns: int
    pose: Array
    twist: Array


class Trail:
    """Follows the odometries since the last one that was used.

    If the robot moves, the path between two odometries and their twists give the time between them.
    If the arrivals agree with that time and the stamp does not, the odometry is neither late nor
    did it follow a loss of data: the clock was set.

    Args:
        walk: (3,) variance per second by which pose and twist of odometry differ [m^2/s, rad^2/s].
    """

    def __init__(self, walk: Array) -> None:
        self._walk = walk
        self.reset()

    def reset(self) -> None:
        """Forgets all odometries."""
        self._recent: deque[ReportedPose] = deque(maxlen=IN_STEP + 1)
        self._refused: deque[ReportedPose] = deque(maxlen=CLOCK_JUMP)

    def use(self, told: ReportedPose) -> None:
        """Records an odometry that is used."""
        self._refused.clear()
        if not self._recent or told.stamp_ns > self._recent[-1].stamp_ns:
            self._recent.append(told)

    def refuse(self, told: ReportedPose) -> None:
        """Records an odometry that is rejected for its stamp."""
        self._refused.append(told)

    def contradicts(self, told: ReportedPose) -> bool:
        """True if an odometry's path and arrival both show that the clock was set by a little.

        Such stamps look like late data, or like data after a gap.
        """
        if len(self._recent) <= IN_STEP:
            return False
        last = self._recent[-1]
        passed, waited = told.stamp_ns - last.stamp_ns, told.arrival_ns - last.arrival_ns
        if abs(passed - waited) < CONTRADICTED_NS or not -NEAR_NS <= passed - waited <= FUTURE_NS:
            return False
        if not all(self._in_step(*pair) for pair in pairwise(self._recent)):
            return False
        seconds, stamped, arrived = (
            self._time_of_way(last, told, 0.0),
            passed / NS_PER_S,
            waited / NS_PER_S,
        )
        return (
            seconds > 0.0
            and abs(seconds - arrived) <= max(0.5 * arrived, 0.5 * CONTRADICTED_NS / NS_PER_S)
            and abs(seconds - stamped) >= CONTRADICTED_NS / NS_PER_S
            and self._fits(last, told, seconds)
            and not self._fits(last, told, stamped)
        )

    def _in_step(self, before: ReportedPose, after: ReportedPose) -> bool:
        """True if both the arrivals and the path agree with the time between two stamps."""
        passed, waited = after.stamp_ns - before.stamp_ns, after.arrival_ns - before.arrival_ns
        return 2 * abs(waited - passed) <= passed and self._fits(before, after, passed / NS_PER_S)

    def seconds(self, now: ReportedPose) -> float:
        """Time since the last used odometry, by its arrival and by the stamps since [s]."""
        if not self._recent:
            return 0.0
        last = self._recent[-1]
        waited = max(now.arrival_ns - last.arrival_ns, 0)
        stamped = now.stamp_ns - (*self._refused, now)[0].stamp_ns
        # The last used one may have been a second late; the arrivals then show too little time.
        return max(waited, min(stamped, waited + HISTORY_NS)) / NS_PER_S

    def continuous(self, now: ReportedPose) -> bool:
        """True if the poses since the last used odometry form one path and follow the motion."""
        if not self._recent:
            return False
        way = [self._recent[-1], *self._refused, now]
        unmoved = all(np.array_equal(each.pose, way[0].pose) for each in way)
        if unmoved and any((np.abs(each.twist) > STILL).any() for each in way):
            return False
        times = [(b.stamp_ns - a.stamp_ns) / NS_PER_S for a, b in pairwise(way[1:])]
        first = max(self.seconds(now) - sum(times), 0.0)
        spans = [(max(first - JITTER_S, 0.0), first + JITTER_S)]
        spans += [(0.5 * each, 1.5 * each) for each in times]
        return all(
            self._fits(a, b, float(np.clip(self._time_of_way(a, b, high), low, high)))
            for (a, b), (low, high) in zip(pairwise(way), spans, strict=True)
        )

    @staticmethod
    def _time_of_way(before: ReportedPose, after: ReportedPose, standing: float) -> float:
        """Time [s] in which the mean twist leads between the poses; `standing` if it is at rest."""
        mean = (before.twist + after.twist) / 2.0
        if not (np.abs(mean) > STILL).any():
            return standing
        way = geometry.log(geometry.between(before.pose, after.pose))
        return float(way @ mean / (mean @ mean))

    def _fits(self, before: ReportedPose, after: ReportedPose, seconds: float) -> bool:
        """True if the twists lead from one pose to the other in a time [s]."""
        mean, change = (before.twist + after.twist) / 2.0, np.abs(after.twist - before.twist)
        way = geometry.between(before.pose, after.pose)
        off = np.abs(geometry.between(geometry.exp(mean * seconds), way))
        span = abs(seconds)
        allowed = LEAST + SIGMA * np.sqrt(self._walk * span) + change * span / 2.0
        return bool((off <= allowed).all())
