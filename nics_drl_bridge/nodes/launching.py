"""Launch descriptions of what `starting` describes, for the launch files in `launch/` and your own.

A launch file of your own takes a whole launch, as `describe(whole_simulation())`, or puts parts
and arguments together, as `describe(Launch("...", [bridge], [*common("false"), *of_bridge()]))`.
"""

from typing import Any

from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration, TextSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

from launch import LaunchDescription
from nics_drl_bridge.nodes.starting import (
    LAUNCHES,
    Argument,
    Launch,
    NodeStart,
    bridge,
    common,
    description,
    e_stop_required,
    of_bridge,
    of_description,
    of_nodes,
    of_simulator,
    simulator,
    whole_simulation,
)

__all__ = [
    "LAUNCHES",
    "Argument",
    "Launch",
    "bridge",
    "common",
    "describe",
    "description",
    "e_stop_required",
    "of_bridge",
    "of_description",
    "of_nodes",
    "of_simulator",
    "simulator",
    "whole_simulation",
]


def describe(launch: Launch) -> Any:
    """Return the launch description of arguments and of the nodes that they ask for."""

    def start(context: Any) -> list[Any]:
        names = [argument.name for argument in launch.arguments]
        given = {name: context.launch_configurations[name] for name in names}
        return [action_of(node) for node in launch.nodes(given)]

    declared = [declaration_of(argument) for argument in launch.arguments]
    return LaunchDescription([*declared, OpaqueFunction(function=start)])


def declaration_of(argument: Argument) -> DeclareLaunchArgument:
    """Return an argument as `launch` declares it."""
    default: Any = argument.default
    if argument.same_as:
        default = LaunchConfiguration(argument.same_as)
    return DeclareLaunchArgument(
        argument.name,
        default_value=default,
        description=argument.about,
        choices=list(argument.choices) or None,
    )


def action_of(node: NodeStart) -> Node:
    """Return a node as `launch` starts it."""
    files = [node.params_file] if node.params_file else []
    parameters = {name: parameter_of(value) for name, value in node.parameters.items()}
    return Node(
        package=node.package,
        executable=node.executable,
        name=node.executable,
        namespace=node.namespace,
        parameters=[*files, parameters],
        remappings=list(node.remappings),
        arguments=[*node.arguments, "--ros-args", "--log-level", node.log_level],
        output="screen",
    )


def parameter_of(value: Any) -> Any:
    """Return a parameter; a string stays a string, even if it looks like a number."""
    if isinstance(value, str):
        return ParameterValue(TextSubstitution(text=value), value_type=str)
    if isinstance(value, list) and all(isinstance(each, str) for each in value):
        return ParameterValue(TextSubstitution(text=str(value)), value_type=list[str])
    return value
