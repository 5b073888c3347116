"""What a robot looks like: its URDF to robot_state_publisher, and RViz.

ros2 launch nics_drl_bridge description.launch.py use_rviz:=true
"""

from ament_index_python.packages import get_packages_with_prefixes
from launch.actions import DeclareLaunchArgument
from launch.conditions import IfCondition
from launch.substitutions import Command, LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

from launch import LaunchDescription

SHARE = FindPackageShare("nics_drl_bridge")
URDF = PathJoinSubstitution([SHARE, "urdf", "ackermann.urdf"])
RVIZ = PathJoinSubstitution([SHARE, "config", "rviz", "bridge.rviz"])
INSTALLED = str("robot_state_publisher" in get_packages_with_prefixes()).lower()
# RViz names topics absolutely; here they are those of the robot's namespace.
TOPICS = ["scan", "odom", "odometry/filtered", "ground_truth", "goal_pose", "robot_description"]
# A robot in a namespace has transforms of its own there, as Nav2 does it.
TF = [("/tf", "tf"), ("/tf_static", "tf_static")]


def generate_launch_description():
    namespace = LaunchConfiguration("namespace")
    use_sim_time = ParameterValue(LaunchConfiguration("use_sim_time"), value_type=bool)
    urdf = ParameterValue(Command(["cat '", LaunchConfiguration("urdf"), "'"]), value_type=str)
    logging = ["--ros-args", "--log-level", LaunchConfiguration("log_level")]
    return LaunchDescription(
        [
            DeclareLaunchArgument("namespace", default_value="", description="Of the robot"),
            DeclareLaunchArgument("use_sim_time", default_value="false", description="Use /clock"),
            DeclareLaunchArgument("use_robot_state_pub", default_value=INSTALLED, description="TF"),
            DeclareLaunchArgument("urdf", default_value=URDF, description="File of the robot"),
            DeclareLaunchArgument("use_rviz", default_value="false", description="Start RViz"),
            DeclareLaunchArgument("rviz_config", default_value=RVIZ, description="File for RViz"),
            DeclareLaunchArgument("log_level", default_value="info", description="Of all nodes"),
            Node(
                package="robot_state_publisher",
                executable="robot_state_publisher",
                name="robot_state_publisher",
                namespace=namespace,
                parameters=[{"use_sim_time": use_sim_time, "robot_description": urdf}],
                remappings=TF,
                arguments=logging,
                output="screen",
                condition=IfCondition(LaunchConfiguration("use_robot_state_pub")),
            ),
            Node(
                package="rviz2",
                executable="rviz2",
                name="rviz2",
                namespace=namespace,
                parameters=[{"use_sim_time": use_sim_time}],
                remappings=[*TF, *((f"/{topic}", topic) for topic in TOPICS)],
                arguments=["-d", LaunchConfiguration("rviz_config"), *logging],
                output="screen",
                condition=IfCondition(LaunchConfiguration("use_rviz")),
            ),
        ]
    )
