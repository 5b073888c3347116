"""Launch descriptions of the launches in `starting`, for the files in `launch/` and your own.

Your own launch file can take a whole launch, as in `describe(LAUNCHES["vehicle"])`, or combine
parts, as in `describe(Launch("...", ["simulator", "bridge"], {"use_sim_time": "true"}))`.
"""

from typing import Any

from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import TextSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterFile, ParameterValue

from launch import LaunchDescription
from nics_drl_bridge.nodes.starting import Argument, Launch, NodeStart


def describe(launch: Launch) -> Any:
    """Return the launch description of a launch: its arguments, and the nodes that they select."""

    def start(context: Any) -> list[Any]:
        configurations = context.launch_configurations
        names = [argument.name for argument in launch.arguments]
        values = {name: configurations[name] for name in names}
        # Below the namespace of a PushRosNamespace around the launch, if any.
        pushed = configurations.get("ros_namespace", "").strip("/")
        values["namespace"] = f"{pushed}/{values['namespace'].strip('/')}".strip("/")
        return [make_action(node) for node in launch.nodes(values)]

    declared = [make_declaration(argument) for argument in launch.arguments]
    return LaunchDescription([*declared, OpaqueFunction(function=start)])


def make_declaration(argument: Argument) -> DeclareLaunchArgument:
    """Return the `launch` declaration of an argument."""
    return DeclareLaunchArgument(
        argument.name,
        default_value=argument.default,
        description=argument.about,
        choices=list(argument.choices) or None,
    )


def make_action(node: NodeStart) -> Node:
    """Return the `launch` action that starts a node."""
    files = []
    if node.params_file:
        files = [ParameterFile(node.params_file, allow_substs=True)]
    parameters = {
        name: make_parameter(value) for name, value in node.parameters.items()
    }
    log_arguments = []
    if node.log_level:
        log_arguments = ["--ros-args", "--log-level", node.log_level]
    return Node(
        package=node.package,
        executable=node.executable,
        name=node.executable,
        namespace=f"/{node.namespace}",
        parameters=[*files, parameters],
        remappings=list(node.remappings),
        arguments=[*node.arguments, *log_arguments],
        output="screen",
    )


def make_parameter(value: Any) -> Any:
    """Return the value of a parameter; a string that looks like a number stays a string."""
    if isinstance(value, str):
        return ParameterValue(TextSubstitution(text=value), value_type=str)
    if isinstance(value, list) and all(isinstance(part, str) for part in value):
        return ParameterValue(TextSubstitution(text=str(value)), value_type=list[str])
    return value
