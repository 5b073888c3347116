"""A simulator and, on its topics, everything that runs on a vehicle.

ros2 launch nics_drl_bridge simulation.launch.py model:=differential world:=corridor
ros2 service call /command_gate/arm std_srvs/srv/Trigger
ros2 topic pub --once /goal_pose geometry_msgs/msg/PoseStamped '{pose: {position: {x: 1.0}}}'
"""

from nics_drl_bridge.nodes.launching import describe
from nics_drl_bridge.nodes.starting import LAUNCHES


def generate_launch_description():
    return describe(LAUNCHES["simulation"])
