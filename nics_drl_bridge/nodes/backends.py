"""The backends over ROS 2, by the way time runs."""

from __future__ import annotations

from typing import Any

from nics_drl_bridge.errors import ConfigError, nearest
from nics_drl_bridge.generator import SimulatorModel
from nics_drl_bridge.interface import Backend
from nics_drl_bridge.nodes.dds_backend import DdsBackend
from nics_drl_bridge.nodes.realtime_backend import RealtimeBackend
from nics_drl_bridge.sim.world import World

MODES = {"lockstep": DdsBackend, "realtime": RealtimeBackend}


def dds_backend(
    model: SimulatorModel, world: World, mode: str = "lockstep", **options: Any
) -> Backend:
    """A robot behind ROS 2 topics.

    Args:
        model: of the robot.
        world: that it stands in.
        mode: `lockstep` with a simulator node, see `DdsBackend`; or `realtime` with one or with a
            vehicle, see `RealtimeBackend`.
        options: of that class.

    Raises:
        ConfigError: no such mode.
        BackendError: nobody is there.
    """
    if mode not in MODES:
        raise ConfigError(f"backend_options: there is no mode {mode!r}; {nearest(mode, MODES)}")
    made: Backend = MODES[mode](model, world, **options)
    return made
