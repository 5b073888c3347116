"""Paces a policy's actions and detects slow inference; times are on a steady clock [s]."""

import math
from dataclasses import dataclass
from enum import Enum


@dataclass
class ActionPace:
    """Allows at most one action per period, as soon as data arrive; a period of 0 has no limit."""

    period_s: float
    due_s: float = -math.inf  # time of the next action

    def get_wait(self, now_s: float) -> float:
        """Returns the time until an action is due [s]; 0 if it is."""
        return max(self.due_s - now_s, 0.0)

    def acted(self, now_s: float) -> None:
        """Records the start of an action."""
        # Due times are a period apart, so jitter of the data does not change the average rate.
        late = now_s - self.due_s > 0.5 * self.period_s
        self.due_s = (now_s if late else self.due_s) + self.period_s


class Answer(Enum):
    """What to do with a command."""

    SEND = "send"
    DROP = "drop"
    STOP = "stop"


@dataclass
class Deadline:
    """Judges inference times: after `patience` late ones in a row, the robot must stop."""

    limit_s: float
    patience: int
    answered: int = 0
    late: int = 0
    late_in_a_row: int = 0
    longest_s: float = 0.0

    @property
    def stops(self) -> bool:
        """True while the robot is stopped because of late inferences."""
        return self.late_in_a_row >= self.patience

    def judge(self, taken_s: float) -> Answer:
        """Decides what to do with a command whose inference took `taken_s`."""
        self.longest_s = max(self.longest_s, taken_s)
        if taken_s <= self.limit_s:
            self.answered += 1
            self.late_in_a_row = 0
            return Answer.SEND
        self.late += 1
        self.late_in_a_row += 1
        return Answer.STOP if self.stops else Answer.DROP
