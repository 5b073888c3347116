"""SimBackend: the fast simulator behind the same middleware as the robot's topics."""

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
    """One robot in the fast simulator, in this process.

    Its scan and odometry pass through the middleware as those of the nodes do, so that this
    backend and the one over DDS give the same numbers for the same seed and commands.

    Args:
        model: the robot.
        world: the field.
        renderer: `baked` or `exact` lidar.
    """

    def __init__(self, model: SimulatorModel, world: World, renderer: Renderer = "baked") -> None:
        self._robot = model.robot
        self._simulator = FastSimulator(model, world, renderer=renderer)
        self._middleware = Middleware(model)
        self._period_ns = round(model.control_period * NANO)
        self._now_ns = 0

    def reset(self, start: Start) -> RobotView:
        """Begins the episode of a seed; see `interface.Backend`."""
        self._simulator.reset([start.seed], starts=start.pose[None, None])
        self._now_ns = 0
        self._middleware.reset(self._now_ns, start.pose)
        return self._measure()

    def step(self, command: Array) -> tuple[RobotView, dict[str, Any]]:
        """Moves the robot by one control period; see `interface.Backend`."""
        # By way of cmd_vel, as over ROS 2, so that both round alike.
        command = self._robot.from_cmd_vel(self._robot.to_cmd_vel(command))
        self._middleware.command(self._now_ns, command)
        self._simulator.step(command[None, None])
        self._now_ns += self._period_ns
        view = self._measure()
        data = self._simulator.data
        facts = {
            "stamp_ns": self._now_ns,
            "true_pose": data.pose[0, 0].copy(),
            "true_collision": bool(data.collided[0, 0]),
        }
        return view, facts

    def _measure(self) -> RobotView:
        data, now = self._simulator.data, self._now_ns
        self._middleware.odometry(now, now, data.odom[0, 0].copy(), data.twist[0, 0].copy())
        self._middleware.scan(now, now, data.ranges[0, 0].copy())
        return self._middleware.view(now)

    def close(self) -> None:
        """Nothing has to be freed."""
