"""The newest datum of each topic, with its stamps."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True)
class Datum:
    """A message as it arrived.

    Attributes:
        stamp_ns: of its header [ns].
        arrival_ns: on the clock of the receiver [ns].
        sequence: how many of its topic came before.
        value: the payload.
    """

    stamp_ns: int
    arrival_ns: int
    sequence: int
    value: Any


@dataclass
class TopicCache:
    """Keeps the newest datum of each topic and counts what was refused.

    Attributes:
        newest: topic -> datum.
        rejected: reason -> how many.
    """

    newest: dict[str, Datum] = field(default_factory=dict)
    rejected: dict[str, int] = field(default_factory=dict)

    def put(self, topic: str, stamp_ns: int, arrival_ns: int, value: Any) -> bool:
        """Stores a datum unless it is older than the one held, or a copy; says whether."""
        held = self.newest.get(topic)
        if held is not None and stamp_ns <= held.stamp_ns:
            self.reject(
                f"{topic}: out of order" if stamp_ns < held.stamp_ns else f"{topic}: duplicate"
            )
            return False
        sequence = 0 if held is None else held.sequence + 1
        self.newest[topic] = Datum(stamp_ns, arrival_ns, sequence, value)
        return True

    def reject(self, reason: str) -> None:
        """Counts a refusal."""
        self.rejected[reason] = self.rejected.get(reason, 0) + 1

    def age_s(self, topic: str, now_ns: int) -> float:
        """Seconds since the newest datum was stamped; inf when there is none."""
        held = self.newest.get(topic)
        return float("inf") if held is None else (now_ns - held.stamp_ns) * 1e-9
