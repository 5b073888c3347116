"""The description of a robot: robot_state_publisher with its URDF, and RViz.

ros2 launch nics_drl_bridge description.launch.py model:=mecanum rviz:=true
"""

from nics_drl_bridge.nodes.launching import describe
from nics_drl_bridge.nodes.starting import LAUNCHES


def generate_launch_description():
    return describe(LAUNCHES["description"])
