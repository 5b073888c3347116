"""Drive an episode with one policy in process and over DDS, with bit-identical results."""

from pathlib import Path

import gymnasium
import numpy as np

import nics_drl_bridge  # noqa: F401 - registers the environments
from nics_drl_bridge.generator import open_model
from nics_drl_bridge.nodes.processes import NodeProcess, choose_domain_id
from nics_drl_bridge.policy.evaluation import drive
from nics_drl_bridge.policy.policies import open_policy
from nics_drl_bridge.report.pictures import draw_trajectories
from nics_drl_bridge.sim.world import load_world

ENV = "NicsBridge/Navigation-v0"
WORLD = "circles"
SEED = 1_000_000


def main() -> None:
    model = open_model("differential")
    domain_id = choose_domain_id()
    policy, task = open_policy("differential", model)
    here = gymnasium.make(ENV, model=model, world=WORLD, task=task, estimator=True)
    inside = drive(here, policy, SEED)

    parameters = {"model": "differential", "world": WORLD, "mode": "lockstep"}
    options = {"domain_id": domain_id, "timeout_s": 120.0}
    with NodeProcess("simulator_node", Path("logs"), parameters, domain_id):
        there = gymnasium.make(
            ENV,
            backend="dds",
            model=model,
            world=WORLD,
            task=task,
            backend_options=options,
        )
        outside = drive(there, policy, SEED)
        there.close()

    difference = np.abs(inside.estimate - outside.estimate).max()
    print(f"{outside.result} over DDS; the estimates differ by {difference:g}")
    runs = {"in process": [inside], "over DDS": [outside]}
    picture = draw_trajectories(runs, load_world(WORLD), model.robot.footprint_radius)
    Path("drive_over_dds.png").write_bytes(picture)


if __name__ == "__main__":
    main()
