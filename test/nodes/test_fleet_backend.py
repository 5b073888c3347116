from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="needs ROS 2: rclpy is not installed")

from nics_drl_bridge.env.bridge_env import BridgeEnv
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.nodes.backends import dds_backend
from nics_drl_bridge.sim.world import load_world

pytestmark = pytest.mark.ros

TEAM = {"task": "cooperative_reaching", "task_options": {"robots": 2}}


def test_a_team_over_dds_sees_what_a_team_in_process_sees(launch, model, domain_id):
    launch("simulator_node", domain_id, mode="lockstep", robots=["a", "b"])
    options = {"domain_id": domain_id, "namespaces": ["a", "b"]}
    here = BridgeEnv(model=model, estimator=True, **TEAM)
    there = BridgeEnv(model=model, backend="dds", backend_options=options, **TEAM)
    try:
        for seed in (3, 4):
            assert (here.reset(seed=seed)[0] == there.reset(seed=seed)[0]).all()
            for k in range(5):
                action = np.full(here.action_space.shape, 0.1 * k, np.float32)
                mine, theirs = here.step(action), there.step(action)
                assert (mine[0] == theirs[0]).all()
                assert mine[1] == theirs[1]
    finally:
        there.close()


@pytest.mark.parametrize("wish", [{"estimator": False}, {"randomisation": "mild"}])
def test_what_topics_can_not_give_is_refused(model, wish):
    with pytest.raises(ConfigError, match="'dds' always estimates and is never randomised"):
        BridgeEnv("dds", model, **wish)


@pytest.mark.parametrize("options", [{"mode": "realtime"}, {"namespaces": ["a"]}])
def test_a_team_is_driven_in_lockstep_in_a_namespace_each(model, options):
    with pytest.raises(ConfigError, match="a team of 2 robots is driven in mode 'lockstep'"):
        dds_backend(model, load_world("arena"), robots=2, **options)
