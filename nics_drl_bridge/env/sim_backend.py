"""Backends of an env: the fast simulator in process, and registered or user-defined ones."""

import math
from inspect import signature
from typing import Any

import numpy as np

from nics_drl_bridge import extensions
from nics_drl_bridge.arguments import check_arguments, check_count
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.generator import SimulatorModel
from nics_drl_bridge.geometry import Array
from nics_drl_bridge.interface import (
    NS_PER_S,
    Backend,
    BackendFacts,
    RobotView,
    Start,
    stack_views,
)
from nics_drl_bridge.middleware.middleware import Middleware
from nics_drl_bridge.sim.simulator import FastSimulator
from nics_drl_bridge.sim.world_set import AnyWorld


def _decode_pose(pose: Array) -> Array:
    """Returns a pose (3,) as decoded from a message, whose quaternion rounds the heading."""
    half = float(pose[2]) / 2.0
    z = math.sin(half)
    w = math.cos(half)
    heading = math.atan2(2.0 * (w * z), 1.0 - 2.0 * (z * z))
    return np.array([pose[0], pose[1], heading])


class SimBackend:
    """One world of the fast simulator, in this process.

    With `estimator`, each robot's scan and odometry pass through its middleware, as in
    the nodes, so that this backend and the DDS backend return the same numbers. Without
    it, poses come from odometry: results are bit-identical to the vector env, and
    several times as fast. Views and commands have a leading (M,) for M > 1 `robots`;
    `simulation` is passed to the FastSimulator.
    """

    @check_arguments("backend 'sim'", FastSimulator, without=("worlds",))
    def __init__(
        self,
        model: SimulatorModel,
        world: AnyWorld,
        estimator: bool = False,
        robots: int = 1,
        **simulation: Any,
    ) -> None:
        check_count("robots", robots)
        check_count("threads", simulation.get("threads", 1))
        self._robot = model.robot
        self.simulator = FastSimulator(model, world, robots=robots, **simulation)
        self._middlewares = [
            Middleware(model) for _ in range(robots if estimator else 0)
        ]
        self._period_ns = round(model.control_period * NS_PER_S)
        self._row: Any = (0, 0) if robots == 1 else 0

    def reset(self, start: Start) -> RobotView:
        """Starts the episode of a seed; see `interface.Backend`."""
        starts = start.pose.reshape(1, -1, 3)
        self.simulator.reset([start.seed], starts=starts)
        for middleware, pose in zip(self._middlewares, starts[0], strict=False):
            middleware.reset(self.now_ns, pose)
        return self._measure()

    def step(self, command: Array) -> tuple[RobotView, dict[str, Any]]:
        """Moves the robots by one control period; see `interface.Backend`."""
        commands = command.reshape(1, self.simulator.data.pose.shape[1], -1)
        if self._middlewares:
            # Round like a message, so that both backends agree.
            commands = self._robot.pass_through_cmd_vel(commands)
            for middleware, one in zip(self._middlewares, commands[0], strict=True):
                middleware.command(self.now_ns, one)
        self.simulator.step(commands)
        view = self._measure()
        facts = {"stamp_ns": self.now_ns, **self._get_truth()}
        if self._middlewares:  # covariance at the time of this view
            covariances = np.array(
                [one.estimator.covariance[:3, :3] for one in self._middlewares]
            )
            alone = len(covariances) == 1
            facts["covariance"] = covariances[0] if alone else covariances
        return view, facts

    @property
    def now_ns(self) -> int:
        """Time since the start of the episode."""
        return self.simulator.data.steps.item(0) * self._period_ns

    def get_live_view(self) -> RobotView | None:
        """Returns a view (1, M) of the simulator's own arrays; None if a view needs more."""
        if self._middlewares or self.simulator.readings:
            return None
        data = self.simulator.data
        return RobotView(data.odom, data.twist, data.ranges)

    def facts(self) -> BackendFacts:
        """Returns true poses, obstacles and drawn values; see `interface.Backend`."""
        simulator = self.simulator
        known: BackendFacts = {
            **self._get_truth(),
            "bodies": simulator.obstacles[0],
            "scenes": simulator.scenes,
        }
        if simulator.drawn:
            drawn = {}
            for name, values in simulator.drawn.items():
                own = values[0] if values.ndim == 1 else values[self._row]
                drawn[name] = own.copy() if own.ndim else own.item()
            known["randomisation"] = drawn
        return known

    def _get_truth(self) -> BackendFacts:
        data = self.simulator.data
        row = self._row
        collided = data.collided[row]
        return {
            "true_pose": data.pose[row].copy(),
            "true_collision": bool(collided)
            if collided.ndim == 0
            else collided.astype(np.bool_),
        }

    def _measure(self) -> RobotView:
        data = self.simulator.data
        now = self.now_ns
        if not self._middlewares:
            row = self._row
            sensed = {
                name: readings[row].copy()
                for name, readings in self.simulator.readings.items()
            }
            scan = data.ranges[row].copy()
            motion = data.odom[row].copy(), data.twist[row].copy()
            return RobotView(*motion, scan, now * 1e-9, sensed=sensed)
        views = []
        for m, middleware in enumerate(self._middlewares):
            pose = _decode_pose(data.odom[0, m])
            middleware.odometry(now, now, pose, data.twist[0, m].copy())
            middleware.scan(now, now, data.ranges[0, m].copy())
            for name, readings in self.simulator.readings.items():
                middleware.sense(name, now, now, readings[0, m].copy())
            views.append(middleware.view(now))
        return views[0] if len(views) == 1 else stack_views(views)

    def halt(self) -> None:
        """Does nothing: robots only move in `step`."""

    def close(self) -> None:
        """Does nothing: there are no resources to free."""


