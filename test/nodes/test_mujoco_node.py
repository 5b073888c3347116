import subprocess
import sys

import gymnasium
import numpy as np
import pytest

pytest.importorskip("rclpy", reason="needs ROS 2: rclpy is not installed")
pytest.importorskip("mujoco", reason="needs MuJoCo: the extra `mujoco`")

from nics_drl_bridge.defaults import EPISODE_STEPS
from nics_drl_bridge.env.bridge_env import BridgeEnv
from nics_drl_bridge.env.registry import NAVIGATION
from nics_drl_bridge.env.sim_backend import SimBackend
from nics_drl_bridge.errors import ModelError
from nics_drl_bridge.extras.mujoco.simulator import MujocoSimulator
from nics_drl_bridge.generator import builtin_model, save_model
from nics_drl_bridge.interface import Start
from nics_drl_bridge.nodes.backends import DdsBackend
from nics_drl_bridge.policy.evaluation import drive_all
from nics_drl_bridge.policy.policies import make_policy
from nics_drl_bridge.sim.world import load_world

pytestmark = pytest.mark.ros

TIMEOUT_S = 60.0
SEEDS = (11, 12)
NODE = "mujoco_node"


class MujocoBackend(SimBackend):
    """The same robots in this process."""

    def __init__(self, model, world):
        super().__init__(model, world, estimator=True)
        self.simulator = MujocoSimulator(model, world, renderer="exact")
        self.simulator.drawn = {}


@pytest.fixture(scope="module")
def robot(tmp_path_factory):
    """A differential robot, and the folder of its model."""
    model = builtin_model("differential")
    folder = tmp_path_factory.mktemp("model") / "differential"
    save_model(model, folder)
    return model, str(folder)


@pytest.fixture(scope="module")
def node(launch, module_domain_id, robot):
    """The domain of robots in MuJoCo, in lock-step."""
    process = launch(NODE, module_domain_id, model=robot[1], mode="lockstep")
    yield module_domain_id
    process.check()


def options(domain_id):
    return {
        "domain_id": domain_id,
        "simulator": NODE,
        "truth": True,
        "timeout_s": TIMEOUT_S,
    }


def test_whole_episodes_over_topics_reach_the_goal_as_in_this_process(node, robot):
    model = robot[0]
    world = load_world("arena")
    arguments = {"model": model, "world": world}
    there = gymnasium.make(
        NAVIGATION, backend="dds", backend_options=options(node), **arguments
    )
    here = gymnasium.wrappers.TimeLimit(
        BridgeEnv(MujocoBackend(model, world), **arguments), EPISODE_STEPS
    )
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


def test_it_refuses_to_be_taken_for_another_model(node, robot):
    other = builtin_model("mecanum")
    backend = DdsBackend(other, load_world("arena"), **options(node))
    try:
        with pytest.raises(ModelError, match="same model"):
            backend.reset(Start(seed=0, pose=np.zeros(3)))
    finally:
        backend.close()


@pytest.mark.process
def test_without_mujoco_the_node_ends_with_one_sentence():
    code = (
        "import sys; sys.modules['mujoco'] = None; sys.argv = ['mujoco_node']\n"
        "from nics_drl_bridge.nodes.start import mujoco_node; mujoco_node()"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=200
    )
    assert done.returncode == 2
    first, sentence = done.stderr.strip().splitlines()
    assert first.endswith("[mujoco_node]: starting")
    assert (
        sentence
        == "MuJoCo is not installed; run pip install 'nics_drl_bridge[mujoco]'."
    )
