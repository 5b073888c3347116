"""Several robots in one simulator, each with a bridge in its namespace.

ros2 launch nics_drl_bridge fleet.launch.py robots:='[ant, bee]'
ros2 service call /ant/command_gate/arm std_srvs/srv/Trigger
"""

from nics_drl_bridge.nodes.launching import describe
from nics_drl_bridge.nodes.starting import LAUNCHES


def generate_launch_description():
    return describe(LAUNCHES["fleet"])
