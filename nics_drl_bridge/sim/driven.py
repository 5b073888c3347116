"""DrivenSimulator: worlds of the fast simulator whose robots are moved from outside.

Obstacles move and robots sense by the functions of the fast simulator's own step, so that both are
the same in a world whose robots are moved by another physics engine.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from nics_drl_bridge.generator import SimulatorModel
from nics_drl_bridge.lidar.scanner import Renderer
from nics_drl_bridge.sim import contact_kernels, step_kernels
from nics_drl_bridge.sim.scenes import Scenes
from nics_drl_bridge.sim.simulator import FastSimulator
from nics_drl_bridge.sim.world import World

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Driven:
    """Motion of the robots in one control period.

    Attributes:
        pose: (M, 3) true pose of `base_link` in `map` at the end.
        twist: (M, 3) true body twist at the end [m/s, m/s, rad/s].
        state: (M, S) at the end.
        wheels: (M, 3) pose at the end by wheel odometry, without noise.
        counted: (M, 3) body twist at the end by wheel odometry.
        touched: (M,) whether each robot touched anything.
    """

    pose: Array
    twist: Array
    state: Array
    wheels: Array
    counted: Array
    touched: NDArray[np.bool_]


class DrivenSimulator:
    """One world: its scenes, moving obstacles, odometry noise and lidar, without its physics.

    Scenes, motion of the obstacles, noise, faults and scans are those of the FastSimulator for the
    same seed. Odometry is the wheel odometry with the model's noise.

    Args:
        model: the robot.
        world: the field and its obstacles.
        robots: M.
        renderer: see `FastSimulator`.

    Attributes:
        fast: holds all data; do not call its `step`.
        wheels: (M, 3) pose by wheel odometry, beginning at the start pose.
    """

    def __init__(
        self, model: SimulatorModel, world: World, robots: int = 1, renderer: Renderer = "auto"
    ) -> None:
        self.fast = FastSimulator(model, world, robots=robots, renderer=renderer)
        self._start = self.fast.obstacles[0, :, :3].copy()
        self.wheels: Array = np.zeros((robots, 3))

    def reset(self, seeds: ArrayLike, starts: ArrayLike | None = None) -> Scenes:
        """Begins an episode, see `FastSimulator.reset`."""
        scenes = self.fast.reset(seeds, starts=starts)
        self.wheels = self.fast.data.pose[0].copy()
        return scenes

    def begin_period(self) -> None:
        """Sets the obstacles' velocities for the period that begins."""
        data = self.fast.data
        self._start = data.bodies[0, :, :3].copy()
        step_kernels.begin_period(self.fast.packed[0])

    def move_obstacles(self, time: float) -> Array:
        """Moves the obstacles to their poses `time` [s] after the beginning of the period.

        Returns:
            (K, 7) see `lidar.shapes.BODY`.
        """
        data = self.fast.data
        contact_kernels.move_obstacles(data.bodies, self._start, data.velocity, 0, time)
        return data.bodies[0, : data.velocity.shape[1]]

    def end_period(self, driven: Driven) -> None:
        """Takes over the motion of the robots and measures what they sense."""
        data = self.fast.data
        data.pose[0], data.state[0] = driven.pose, driven.state
        data.collided[0] |= driven.touched.astype(np.uint8)
        step_kernels.end_period(
            self.fast.packed[0], driven.twist[None], self.wheels[None], driven.wheels[None],
            driven.counted[None],
        )  # fmt: skip
        self.wheels = driven.wheels.copy()
