"""How often a device publishes, when its world moves in steps of its own."""

from __future__ import annotations

import math

from nics_drl_bridge.interface import NS_PER_S

SLACK = 0.1
"""A step may be made earlier by this share of it, because a timer is no better."""
PATIENCE_NS = NS_PER_S // 2
"""Steps that were missed for longer are not made up for."""


class Pace:
    """Says when a topic is due, so that its mean rate is the asked one, whatever the steps.

    Args:
        period_ns: between two messages.
        step_ns: between two looks; where it divides the period, the messages are regular.
    """

    def __init__(self, period_ns: int, step_ns: int) -> None:
        self._period_ns, self._slack_ns = period_ns, step_ns // 2 if period_ns > step_ns else 0
        self._next_ns = 0

    def begin(self, now_ns: int) -> None:
        """Begins anew: the next message is due now."""
        self._next_ns = now_ns

    def due(self, now_ns: int) -> bool:
        """Whether a message is due at a time; if so, it counts as sent."""
        if now_ns + self._slack_ns < self._next_ns:
            return False
        self._next_ns += self._period_ns
        return True


def common_step(dt: float, periods: tuple[float, ...]) -> int:
    """The longest step, in steps of the model, that meets all periods as well as it can.

    Args:
        dt: step of the model [s].
        periods: of what is published [s].

    Returns:
        Steps of the model: a divisor of all periods where `dt` divides them.
    """
    return math.gcd(*(max(1, round(period / dt)) for period in periods))


class RealTime:
    """Says how many steps the world is behind the steady clock.

    Args:
        step_ns: by which the world moves.
        rate: simulated seconds per second.
    """

    def __init__(self, step_ns: int, rate: float) -> None:
        self._step_ns, self._rate = step_ns, rate
        self._began_ns = self._then_ns = 0

    def begin(self, steady_ns: int, now_ns: int) -> None:
        """Both clocks stand at these times together."""
        self._began_ns, self._then_ns = steady_ns, now_ns

    def time_at(self, steady_ns: int) -> int:
        """The simulated time [ns] at a time of the steady clock."""
        return self._then_ns + int((steady_ns - self._began_ns) * self._rate)

    def behind(self, steady_ns: int, now_ns: int) -> int:
        """Steps to make at a time of the steady clock, for a world that stands at `now_ns`."""
        missing_ns = self.time_at(steady_ns) - now_ns
        return max(0, int((missing_ns + SLACK * self._step_ns) // self._step_ns))

    def lost(self, steady_ns: int, now_ns: int) -> bool:
        """Whether the world is so far behind that it can't be in real time any more."""
        late_ns = self.time_at(steady_ns) - now_ns - self._step_ns
        return late_ns > PATIENCE_NS * self._rate
