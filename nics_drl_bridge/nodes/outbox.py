"""Outbox: what a device measured at one time and tells at a later one."""

from __future__ import annotations

import heapq
import itertools
from typing import Any

import numpy as np
from rclpy.publisher import Publisher
from rclpy.serialization import serialize_message


class Outbox:
    """Publishes messages a latency and a jitter after they were made, each topic in order.

    Without either a message goes out at once. Otherwise its bytes are kept, so that whoever made
    it may use it again.

    Args:
        seed: of the draws of the jitter.
    """

    def __init__(self, seed: int = 0) -> None:
        self._random = np.random.default_rng(seed)
        self._waiting: list[tuple[int, int, Publisher, bytes]] = []
        self._latest: dict[Publisher, int] = {}
        self._numbers = itertools.count()

    def send(
        self, publisher: Publisher, message: Any, now_ns: int, late_ns: tuple[int, int]
    ) -> None:
        """Publishes a message now, or notes when to.

        Args:
            publisher: to publish with.
            message: to publish, or its bytes.
            now_ns: the present.
            late_ns: least delay, and the greatest further one, drawn evenly for each message.
        """
        delay, jitter = late_ns
        if jitter:
            delay += int(self._random.integers(jitter + 1))
        if not delay:
            publisher.publish(message)
            return
        due = max(now_ns + delay, self._latest.get(publisher, 0))
        self._latest[publisher] = due
        content = message if isinstance(message, bytes) else serialize_message(message)
        heapq.heappush(self._waiting, (due, next(self._numbers), publisher, content))

    def flush(self, now_ns: int) -> None:
        """Publishes what is due."""
        while self._waiting and self._waiting[0][0] <= now_ns:
            _, _, publisher, content = heapq.heappop(self._waiting)
            publisher.publish(content)

    def clear(self) -> None:
        """Forgets what waits: it was of an episode that is over."""
        self._waiting.clear()
        self._latest.clear()
