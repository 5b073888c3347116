"""Millions of steps in a row: does memory grow, does a NaN appear, does a world get stuck?

Worlds of every kind (still and moving obstacles, maps, teams, domain randomisation) take turns;
each is stepped by random actions, with autoreset. File descriptors and threads are counted, too.
"""

from __future__ import annotations

import math
import os
from pathlib import Path
from typing import Any

import numpy as np
from campaign import Bars, Given, Result, at_least, at_most, run_campaign, some_of
from numpy.typing import NDArray
from parts.processes import measure_use

from nics_drl_bridge.env.vector_env import BridgeVectorEnv

LIMIT = 300
ROUNDS = 20
WORLDS = 256
GROWTH = {
    "rss_mb": at_most(10.0, "memory grew by [MB]"),
    "files": at_most(0, "file descriptors more"),
    "threads": at_most(0, "threads more"),
}
CASE_BARS = {
    "still": at_most(20, "a robot that stood for so many steps"),
    "blind": at_most(5, "an observation that stood for so many steps"),
    "nans": at_most(0, "numbers that are not finite"),
    "episodes": at_least(1, "episodes that ended"),
}
# arguments of `BridgeVectorEnv`
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


class Case:
    """An environment of N worlds with M robots, and what was seen in it."""

    def __init__(self, arguments: dict[str, Any], seed: int, limit: int) -> None:
        self._env = BridgeVectorEnv(WORLDS, max_episode_steps=limit, **arguments)
        self._seen, _ = self._env.reset(seed=seed)
        self._length = np.zeros(WORLDS, np.int64)
        self._blind = np.zeros(WORLDS, np.int64)
        self._still = np.zeros((WORLDS, self._env.robots), np.int64)
        self.steps = 0
        self.nans = 0  # numbers that are not finite
        self.episodes = 0  # that ended
        self.longest = 0  # steps of the longest episode
        # most steps in a row in which a free robot that was told to move did not
        self.still = 0
        # most in which a world's robots moved and its observation did not change
        self.blind = 0

    def run(self, steps: int, rng: np.random.Generator, control: str | None) -> None:
        """Steps the environment by random actions."""
        data = self._env.simulator.data
        space = self._env.action_space
        for _ in range(math.ceil(steps / WORLDS)):
            before = data.pose.copy()
            actions = rng.uniform(-1.0, 1.0, space.shape).astype(space.dtype)
            seen, reward, terminated, truncated, _ = self._env.step(actions)
            if control == "stuck":
                data.pose[0] = before[0]
            elif control == "blind":
                seen[0] = self._seen[0]
            for array in (seen, reward, data.pose, data.odom):
                self.nans += int(np.count_nonzero(~np.isfinite(array)))
            moved = (data.pose != before).any(axis=-1)
            self._count(seen, moved, terminated | truncated)

    def _count(
        self, seen: NDArray[Any], moved: NDArray[np.bool_], over: NDArray[np.bool_]
    ) -> None:
        """Counts for how long each world has gone on, stood, and told the same."""
        free = (self._env.simulator.data.collided == 0) & ~self._env.ended
        self.steps += WORLDS
        self.episodes += int(over.sum())
        self._length += 1
        self.longest = max(self.longest, int(self._length.max()))
        self._length[over] = 0
        self._still += 1
        self._still[moved | ~free | over[:, None]] = 0
        self.still = max(self.still, int(self._still.max()))
        news = (seen != self._seen).any(axis=1)
        self._blind += 1
        self._blind[news | ~(moved & free).any(axis=1) | over] = 0
        self.blind = max(self.blind, int(self._blind.max()))
        self._seen = seen.copy()

    def describe(self) -> dict[str, int]:
        """Returns what was seen."""
        return {key: value for key, value in vars(self).items() if key[0] != "_"}


def measure(given: Given) -> Result:
    """Runs the cases in turn, the first round to warm up and for the memory to settle."""
    limit = 10**9 if given.control == "endless" else given.limit
    cases = {
        name: Case(CASES[name], given.seed + 1000 * k, limit)
        for k, name in enumerate(given.cases)
    }
    rng = np.random.default_rng(given.seed)
    steps = math.ceil(given.steps / (ROUNDS * len(cases)))
    uses = []
    held: list[Any] = []
    for _ in range(ROUNDS):
        for case in cases.values():
            case.run(steps, rng, given.control)
        if given.control == "leak":
            held += [np.ones(2**17), Path(os.devnull).open()]  # noqa: SIM115
        uses.append(measure_use())
    growth = np.subtract(uses[-1], uses[1]).tolist()
    return {
        "growth": dict(zip(GROWTH, growth, strict=True)),
        "cases": {name: case.describe() for name, case in cases.items()},
        "limit": given.limit,
    }


def set_bars(result: Result) -> Bars:
    longest = at_most(result["limit"] + 1, "an episode of so many steps")
    return {"growth": GROWTH, "cases": {"*": CASE_BARS | {"longest": longest}}}


OPTIONS = {
    "steps": (20_000_000, "env steps in all"),
    "seed": 0,
    "cases": some_of(tuple(CASES)),
    "limit": (LIMIT, "steps of the longest episode"),
}

if __name__ == "__main__":
    run_campaign(measure, set_bars, OPTIONS)
