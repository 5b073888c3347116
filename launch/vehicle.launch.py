"""Everything that runs on a vehicle, except the drivers of its lidar and base.

Give your own parameter file, because model, limits and latency depend on the robot. Without any
`e_stop` message, the emergency stop counts as pressed, whatever the file says.

ros2 launch nics_drl_bridge vehicle.launch.py model:=my_car params_file:=car.yaml
"""

from nics_drl_bridge.nodes.launching import describe
from nics_drl_bridge.nodes.starting import LAUNCHES


def generate_launch_description():
    return describe(LAUNCHES["vehicle"])
