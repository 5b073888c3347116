"""Order of a robot's data in time: replay of late ones, and time stamps that can't be right."""

from bisect import bisect_left, bisect_right
from collections import Counter, deque
from dataclasses import dataclass
from operator import attrgetter, index

import numpy as np
from numpy.typing import ArrayLike, NDArray

from nics_drl_bridge.interface import NS_PER_S
from nics_drl_bridge.middleware.belief import Belief
from nics_drl_bridge.middleware.ekf import Estimator
from nics_drl_bridge.middleware.measurement import (
    Acceptance,
    Judgement,
    Kind,
    Measurement,
)

HISTORY_NS = NS_PER_S  # Length of the past that may still change [ns]
BEFORE_START = "not after the reset"
TOO_OLD = f"older than {HISTORY_NS / NS_PER_S:g} s"
DUPLICATE = "duplicate"
# By which a stamp may be early [ns], or two control periods if longer
FUTURE_NS = NS_PER_S
# Odometries rejected in a row for their stamps that show that a clock was set
CLOCK_JUMP = 10
Moment = tuple[
    int, int
]  # Stamp [ns] and kind: the order of measurements, however they arrive


@dataclass(slots=True)
class _Entry:
    moment: Moment
    belief: Belief
    measurement: Measurement | None = None
    verdict: Judgement | None = None


class Timeline:
    """Feeds the estimator, as nothing else may, with measurements and commands by their stamps.

    A late one is inserted at its time and the filter re-run from a snapshot before, as in
    robot_localization's `smooth_lagged_data`: the same bits, if not older than `HISTORY_NS`.
    """

    def __init__(self, estimator: Estimator) -> None:
        self._estimator = estimator
        self.reset()

    def reset(self) -> None:
        """Forgets the past; begins with the present state of the estimator."""
        self._start_ns = self._estimator.time_ns
        # Numbers of measurements by kind and outcome; the innovation of the newest of each kind.
        self.outcomes: Counter[tuple[Kind, Acceptance]] = Counter()
        self.distances: dict[Kind, float] = {}
        self.replayed = 0
        self._entries = deque([_Entry((self._start_ns, -1), self._estimator.belief)])

    @property
    def newest_ns(self) -> int:
        """Stamp of the newest measurement, or of the reset [ns]."""
        return self._entries[-1].moment[0]

    def anchor(self, odom: NDArray[np.float64]) -> None:
        """Records the pose (3,) in `odom` of the start, if nothing was measured since."""
        if len(self._entries) == 1:
            self._estimator.anchor(odom)
            self._entries[0].belief = self._estimator.belief

    def measure(self, stamp_ns: int, measurement: Measurement) -> str:
        """Takes a measurement; returns the reason if it cannot be used, or an empty string."""
        moment = (stamp_ns, measurement.kind)
        if stamp_ns <= self._start_ns:
            return BEFORE_START
        if stamp_ns < self.newest_ns - HISTORY_NS:
            return TOO_OLD
        place = bisect_left(self._entries, moment, key=attrgetter("moment"))
        if place == len(self._entries):
            self._entries.append(self._run(moment, measurement))
            while self._entries[1].moment[0] < stamp_ns - HISTORY_NS:
                self._entries.popleft()  # it can no longer change
        elif self._entries[place].moment == moment:
            return DUPLICATE
        else:
            self._entries.insert(
                place, _Entry(moment, self._entries[0].belief, measurement)
            )
            self._rerun(place)
        return ""

    def command(self, stamp_ns: int, command: ArrayLike) -> str:
        """Takes a command (C,); returns the reason if it cannot be used, or an empty string."""
        if stamp_ns < self._start_ns:
            return BEFORE_START
        effective_ns = self._estimator.effective_ns(stamp_ns)
        if effective_ns < self.newest_ns - HISTORY_NS:
            return TOO_OLD
        if not self._estimator.command(stamp_ns, command, self._entries[0].moment[0]):
            return DUPLICATE
        if effective_ns < self.newest_ns:
            self._rerun(
                bisect_right(self._entries, effective_ns, key=lambda e: e.moment[0])
            )
        return ""

    def _run(self, moment: Moment, measurement: Measurement) -> _Entry:
        if measurement.kind is Kind.YAW_RATE:  # the next odometry turns by it
            verdict = self._estimator.turn(moment[0], measurement)
        else:
            self._estimator.predict(moment[0])
            verdict = self._estimator.correct(measurement)
        self.outcomes[measurement.kind, verdict.outcome] += 1
        self.distances[measurement.kind] = verdict.distance
        return _Entry(moment, self._estimator.belief, measurement, verdict)

    def _rerun(self, place: int) -> None:
        self._estimator.belief = self._entries[place - 1].belief
        for k in range(place, len(self._entries)):
            entry = self._entries[k]
            if entry.measurement is None:
                continue
            if entry.verdict is not None:
                self.outcomes[entry.measurement.kind, entry.verdict.outcome] -= 1
            self._entries[k] = self._run(entry.moment, entry.measurement)
        self.replayed += 1


class Stamps:
    """Compares the progress of time stamps with that of the receiver's clock.

    Only differences count: a clock may be off, a simulation slower, or faster within the tolerance,
    which the control period [ns] widens. The first datum after a reset gives the offset.
    """

    def __init__(self, period_ns: int = 0) -> None:
        self._tolerance_ns = max(FUTURE_NS, 2 * period_ns)
        self.from_the_future = (
            f"more than {self._tolerance_ns * 1e-9:g} s in the future"
        )
        self.reset()

    def reset(self) -> None:
        """Forgets the offset of the clocks."""
        self._stamp_ns: int | None = None
        self._arrival_ns = 0
        self._refused = 0

    def fault(self, stamp_ns: int, arrival_ns: int | None) -> str:
        """Returns the fault of a stamp, or an empty string; without an arrival only its type."""
        try:
            index(stamp_ns)
        except TypeError:
            return "stamp is no number"
        if arrival_ns is None or self._stamp_ns is None:
            return ""
        latest_ns = self._stamp_ns + self._tolerance_ns
        if stamp_ns <= latest_ns or stamp_ns <= latest_ns + (
            arrival_ns - self._arrival_ns
        ):
            return ""
        return self.from_the_future

    def accept(self, stamp_ns: int, arrival_ns: int) -> None:
        """Records a datum that is used."""
        self._refused = 0
        if self._stamp_ns is None or stamp_ns > self._stamp_ns:
            self._stamp_ns = stamp_ns
            self._arrival_ns = arrival_ns

    def refuse(self) -> bool:
        """Records an odometry rejected for its stamp; True if the clock has jumped."""
        self._refused += 1
        return self._refused >= CLOCK_JUMP
