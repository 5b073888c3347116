"""All that runs on a vehicle, beside the drivers of its lidar and its base.

Give it a file of parameters of your own: model, limits and latency are those of the robot. An
emergency stop that was never heard counts as pressed, whatever the file says.

ros2 launch nics_drl_bridge vehicle.launch.py params_file:=car.yaml
"""

from nics_drl_bridge.nodes.launching import LAUNCHES, describe


def generate_launch_description():
    return describe(LAUNCHES["vehicle"]())
