"""One world of the fast simulator whose robots are moved by other physics."""

import numpy as np
from numpy.typing import ArrayLike

from nics_drl_bridge.lidar.arrays import Array, Mask
from nics_drl_bridge.sim import contact_kernels, step_kernels
from nics_drl_bridge.sim.scenes import Scenes
from nics_drl_bridge.sim.simulator import FastSimulator, Starts


class DrivenSimulator(FastSimulator):
    """One world of the fast simulator whose robots are moved by external physics.

    Scenes, obstacles, noise, faults and scans are those of the FastSimulator. Odometry
    is the wheel odometry `wheels` (M, 3) since the start, plus the model's noise. A
    subclass implements the step.
    """

    def reset(
        self, seeds: ArrayLike, worlds: ArrayLike | None = None, starts: Starts = None
    ) -> Scenes:
        """Begins an episode, see `FastSimulator.reset`."""
        scenes = super().reset(seeds, worlds, starts)
        self.wheels = self.data.pose[0].copy()
        return scenes

    def begin_period(self, commands: Array) -> None:
        """Begins a period under commands (M, C) and steers the obstacles."""
        history = self.data.history[0]
        history[:, 1:] = history[:, :-1].copy()
        history[:, 0] = commands
        self._start = self.data.bodies[0, :, :3].copy()
        step_kernels.begin_period(self.packed[0])

    def in_force(self, time: float) -> Array:
        """Commands (M, C) in effect `time` [s] into the period, after latency."""
        timing = self.model.timing
        late = (self.data.delay[0] - timing.delay) * timing.dt - time
        rows = np.ceil(np.maximum(late, 0.0) / self.model.control_period - 1e-6).astype(
            np.int64
        )
        return np.asarray(self.data.history[0, np.arange(len(rows)), rows])

    def move_obstacles(self, time: float) -> Array:
        """Moves the obstacles (K, 7) to their poses `time` [s] into the period."""
        data = self.data
        contact_kernels.move_obstacles(data.bodies, self._start, data.velocity, 0, time)
        return data.bodies[0, : data.velocity.shape[1]]

    def end_period(
        self,
        pose: Array,
        twist: Array,
        state: Array,
        wheels: Array,
        counted: Array,
        touched: Mask,
    ) -> None:
        """Takes over the robots' motion in the period, and makes their measurements.

        The arguments are, at the end of the period: the true poses, body twists and states
        (M, ...); pose and body twist (M, 3) by wheel odometry without noise; and (M,) True for
        robots that touched anything.
        """
        data = self.data
        data.pose[0] = pose
        data.state[0] = state
        data.collided[0] |= touched.astype(np.uint8)
        motion = twist[None], self.wheels[None], wheels[None], counted[None]
        step_kernels.end_period(self.packed[0], *motion)
        self.sense(np.zeros(1, np.int64))
        self.wheels = wheels.copy()
