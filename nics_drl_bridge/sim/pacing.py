"""When a simulated device publishes, and how far its world is behind the steady clock."""

import math

from nics_drl_bridge.interface import NS_PER_S

# fraction of a step by which it may be early, because timers are no more precise
SLACK = 0.1
# a backlog longer than this is dropped instead of made up for [ns]
PATIENCE_NS = NS_PER_S // 2


def find_common_step(dt: float, periods: tuple[float, ...]) -> int:
    """Return the longest step, in steps `dt` of the model [s], that suits the periods [s] best."""
    return math.gcd(*(max(1, round(period / dt)) for period in periods))


class TopicPace:
    """Decides when a topic is due, so that its mean rate is as requested with any step."""

    def __init__(self, period_ns: int, step_ns: int) -> None:
        self._period_ns = period_ns
        self._slack_ns = step_ns // 2 if period_ns > step_ns else 0
        self._next_ns = 0

    def begin(self, now_ns: int) -> None:
        """Restart: the next message is due now."""
        self._next_ns = now_ns

    def due(self, now_ns: int) -> bool:
        """True if a message is due at a time; it then counts as sent."""
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
        """Align a time of the steady clock with a simulated time."""
        self._began_ns = steady_ns
        self._then_ns = now_ns

    def time_at(self, steady_ns: int) -> int:
        """Return the simulated time [ns] at a time of the steady clock."""
        return self._then_ns + int((steady_ns - self._began_ns) * self._rate)

    def behind(self, steady_ns: int, now_ns: int) -> int:
        """Return the steps due at a time of the steady clock, for a world at `now_ns`."""
        missing_ns = self.time_at(steady_ns) - now_ns
        return max(0, int((missing_ns + SLACK * self._step_ns) // self._step_ns))

    def lost(self, steady_ns: int, now_ns: int) -> bool:
        """True if the world is too far behind to catch up with real time."""
        return (
            self.time_at(steady_ns) - now_ns - self._step_ns > PATIENCE_NS * self._rate
        )
