"""Latency: how long after it was measured a robot's scan and odometry come."""

from __future__ import annotations

from pydantic import Field

from nics_drl_bridge.config import Schema


class Delay(Schema):
    """An even distribution of delays.

    Attributes:
        least: the smallest [s].
        jitter: by how much the greatest is more [s].
    """

    least: float = Field(ge=0.0)
    jitter: float = Field(ge=0.0)


class Latency(Schema):
    """From what was measured to its receipt; None where nothing showed it.

    Attributes:
        scan: of scans, from the last beam.
        odom: of odometry, from its stamp.
    """

    scan: Delay | None = None
    odom: Delay | None = None

    @property
    def measured(self) -> dict[str, Delay]:
        """The delays that are known, by topic."""
        named = {"scan": self.scan, "odom": self.odom}
        return {topic: delay for topic, delay in named.items() if delay is not None}

    def sentences(self) -> list[str]:
        """One line per topic, for people."""
        return [
            f"{topic} comes {1e3 * delay.least:.1f} to {1e3 * (delay.least + delay.jitter):.1f} ms "
            "after it was measured"
            for topic, delay in self.measured.items()
        ]
