"""Paces a policy's actions and detects slow inference; times are on a steady clock [s]."""

from enum import Enum


class ActionPace:
    """Allows at most one action per period, as soon as data arrive; a period of 0 allows all."""

    def __init__(self, period_s: float) -> None:
        self._period_s = period_s
        self._due_s = -float("inf")

    def get_wait(self, now_s: float) -> float:
        """Returns the time until an action is due [s]; 0 if it is."""
        return max(self._due_s - now_s, 0.0)

    def acted(self, now_s: float) -> None:
        """Records the start of an action."""
        # Due times are a period apart, so jitter of the data does not change the average rate.
        late = now_s - self._due_s > 0.5 * self._period_s
        self._due_s = (now_s if late else self._due_s) + self._period_s


class Answer(Enum):
    """What to do with a command."""

    SEND = "send"
    DROP = "drop"
    STOP = "stop"


class Deadline:
    """Judges inference times: after `patience` late ones in a row, the robot must stop."""

    def __init__(self, limit_s: float, patience: int) -> None:
        self._limit_s = limit_s
        self._patience = patience
        self.answered = self.late = self._in_a_row = 0
        self.longest_s = 0.0

    @property
    def stops(self) -> bool:
        """True while the robot is stopped because of late inferences."""
        return self._in_a_row >= self._patience

    def judge(self, taken_s: float) -> Answer:
        """Decides what to do with a command whose inference took `taken_s`."""
        self.longest_s = max(self.longest_s, taken_s)
        if taken_s <= self._limit_s:
            self.answered += 1
            self._in_a_row = 0
            return Answer.SEND
        self.late += 1
        self._in_a_row += 1
        return Answer.STOP if self.stops else Answer.DROP
