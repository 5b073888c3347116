"""Pacing: when a topic or an action is due, and how far a world is behind real time."""

import math
from dataclasses import dataclass
from enum import Enum

from nics_drl_bridge.interface import NS_PER_S

# fraction of a step by which it may be early, because timers are no more precise
SLACK = 0.1
# a backlog longer than this is dropped instead of made up for [ns]
PATIENCE_NS = NS_PER_S // 2


def find_common_step(dt: float, periods: tuple[float, ...]) -> int:
    """Returns the greatest common divisor of periods [s], as a number of model steps `dt` [s]."""
    return math.gcd(*(max(1, round(period / dt)) for period in periods))


class TopicPace:
    """Decides when a topic is due, so that its mean rate is as requested with any step."""

    def __init__(self, period_ns: int, step_ns: int) -> None:
        self._period_ns = period_ns
        self._slack_ns = step_ns // 2 if period_ns > step_ns else 0
        self._next_ns = 0

    def begin(self, now_ns: int) -> None:
        """Restarts: the next message is due now."""
        self._next_ns = now_ns

    def due(self, now_ns: int) -> bool:
        """Returns True if a message is due at a time; it then counts as sent."""
        if now_ns + self._slack_ns < self._next_ns:
            return False
        self._next_ns += self._period_ns
        return True


class RealTime:
    """Tracks by how many steps the world is behind the steady clock."""

    def __init__(self, step_ns: int, rate: float) -> None:
        self._step_ns = step_ns
        self._rate = rate
        self._began_ns = self._then_ns = 0

    def begin(self, steady_ns: int, now_ns: int) -> None:
        """Aligns a time of the steady clock with a simulated time."""
        self._began_ns = steady_ns
        self._then_ns = now_ns

    def time_at(self, steady_ns: int) -> int:
        """Returns the simulated time [ns] at a time of the steady clock."""
        return self._then_ns + int((steady_ns - self._began_ns) * self._rate)

    def behind(self, steady_ns: int, now_ns: int) -> int:
        """Returns the steps due at a time of the steady clock, for a world at `now_ns`."""
        missing_ns = self.time_at(steady_ns) - now_ns
        return max(0, int((missing_ns + SLACK * self._step_ns) // self._step_ns))

    def lost(self, steady_ns: int, now_ns: int) -> bool:
        """Returns True if the world is too far behind to catch up with real time."""
        return (
            self.time_at(steady_ns) - now_ns - self._step_ns > PATIENCE_NS * self._rate
        )


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
