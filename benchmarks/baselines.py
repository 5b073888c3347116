"""How well do the policies that need no training navigate, beside those that come trained?

Every policy by name, and the shipped policy file of each robot if there is one, drives the same
unseen episodes: the evaluation protocol of `nics train`.
"""

from __future__ import annotations

import argparse
import dataclasses
import json

from nics_drl_bridge.env.vector_env import BridgeVectorEnv
from nics_drl_bridge.generator import open_model
from nics_drl_bridge.policy.evaluation_batch import FIRST_SEED, Summary, drive_worlds, summarise
from nics_drl_bridge.policy.policies import POLICIES, open_policy, shipped_policies
from nics_drl_bridge.policy.train_run import line_of

ROBOTS = ("differential", "ackermann", "mecanum")


def measure(robot: str, name: str, world: str, episodes: int) -> Summary:
    """A policy by name, in a world."""
    model = open_model(robot)
    policy, task = open_policy(name, model)
    env = BridgeVectorEnv(episodes, model, world, task)
    seeds = range(FIRST_SEED, FIRST_SEED + episodes)
    return summarise(drive_worlds(env, policy.act, seeds), model.control_period)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--world", nargs="+", default=["circles"])
    parser.add_argument("--robot", nargs="+", choices=ROBOTS, default=ROBOTS)
    parser.add_argument("--policy", nargs="+", default=list(POLICIES))
    parser.add_argument("--episodes", type=int, default=500)
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    figures = {}
    for world in arguments.world:
        for robot in arguments.robot:
            own = [robot] if robot in shipped_policies() else []
            for name in [*own, *arguments.policy]:
                summary = measure(robot, name, world, arguments.episodes)
                figures[f"{world}/{robot}/{name}"] = dataclasses.asdict(summary)
                if not arguments.json:
                    print(f"{world}, {robot}, {name}: {line_of(summary)}", flush=True)
    if arguments.json:
        print(json.dumps(figures))


if __name__ == "__main__":
    main()
