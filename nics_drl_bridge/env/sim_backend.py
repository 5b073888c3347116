"""SimBackend: the fast simulator in this process, with or without the robot's middleware.

Backends of an env: those known by name, and user-defined ones.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge import extensions
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.generator import SimulatorModel
from nics_drl_bridge.interface import NS_PER_S, Backend, RobotView, Start, stacked
from nics_drl_bridge.lidar.scanner import Renderer
from nics_drl_bridge.middleware.middleware import Middleware
from nics_drl_bridge.sim.simulator import FastSimulator
from nics_drl_bridge.sim.world import World

Array = NDArray[np.float64]


class SimBackend:
    """One world of the fast simulator, in this process.

    With `estimator`, scan and odometry of each robot pass through its middleware as in the nodes,
    so that this backend and the one over DDS give the same numbers for the same seed and commands.
    Without it, the pose is that of the wheel odometry: bit-identical to a world of the vector env,
    and several times faster.

    Args:
        model: the robot.
        world: the field.
        renderer: `baked` or `exact` lidar.
        estimator: True puts a middleware for each robot between simulator and env.
        robots: M; views and commands have a leading (M,) if M > 1.
        simulation: further arguments of the FastSimulator.
    """

    def __init__(
        self,
        model: SimulatorModel,
        world: World,
        renderer: Renderer = "baked",
        estimator: bool = False,
        robots: int = 1,
        **simulation: Any,
    ) -> None:
        self._robot = model.robot
        self.simulator = FastSimulator(model, world, robots=robots, renderer=renderer, **simulation)
        self._middlewares = [Middleware(model) for _ in range(robots if estimator else 0)]
        self._period_ns = round(model.control_period * NS_PER_S)
        self._row: Any = (0, 0) if robots == 1 else 0
        self._now_ns = 0

    def reset(self, start: Start) -> RobotView:
        """Begins the episode of a seed; see `interface.Backend`."""
        robots = self.simulator.data.pose.shape[1]
        self.simulator.reset([start.seed], starts=start.pose.reshape(1, robots, 3))
        self._now_ns = 0
        for middleware, pose in zip(self._middlewares, start.pose.reshape(-1, 3), strict=False):
            middleware.reset(self._now_ns, pose)
        return self._measure()

    def step(self, command: Array) -> tuple[RobotView, dict[str, Any]]:
        """Moves the robots by one control period; see `interface.Backend`."""
        data = self.simulator.data
        if self._middlewares:
            # Via cmd_vel, as over ROS 2, so that both round alike.
            command = self._robot.from_cmd_vel(self._robot.to_cmd_vel(command))
        commands = command.reshape(data.pose.shape[1], -1)
        for middleware, one in zip(self._middlewares, commands, strict=False):
            middleware.command(self._now_ns, one)
        self.simulator.step(commands[None])
        self._now_ns += self._period_ns
        view = self._measure()
        collided = data.collided[self._row]
        facts = {
            "stamp_ns": self._now_ns,
            "true_pose": data.pose[self._row].copy(),
            "true_collision": bool(collided) if collided.ndim == 0 else collided.astype(np.bool_),
        }
        return view, facts

    def _measure(self) -> RobotView:
        data, now, row = self.simulator.data, self._now_ns, self._row
        odom, twist, ranges = data.odom[row].copy(), data.twist[row].copy(), data.ranges[row].copy()
        if not self._middlewares:
            return RobotView(odom, twist, ranges, now * 1e-9, 0.0, 0.0)
        views = [self._estimated(robot) for robot in range(len(self._middlewares))]
        return views[0] if len(views) == 1 else stacked(views)

    def _estimated(self, robot: int) -> RobotView:
        data, now, middleware = self.simulator.data, self._now_ns, self._middlewares[robot]
        middleware.odometry(now, now, data.odom[0, robot].copy(), data.twist[0, robot].copy())
        middleware.scan(now, now, data.ranges[0, robot].copy())
        return middleware.view(now)

    def halt(self) -> None:
        """Does nothing: robots only move in `step`."""

    def close(self) -> None:
        """Does nothing: there is nothing to free."""


NEEDED = ("reset", "step", "close")


class HaltedByStep:
    """Wraps a backend without `halt`, which becomes a step with the command nearest to zero.

    Args:
        backend: with `reset`, `step` and `close`.
        still: (C,), or (M, C) for a team, the command nearest to zero.
    """

    def __init__(self, backend: Any, still: NDArray[np.float64]) -> None:
        self._backend, self._still = backend, still
        self._told = False

    def reset(self, start: Start) -> RobotView:
        """Calls the backend's."""
        view: RobotView = self._backend.reset(start)
        return view

    def step(self, command: NDArray[np.float64]) -> tuple[RobotView, dict[str, Any]]:
        """Calls the backend's."""
        self._told = True
        told: tuple[RobotView, dict[str, Any]] = self._backend.step(command)
        return told

    def halt(self) -> None:
        """Steps once with the command nearest to zero, if there was a step since the last halt."""
        if self._told:
            self._backend.step(self._still.copy())
            self._told = False

    def close(self) -> None:
        """Closes the backend, which sends a zero command itself."""
        self._backend.close()
        self._told = False


def halting(backend: Any, still: NDArray[np.float64]) -> Backend:
    """Returns a user-defined backend as one that can be halted.

    Raises:
        ConfigError: it is not a backend.
    """
    if isinstance(backend, Backend):
        return backend
    missing = [name for name in NEEDED if not callable(getattr(backend, name, None))]
    if missing:
        raise ConfigError(
            f"backend of type {type(backend).__name__}: has no {', no '.join(missing)}; see "
            "interface.Backend."
        )
    return HaltedByStep(backend, still)


def make_backend(name: str, model: SimulatorModel, world: World, **options: Any) -> Backend:
    """A backend by the name under which it is registered, see `extensions`.

    Raises:
        ConfigError: unknown name, or its library is missing.
    """
    made: Backend = extensions.load("backends", name)(model, world, **options)
    return made
