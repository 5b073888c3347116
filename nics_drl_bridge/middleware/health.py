"""How well a robot is heard: what the diagnostics tell."""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass(frozen=True)
class TopicHealth:
    """One topic.

    Attributes:
        received: how many data were taken.
        rate_hz: how many come in a second [1/s]; 0 before the second.
        age_s: how long ago the newest came [s], on the clock of the receiver.
        innovation: squared, normalised innovation of the newest measurement, about its number of
            components when all is well; NaN for what corrects nothing.
    """

    received: int
    rate_hz: float
    age_s: float
    innovation: float = float("nan")


@dataclass(frozen=True)
class Health:
    """All topics of a robot.

    Attributes:
        topics: topic -> its health; those that nothing came from are missing.
        rejected: reason -> how many; a reason begins with the topic.
        noticed: what was used although it was surprising (`odom: news`), and how often.
        replayed: how many data came late and were put in their place.
    """

    topics: dict[str, TopicHealth] = field(default_factory=dict)
    rejected: dict[str, int] = field(default_factory=dict)
    noticed: dict[str, int] = field(default_factory=dict)
    replayed: int = 0
