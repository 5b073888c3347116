"""SimBackend: the fast simulator in this process, with the robot's middleware or without."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.generator import SimulatorModel
from nics_drl_bridge.interface import RobotView, Start
from nics_drl_bridge.lidar.scanner import Renderer
from nics_drl_bridge.middleware.view import Middleware
from nics_drl_bridge.sim.simulator import FastSimulator
from nics_drl_bridge.sim.world import World

Array = NDArray[np.float64]
NANO = 1_000_000_000


class SimBackend:
    """One world of the fast simulator, in this process.

    With `estimator`, scan and odometry of its one robot pass through the middleware as those of
    the nodes do, so that this backend and the one over DDS give the same numbers for the same seed
    and commands. Without, the pose is what the wheels' odometry says: the same bits as a world of
    the vector env, and several times faster.

    Args:
        model: the robot.
        world: the field.
        renderer: `baked` or `exact` lidar.
        estimator: whether the middleware stands between simulator and env.
        robots: M; views and commands have a leading (M,) when there are several.
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
        self._middleware = Middleware(model) if estimator else None
        self._period_ns = round(model.control_period * NANO)
        self._row: Any = (0, 0) if robots == 1 else 0
        self._now_ns = 0

    def reset(self, start: Start) -> RobotView:
        """Begins the episode of a seed; see `interface.Backend`."""
        robots = self.simulator.data.pose.shape[1]
        self.simulator.reset([start.seed], starts=start.pose.reshape(1, robots, 3))
        self._now_ns = 0
        if self._middleware is not None:
            self._middleware.reset(self._now_ns, start.pose)
        return self._measure()

    def step(self, command: Array) -> tuple[RobotView, dict[str, Any]]:
        """Moves the robots by one control period; see `interface.Backend`."""
        if self._middleware is not None:
            # By way of cmd_vel, as over ROS 2, so that both round alike.
            command = self._robot.from_cmd_vel(self._robot.to_cmd_vel(command))
            self._middleware.command(self._now_ns, command)
        data = self.simulator.data
        self.simulator.step(command.reshape(1, data.pose.shape[1], -1))
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
        if self._middleware is None:
            return RobotView(odom, twist, ranges, now * 1e-9, 0.0, 0.0)
        self._middleware.odometry(now, now, odom, twist)
        self._middleware.scan(now, now, ranges)
        return self._middleware.view(now)

    def close(self) -> None:
        """Nothing has to be freed."""
