"""Evaluate a shipped policy on 200 unseen episodes in parallel, and draw six of them."""

from pathlib import Path

import gymnasium

import nics_drl_bridge  # noqa: F401 - registers the environments
from nics_drl_bridge.env.vector_env import BridgeVectorEnv
from nics_drl_bridge.generator import open_model
from nics_drl_bridge.policy.evaluation import drive_all, drive_worlds, summarise
from nics_drl_bridge.policy.policies import open_policy
from nics_drl_bridge.policy.train.run import line_of
from nics_drl_bridge.report.pictures import draw_trajectories
from nics_drl_bridge.sim.world import load_world

FIRST_SEED = 1_000_000  # no training draws these seeds


def main() -> None:
    model = open_model("differential")
    world = load_world("circles")
    policy, task = open_policy("differential", model)  # or the path of your policy.onnx

    envs = BridgeVectorEnv(100, model, world, task)
    outcomes = drive_worlds(envs, policy.act, range(FIRST_SEED, FIRST_SEED + 200))
    print(line_of(summarise(outcomes, model.control_period)))

    env = gymnasium.make(
        "NicsBridge/Navigation-v0", model=model, world=world, task=task
    )
    episodes = drive_all(env, policy, range(FIRST_SEED, FIRST_SEED + 6))
    picture = draw_trajectories(
        {"policy": episodes}, world, model.robot.footprint_radius
    )
    Path("evaluate_policy.png").write_bytes(picture)


if __name__ == "__main__":
    main()
