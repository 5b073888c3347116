"""Whether a press of the e-stop may have been lost while the gate slept.

While the system does not schedule a process, its messages wait in the socket's buffer. Messages
that do not fit are sent again only while the button still holds them; a press that was followed by
other messages is lost. So a sleep during which the buffer may overflow counts as a press.
"""

from collections import deque

QUEUE_MESSAGES = 150  # certain to fit: Linux's default buffer held 254 when measured
LONGEST_SLEEP_S = (
    1.0  # after a longer sleep, the rate measured before it proves nothing
)
RATE_WINDOW_S = 1.0  # window over which the rate of messages is measured


class EStopQueue:
    """Measures the rate of `e_stop`, and judges each sleep of the gate by it."""

    def __init__(self) -> None:
        # (time [s], number of messages read)
        self._heard: deque[tuple[float, int]] = deque()
        self._ticked_s: float | None = None  # last tick of the gate
        self._ever_heard = False
        self._since_tick = 0  # messages

    def add(self, now: float, messages: int) -> None:
        """Account for messages that were read at a steady time [s]."""
        self._ever_heard = True
        self._since_tick += messages
        self._heard.append((now, messages))
        while now - self._heard[0][0] > RATE_WINDOW_S:
            self._heard.popleft()

    def tick(self, now: float) -> str:
        """Return why a press may have been lost since the last tick; "" if none can be."""
        before = self._ticked_s
        self._ticked_s = now
        waiting = self._since_tick
        self._since_tick = 0
        # if the publisher started during the sleep, there is no earlier rate
        if waiting > QUEUE_MESSAGES:
            return f"{waiting} messages came at once, and a press may have been lost among them"
        if before is None or not self._ever_heard:
            return ""
        asleep = now - before
        rate = sum(messages for _, messages in self._heard) / RATE_WINDOW_S
        longest = min(LONGEST_SLEEP_S, QUEUE_MESSAGES / max(rate, 1.0))
        if asleep <= longest:
            return ""
        return f"the gate slept for {asleep:.2f} s, and a press may have been lost meanwhile"
