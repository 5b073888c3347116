"""Millions of steps in a row: does memory grow, does a NaN appear, does a world get stuck?

Worlds of every kind (still and moving obstacles, maps, teams, domain randomisation) take turns;
each is stepped by random actions, with autoreset. With `--resets`, one Gymnasium env is reset so
often instead, and file descriptors and threads are counted too.
"""

from __future__ import annotations

import argparse
import gc
import json
import math
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from measuring.processes import use_of
from numpy.typing import NDArray

from nics_drl_bridge.env.registration import NAVIGATION, register_envs
from nics_drl_bridge.env.vector_env import BridgeVectorEnv

PAGE = 4096
LIMIT = 300
ROUNDS = 20
WORLDS = 256
CASES: dict[str, dict[str, Any]] = {
    "arena": {"model": "differential", "world": "arena"},
    "arena, same step": {"model": "ackermann", "autoreset_mode": "SameStep"},
    "room": {"model": "mecanum", "world": "room"},
    "crowd": {"model": "differential", "world": "crowd"},
    "randomised": {"model": "differential", "world": "clutter", "randomisation": "strong"},
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
        longest: steps of the longest episode; beyond the limit a world is stuck.
        still: most steps in a row in which a free robot that was told to move did not.
    """

    steps: int = 0
    nans: int = 0
    episodes: int = 0
    longest: int = 0
    still: int = 0


def resident_mb() -> float:
    """Memory of this process that is resident [MB]."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * PAGE / 1e6


def not_finite(*arrays: NDArray[Any]) -> int:
    """How many numbers are not finite."""
    return sum(int(np.count_nonzero(~np.isfinite(array))) for array in arrays)


@dataclass
class Case:
    """An environment that has been reset, and what is counted from one turn to the next.

    Attributes:
        env: of N worlds with M robots.
        length: (N,) steps of the running episodes.
        still: (N, M) steps since a robot moved.
        found: what was seen so far.
    """

    env: BridgeVectorEnv
    length: NDArray[np.int64]
    still: NDArray[np.int64]
    found: Findings


def begun(arguments: dict[str, Any], seed: int) -> Case:
    """The environment of a case, reset."""
    env = BridgeVectorEnv(WORLDS, max_episode_steps=LIMIT, **arguments)
    env.reset(seed=seed)
    zero = np.zeros((WORLDS, env.robots), np.int64)
    return Case(env, zero[:, 0].copy(), zero, Findings())


def soak(case: Case, steps: int, rng: np.random.Generator) -> None:
    """Steps the environment of a case."""
    env, found, length, still = case.env, case.found, case.length, case.still
    data = env.simulator.data
    shape, kind = env.action_space.shape, env.action_space.dtype
    for _ in range(math.ceil(steps / env.num_envs)):
        before = data.pose.copy()
        actions = rng.uniform(-1.0, 1.0, shape).astype(kind)
        seen, reward, terminated, truncated, _ = env.step(actions)
        found.nans += not_finite(seen, reward, data.pose, data.odom)
        length += 1
        over = terminated | truncated
        found.episodes += int(over.sum())
        found.longest = max(found.longest, int(length.max()))
        length[over] = 0
        moved = (data.pose != before).any(axis=-1) | (data.collided != 0) | env.ended
        still += 1
        still[moved | over[:, None]] = 0
        found.still = max(found.still, int(still.max()))
        found.steps += env.num_envs


def run(steps: int, seed: int, names: Sequence[str]) -> dict[str, Any]:
    """The cases in turn, the first round to warm up and for the memory to settle."""
    cases = {name: begun(CASES[name], seed + 1000 * k) for k, name in enumerate(names)}
    found = {name: case.found for name, case in cases.items()}
    rng, begin = np.random.default_rng(seed), time.perf_counter()
    memory = []
    for _ in range(ROUNDS):
        for case in cases.values():
            soak(case, math.ceil(steps / (ROUNDS * len(cases))), rng)
        memory.append(resident_mb())
    stuck = sum(one.longest > LIMIT + 1 or one.still > LIMIT for one in found.values())
    return {
        "steps": sum(one.steps for one in found.values()),
        "seconds": time.perf_counter() - begin,
        "rss_start_mb": memory[1],
        "rss_end_mb": memory[-1],
        "rss_growth_mb": memory[-1] - memory[1],
        "nans": sum(one.nans for one in found.values()),
        "stuck_worlds": stuck,
        "episodes": sum(one.episodes for one in found.values()),
        "cases": {name: vars(one) for name, one in found.items()},
    }


def run_resets(resets: int, seed: int) -> dict[str, Any]:
    """Resets of one Gymnasium env, each with a step; a tenth of them to warm up."""
    register_envs()
    env = gymnasium.make(NAVIGATION, model="differential", world="arena")
    rng, begin, nans = np.random.default_rng(seed), time.perf_counter(), 0
    uses = []
    for number in range(resets):
        seen, _ = env.reset(seed=seed + number)
        after, reward, *_ = env.step(rng.uniform(-1.0, 1.0, env.action_space.shape))
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
    }


def table_of(result: dict[str, Any]) -> str:
    """One line per case, and the sum."""
    text = f"{'case':<18}{'steps':>12}{'episodes':>10}{'longest':>9}{'still':>7}{'NaN':>5}\n"
    for name, one in result["cases"].items():
        text += f"{name:<18}{one['steps']:>12}{one['episodes']:>10}{one['longest']:>9}"
        text += f"{one['still']:>7}{one['nans']:>5}\n"
    return text + (
        f"{result['steps']} steps in {result['seconds']:.0f} s; memory grew by "
        f"{result['rss_growth_mb']:.1f} MB to {result['rss_end_mb']:.0f} MB\n"
    )


def main() -> None:
    """Prints a table, or one JSON object."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--steps", type=int, default=20_000_000, help="env steps in all")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--cases", nargs="+", choices=CASES, default=list(CASES))
    parser.add_argument("--resets", type=int, default=0, help="resets of a single env instead")
    given = parser.parse_args()
    if given.resets:
        told = run_resets(given.resets, given.seed)
        lines = "".join(f"{key:<16}{value}\n" for key, value in told.items())
        sys.stdout.write(json.dumps(told) + "\n" if given.json else lines)
        return
    result = run(given.steps, given.seed, given.cases)
    sys.stdout.write(json.dumps(result) + "\n" if given.json else table_of(result))


if __name__ == "__main__":
    main()
