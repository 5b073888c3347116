"""When a policy acts, and what becomes of an inference that takes too long.

Times are seconds on a steady clock, given by the caller.
"""

from __future__ import annotations

from enum import Enum


class Pace:
    """At most one action in each period, as soon as there is something to act on.

    Due times follow each other by the period, so that jitter of the data makes it neither faster
    nor slower; when data come late, the next due time is a period after them.

    Args:
        period_s: between actions; 0 acts on everything.
    """

    def __init__(self, period_s: float) -> None:
        self._period_s, self._due_s = period_s, -float("inf")

    def due(self, now_s: float) -> bool:
        """Whether it is time to act."""
        return now_s >= self._due_s

    def acted(self, now_s: float) -> None:
        """Notes an action at its begin."""
        late = now_s - self._due_s > 0.5 * self._period_s
        self._due_s = (now_s if late else self._due_s) + self._period_s


class Answer(Enum):
    """What becomes of a command."""

    SEND = "send"
    DROP = "drop"
    STOP = "stop"


class Deadline:
    """Judges how long each inference took.

    A late command is dropped: it answers a world that has moved on. After several in a row the
    robot is told to stop, until one is in time again.

    Args:
        limit_s: longest time of an inference.
        patience: with so many late ones in a row, zero is sent.

    Attributes:
        answered, late: how many were in time, and how many not.
        longest_s: that one took.
    """

    def __init__(self, limit_s: float, patience: int) -> None:
        self._limit_s, self._patience = limit_s, patience
        self.answered = self.late = self._in_a_row = 0
        self.longest_s = 0.0

    def judge(self, taken_s: float) -> Answer:
        """What becomes of a command that took so long."""
        self.longest_s = max(self.longest_s, taken_s)
        if taken_s <= self._limit_s:
            self.answered += 1
            self._in_a_row = 0
            return Answer.SEND
        self.late += 1
        self._in_a_row += 1
        return Answer.STOP if self._in_a_row >= self._patience else Answer.DROP
