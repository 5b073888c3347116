"""Only a simulator and the description of its robots, to be driven through `cmd_vel`.

ros2 launch nics_drl_bridge simulator.launch.py model:=differential world:=corridor
"""

from nics_drl_bridge.nodes.launching import describe
from nics_drl_bridge.nodes.starting import LAUNCHES


def generate_launch_description():
    return describe(LAUNCHES["simulator"])
