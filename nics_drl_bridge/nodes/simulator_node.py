"""simulator_node: the fast simulator behind the topics of the hardware."""

from __future__ import annotations

from typing import cast

from rclpy.context import Context
from rclpy.node import Node

from nics_drl_bridge.generator import SimulatorModel
from nics_drl_bridge.interface import Simulator
from nics_drl_bridge.lidar.scanner import RENDERERS, Renderer
from nics_drl_bridge.nodes.device_node import DeviceNode
from nics_drl_bridge.nodes.device_parameters import choice
from nics_drl_bridge.nodes.runner import declare, run_node
from nics_drl_bridge.sim.simulator import FastSimulator
from nics_drl_bridge.sim.world import World


def fast_simulator(node: Node, model: SimulatorModel, world: World, robots: int) -> Simulator:
    """Makes the fast simulator, with the lidar that the parameter `renderer` names."""
    declare(node, "renderer", "baked", "Lidar: baked or exact.", read_only=True)
    renderer = cast(Renderer, choice(node, "renderer", RENDERERS))
    tell = node.get_logger().warning
    return FastSimulator(model, world, robots=robots, renderer=renderer, tell=tell)


def simulator_node(context: Context) -> DeviceNode:
    """Makes the node `simulator_node`; see `DeviceNode`."""
    return DeviceNode("simulator_node", context, fast_simulator)


def main(args: list[str] | None = None) -> None:
    """Entry point of the executable."""
    run_node(simulator_node, args, "simulator_node")


if __name__ == "__main__":
    main()
