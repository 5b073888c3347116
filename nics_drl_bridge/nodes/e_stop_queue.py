"""How long the gate may sleep until the queue of `e_stop` may have lost a press.

A process that the system does not run reads nothing; the messages then wait in the socket's buffer.
What no longer fits is sent again only as long as the button still has it, and a press that was
followed by other messages is gone. So a sleep beyond what surely fits counts as a press.
"""

from collections import deque

QUEUE_MESSAGES = 150  # that surely fit: Linux's default buffer was measured to hold 254
LONGEST_SLEEP_S = 1.0  # a rate that was measured before a longer sleep proves nothing
RATE_WINDOW_S = 1.0  # over which the rate of messages is measured


class EStopQueue:
    """Measures the rate of `e_stop`, and judges each sleep of the gate by it."""

    def __init__(self) -> None:
        # times [s], and messages read at each
        self._heard: deque[tuple[float, int]] = deque()
        self._ticked_s: float | None = None  # last tick of the gate
        self._ever_heard = False
        self._since_tick = 0  # messages

    def hear(self, now: float, messages: int) -> None:
        """Account for messages that were read at a steady time [s]."""
        self._ever_heard = True
        self._since_tick += messages
        self._heard.append((now, messages))
        while now - self._heard[0][0] > RATE_WINDOW_S:
            self._heard.popleft()

    def tick(self, now: float) -> str:
        """Return why the sleep since the last tick may have lost a press; else ""."""
        before = self._ticked_s
        self._ticked_s = now
        waiting = self._since_tick
        self._since_tick = 0
        # a publisher that began in a sleep has no rate from before
        if waiting > QUEUE_MESSAGES:
            return (
                f"{waiting} messages came at once, and a press among more may be lost"
            )
        if before is None or not self._ever_heard:
            return ""
        asleep = now - before
        rate = sum(messages for _, messages in self._heard) / RATE_WINDOW_S
        longest = min(LONGEST_SLEEP_S, QUEUE_MESSAGES / max(rate, 1.0))
        if asleep <= longest:
            return ""
        return f"the gate slept for {asleep:.2f} s, and a press in it may be lost"
