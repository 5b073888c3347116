"""Arguments of the vector env, and joining of the results of its parts.

Contents of a vector env's `info`: facts of its worlds, by name.

Builds the `info` of Gymnasium's SyncVectorEnv from arrays over the worlds.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import ArrayLike, NDArray

from nics_drl_bridge.env.task import Outcome
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.sim.simulator import FastSimulator

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]
Observation = NDArray[np.float32]
MODES = {mode.value: mode for mode in (AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP)}


def flat(observations: Observation) -> Observation:
    """Concatenates the observations of each world's robots to (N, M O), without a copy."""
    return observations.reshape(len(observations), -1)


def over_robots(rewards: Array) -> Array:
    """Sums rewards (N, M) to (N,), robot by robot as a single env does."""
    total = rewards[:, 0].copy()
    for m in range(1, rewards.shape[1]):
        total += rewards[:, m]
    return total


def joined(parts: Sequence[Outcome]) -> Outcome:
    """Joins the outcomes of consecutive parts of the worlds."""
    if len(parts) == 1:
        return parts[0]

    def join(one: Callable[[Outcome], dict[str, Any]]) -> dict[str, Any]:
        return {name: np.concatenate([one(part)[name] for part in parts]) for name in one(parts[0])}

    ended = np.concatenate([part.ended for part in parts])
    return Outcome(join(lambda part: part.terms), ended, join(lambda part: part.info))


def mode_of(mode: str | AutoresetMode) -> AutoresetMode:
    """An autoreset mode by its value. Raises ConfigError for an unsupported one."""
    value = mode.value if isinstance(mode, AutoresetMode) else mode
    if value not in MODES:
        raise ConfigError(f"autoreset_mode {value!r}: must be one of {', '.join(MODES)}.")
    return MODES[value]


def chosen_worlds(options: dict[str, Any] | None, count: int) -> Flags:
    """Mask (N,) of the worlds to reset. Raises ConfigError for a wrong `reset_mask`."""
    if not options or "reset_mask" not in options:
        return np.ones(count, np.bool_)
    mask: ArrayLike = options["reset_mask"]
    chosen = np.asarray(mask)
    if chosen.shape != (count,) or chosen.dtype != np.bool_ or not chosen.any():
        raise ConfigError(
            f"options['reset_mask'] of shape {chosen.shape}, {chosen.dtype}: must be ({count},) "
            "bool with at least one True."
        )
    return chosen.copy()


def named_seeds(
    seed: int | Sequence[int | None] | None, chosen: Flags, unnamed: Flags, rng: np.random.Generator
) -> tuple[NDArray[np.int64], Flags]:
    """Seeds that a reset gives to worlds.

    Args:
        seed: of the first world, or of each (None keeps its present one), or None for all.
        chosen: (N,) worlds that are reset.
        unnamed: (N,) worlds that never had a seed; one is drawn if none is given.
        rng: generator of drawn seeds.

    Returns:
        Seeds (N,), and a mask (N,) of the worlds that begin a series of episodes with them.

    Raises:
        ConfigError: wrong number of seeds, or a negative one.
    """
    count = len(chosen)
    if isinstance(seed, Sequence | np.ndarray):
        if len(seed) != count:
            raise ConfigError(f"{len(seed)} seeds for {count} worlds; give one each.")
        given = chosen & np.array([one is not None for one in seed])
        seeds = np.array([0 if one is None else one for one in seed], np.int64)
    else:
        given = chosen & (seed is not None)
        seeds = (seed or 0) + np.arange(count, dtype=np.int64)
    new = chosen & unnamed & ~given
    if new.any():
        seeds = np.where(new, int(rng.integers(2**31)) + np.arange(count), seeds)
    fresh = given | new
    if (seeds[fresh] < 0).any():
        raise ConfigError("a seed must not be negative.")
    return seeds, fresh


Rows = slice | NDArray[np.intp]
EVERY = slice(None)


