"""A simulator and the description of its robots alone, to drive from elsewhere by `cmd_vel`.

ros2 launch nics_drl_bridge simulator.launch.py model:=differential world:=corridor
"""

from nics_drl_bridge.nodes import launching


def generate_launch_description():
    arguments = [
        *launching.common("true"),
        *launching.of_nodes(),
        *launching.of_simulator(),
    ]
    return launching.launched(
        [launching.simulator, launching.description],
        [*arguments, *launching.of_description()],
    )
