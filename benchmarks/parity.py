"""The same seed and commands in process and over DDS: how much do the observations differ?

A simulator node runs in lock-step as a process of its own. Both envs are reset to the same
seeds and get the same random actions. A late observation is one that holds a scan or an
odometry older than the step that it answers.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from pathlib import Path

import gymnasium
import numpy as np

from nics_drl_bridge.env.registration import NAVIGATION, register_envs
from nics_drl_bridge.nodes.processes import NodeProcess, free_domain_id


def measure(robot: str, world: str, steps: int, seed: int) -> dict[str, float]:
    """Drives both envs for `steps` steps and compares every observation."""
    register_envs()
    domain_id = free_domain_id()
    parameters = {"model": robot, "world": world, "mode": "lockstep"}
    with (
        tempfile.TemporaryDirectory() as folder,
        NodeProcess("simulator_node", Path(folder), parameters, domain_id),
    ):
        here = gymnasium.make(NAVIGATION, backend="sim", model=robot, world=world, estimator=True)
        there = gymnasium.make(
            NAVIGATION,
            backend="dds",
            model=robot,
            world=world,
            backend_options={"domain_id": domain_id},
        )
        try:
            return compare(here, there, steps, seed)
        finally:
            here.close()
            there.close()


def compare(here: gymnasium.Env, there: gymnasium.Env, steps: int, seed: int) -> dict[str, float]:
    """Steps two envs side by side, beginning a new episode in both whenever one ends."""
    rng = np.random.default_rng(seed)
    worst, late, spent, episodes = 0.0, 0, 0.0, 0
    ended = True
    for _ in range(steps):
        if ended:
            a, _ = here.reset(seed=seed + episodes)
            b, _ = there.reset(seed=seed + episodes)
            episodes += 1
            worst = max(worst, float(np.abs(a - b).max()))
        action = rng.uniform(-1.0, 1.0, here.action_space.shape).astype(np.float32)
        a, reward_a, end_a, cut_a, _ = here.step(action)
        begin = time.perf_counter()
        b, reward_b, end_b, cut_b, info = there.step(action)
        spent += time.perf_counter() - begin
        worst = max(worst, float(np.abs(a - b).max()), abs(reward_a - reward_b))
        late += info["scan_age_s"] > 0.0 or info["odom_age_s"] > 0.0
        if (end_a, cut_a) != (end_b, cut_b):
            worst = float("inf")
        ended = end_a or cut_a or end_b or cut_b
    return {
        "steps": steps,
        "max_abs_observation_difference": worst,
        "late_observations": int(late),
        "episodes": episodes,
        "dds_steps_per_s": round(steps / spent, 1),
    }


def main() -> None:
    """Prints a table, or one JSON object."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--steps", type=int, default=500)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--robot", default="ackermann")
    parser.add_argument("--world", default="arena")
    given = parser.parse_args()
    result = measure(given.robot, given.world, given.steps, given.seed)
    if given.json:
        sys.stdout.write(json.dumps(result) + "\n")
    else:
        for key, value in result.items():
            sys.stdout.write(f"{key:<34}{value}\n")


if __name__ == "__main__":
    main()
