"""Measure a policy's success in the nominal simulator and with varied robot, sensors and scene."""

from pathlib import Path

import numpy as np

from nics_drl_bridge.confidence import estimate_rate
from nics_drl_bridge.env.vector_env import BridgeVectorEnv
from nics_drl_bridge.generator import open_model
from nics_drl_bridge.policy.evaluation import drive_worlds
from nics_drl_bridge.policy.policies import open_policy
from nics_drl_bridge.style import make_panels, render_png

EPISODES = range(1_000_000, 1_000_100)
CONDITIONS = {
    "nominal": {},
    "mild": {"randomisation": "mild"},
    "strong": {"randomisation": "strong"},
}


def main() -> None:
    model = open_model("differential", lidar="rplidar_a2")
    found = []
    policy, task = open_policy("differential", model)
    for name, simulation in CONDITIONS.items():
        envs = BridgeVectorEnv(len(EPISODES), model, "circles", task, **simulation)
        success = drive_worlds(envs, policy.act, EPISODES).success
        found.append(estimate_rate(int(success.sum()), len(EPISODES)))
        print(
            f"{name}: {found[-1].value:.0%} ({found[-1].low:.0%} to {found[-1].high:.0%})"
        )

    figure, (axes,) = make_panels(1, 1, (5.5, 3.6))
    value, low, high = (
        100.0 * np.array([(one.value, one.low, one.high) for one in found]).T
    )
    axes.errorbar(
        list(CONDITIONS), value, yerr=[value - low, high - value], fmt="o", capsize=6
    )
    axes.set(title="100 episodes in circles", ylabel="success [%]", ylim=(0, 105))
    Path("perturb.png").write_bytes(render_png(figure))


if __name__ == "__main__":
    main()
