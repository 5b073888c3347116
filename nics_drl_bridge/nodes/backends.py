"""The backends over ROS 2, by the way time runs."""

from __future__ import annotations

from typing import Any

from nics_drl_bridge.errors import ConfigError, nearest
from nics_drl_bridge.generator import SimulatorModel
from nics_drl_bridge.interface import Backend
from nics_drl_bridge.nodes.dds_backend import DdsBackend
from nics_drl_bridge.nodes.device_parameters import default_namespaces
from nics_drl_bridge.nodes.fleet_backend import FleetBackend
from nics_drl_bridge.nodes.realtime_backend import RealtimeBackend
from nics_drl_bridge.sim.world import World

MODES = {"lockstep": DdsBackend, "realtime": RealtimeBackend}


def dds_backend(
    model: SimulatorModel, world: World, mode: str = "lockstep", robots: int = 1, **options: Any
) -> Backend:
    """A robot behind ROS 2 topics, or a team in lock-step, see `FleetBackend`.

    Args:
        model: of the robot.
        world: that it stands in.
        mode: `lockstep` with a simulator node, see `DdsBackend`; or `realtime` with one or with a
            vehicle, see `RealtimeBackend`.
        robots: how many; their `namespaces` are robot1, robot2, ... unless given as an option.
        options: of that class.

    Raises:
        ConfigError: no such mode, or not for a team.
        BackendError: nobody is there.
    """
    if mode not in MODES:
        raise ConfigError(f"backend_options: there is no mode {mode!r}; {nearest(mode, MODES)}")
    if robots > 1:
        return _team(model, world, mode, robots, options)
    made: Backend = MODES[mode](model, world, **options)
    return made


def _team(
    model: SimulatorModel, world: World, mode: str, robots: int, options: dict[str, Any]
) -> Backend:
    names = options.pop("namespaces", default_namespaces(robots))
    if mode != "lockstep" or len(names) != robots:
        raise ConfigError(
            f"backend_options: a team of {robots} robots is driven in mode 'lockstep' alone, with "
            f"{robots} namespaces, not in {mode!r} with {list(names)!r}."
        )
    return FleetBackend(model, world, names, **options)
