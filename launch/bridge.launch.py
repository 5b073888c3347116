"""Middleware, policy and gate on a robot's topics.

ros2 launch nics_drl_bridge bridge.launch.py namespace:=car
"""

from nics_drl_bridge.nodes.launching import describe
from nics_drl_bridge.nodes.starting import LAUNCHES


def generate_launch_description():
    return describe(LAUNCHES["bridge"])
