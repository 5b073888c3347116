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
        jitter_ns: greatest further delay, drawn uniformly for each message.
        seed: of the draws.
    """

    def __init__(self, jitter_ns: int = 0, seed: int = 0) -> None:
        self._jitter_ns, self._random = jitter_ns, np.random.default_rng(seed)
        self._waiting: list[tuple[int, int, Publisher, bytes]] = []
        self._latest: dict[Publisher, int] = {}
        self._numbers = itertools.count()

    def send(self, publisher: Publisher, message: Any, now_ns: int, latency_ns: int) -> None:
        """Publishes a message now, or notes when to."""
        delay = latency_ns
        if self._jitter_ns:
            delay += int(self._random.integers(self._jitter_ns + 1))
        if not delay:
            publisher.publish(message)
            return
        due = max(now_ns + delay, self._latest.get(publisher, 0))
        self._latest[publisher] = due
        entry = (due, next(self._numbers), publisher, serialize_message(message))
        heapq.heappush(self._waiting, entry)

    def flush(self, now_ns: int) -> None:
        """Publishes what is due."""
        while self._waiting and self._waiting[0][0] <= now_ns:
            _, _, publisher, content = heapq.heappop(self._waiting)
            publisher.publish(content)

    def clear(self) -> None:
        """Forgets what waits: it was of an episode that is over."""
        self._waiting.clear()
        self._latest.clear()
