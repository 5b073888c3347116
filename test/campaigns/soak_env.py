"""Millions of steps in a row: does memory grow, does a NaN appear, does a world get stuck?

Worlds of every kind (still and moving obstacles, maps, teams, domain randomisation) take turns;
each is stepped by random actions, with autoreset. With `--resets`, one Gymnasium env is reset so
often instead, and file descriptors and threads are counted too.
"""

from __future__ import annotations

import argparse
import gc
import math
import os
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import gymnasium
import numpy as np
from campaign import answer, parser_of
from numpy.typing import NDArray
from parts.processes import use_of

from nics_drl_bridge.env.registry import NAVIGATION, register_envs
from nics_drl_bridge.env.vector_env import BridgeVectorEnv

LIMIT = 300
LONGEST_STILL = 20
"""A free robot that is told to move at random stands no longer than so many steps."""
LONGEST_BLIND = 5
"""While its robots move, a world tells the same for no more than so many steps."""
GROWTH_MB = 10.0
ROUNDS = 20
WORLDS = 256
CASES: dict[str, dict[str, Any]] = {
    "arena": {"model": "differential", "world": "arena"},
    "arena, same step": {"model": "ackermann", "autoreset_mode": "SameStep"},
    "room": {"model": "mecanum", "world": "room"},
    "crowd": {"model": "differential", "world": "crowd"},
    "randomised": {
        "model": "differential",
        "world": "clutter",
        "randomisation": "strong",
    },
    "team": {"model": "differential", "world": "arena", "task": "cooperative_reaching"},
}
"""Arguments of `BridgeVectorEnv`."""


@dataclass
class Findings:
    """What was seen in one case.

    Attributes:
        steps: env steps that were made.
        nans: numbers that are not finite, in observations, rewards and true poses.
        episodes: how many ended.
        longest: steps of the longest episode.
        still: most steps in a row in which a free robot that was told to move did not.
        blind: most steps in a row in which a world's robots moved and its observation did not
            change.
    """

    steps: int = 0
    nans: int = 0
    episodes: int = 0
    longest: int = 0
    still: int = 0
    blind: int = 0


def not_finite(*arrays: NDArray[Any]) -> int:
    """How many numbers are not finite."""
    return sum(int(np.count_nonzero(~np.isfinite(array))) for array in arrays)


@dataclass
class Case:
    """An environment that has been reset, and what is counted from one turn to the next.

    Attributes:
        env: of N worlds with M robots.
        seen: (N, O) the observations of the step before.
        length: (N,) steps of the running episodes.
        still: (N, M) steps since a robot moved.
        blind: (N,) steps in which robots moved and the observation stayed the same.
        found: what was seen so far.
    """

    env: BridgeVectorEnv
    seen: NDArray[Any]
    length: NDArray[np.int64]
    still: NDArray[np.int64]
    blind: NDArray[np.int64]
    found: Findings


def begun(arguments: dict[str, Any], seed: int, limit: int) -> Case:
    """The environment of a case, reset."""
    env = BridgeVectorEnv(WORLDS, max_episode_steps=limit, **arguments)
    seen, _ = env.reset(seed=seed)
    zero = np.zeros((WORLDS, env.robots), np.int64)
    return Case(env, seen, zero[:, 0].copy(), zero, zero[:, 0].copy(), Findings())


def soak(case: Case, steps: int, rng: np.random.Generator, control: str | None) -> None:
    """Steps the environment of a case."""
    env = case.env
    found = case.found
    data = env.simulator.data
    shape = env.action_space.shape
    kind = env.action_space.dtype
    for _ in range(math.ceil(steps / env.num_envs)):
        before = data.pose.copy()
        actions = rng.uniform(-1.0, 1.0, shape).astype(kind)
        seen, reward, terminated, truncated, _ = env.step(actions)
        if control == "stuck":
            data.pose[0] = before[0]
        elif control == "blind":
            seen[0] = case.seen[0]
        elif control == "nan":
            seen[0, 0] = np.nan
        found.nans += not_finite(seen, reward, data.pose, data.odom)
        over = terminated | truncated
        count(case, seen, (data.pose != before).any(axis=-1), over)
        found.episodes += int(over.sum())
        found.steps += env.num_envs


def count(
    case: Case, seen: NDArray[Any], moved: NDArray[np.bool_], over: NDArray[np.bool_]
) -> None:
    """Counts for how long each world has gone on, stood, and told the same."""
    found = case.found
    free = (case.env.simulator.data.collided == 0) & ~case.env.ended
    case.length += 1
    found.longest = max(found.longest, int(case.length.max()))
    case.still += 1
    case.still[moved | ~free | over[:, None]] = 0
    found.still = max(found.still, int(case.still.max()))
    case.blind += 1
    case.blind[(seen != case.seen).any(axis=1) | ~(moved & free).any(axis=1) | over] = 0
    found.blind = max(found.blind, int(case.blind.max()))
    case.length[over] = 0
    case.seen = seen.copy()


