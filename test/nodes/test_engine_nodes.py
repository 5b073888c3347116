"""Nodes of other physics engines: the same robots over topics as in this process."""

from importlib import import_module

import gymnasium
import numpy as np
import pytest

pytest.importorskip("rclpy", reason="needs ROS 2: rclpy is not installed")

from nics_drl_bridge.defaults import EPISODE_STEPS
from nics_drl_bridge.env.bridge_env import BridgeEnv
from nics_drl_bridge.env.registry import NAVIGATION
from nics_drl_bridge.env.sim_backend import SimBackend
from nics_drl_bridge.generator import builtin_model, save_model
from nics_drl_bridge.policy.evaluation import drive_all
from nics_drl_bridge.policy.policies import make_policy
from nics_drl_bridge.sim.world import load_world

pytestmark = pytest.mark.ros

TIMEOUT_S = 60.0
SEEDS = (11,)
# node -> library, name
ENGINES = {"dart_node": ("dartpy", "DART"), "mujoco_node": ("mujoco", "MuJoCo")}


class EngineBackend(SimBackend):
    """The same robots in this process."""

    def __init__(self, model, world, name):
        super().__init__(model, world, estimator=True)
        module = import_module(f"nics_drl_bridge.extras.{name.lower()}.simulator")
        self.simulator = getattr(module, f"{name.capitalize()}Simulator")(model, world)
        self.simulator.drawn = {}


@pytest.fixture(scope="module")
def robot(tmp_path_factory):
    """A differential robot, and the folder of its model."""
    model = builtin_model("differential")
    folder = tmp_path_factory.mktemp("model") / "differential"
    save_model(model, folder)
    return model, str(folder)


@pytest.fixture(scope="module", params=ENGINES)
def node(request, launch_process, module_domain_id, robot):
    """A node in a process of its own, in lock-step, and the options of its backend."""
    pytest.importorskip(ENGINES[request.param][0])
    process = launch_process(
        request.param, module_domain_id, model=robot[1], mode="lockstep"
    )
    yield (
        request.param,
        {
            "domain_id": module_domain_id,
            "simulator": request.param,
            "truth": True,
            "timeout_s": TIMEOUT_S,
        },
    )
    process.check()
    assert process.close() == 0


@pytest.mark.process
def test_whole_episodes_over_topics_reach_the_goal_as_in_this_process(node, robot):
    name, options = node
    model = robot[0]
    world = load_world("arena")
    arguments = {"model": model, "world": world}
    there = gymnasium.make(
        NAVIGATION, backend="dds", backend_options=options, **arguments
    )
    backend = EngineBackend(model, world, ENGINES[name][1])
    here = gymnasium.wrappers.TimeLimit(BridgeEnv(backend, **arguments), EPISODE_STEPS)
    policy = make_policy("dynamic_window", there.unwrapped.task)
    try:
        over_topics = drive_all(there, policy, SEEDS)
    finally:
        there.close()
    in_process = drive_all(here, policy, SEEDS)
    assert [episode.result for episode in over_topics] == ["success"] * len(SEEDS)
    for one, other in zip(over_topics, in_process, strict=True):
        assert np.array_equal(one.estimate, other.estimate)
        assert np.abs(one.path - other.path).max() < 1e-12
