"""The newest datum of each topic, with its time stamps.

Checks of time stamps by a receiver whose clock need not agree with the sender's.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from operator import index
from typing import Any, NamedTuple

RATE_OVER = 32
"""Number of arrivals over which rates are computed."""


class Datum(NamedTuple):
    """A message as it arrived.

    Attributes:
        stamp_ns: of its header [ns].
        arrival_ns: on the clock of the receiver [ns].
        sequence: number of earlier data of its topic.
        value: the payload.
    """

    stamp_ns: int
    arrival_ns: int
    sequence: int
    value: Any


@dataclass
class TopicCache:
    """Keeps the newest datum and the arrival times of each topic, and counts rejected data.

    Attributes:
        newest: topic -> datum.
        rejected: reason -> number of data.
        received: topic -> number of accepted data.
        arrivals: topic -> arrival times of the latest data [ns].
    """

    newest: dict[str, Datum] = field(default_factory=dict)
    rejected: dict[str, int] = field(default_factory=dict)
    received: dict[str, int] = field(default_factory=dict)
    arrivals: dict[str, deque[int]] = field(default_factory=dict)

    def put(self, topic: str, stamp_ns: int, arrival_ns: int, value: Any) -> bool:
        """Stores a datum unless it is older than the cached one, or a duplicate; True if stored."""
        held = self.newest.get(topic)
        if held is not None and stamp_ns <= held.stamp_ns:
            self.reject(
                f"{topic}: out of order" if stamp_ns < held.stamp_ns else f"{topic}: duplicate"
            )
            return False
        self.take(topic, stamp_ns, arrival_ns, value)
        return True

    def take(self, topic: str, stamp_ns: int, arrival_ns: int, value: Any) -> None:
        """Counts a datum, and stores it if it is the newest: late data may be useful, too."""
        held, count = self.newest.get(topic), self.received.get(topic, 0)
        if held is None or stamp_ns > held.stamp_ns:
            self.newest[topic] = Datum(stamp_ns, arrival_ns, count, value)
        self.received[topic] = count + 1
        arrivals = self.arrivals.get(topic)
        if arrivals is None:
            arrivals = self.arrivals[topic] = deque(maxlen=RATE_OVER)
        arrivals.append(arrival_ns)

    def reject(self, reason: str) -> None:
        """Counts a rejected datum."""
        self.rejected[reason] = self.rejected.get(reason, 0) + 1

    def age_s(self, topic: str, now_ns: int) -> float:
        """Age of the newest datum by its stamp [s]; inf if there is none."""
        held = self.newest.get(topic)
        return float("inf") if held is None else (now_ns - held.stamp_ns) * 1e-9

    def rate_hz(self, topic: str, arrival_ns: int) -> float:
        """Rate of arrivals by the receiver's clock [Hz]; it falls while a datum is overdue."""
        arrivals = self.arrivals.get(topic, deque())
        intervals = len(arrivals) - 1
        if intervals < 1:
            return 0.0
        overdue_ns = (arrival_ns - arrivals[0]) * intervals / (intervals + 1)
        span_ns = max(arrivals[-1] - arrivals[0], overdue_ns)
        return intervals / (span_ns * 1e-9) if span_ns > 0 else 0.0


FUTURE_NS = 1_000_000_000
"""Tolerance by which a stamp may be ahead of its due time [ns], at least two control periods."""
CLOCK_JUMP = 10
"""Number of consecutive odometries rejected for their stamps that shows that the robot's clock was
set, or its simulation restarted."""
NO_STAMP = "stamp is no number"


class Stamps:
    """Compares the progress of time stamps with that of the receiver's clock.

    Only differences count: the clock of a robot may be off by any amount, and a simulation may run
    slower, or faster if no two data are farther apart than the tolerance. The first datum after a
    reset gives the offset of the two clocks.

    Args:
        period_ns: time between commands [ns].
    """

    def __init__(self, period_ns: int = 0) -> None:
        self._tolerance_ns = max(FUTURE_NS, 2 * period_ns)
        self.from_the_future = f"more than {self._tolerance_ns * 1e-9:g} s in the future"
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
            return NO_STAMP
        if arrival_ns is None or self._stamp_ns is None:
            return ""
        latest_ns = self._stamp_ns + self._tolerance_ns
        if stamp_ns <= latest_ns or stamp_ns <= latest_ns + (arrival_ns - self._arrival_ns):
            return ""
        return self.from_the_future

    def accept(self, stamp_ns: int, arrival_ns: int) -> None:
        """Records a datum that is used."""
        self._refused = 0
        if self._stamp_ns is None or stamp_ns > self._stamp_ns:
            self._stamp_ns, self._arrival_ns = stamp_ns, arrival_ns

    def refuse(self) -> bool:
        """Records an odometry rejected for its stamp; True if the clock has jumped."""
        self._refused += 1
        return self._refused >= CLOCK_JUMP