class VectorFacts:
    """Provides facts as arrays (N, ...) for worlds of one robot, or (N, M, ...) for teams.

    Args:
        simulator: of the worlds.
        period_ns: control period [ns].
    """

    def __init__(self, simulator: FastSimulator, period_ns: int) -> None:
        self._simulator, self._period_ns = simulator, period_ns
        self._alone = simulator.data.pose.shape[1] == 1

    def known(self, shown: Mapping[str, NDArray[Any]], rows: Rows = EVERY) -> dict[str, Any]:
        """Facts of some worlds that are known at any time, in new arrays.

        Args:
            shown: memory arrays that the task shows (N, M, ...).
            rows: indices of the worlds.
        """
        pose = self._own(self._simulator.data.odom[rows])
        told = {name: self._own(values[rows]) for name, values in shown.items()}
        ages = np.zeros(len(pose))
        return {**told, "pose": pose, "scan_age_s": ages, "odom_age_s": ages.copy()}

    def beginnings(self, starts: Array, bodies: Array, rows: Rows) -> dict[str, Any]:
        """Facts of episodes that begin, with the values that the randomisation drew.

        Args:
            starts: (N, M, 3) poses of the robots.
            bodies: (N, K, 7) the obstacles.
            rows: indices of the worlds.
        """
        drawn = {
            name: self._row(values[rows]) if values.ndim > 1 else values[rows]
            for name, values in self._simulator.drawn.items()
        }
        return {
            "episode_seed": self._simulator.data.seeds[rows],
            "start": self._row(starts[rows]),
            "bodies": bodies[rows],
            **({"randomisation": drawn} if drawn else {}),
        }

    def of_step(self, outcome: Outcome) -> dict[str, Any]:
        """Facts of a step, for every world, in new arrays."""
        data = self._simulator.data
        return {
            "stamp_ns": data.steps * self._period_ns,
            "true_pose": self._own(data.pose),
            "true_collision": self._row(data.collided).astype(np.bool_),
            **{name: self._own(values) for name, values in outcome.info.items()},
            "reward_terms": {name: self._own(term) for name, term in outcome.terms.items()},
        }

    def _own(self, rows: NDArray[Any]) -> NDArray[Any]:
        return self._row(rows).copy()

    def _row(self, rows: NDArray[Any]) -> NDArray[Any]:
        return rows[:, 0] if self._alone else rows


RowIndices = NDArray[np.intp]
Facts = Mapping[str, Any]
"""Name -> array whose first dimension is the world, or another such mapping."""


def put_all(infos: dict[str, Any], facts: Facts, without: Flags) -> None:
    """Adds facts of all worlds (N, ...), each paired with its mask `_name`.

    Args:
        infos: takes ownership of the arrays.
        facts: of every world.
        without: (N,) worlds without facts; their rows become zero, as in Gymnasium.
    """
    gone = np.flatnonzero(without)
    for name, values in facts.items():
        if isinstance(values, Mapping):
            infos[name] = {}
            put_all(infos[name], values, without)
        else:
            if len(gone):
                values[gone] = 0
            infos[name] = values
        infos[f"_{name}"] = ~without


def put_rows(infos: dict[str, Any], facts: Facts, rows: RowIndices, count: int) -> None:
    """Adds facts (n, ...) of the worlds `rows` (n,) of N, with masks; other rows are zero."""
    for name, values in facts.items():
        if isinstance(values, Mapping):
            infos[name] = {}
            put_rows(infos[name], values, rows, count)
        else:
            infos[name] = np.zeros((count, *values.shape[1:]), values.dtype)
            infos[name][rows] = values
        infos[f"_{name}"] = np.zeros(count, np.bool_)
        infos[f"_{name}"][rows] = True


def rows_of(facts: Facts, rows: RowIndices) -> dict[str, Any]:
    """The same facts of some worlds only."""
    return {
        name: rows_of(values, rows) if isinstance(values, Mapping) else values[rows]
        for name, values in facts.items()
    }


def finals(observation: NDArray[Any], rows: RowIndices) -> dict[str, Any]:
    """`final_obs` of the worlds `rows`: an object array with None elsewhere."""
    shown, mask = np.full(len(observation), None, dtype=object), np.zeros(len(observation), bool)
    for n in rows:  # only those that ended: each needs its own object
        shown[n] = observation[n].copy()
    mask[rows] = True
    return {"final_obs": shown, "_final_obs": mask}
