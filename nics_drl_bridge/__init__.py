"""From a recording of a robot to a fast simulator, and from there to the robot over ROS 2.

The package generates a simulator (a fitted, pruned second-order Taylor model of the
kinematics and baked lidar tables), trains or tests a policy in it, and drives the same task
and the same policy in process, over ROS 2 and on the vehicle.

Importing this package needs neither ROS 2 nor any heavy library: each public name is loaded when
it is first used. The environments are registered if Gymnasium was imported before, as in
`gymnasium.make("nics_drl_bridge:NicsBridge/Navigation-v0")`, or when `make` is first used.
"""

import sys
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from nics_drl_bridge.env.make import make, make_vec
    from nics_drl_bridge.generator import generate, load_model, open_model, save_model
    from nics_drl_bridge.policy.file.policy_file import load_policy
    from nics_drl_bridge.recording.readers import read_recording
    from nics_drl_bridge.recording.recording import load_recording, save_recording
    from nics_drl_bridge.robot.spec import load_robot
    from nics_drl_bridge.sim.sdf import read_sdf
    from nics_drl_bridge.sim.simulator import FastSimulator
    from nics_drl_bridge.sim.world import load_world
    from nics_drl_bridge.sim.world_set import load_worlds

try:
    __version__ = version("nics_drl_bridge")
except PackageNotFoundError:  # a source tree that was never installed
    __version__ = "0+unknown"

__all__ = [
    "FastSimulator",
    "__version__",
    "generate",
    "load_model",
    "load_policy",
    "load_recording",
    "load_robot",
    "load_world",
    "load_worlds",
    "make",
    "make_vec",
    "open_model",
    "read_recording",
    "read_sdf",
    "save_model",
    "save_recording",
]

_NAMES = {
    "env.make": ("make", "make_vec"),
    "generator": ("generate", "load_model", "open_model", "save_model"),
    "policy.file.policy_file": ("load_policy",),
    "recording.readers": ("read_recording",),
    "recording.recording": ("load_recording", "save_recording"),
    "robot.spec": ("load_robot",),
    "sim.sdf": ("read_sdf",),
    "sim.simulator": ("FastSimulator",),
    "sim.world": ("load_world",),
    "sim.world_set": ("load_worlds",),
}
_HOMES = {name: home for home, names in _NAMES.items() for name in names}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    try:
        return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
    except ImportError as error:
        from nics_drl_bridge.extensions import explain_unmet

        clause = explain_unmet(error)
        if clause is None:
            raise
        raise type(error)(f"{__name__}.{name} {clause}", name=error.name) from error


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


if "gymnasium" in sys.modules:
    import_module("nics_drl_bridge.env.registry")  # registers on import
