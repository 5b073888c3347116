"""What a robot looks like: its URDF to robot_state_publisher, and RViz.

ros2 launch nics_drl_bridge description.launch.py model:=mecanum rviz:=true
"""

from nics_drl_bridge.nodes.launching import LAUNCHES, describe


def generate_launch_description():
    return describe(LAUNCHES["description"]())
