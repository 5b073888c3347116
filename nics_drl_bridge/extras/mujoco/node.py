"""mujoco_node: robots in MuJoCo behind the topics of the hardware."""

from dataclasses import replace
from functools import partial

from rclpy.context import Context
from rclpy.node import Node

from nics_drl_bridge.extras.mujoco.machines import Physics
from nics_drl_bridge.extras.mujoco.simulator import MujocoSimulator
from nics_drl_bridge.generator import SimulatorModel
from nics_drl_bridge.nodes.device_parameters import randomisation
from nics_drl_bridge.nodes.runner import declare, run_node
from nics_drl_bridge.nodes.simulator_node import DeviceNode, declare_renderer
from nics_drl_bridge.sim.world_set import AnyWorld


def mujoco_simulator(
    node: Node, model: SimulatorModel, world: AnyWorld, robots: int
) -> MujocoSimulator:
    """Makes robots in MuJoCo, with the lidar and the floor that the parameters name."""
    renderer = declare_renderer(node, "exact")
    floor = "Friction between tyres and floor; ice has 0.1."
    friction = declare(node, "friction", 1.0, floor, span=(0.01, 2.0), read_only=True)
    physics, drawn = replace(Physics(), friction=friction), randomisation(node)
    return MujocoSimulator(model, world, robots, renderer, physics, drawn)


def mujoco_node(context: Context) -> DeviceNode:
    """Makes the node `mujoco_node`; see `DeviceNode`."""
    return DeviceNode("mujoco_node", context, mujoco_simulator)


main = partial(run_node, mujoco_node, sole_name="mujoco_node")
