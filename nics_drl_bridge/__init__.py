"""From a recording of a robot to a fast simulator, and from there to the robot over ROS 2.

The package generates a simulator (a fitted, pruned second-order Taylor model of the
kinematics and baked lidar tables), trains or tests a policy in it, and drives the same task
and the same policy in process, over ROS 2 and on the vehicle.

Importing this package needs neither ROS 2 nor any heavy library, and makes its environments
known to `gymnasium.make`, now or when gymnasium is imported later.
"""

import sys
from importlib.metadata import PackageNotFoundError, version

try:
    __version__ = version("nics_drl_bridge")
except PackageNotFoundError:  # a source tree that was never installed
    __version__ = "0+unknown"

__all__ = ["__version__"]

if "gymnasium" in sys.modules:
    import nics_drl_bridge.env.registry  # noqa: F401 - registers as it is imported
else:
    from nics_drl_bridge.discovery import register_on_import

    register_on_import()
