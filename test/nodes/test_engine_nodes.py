"""Nodes of other physics engines: the same robots over topics as in this process."""

from contextlib import closing
from importlib import import_module

import pytest

from nics_drl_bridge.env.bridge_env import BridgeEnv
from nics_drl_bridge.env.sim_backend import SimBackend
from nics_drl_bridge.generator import builtin_model, save_model
from nics_drl_bridge.sim.world import load_world
from nodes.peer import drive_alike

pytestmark = pytest.mark.ros

TIMEOUT_S = 60.0
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
def test_a_drive_over_topics_is_that_in_this_process(node, robot):
    name, options = node
    arguments = {"model": robot[0], "world": load_world("arena")}
    backend = EngineBackend(*arguments.values(), ENGINES[name][1])
    here = BridgeEnv(backend, **arguments)
    with closing(BridgeEnv("dds", backend_options=options, **arguments)) as there:
        drive_alike(here, there, seeds=(11,), steps=10)
