"""Which stamps can be believed, by a receiver whose clock need not agree with the sender's."""

from __future__ import annotations

from operator import index

FUTURE_NS = 1_000_000_000
"""A stamp may be ahead of what is due by this much [ns]."""
CLOCK_JUMP = 10
"""So many odometries in a row refused for their stamps: the robot's clock was set, or its
simulation begun anew."""
FROM_THE_FUTURE = f"more than {FUTURE_NS * 1e-9:g} s in the future"
NO_STAMP = "stamp is no number"


class Stamps:
    """Compares how stamps go on with how the receiver's own time does.

    Only differences count: the clock of a robot may be off by any amount, and a simulation may
    run slower, or faster as long as no step is longer than `FUTURE_NS`. The first datum
    after a reset shows how the two clocks lie.
    """

    def __init__(self) -> None:
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
        if stamp_ns <= self._stamp_ns + FUTURE_NS:
            return ""
        elapsed_ns = max(arrival_ns - self._arrival_ns, 0)
        return FROM_THE_FUTURE if stamp_ns > self._stamp_ns + elapsed_ns + FUTURE_NS else ""

    def accept(self, stamp_ns: int, arrival_ns: int) -> None:
        """Notes a datum that is used."""
        self._refused = 0
        if self._stamp_ns is None or stamp_ns > self._stamp_ns:
            self._stamp_ns, self._arrival_ns = stamp_ns, arrival_ns

    def refuse(self) -> bool:
        """Notes an odometry that is not used for its stamp; says whether the clock has jumped."""
        self._refused += 1
        return self._refused >= CLOCK_JUMP
