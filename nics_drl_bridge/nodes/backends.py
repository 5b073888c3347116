"""Backends over ROS 2, for lock-step and real time.

FleetBackend: several robots of one simulator behind ROS 2 topics, each in its namespace.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.errors import ConfigError, nearest
from nics_drl_bridge.generator import SimulatorModel
from nics_drl_bridge.interface import Backend, BackendFacts, RobotView, Start, stacked
from nics_drl_bridge.nodes.dds_backend import DdsBackend
from nics_drl_bridge.nodes.device_parameters import default_namespaces
from nics_drl_bridge.nodes.realtime_backend import RealtimeBackend
from nics_drl_bridge.sim.world import World

MODES = {"lockstep": DdsBackend, "realtime": RealtimeBackend}


def dds_backend(
    model: SimulatorModel,
    world: World,
    mode: str = "lockstep",
    robots: int = 1,
    estimator: bool = True,
    randomisation: None = None,
    **options: Any,
) -> Backend:
    """Returns the backend of a robot behind ROS 2 topics, or of a team in lock-step.

    For a team it is a `FleetBackend`.

    Args:
        model: of the robot.
        world: of the robot.
        mode: `lockstep` with a simulator node, see `DdsBackend`; or `realtime` with one or with a
            vehicle, see `RealtimeBackend`.
        robots: number of robots; their `namespaces` are robot1, robot2, ... unless given as an
            option.
        estimator: must be True.
        randomisation: must be None.
        options: of the chosen class.

    Raises:
        ConfigError: there is no such mode, or not for a team; or it should not estimate, or
            randomise.
        BackendError: no peer is there.
    """
    if not estimator or randomisation is not None:
        raise ConfigError(
            "backend 'dds' always estimates and is never randomised; leave out `estimator` and "
            "`randomisation`."
        )
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


Array = NDArray[np.float64]


class FleetBackend:
    """M robots in lock-step with one simulator node, which moves when all have their commands.

    Views and commands have a leading (M,). Each robot has its own `DdsBackend`.

    Args:
        model: of every robot; must be the one that the simulator node runs.
        world: likewise.
        namespaces: of the robots, in the order of its parameter `robots`.
        simulator: full name of the simulator's node.
        options: further options of each DdsBackend.

    Raises:
        BackendError: no simulator is there, or a robot is missing.
    """

    def __init__(
        self,
        model: SimulatorModel,
        world: World,
        namespaces: Sequence[str],
        simulator: str = "/simulator_node",
        **options: Any,
    ) -> None:
        if len(set(namespaces)) < max(2, len(namespaces)):
            raise ConfigError(
                f"backend_options: namespaces {list(namespaces)!r} must be those of at least two "
                "different robots."
            )
        self._robots: list[DdsBackend] = []
        try:
            for namespace in namespaces:
                self._robots.append(DdsBackend(model, world, namespace, simulator, **options))
        except BaseException:
            self.close()
            raise

    def reset(self, start: Start) -> RobotView:
        """Begins one episode for all robots, at poses (M, 3); see `DdsBackend.reset`."""
        leader = self._robots[0]
        with self._zero_after_an_error():
            leader.choose(start)
            stamp_ns = leader.begin()
            both = zip(self._robots, start.pose, strict=True)
            return stacked([robot.first(stamp_ns, pose) for robot, pose in both])

    def step(self, command: Array) -> tuple[RobotView, dict[str, Any]]:
        """Publishes all commands (M, C) and waits for all data after them."""
        with self._zero_after_an_error():
            for robot, one in zip(self._robots, command, strict=True):
                robot.send(one)
            views, facts = zip(*(robot.receive() for robot in self._robots), strict=True)
        return stacked(views), together(facts)

    def facts(self) -> BackendFacts:
        """Returns what is known of all robots, stacked."""
        return cast("BackendFacts", together([robot.facts() for robot in self._robots]))

    @contextmanager
    def _zero_after_an_error(self) -> Iterator[None]:
        try:
            yield
        except BaseException:
            self.halt()
            raise

    def halt(self) -> None:
        """Publishes a zero command for each robot, even if one of them raises."""
        with ExitStack() as each:
            for robot in self._robots:
                each.callback(robot.halt)

    def close(self) -> None:
        """Publishes a zero command for each robot and ends the nodes, even if one raises."""
        with ExitStack() as each:
            for robot in self._robots:
                each.callback(robot.close)


def together(facts: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Merges the facts of M robots: equal values stay as they are, others become (M, ...)."""
    return {
        name: value
        if all(np.array_equal(value, each[name]) for each in facts)
        else np.stack([each[name] for each in facts])
        for name, value in facts[0].items()
    }
