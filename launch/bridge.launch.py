"""Middleware, policy and gate on a robot's topics; with `simulation:=true`, a simulator too.

ros2 launch nics_drl_bridge bridge.launch.py simulation:=true
ros2 topic pub --once /goal_pose geometry_msgs/PoseStamped '{pose: {position: {x: 1.0}}}'
"""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch.actions import DeclareLaunchArgument
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from launch import LaunchDescription

PACKAGE = "nics_drl_bridge"


def generate_launch_description():
    share = Path(get_package_share_directory(PACKAGE))
    arguments = {
        "namespace": ("", "Namespace of the robot"),
        "params_file": (str(share / "config" / "nodes" / "bridge.yaml"), "Parameters of all nodes"),
        "use_sim_time": ("false", "Take the time from /clock"),
        "log_level": ("info", "Log level of all nodes"),
        "simulation": ("false", "Start the simulator as well"),
    }
    value = {name: LaunchConfiguration(name) for name in arguments}

    def node(executable, condition=None):
        return Node(
            package=PACKAGE,
            executable=executable,
            name=executable,
            namespace=value["namespace"],
            parameters=[value["params_file"], {"use_sim_time": value["use_sim_time"]}],
            arguments=["--ros-args", "--log-level", value["log_level"]],
            output="screen",
            condition=condition,
        )

    return LaunchDescription(
        [
            *(
                DeclareLaunchArgument(name, default_value=default, description=text)
                for name, (default, text) in arguments.items()
            ),
            node("simulator_node", IfCondition(value["simulation"])),
            node("middleware_node"),
            node("command_gate"),
            node("policy_node"),
        ]
    )
