"""Middleware, policy and gate on a robot's topics.

ros2 launch nics_drl_bridge bridge.launch.py namespace:=car
"""

from nics_drl_bridge.nodes import launching


def generate_launch_description():
    arguments = [
        *launching.common("false"),
        *launching.of_nodes(),
        *launching.of_bridge(),
    ]
    return launching.launched(
        [launching.bridge], [*arguments, launching.e_stop_required("true")]
    )
