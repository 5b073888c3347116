"""The same seed and commands in process and over DDS: how much do the observations differ?

A simulator node runs in lock-step as a process of its own. Both envs are reset to the same
seeds and get the same random actions. A late observation is one that holds a scan or an
odometry older than the step that it answers. By default each robot drives alone, and then a team
of four cars drives with each in its own namespace.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

from nics_drl_bridge.env.registration import COOPERATIVE_REACHING, NAVIGATION, register_envs
from nics_drl_bridge.nodes.processes import NodeProcess, free_domain_id

ROBOTS = ("ackermann", "differential", "mecanum")
FLEET = 4


def measure(robot: str, world: str, steps: int, seed: int, robots: int = 1) -> dict[str, float]:
    """Drives both envs for `steps` steps and compares every observation."""
    register_envs()
    domain_id = free_domain_id()
    parameters = {"model": robot, "world": world, "mode": "lockstep", "robots": robots}
    task: dict[str, Any] = {"id": NAVIGATION}
    if robots > 1:
        task = {"id": COOPERATIVE_REACHING, "task_options": {"robots": robots}}
    with (
        tempfile.TemporaryDirectory() as folder,
        NodeProcess("simulator_node", Path(folder), parameters, domain_id),
    ):
        here = gymnasium.make(**task, backend="sim", model=robot, world=world, estimator=True)
        there = gymnasium.make(
            **task,
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


def measure_all(world: str, steps: int, seed: int) -> dict[str, Any]:
    """Each robot alone, then the fleet; with the worst of all on top."""
    runs = {robot: measure(robot, world, steps, seed) for robot in ROBOTS}
    runs[f"{FLEET} robots in namespaces"] = measure(ROBOTS[0], world, steps, seed, FLEET)
    name = "max_abs_observation_difference"
    return {
        "steps": sum(int(run["steps"]) for run in runs.values()),
        name: max(run[name] for run in runs.values()),
        "late_observations": sum(int(run["late_observations"]) for run in runs.values()),
        "runs": runs,
    }


def show(result: dict[str, Any], indent: str = "") -> None:
    """Prints a table."""
    for key, value in result.items():
        if isinstance(value, dict):
            sys.stdout.write(f"{indent}{key}\n")
            show(value, indent + "  ")
        else:
            sys.stdout.write(f"{indent}{key:<34}{value}\n")


def main() -> None:
    """Prints a table, or one JSON object."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--steps", type=int, default=500)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--robot", help="one kind of robot alone, as ackermann")
    parser.add_argument("--robots", type=int, help="so many of them, in namespaces")
    parser.add_argument("--world", default="arena")
    given = parser.parse_args()
    if given.robot is None and given.robots is None:
        result = measure_all(given.world, given.steps, given.seed)
    else:
        robot = given.robot or ROBOTS[0]
        result = measure(robot, given.world, given.steps, given.seed, given.robots or 1)
    if given.json:
        sys.stdout.write(json.dumps(result) + "\n")
    else:
        show(result)


if __name__ == "__main__":
    main()