def run(
    steps: int, seed: int, names: Sequence[str], limit: int, control: str | None
) -> dict[str, Any]:
    """The cases in turn, the first round to warm up and for the memory to settle."""
    allowed = 10**9 if control == "endless" else limit
    cases = {
        name: begun(CASES[name], seed + 1000 * k, allowed)
        for k, name in enumerate(names)
    }
    found = {name: case.found for name, case in cases.items()}
    rng = np.random.default_rng(seed)
    begin = time.perf_counter()
    memory: list[float] = []
    held: list[NDArray[Any]] = []
    for _ in range(ROUNDS):
        for case in cases.values():
            soak(case, math.ceil(steps / (ROUNDS * len(cases))), rng, control)
        if control == "leak":
            held.append(np.ones(2**17))
        memory.append(use_of().rss_mb)
    stuck = {name: stuck_in(one, limit) for name, one in found.items()}
    return {
        "steps": sum(one.steps for one in found.values()),
        "seconds": time.perf_counter() - begin,
        "rss_start_mb": memory[1],
        "rss_end_mb": memory[-1],
        "rss_growth_mb": memory[-1] - memory[1],
        "nans": sum(one.nans for one in found.values()),
        "stuck_worlds": sum(map(bool, stuck.values())),
        "stuck": stuck,
        "episodes": sum(one.episodes for one in found.values()),
        "cases": {name: vars(one) for name, one in found.items()},
    }


def stuck_in(one: Findings, limit: int) -> list[str]:
    """In which ways a world of a case was stuck."""
    bars = (
        (one.longest, limit + 1, "an episode of {} steps, bar {}"),
        (one.still, LONGEST_STILL, "a robot that stood for {} steps, bar {}"),
        (one.blind, LONGEST_BLIND, "an observation that stood for {} steps, bar {}"),
    )
    return [words.format(value, bar) for value, bar, words in bars if not value <= bar]


def missed_of(result: dict[str, Any]) -> list[str]:
    """The bars that a soak missed."""
    missed = [
        f"{name}: {line}" for name, lines in result["stuck"].items() for line in lines
    ]
    missed += [
        f"{name}: {one['nans']} numbers that are not finite"
        for name, one in result["cases"].items()
        if one["nans"] != 0
    ]
    missed += [
        f"{name}: no episode ended in {one['steps']} steps"
        for name, one in result["cases"].items()
        if not one["episodes"] > 0
    ]
    return missed + grown(result)


def grown(result: dict[str, Any]) -> list[str]:
    """A sentence if memory grew too much."""
    growth = result["rss_growth_mb"]
    if growth <= GROWTH_MB:
        return []
    return [f"memory grew by {growth:.1f} MB, bar {GROWTH_MB:g} MB"]


def missed_of_resets(result: dict[str, Any]) -> list[str]:
    """The bars that resets missed."""
    missed = [
        f"{result[key]} {words}, bar 0"
        for key, words in (
            ("nans", "numbers that are not finite"),
            ("fds_growth", "file descriptors more"),
            ("threads_growth", "threads more"),
        )
        if not result[key] <= 0
    ]
    if not result["moved"] > 0:
        missed.append("no step moved the robot")
    return missed + grown(result)


def run_resets(resets: int, seed: int, control: str | None) -> dict[str, Any]:
    """Resets of one Gymnasium env, each with a step; a tenth of them to warm up."""
    register_envs()
    env = gymnasium.make(NAVIGATION, model="differential", world="arena")
    rng = np.random.default_rng(seed)
    begin = time.perf_counter()
    nans = 0
    uses = []
    moved = 0
    held: list[int] = []
    for number in range(resets):
        seen, _ = env.reset(seed=seed + number)
        after, reward, *_ = env.step(rng.uniform(-1.0, 1.0, env.action_space.shape))
        if control == "nan":
            after = np.full_like(after, np.nan)
        if control == "leak":
            held.append(os.open(os.devnull, os.O_RDONLY))
        moved += bool((np.asarray(seen) != np.asarray(after)).any())
        nans += not_finite(seen, after, np.array(reward))
        if number in (resets // 10, resets - 1):
            gc.collect()
            uses.append(use_of())
    env.close()
    return {
        "resets": resets,
        "seconds": time.perf_counter() - begin,
        "rss_growth_mb": uses[-1].rss_mb - uses[0].rss_mb,
        "fds_growth": uses[-1].files - uses[0].files,
        "threads_growth": uses[-1].threads - uses[0].threads,
        "nans": nans,
        "moved": moved,
    }


def main() -> None:
    """Prints a table, or one JSON object."""
    parser = parser_of(__doc__)
    add_options(parser)
    given = parser.parse_args()
    if given.resets:
        told = run_resets(given.resets, given.seed, given.control)
        answer(told, missed_of_resets(told), given.json)
    result = run(given.steps, given.seed, given.cases, given.limit, given.control)
    answer(result, missed_of(result), given.json)


def add_options(parser: argparse.ArgumentParser) -> None:
    """What may be given beside the options that all benchmarks have."""
    parser.add_argument(
        "--steps", type=int, default=20_000_000, help="env steps in all"
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--cases", nargs="+", choices=CASES, default=list(CASES))
    parser.add_argument(
        "--limit", type=int, default=LIMIT, help="steps of the longest episode"
    )
    parser.add_argument(
        "--resets", type=int, default=0, help="resets of a single env instead"
    )


if __name__ == "__main__":
    main()
