"""DrivenSimulator: worlds of the fast simulator whose robots are moved from outside."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from nics_drl_bridge.generator import SimulatorModel
from nics_drl_bridge.lidar.scanner import Renderer
from nics_drl_bridge.sim import contact_kernels, driven_kernels
from nics_drl_bridge.sim.scenes import Scenes
from nics_drl_bridge.sim.simulator import FastSimulator
from nics_drl_bridge.sim.world import World

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Driven:
    """What robots have done in one control period.

    Attributes:
        pose: (M, 3) true pose of `base_link` in `map` at the end.
        twist: (M, 3) true body twist at the end [m/s, m/s, rad/s].
        state: (M, S) at the end.
        wheels: (M, 3) pose at the end by counting the turns of the wheels, without noise.
        counted: (M, 3) body twist at the end by the wheels.
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
    same seed. Odometry is what the wheels count, with the model's noise.

    Args:
        model: the robot.
        world: the field and its obstacles.
        robots: M.
        renderer: see `FastSimulator`.

    Attributes:
        fast: holds all data; its own `step` is not for use.
        wheels: (M, 3) pose by counting the turns of the wheels, since the start pose.
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
        driven_kernels.begin_period(self.fast.packed[0])

    def move_obstacles(self, time: float) -> Array:
        """Puts the obstacles to where they are `time` [s] after the beginning of the period.

        Returns:
            (K, 7) see `lidar.shapes.BODY`.
        """
        data = self.fast.data
        contact_kernels.move_obstacles(data.bodies, self._start, data.velocity, 0, time)
        return data.bodies[0, : data.velocity.shape[1]]

    def end_period(self, driven: Driven) -> None:
        """Takes over what the robots have done and measures what they sense."""
        data = self.fast.data
        data.pose[0], data.state[0] = driven.pose, driven.state
        data.collided[0] |= driven.touched.astype(np.uint8)
        driven_kernels.end_period(
            self.fast.packed[0], driven.twist[None], self.wheels[None], driven.wheels[None],
            driven.counted[None],
        )  # fmt: skip
        self.wheels = driven.wheels.copy()