class CompletedBackend:
    """Adds `halt` (by stepping with `still`) and `facts` to a user's backend that lacks them."""

    def __init__(self, backend: Any, still: Array) -> None:
        self._backend = backend
        self._still = still
        self._moved = False
        self._known = BackendFacts()
        for name in ("halt", "facts"):  # prefer the backend's own method
            method = getattr(backend, name, None)
            if callable(method):
                setattr(self, name, method)

    def reset(self, start: Start) -> RobotView:
        """Resets the backend."""
        self._known = {}
        return self._backend.reset(start)  # type: ignore[no-any-return]

    def step(self, command: Array) -> tuple[RobotView, dict[str, Any]]:
        """Steps the backend."""
        self._moved = True
        view, facts = self._backend.step(command)
        if "true_pose" in facts:
            self._known = {"true_pose": facts["true_pose"]}
        return view, facts

    def halt(self) -> None:
        """Steps with the stop command, unless there was no step since the last halt."""
        if self._moved:
            self._backend.step(self._still.copy())
            self._moved = False

    def facts(self) -> BackendFacts:
        """Returns the true pose of the last step, if the backend returned one."""
        return self._known

    def close(self) -> None:
        """Closes the backend, which sends a zero command itself."""
        self._backend.close()
        self._moved = False


def complete_backend(backend: Any, still: Array) -> Backend:
    """Returns a backend with all methods. Raises ConfigError if the object is not a backend."""
    if isinstance(backend, Backend):
        return backend
    needed = ("reset", "step", "close")
    methods = {name: getattr(backend, name, None) for name in needed}
    missing = [name for name in needed if not callable(methods[name])]
    if missing:
        kind = type(backend).__name__
        lacks = ", no ".join(missing)
        raise ConfigError(
            f"backend of type {kind}: has no {lacks}; see interface.Backend."
        )
    return CompletedBackend(backend, still)


def make_backend(
    name: str, model: SimulatorModel, world: AnyWorld, **options: Any
) -> Any:
    """Makes a backend by its registered name, see `extensions`."""
    make = extensions.load("backends", name)
    try:
        signature(make).bind(model, world, **options)
    except TypeError as error:
        raise ConfigError(f"backend {name!r}: {error}; check its arguments.") from None
    return make(model, world, **options)
