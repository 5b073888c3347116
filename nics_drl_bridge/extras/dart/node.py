"""dart_node: robots in DART behind the same topics as hardware."""

from dataclasses import replace
from functools import partial
from pathlib import Path

from rclpy.node import Node

from nics_drl_bridge.extras.dart.simulator import PHYSICS, DartSimulator
from nics_drl_bridge.extras.physics.machines import design_machine
from nics_drl_bridge.generator import SimulatorModel
from nics_drl_bridge.nodes.device_parameters import get_randomisation
from nics_drl_bridge.nodes.runner import declare_rows, run_node
from nics_drl_bridge.nodes.simulator_node import DeviceNode
from nics_drl_bridge.sim.world_set import AnyWorld

# Raises ConfigError for a robot without a machine.
check = partial(design_machine, physics=PHYSICS, engine="DART")


def dart_simulator(
    node: Node, model: SimulatorModel, world: AnyWorld, robots: int
) -> DartSimulator:
    """Makes robots in DART, with the floor, gyro and robot of the node's parameters."""
    physics = declare_rows(node, "physics", "gyro")
    file = declare_rows(node, "urdf")["urdf"]
    return DartSimulator(
        model,
        world,
        robots,
        physics=replace(PHYSICS, **physics),
        randomisation=get_randomisation(node),
        file=Path(file) if file else None,
    )


DartNode = partial(DeviceNode, "dart_node", dart_simulator)
main = partial(run_node, DartNode, sole_name="dart_node")
