"""What the same episodes came to in several worlds."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from nics_drl_bridge.policy.evaluation import Episode, deviation
from nics_drl_bridge.policy.evaluation_intervals import Estimate, mean, rate

RESULTS = ("success", "collision")


@dataclass(frozen=True)
class Tally:
    """What the episodes of one world came to, each figure with its 95 % interval.

    Attributes:
        episodes: how many.
        success, collision: shares of the episodes, by the truth where it is known.
        time_out: share of those that ended neither way.
        believed: share that the robot itself took for a success.
        length: mean path of the successful ones [m].
        time: mean duration of the successful ones [s].
        same: share of the episodes that ended as in the first world.
        deviation: mean over the episodes of the greatest distance between the true path and that
            in the first world at the same step [m].
        greatest_deviation: of all episodes [m].
    """

    episodes: int
    success: Estimate
    collision: Estimate
    time_out: Estimate
    length: Estimate
    time: Estimate
    same: float
    deviation: Estimate
    greatest_deviation: float
    believed: Estimate

    def figures(self) -> dict[str, Any]:
        """As plain data; what is not finite is null."""
        told = {name: list(v.values()) if isinstance(v, dict) else v
                for name, v in asdict(self).items()}  # fmt: skip
        return {name: _finite(value) for name, value in told.items()}


def _finite(value: Any) -> Any:
    if isinstance(value, list):
        return [_finite(each) for each in value]
    return value if math.isfinite(value) else None


def tally(episodes: Sequence[Episode], first: Sequence[Episode], control_period: float) -> Tally:
    """The figures of episodes.

    Args:
        episodes: of one world.
        first: the same seeds in the world that it is compared with.
        control_period: of the robot [s].
    """
    count = len(episodes)
    arrived = [episode for episode in episodes if episode.result == "success"]
    gaps = [deviation(one, other) for one, other in zip(episodes, first, strict=True)]
    same = sum(one.result == other.result for one, other in zip(episodes, first, strict=True))
    ended = [sum(episode.result == name for episode in episodes) for name in RESULTS]
    believed = sum(episode.believed_success for episode in episodes)
    success, collision, time_out, taken = (
        rate(number, count) for number in (*ended, count - sum(ended), believed)
    )
    return Tally(
        count,
        success,
        collision,
        time_out,
        mean([episode.length for episode in arrived]),
        mean([episode.steps * control_period for episode in arrived]),
        same / count,
        mean(gaps),
        max(gaps),
        taken,
    )


def tallies(runs: Mapping[str, Sequence[Episode]], control_period: float) -> dict[str, Tally]:
    """The figures of each world; all are compared with the first."""
    first = next(iter(runs.values()))
    return {place: tally(episodes, first, control_period) for place, episodes in runs.items()}


def record_of(episode: Episode) -> dict[str, Any]:
    """An episode as plain data, with its true path (T, 3)."""
    return {
        "seed": episode.seed,
        "result": episode.result,
        "believed": episode.believed,
        "goal_distance_m": round(episode.miss, 4),
        "steps": episode.steps,
        "length_m": round(episode.length, 4),
        "goal": episode.goal.tolist(),
        "path": np.round(episode.path, 4).tolist(),
    }
