"""All that runs on a vehicle, beside the drivers of its lidar and its base.

Give it a file of parameters of your own: model, limits and latency are those of the robot. An
emergency stop that was never heard counts as pressed, whatever the file says.

ros2 launch nics_drl_bridge vehicle.launch.py params_file:=car.yaml
"""

from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.substitutions import FindPackageShare

from launch import LaunchDescription

SHARE = FindPackageShare("nics_drl_bridge")
DEFAULT = PathJoinSubstitution([SHARE, "config", "nodes", "bridge.yaml"])


def generate_launch_description():
    def include(file, *names, **given):
        source = PythonLaunchDescriptionSource(PathJoinSubstitution([SHARE, "launch", file]))
        names = ("namespace", "use_sim_time", "log_level", *names)
        given |= {name: LaunchConfiguration(name) for name in names}
        return IncludeLaunchDescription(source, launch_arguments=given.items())

    return LaunchDescription(
        [
            DeclareLaunchArgument("namespace", default_value="", description="Of the robot"),
            DeclareLaunchArgument("params_file", default_value=DEFAULT, description="Of all nodes"),
            DeclareLaunchArgument("use_sim_time", default_value="false", description="Use /clock"),
            DeclareLaunchArgument("autostart", default_value="true", description="Lead lifecycles"),
            DeclareLaunchArgument("use_rviz", default_value="false", description="Start RViz"),
            DeclareLaunchArgument("log_level", default_value="info", description="Of all nodes"),
            DeclareLaunchArgument("fallback", default_value="", description="Of policy_node"),
            include(
                "bridge.launch.py", "params_file", "autostart", "fallback", e_stop_required="true"
            ),
            include("description.launch.py", "use_rviz"),
        ]
    )
