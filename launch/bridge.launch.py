"""Middleware, policy and gate on a robot's topics.

ros2 launch nics_drl_bridge bridge.launch.py namespace:=car
"""

from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

from launch import LaunchDescription

PACKAGE = "nics_drl_bridge"
DEFAULT = PathJoinSubstitution([FindPackageShare(PACKAGE), "config", "nodes", "bridge.yaml"])


def generate_launch_description():
    use_sim_time = ParameterValue(LaunchConfiguration("use_sim_time"), value_type=bool)
    autostart = ParameterValue(LaunchConfiguration("autostart"), value_type=bool)
    e_stop_required = ParameterValue(LaunchConfiguration("e_stop_required"), value_type=bool)

    def node(name, **more):
        return Node(
            package=PACKAGE,
            executable=name,
            name=name,
            namespace=LaunchConfiguration("namespace"),
            parameters=[LaunchConfiguration("params_file"), {"use_sim_time": use_sim_time, **more}],
            arguments=["--ros-args", "--log-level", LaunchConfiguration("log_level")],
            output="screen",
        )

    def policy(context):
        # Empty leaves the file's, which an empty parameter would go before.
        fallback = context.launch_configurations["fallback"]
        given = {"fallback": fallback} if fallback else {}
        return [node("policy_node", autostart=autostart, **given)]

    return LaunchDescription(
        [
            DeclareLaunchArgument("namespace", default_value="", description="Of the robot"),
            DeclareLaunchArgument("params_file", default_value=DEFAULT, description="Of all nodes"),
            DeclareLaunchArgument("use_sim_time", default_value="false", description="Use /clock"),
            DeclareLaunchArgument("autostart", default_value="true", description="Lead lifecycles"),
            DeclareLaunchArgument("log_level", default_value="info", description="Of all nodes"),
            DeclareLaunchArgument(
                "e_stop_required",
                default_value="true",
                description="An e_stop that was never heard counts as pressed",
            ),
            DeclareLaunchArgument("fallback", default_value="", description="Of policy_node"),
            node("command_gate", e_stop_required=e_stop_required),
            node("middleware_node", autostart=autostart),
            OpaqueFunction(function=policy),
        ]
    )
