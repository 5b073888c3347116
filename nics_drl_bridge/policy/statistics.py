"""95 % intervals: of a rate by Wilson's score, of a mean by Student's t.

Comparison of the same episodes in several worlds.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy import stats

from nics_drl_bridge.policy.evaluation import Episode, deviation

CONFIDENCE = 0.95


@dataclass(frozen=True)
class ConfidenceInterval:
    """A figure with its 95 % confidence interval.

    Attributes:
        value: NaN if nothing was observed.
        low, high: ends of the interval; infinite for the mean of a single observation.
    """

    value: float
    low: float
    high: float


def rate(hits: int, trials: int) -> ConfidenceInterval:
    """A share of trials with Wilson's score interval (1927), valid for few trials too."""
    if trials < 1:
        return ConfidenceInterval(math.nan, 0.0, 1.0)
    share, z = hits / trials, float(stats.norm.ppf(0.5 + CONFIDENCE / 2.0))
    scale = 1.0 + z * z / trials
    middle = (share + z * z / (2.0 * trials)) / scale
    half = z / scale * math.sqrt(share * (1.0 - share) / trials + (z / (2.0 * trials)) ** 2)
    # With no hits, or hits only, rounding must not move the end away from 0 or 1.
    low = 0.0 if hits == 0 else middle - half
    return ConfidenceInterval(share, low, 1.0 if hits == trials else middle + half)


def mean(values: ArrayLike) -> ConfidenceInterval:
    """The mean of observations (n,) with the interval of Student's t."""
    seen = np.asarray(values, np.float64)
    if not len(seen):
        return ConfidenceInterval(math.nan, -math.inf, math.inf)
    middle = float(seen.mean())
    if len(seen) == 1:
        return ConfidenceInterval(middle, -math.inf, math.inf)
    quantile = float(stats.t.ppf(0.5 + CONFIDENCE / 2.0, len(seen) - 1))
    half = quantile * float(seen.std(ddof=1)) / math.sqrt(len(seen))
    return ConfidenceInterval(middle, middle - half, middle + half)


RESULTS = ("success", "collision")


@dataclass(frozen=True)
class Tally:
    """Figures of the episodes of one world, each with its 95 % interval.

    Attributes:
        episodes: number of episodes.
        success, collision: shares of the episodes, by the truth if it is known.
        time_out: share of episodes that ended neither way.
        believed: share of episodes that the robot itself believed successful.
        length: mean path of the successful ones [m].
        time: mean duration of the successful ones [s].
        same: share of the episodes that ended as in the first world.
        deviation: mean over the episodes of the maximum distance between the true path and that
            in the first world at the same step [m].
        greatest_deviation: maximum over all episodes [m].
    """

    episodes: int
    success: ConfidenceInterval
    collision: ConfidenceInterval
    time_out: ConfidenceInterval
    length: ConfidenceInterval
    time: ConfidenceInterval
    same: float
    deviation: ConfidenceInterval
    greatest_deviation: float
    believed: ConfidenceInterval

    def figures(self) -> dict[str, Any]:
        """The tally as plain data; non-finite values become null."""
        told = {name: list(v.values()) if isinstance(v, dict) else v
                for name, v in asdict(self).items()}  # fmt: skip
        return {name: _finite(value) for name, value in told.items()}


def _finite(value: Any) -> Any:
    if isinstance(value, list):
        return [_finite(each) for each in value]
    return value if math.isfinite(value) else None


def tally(episodes: Sequence[Episode], first: Sequence[Episode], control_period: float) -> Tally:
    """Computes the figures of episodes.

    Args:
        episodes: of one world.
        first: the same seeds in the world to compare with.
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
    """Computes the figures of each world, compared with the first."""
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
