"""Which stamps can be believed, by a receiver whose clock need not agree with the sender's."""

from __future__ import annotations

from operator import index

FUTURE_NS = 1_000_000_000
"""A stamp may be ahead of what is due by this much [ns], or by two control periods."""
CLOCK_JUMP = 10
"""So many odometries in a row refused for their stamps: the robot's clock was set, or its
simulation begun anew."""
NO_STAMP = "stamp is no number"


class Stamps:
    """Compares how stamps go on with how the receiver's own time does.

    Only differences count: the clock of a robot may be off by any amount, and a simulation may
    run slower, or faster as long as no two data are farther apart than the tolerance. The first
    datum after a reset shows how the two clocks lie.

    Args:
        period_ns: between commands [ns].
    """

    def __init__(self, period_ns: int = 0) -> None:
        self._tolerance_ns = max(FUTURE_NS, 2 * period_ns)
        self.from_the_future = f"more than {self._tolerance_ns * 1e-9:g} s in the future"
        self.reset()

    def reset(self) -> None:
        """Forgets how the clocks lie."""
        self._stamp_ns: int | None = None
        self._arrival_ns = 0
        self._refused = 0

    def fault(self, stamp_ns: int, arrival_ns: int | None) -> str:
        """What is wrong with a stamp, or nothing; without an arrival only what is no number."""
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
        """Notes a datum that is used."""
        self._refused = 0
        if self._stamp_ns is None or stamp_ns > self._stamp_ns:
            self._stamp_ns, self._arrival_ns = stamp_ns, arrival_ns

    def refuse(self) -> bool:
        """Notes an odometry that is not used for its stamp; says whether the clock has jumped."""
        self._refused += 1
        return self._refused >= CLOCK_JUMP
