"""The newest message of each topic of a robot in lock-step."""

import math
import time
from collections.abc import Callable
from typing import NamedTuple, TypeVar

from nics_drl_bridge.errors import BackendError
from nics_drl_bridge.interface import S_PER_NS
from nics_drl_bridge.nodes import wire

T = TypeVar("T")


class Message(NamedTuple):
    """A serialised message; the defaults stand for a topic without any."""

    stamp_ns: int = -1
    arrival_ns: int = 0  # on the monotonic clock
    content: bytes = b""

    @property
    def age_s(self) -> float:
        """Time since its arrival [s]; inf if there is none."""
        if not self.content:
            return math.inf
        return (time.monotonic_ns() - self.arrival_ns) * S_PER_NS


class Inbox:
    """The newest message of each topic.

    Args:
        topics: names of the topics.
        slack_ns: messages may be older than an awaited stamp by this much.
    """

    def __init__(self, topics: tuple[str, ...], slack_ns: int) -> None:
        self._slack_ns = slack_ns
        self.messages = dict.fromkeys(topics, Message())

    def clear(self) -> None:
        """Forget all messages."""
        self.messages = dict.fromkeys(self.messages, Message())

    def put(self, topic: str, content: bytes) -> None:
        """Store a message. Raises BackendError if it is damaged."""
        stamp_ns = read_message(topic, wire.stamp_of, content)
        self.messages[topic] = Message(stamp_ns, time.monotonic_ns(), content)

    def has(self, topic: str, stamp_ns: int) -> bool:
        """True if the message of a stamp is there."""
        return self.messages[topic].stamp_ns + self._slack_ns >= stamp_ns

    def find_late(self, stamp_ns: int) -> str | None:
        """Return the first topic whose message of a stamp is not there; None if all are."""
        for topic in self.messages:
            if not self.has(topic, stamp_ns):
                return topic
        return None

    def find_newest_ns(self) -> int:
        """Return the newest stamp of any topic [ns]; -1 if there is no message."""
        return max(message.stamp_ns for message in self.messages.values())


def read_message(topic: str, read: Callable[[bytes], T], content: bytes) -> T:
    """Deserialise a message by `read`. Raises BackendError if it is damaged."""
    try:
        return read(content)
    except wire.UNREADABLE as error:
        reason = f"a message can't be read ({error}); look at who publishes it."
        raise BackendError(f"topic {topic!r}: {reason}") from None
