"""Replay of late data: the last second of the filter is kept and re-run with them in order."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from nics_drl_bridge.middleware.belief import Belief
from nics_drl_bridge.middleware.ekf import Estimator
from nics_drl_bridge.middleware.measurement import Acceptance, Judgement, Kind, Measurement

HISTORY_NS = 1_000_000_000
"""Length of the past that may still change [ns]."""
BEFORE_START = "not after the reset"
TOO_OLD = f"older than {HISTORY_NS * 1e-9:g} s"
DUPLICATE = "duplicate"

Moment = tuple[int, int]
"""Stamp [ns] and kind: the order of measurements, whatever the order of their arrival."""


@dataclass(slots=True)
class _Entry:
    """A measurement, its verdict, and the state of the filter after it."""

    moment: Moment
    measurement: Measurement | None
    verdict: Judgement | None
    belief: Belief


class Timeline:
    """Feeds measurements and commands to the estimator in the order of their stamps.

    A late one is inserted at its time, and the filter is re-run from before it. The arithmetic is
    the same as if it had arrived in time, so the result is bit-identical, unless something is
    later than `HISTORY_NS`. Going back to a snapshot of the filter is the idea of
    robot_localization's `smooth_lagged_data`.

    Args:
        estimator: to feed; it must not be fed otherwise.
    """

    def __init__(self, estimator: Estimator) -> None:
        self._estimator = estimator
        self._entries: deque[_Entry] = deque()
        self.reset()

    def reset(self) -> None:
        """Forgets the past; begins with the present state of the estimator."""
        self._start_ns = self._estimator.time_ns
        self._past: Counter[tuple[Kind, Acceptance]] = Counter()
        self._distances: dict[Kind, float] = {}
        self.replayed = 0
        self._entries.clear()
        belief = self._estimator.belief
        self._entries.append(_Entry((self._start_ns, -1), None, None, belief))

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
        """Takes a measurement; returns the reason if it cannot be used, or an empty string.

        The verdict of the gate is no such reason: it may change with data still to come.
        """
        moment = (stamp_ns, measurement.kind)
        if moment > self._entries[-1].moment and stamp_ns > self._start_ns:
            self._entries.append(self._run(moment, measurement))
            self._forget()
            return ""
        place, reason = self._place(moment)
        if reason:
            return reason
        self._entries.insert(place, _Entry(moment, measurement, None, self._entries[0].belief))
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
            place = len(self._entries)
            while self._entries[place - 1].moment[0] > effective_ns:
                place -= 1
            self._rerun(place)
        return ""

    def outcomes(self) -> Mapping[tuple[Kind, Acceptance], int]:
        """Returns the number of measurements by kind and outcome."""
        recent = Counter(
            (entry.measurement.kind, entry.verdict.outcome)
            for entry in self._entries
            if entry.measurement is not None and entry.verdict is not None
        )
        return self._past + recent

    def distances(self) -> Mapping[Kind, float]:
        """Returns the squared, normalised innovation of the newest measurement of each kind."""
        return self._distances | {
            entry.measurement.kind: entry.verdict.distance
            for entry in self._entries
            if entry.measurement is not None and entry.verdict is not None
        }

    def _place(self, moment: Moment) -> tuple[int, str]:
        """Returns the place of a late measurement, or the reason if it cannot be used."""
        if moment[0] <= self._start_ns:
            return 0, BEFORE_START
        if moment[0] < self.newest_ns - HISTORY_NS:
            return 0, TOO_OLD
        place = len(self._entries)
        while self._entries[place - 1].moment >= moment:
            place -= 1
            if self._entries[place].moment == moment:
                return 0, DUPLICATE
        return place, ""

    def _run(self, moment: Moment, measurement: Measurement) -> _Entry:
        self._estimator.predict(moment[0])
        verdict = self._estimator.correct(measurement)
        return _Entry(moment, measurement, verdict, self._estimator.belief)

    def _rerun(self, place: int) -> None:
        """Re-runs the filter over all entries from a place on."""
        self._estimator.belief = self._entries[place - 1].belief
        for index in range(place, len(self._entries)):
            entry = self._entries[index]
            if entry.measurement is not None:
                self._entries[index] = self._run(entry.moment, entry.measurement)
        self.replayed += 1

    def _forget(self) -> None:
        """Drops entries that can no longer change, except the last one before the history."""
        needed_ns = self.newest_ns - HISTORY_NS
        while self._entries[1].moment[0] < needed_ns:
            entry = self._entries.popleft()
            if entry.measurement is not None and entry.verdict is not None:
                self._past[entry.measurement.kind, entry.verdict.outcome] += 1
                self._distances[entry.measurement.kind] = entry.verdict.distance
