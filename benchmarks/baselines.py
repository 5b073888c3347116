"""How well do the policies that need no training navigate, beside those that come trained?

Every policy by name, and the shipped policy file of each robot if there is one, drives the same
unseen episodes: the evaluation protocol of `nics train`.
"""

from __future__ import annotations

import dataclasses
from typing import Any

from bench import answer, parser_of
from measuring.standing import Standing

from nics_drl_bridge.env.vector_env import BridgeVectorEnv
from nics_drl_bridge.generator import open_model
from nics_drl_bridge.policy.evaluation import (
    FIRST_SEED,
    Summary,
    drive_worlds,
    summarise,
)
from nics_drl_bridge.policy.policies import POLICIES, open_policy, shipped_policies

ROBOTS = ("differential", "ackermann", "mecanum")
CONTROLS = {"standing": "every policy stands still"}
FLOORS = {"dynamic_window": 0.7, "mppi": 0.7, "straight": 0.05}
FLOORS |= dict.fromkeys(ROBOTS, 0.8)
"""Least success in the world `circles`; the shipped policies go by the names of their robots."""
LEAST_WAY_M = 1.0


def measure(
    robot: str, name: str, world: str, episodes: int, control: str | None
) -> Summary:
    """A policy by name, in a world."""
    model = open_model(robot)
    policy, task = open_policy(name, model)
    if control == "standing":
        policy = Standing(task)
    env = BridgeVectorEnv(episodes, model, world, task)
    seeds = range(FIRST_SEED, FIRST_SEED + episodes)
    return summarise(drive_worlds(env, policy.act, seeds), model.control_period)


def missed(figures: dict[str, dict[str, Any]]) -> list[str]:
    """A sentence for each bar that was missed; world/robot/policy -> figures."""
    said = []
    for place, told in figures.items():
        world, _, name = place.split("/")
        success = told["success"]["value"]
        length = told["length"]["value"]
        floor = FLOORS.get(name, 0.0) if world == "circles" else 0.0
        if not success >= floor:
            said.append(f"{place}: {success:.0%} success, less than {floor:.0%}")
        if name in (*ROBOTS, "dynamic_window", "mppi") and not length >= LEAST_WAY_M:
            said.append(f"{place}: no successful way of at least {LEAST_WAY_M:g} m")
    return said if figures else ["no policy was driven"]


def main() -> None:
    """Prints a line for each policy, or one JSON object."""
    parser = parser_of(__doc__, CONTROLS)
    parser.add_argument("--world", nargs="+", default=["circles"])
    parser.add_argument("--robot", nargs="+", choices=ROBOTS, default=ROBOTS)
    parser.add_argument("--policy", nargs="+", default=list(POLICIES))
    parser.add_argument("--episodes", type=int, default=500)
    given = parser.parse_args()
    figures = {}
    for world in given.world:
        for robot in given.robot:
            own = [robot] if robot in shipped_policies() else []
            for name in [*own, *given.policy]:
                summary = measure(robot, name, world, given.episodes, given.control)
                figures[f"{world}/{robot}/{name}"] = dataclasses.asdict(summary)
    answer(figures, missed(figures), given.json)


if __name__ == "__main__":
    main()
