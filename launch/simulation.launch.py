"""A simulator, and on its topics all that runs on a vehicle.

ros2 launch nics_drl_bridge simulation.launch.py
ros2 service call /command_gate/arm std_srvs/srv/Trigger
ros2 topic pub --once /goal_pose geometry_msgs/msg/PoseStamped '{pose: {position: {x: 1.0}}}'
"""

from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

from launch import LaunchDescription

PACKAGE = "nics_drl_bridge"
SHARE = FindPackageShare(PACKAGE)
DEFAULT = PathJoinSubstitution([SHARE, "config", "nodes", "bridge.yaml"])


def generate_launch_description():
    value = LaunchConfiguration

    def include(file, *names):
        source = PythonLaunchDescriptionSource(PathJoinSubstitution([SHARE, "launch", file]))
        given = {name: value(name) for name in ("namespace", "use_sim_time", "log_level", *names)}
        return IncludeLaunchDescription(source, launch_arguments=given.items())

    return LaunchDescription(
        [
            DeclareLaunchArgument("namespace", default_value="", description="Of the robot"),
            DeclareLaunchArgument("params_file", default_value=DEFAULT, description="Of all nodes"),
            DeclareLaunchArgument("use_sim_time", default_value="true", description="Use /clock"),
            DeclareLaunchArgument("autostart", default_value="true", description="Lead lifecycles"),
            DeclareLaunchArgument("use_rviz", default_value="false", description="Start RViz"),
            DeclareLaunchArgument("log_level", default_value="info", description="Of all nodes"),
            DeclareLaunchArgument("fallback", default_value="", description="Of policy_node"),
            DeclareLaunchArgument(
                "e_stop_required",
                default_value="false",
                description="An e_stop that was never heard counts as pressed",
            ),
            DeclareLaunchArgument(
                "simulator",
                default_value="simulator",
                choices=["simulator", "mujoco"],
                description="The fast simulator, or MuJoCo",
            ),
            Node(
                package=PACKAGE,
                executable=[value("simulator"), "_node"],
                name=[value("simulator"), "_node"],
                namespace=value("namespace"),
                parameters=[value("params_file")],
                remappings=[("/tf", "tf"), ("/tf_static", "tf_static")],
                arguments=["--ros-args", "--log-level", value("log_level")],
                output="screen",
            ),
            include("bridge.launch.py", "params_file", "autostart", "fallback", "e_stop_required"),
            include("description.launch.py", "use_rviz"),
        ]
    )
