"""CommandTimeout: a command that no other one follows is followed by a zero."""

from __future__ import annotations

import math
import time
from typing import Any

from rclpy.publisher import Publisher

from nics_drl_bridge.nodes.runner import last_word


class CommandTimeout:
    """Ends a command whose sender was last heard of a while ago.

    Whoever calls `step` may have died of an error that the env never saw: a policy that raised, a
    wrapper, a loop that hangs. It knows nothing of the link, which may be garbage.

    Args:
        publisher: of the commands.
        kind: of message.
        limit_s: how long a command holds [s]; inf for ever.
    """

    def __init__(self, publisher: Publisher, kind: Any, limit_s: float) -> None:
        self._publisher, self._kind, self._limit_s = publisher, kind, limit_s
        self._due_s = self._answered_s = math.inf

    def begin(self, moving: bool) -> None:
        """Counts from now; to be called before a command is published, zero or not."""
        self._due_s = time.monotonic() + self._limit_s if moving else math.inf

    def look(self) -> None:
        """Publishes a zero, once, when time is over; to be called often, from another thread."""
        due_s = self._due_s
        if due_s != self._answered_s and time.monotonic() >= due_s:
            self._answered_s = due_s
            self._publisher.publish(self._kind())

    def end(self) -> None:
        """Publishes the last zero, and sees it delivered."""
        last_word(self._publisher, self._kind())
