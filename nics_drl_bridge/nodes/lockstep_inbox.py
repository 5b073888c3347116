"""The inbox of a backend in lock-step: the newest messages, and the wait for those of a stamp."""

import math
import threading
import time
from collections.abc import Callable
from typing import NamedTuple, TypeVar

from nics_drl_bridge.errors import BackendError, StaleDataError
from nics_drl_bridge.interface import S_PER_NS
from nics_drl_bridge.middleware.measurement import ODOM
from nics_drl_bridge.nodes import wire
from nics_drl_bridge.nodes.executor import HANDED_OVER

T = TypeVar("T")


class Message(NamedTuple):
    """A serialised message; the defaults stand for a topic without any."""

    stamp_ns: int = -1
    arrival_ns: int = 0  # on the monotonic clock
    content: bytes = b""


class Inbox:
    """The newest message of each topic, and the wait for those of one stamp.

    The executor's thread puts messages in; the caller's thread waits. The caller is woken once,
    when the messages of all topics are there, because each wake-up costs a good part of a step.
    The executor's thread does not idle until then: it updates the estimator with the awaited
    odometry while the scan is still in transit.

    Args:
        topics: names of the topics; `odom` is one of them.
        update_estimator: is called with stamp, arrival and content of each awaited odometry.
        slack_ns: messages may be older than the awaited stamp by this much.
    """

    def __init__(
        self,
        topics: tuple[str, ...],
        update_estimator: Callable[[int, int, bytes], None],
        slack_ns: int,
    ) -> None:
        self._slack_ns = slack_ns
        self._messages = dict.fromkeys(topics, Message())
        self._update_estimator = update_estimator
        self._lock = threading.Lock()
        # Locked while the caller waits, released to wake it: cheaper than an Event.
        self._caller_waits = threading.Lock()
        self._awaited_ns = -1  # the awaited stamp; -1: nothing is awaited
        self._estimated_ns = -1  # the awaited stamp of the last update of the estimator
        self._failure: Exception | None = None  # of `put`, for the caller

    def put(self, topic: str, content: bytes) -> object:
        """Store a message; return HANDED_OVER if that woke the caller.

        An exception is kept for the caller: the next `wait` raises it.
        """
        with self._lock:
            try:
                stamp_ns = read_message(topic, wire.stamp_of, content)
                self._messages[topic] = Message(stamp_ns, time.monotonic_ns(), content)
                self._update_if_due()
            except Exception as error:  # noqa: BLE001  (it is raised in the caller's thread)
                self._failure = error
            if self._awaited_ns < 0:
                return None
            if self._failure is None and self._find_late(self._awaited_ns):
                return None
            if self._caller_waits.locked():
                self._caller_waits.release()
            return HANDED_OVER

    def wait(self, stamp_ns: int, timeout_s: float) -> dict[str, Message]:
        """Wait for the messages of a stamp; return them by topic.

        Raises StaleDataError if a topic is late, and what `put` failed with since the last call.
        """
        try:
            with self._lock:
                self._awaited_ns = stamp_ns
                self._caller_waits.acquire(blocking=False)
                self._update_if_due()
                is_complete = self._find_late(stamp_ns) is None
                is_over = is_complete or self._failure is not None
            if not is_over:
                self._caller_waits.acquire(timeout=timeout_s)  # until `put` releases it
        finally:
            self._awaited_ns = -1
        with self._lock:
            failure = self._failure
            self._failure = None
            if failure is not None:
                raise failure
            late_topic = self._find_late(stamp_ns)
            if late_topic is None:
                return dict(self._messages)
            latest = self._messages[late_topic]
        age_s = math.inf
        if latest.content:
            age_s = (time.monotonic_ns() - latest.arrival_ns) * S_PER_NS
        raise StaleDataError(late_topic, age_s, timeout_s)

    def _update_if_due(self) -> None:
        """Update the estimator, once, with the odometry that is awaited, if it is there."""
        awaited_ns = self._awaited_ns
        if awaited_ns < 0 or self._estimated_ns == awaited_ns:
            return
        odometry = self._messages[ODOM]
        if odometry.stamp_ns + self._slack_ns >= awaited_ns:
            self._estimated_ns = awaited_ns
            self._update_estimator(*odometry)

    def _find_late(self, stamp_ns: int) -> str | None:
        """Return the first topic whose message of a stamp is not there; None if all are."""
        for topic, message in self._messages.items():
            if message.stamp_ns + self._slack_ns < stamp_ns:
                return topic
        return None

    def get_stamp_ns(self, topic: str) -> int:
        """Return the stamp of the newest message of a topic [ns]; -1 if there is none."""
        return self._messages[topic].stamp_ns

    def get_content(self, topic: str) -> bytes:
        """Return the newest message of a topic, serialised; empty if there is none."""
        return self._messages[topic].content

    def find_newest_ns(self) -> int:
        """Return the newest stamp of any topic [ns]; -1 if there is no message."""
        return max(message.stamp_ns for message in self._messages.values())

    def clear(self) -> None:
        """Drop all messages."""
        with self._lock:
            self._messages = dict.fromkeys(self._messages, Message())
            self._estimated_ns = -1

    def forget_failure(self) -> None:
        """Drop what `put` failed with, because an episode begins."""
        with self._lock:
            self._failure = None


def read_message(topic: str, read: Callable[[bytes], T], content: bytes) -> T:
    """Deserialise a message by `read`. Raises BackendError if it is damaged."""
    try:
        return read(content)
    except wire.UNREADABLE as error:
        reason = f"a message can't be read ({error}); look at who publishes it."
        raise BackendError(f"topic {topic!r}: {reason}") from None
