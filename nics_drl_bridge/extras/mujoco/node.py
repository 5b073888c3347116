"""mujoco_node: robots in MuJoCo behind the same topics as hardware."""

from dataclasses import replace
from functools import partial

from rclpy.node import Node

from nics_drl_bridge import defaults
from nics_drl_bridge.extras.mujoco.simulator import PHYSICS, MujocoSimulator
from nics_drl_bridge.extras.physics.machines import design_machine
from nics_drl_bridge.generator import SimulatorModel
from nics_drl_bridge.nodes.device_parameters import get_randomisation
from nics_drl_bridge.nodes.runner import declare_rows, run_node
from nics_drl_bridge.nodes.simulator_node import DeviceNode, declare_renderer
from nics_drl_bridge.sim.world_set import AnyWorld

# Raises ConfigError for a robot without a machine.
check = partial(design_machine, physics=PHYSICS, engine="MuJoCo")


def mujoco_simulator(
    node: Node, model: SimulatorModel, world: AnyWorld, robots: int
) -> MujocoSimulator:
    """Makes robots in MuJoCo, with the lidar and floor of the node's parameters."""
    renderer = declare_renderer(node, defaults.MUJOCO_RENDERER)
    physics = replace(PHYSICS, friction=declare_rows(node, "physics")["friction"])
    return MujocoSimulator(
        model, world, robots, renderer, physics, get_randomisation(node)
    )


MujocoNode = partial(DeviceNode, "mujoco_node", mujoco_simulator)
main = partial(run_node, MujocoNode, sole_name="mujoco_node")
