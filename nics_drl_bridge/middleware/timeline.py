"""Orders a robot's data in time: replays late data and finds implausible time stamps."""

from bisect import bisect_left, bisect_right
from collections import Counter, deque
from dataclasses import dataclass
from operator import attrgetter, index
from typing import NamedTuple

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

HISTORY_NS = NS_PER_S  # maximum age of late data [ns]
# A stamp may be ahead by this [ns], or by two control periods if these are longer
FUTURE_NS = NS_PER_S
# A clock was set if this many consecutive odometries have rejected stamps
CLOCK_JUMP = 10


class Refusal(NamedTuple):
    """Reason why a datum is not used."""

    reason: str
    may_be_clock: bool = False  # True if setting a clock would explain it


BEFORE_START = Refusal("not after the reset", may_be_clock=True)
TOO_OLD = Refusal(f"older than {HISTORY_NS / NS_PER_S:g} s", may_be_clock=True)
DUPLICATE = Refusal("duplicate")
NO_INTEGER = Refusal("stamp is not an integer")
# Stamp [ns] and kind. Measurements are sorted by both, regardless of their arrival.
Moment = tuple[int, int]


@dataclass(slots=True)
class _Entry:
    moment: Moment
    belief: Belief
    measurement: Measurement | None = None
    judgement: Judgement | None = None


class Timeline:
    """Feeds the estimator with measurements and commands in the order of their stamps.

    Late data are inserted at their stamps, and everything since is replayed from the filter's
    earlier state, like robot_localization's `smooth_lagged_data`. The estimate is bit-identical no
    matter in which order data arrive, unless they are older than `HISTORY_NS`.
    """

    def __init__(self, estimator: Estimator) -> None:
        self._estimator = estimator
        self.reset()

    def reset(self) -> None:
        """Forgets the past; starts with the current state of the estimator."""
        self._start_ns = self._estimator.time_ns
        # Counts of measurements by kind and outcome; NIS of the newest of each kind
        self.outcomes: Counter[tuple[Kind, Acceptance]] = Counter()
        self.newest_nis: dict[Kind, float] = {}
        self.replayed = 0
        self._entries = deque([_Entry((self._start_ns, -1), self._estimator.belief)])

    @property
    def newest_ns(self) -> int:
        """Stamp of the newest measurement, or of the reset [ns]."""
        return self._entries[-1].moment[0]

    def clone_start(self, odom: NDArray[np.float64]) -> None:
        """Clones the start for its odometry pose (3,), unless something was measured since."""
        if len(self._entries) == 1:
            self._estimator.clone_state(odom, np.zeros(3))
            self._entries[0].belief = self._estimator.belief

    def measure(self, stamp_ns: int, measurement: Measurement) -> Refusal | None:
        """Takes a measurement; returns the reason for a refusal, or None."""
        moment = (stamp_ns, measurement.kind)
        if stamp_ns <= self._start_ns:
            return BEFORE_START
        if stamp_ns < self.newest_ns - HISTORY_NS:
            return TOO_OLD
        place = bisect_left(self._entries, moment, key=attrgetter("moment"))
        if place == len(self._entries):
            self._entries.append(self._run(moment, measurement))
            while self._entries[1].moment[0] < stamp_ns - HISTORY_NS:
                self._entries.popleft()  # earlier data would be refused
        elif self._entries[place].moment == moment:
            return DUPLICATE
        else:
            self._entries.insert(
                place, _Entry(moment, self._entries[0].belief, measurement)
            )
            self._replay(place)
        return None

    def command(self, stamp_ns: int, command: ArrayLike) -> Refusal | None:
        """Takes a command (C,); returns the reason for a refusal, or None."""
        if stamp_ns < self._start_ns:
            return BEFORE_START
        effective_ns = self._estimator.compute_effect_time(stamp_ns)
        if effective_ns < self.newest_ns - HISTORY_NS:
            return TOO_OLD
        first_ns = self._entries[0].moment[0]
        if not self._estimator.add_command(stamp_ns, command, first_ns):
            return DUPLICATE
        if effective_ns < self.newest_ns:
            place = bisect_right(
                self._entries, effective_ns, key=lambda entry: entry.moment[0]
            )
            self._replay(place)
        return None

    def _run(self, moment: Moment, measurement: Measurement) -> _Entry:
        if measurement.kind is Kind.YAW_RATE:  # needs no prediction
            judgement = self._estimator.take_yaw_rate(moment[0], measurement)
        else:
            self._estimator.predict(moment[0])
            judgement = self._estimator.correct(measurement)
        self.outcomes[measurement.kind, judgement.outcome] += 1
        self.newest_nis[measurement.kind] = judgement.nis
        return _Entry(moment, self._estimator.belief, measurement, judgement)

    def _replay(self, place: int) -> None:
        """Reruns all measurements from index `place` on."""
        self._estimator.belief = self._entries[place - 1].belief
        for k in range(place, len(self._entries)):
            entry = self._entries[k]
            if entry.measurement is None:
                continue
            if entry.judgement is not None:
                self.outcomes[entry.measurement.kind, entry.judgement.outcome] -= 1
            self._entries[k] = self._run(entry.moment, entry.measurement)
        self.replayed += 1


class Stamps:
    """Compares the progress of time stamps with that of the receiver's clock.

    Only differences count, so clocks may have an offset. A simulation may run slower
    than real time, or ahead of it by at most a tolerance, which grows with the control
    period [ns]. The first datum after a reset gives the offset.
    """

    def __init__(self, period_ns: int = 0) -> None:
        self._tolerance_ns = max(FUTURE_NS, 2 * period_ns)
        tolerance = f"{self._tolerance_ns / NS_PER_S:g} s"
        self._early = Refusal(f"more than {tolerance} in the future", may_be_clock=True)
        self.reset()

    def reset(self) -> None:
        """Forgets the offset of the clocks."""
        self._stamp_ns: int | None = None
        self._arrival_ns = 0
        self._rejected = 0

    def find_fault(self, stamp_ns: int, arrival_ns: int | None) -> Refusal | None:
        """Returns the fault of a stamp, or None; without arrival, checks only its type."""
        try:
            index(stamp_ns)
        except TypeError:
            return NO_INTEGER
        if arrival_ns is None or self._stamp_ns is None:
            return None
        passed_ns = max(arrival_ns - self._arrival_ns, 0)
        if stamp_ns <= self._stamp_ns + self._tolerance_ns + passed_ns:
            return None
        return self._early

    def accept(self, stamp_ns: int, arrival_ns: int) -> None:
        """Records a datum that is used."""
        self._rejected = 0
        if self._stamp_ns is None or stamp_ns > self._stamp_ns:
            self._stamp_ns = stamp_ns
            self._arrival_ns = arrival_ns

    def refuse(self) -> bool:
        """Records an odometry that is refused for its stamp; True if the clock was set."""
        self._rejected += 1
        return self._rejected >= CLOCK_JUMP
