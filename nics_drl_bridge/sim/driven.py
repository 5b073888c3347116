"""DrivenSimulator: worlds of the fast simulator whose robots are moved from outside.

Compiled step of worlds whose robots are moved from outside, in two halves.

Obstacles move and robots sense by the functions of the fast simulator's own step, so that both are
the same in a world whose robots are moved by another physics engine. Shapes are those of `kernels`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from nics_drl_bridge.generator import SimulatorModel
from nics_drl_bridge.kernels import kernel
from nics_drl_bridge.lidar.scanner import Renderer
from nics_drl_bridge.sim import contact_kernels
from nics_drl_bridge.sim import contact_kernels as crowd
from nics_drl_bridge.sim import sensing_kernels as sensing
from nics_drl_bridge.sim import sensing_kernels as sight
from nics_drl_bridge.sim.contact_kernels import put_body
from nics_drl_bridge.sim.scenes import Scenes
from nics_drl_bridge.sim.simulator import FastSimulator
from nics_drl_bridge.sim.step_kernels import steer_world
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
        begin_period(self.fast.packed[0])

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
        end_period(
            self.fast.packed[0], driven.twist[None], self.wheels[None], driven.wheels[None],
            driven.counted[None],
        )  # fmt: skip
        self.wheels = driven.wheels.copy()


@kernel(allocates=True)
def begin_period(packed):  # type: ignore[no-untyped-def]
    """Sets the velocities of the obstacles for the period that begins.

    Args:
        packed: see `kernels.step_worlds`; robots are at their poses as the period begins.
    """
    fields, scene, _, motion, room = packed.content
    pose, bodies, odom, twist = fields[0], fields[3], fields[4], fields[5]
    steps, seeds, velocity, past, marks = fields[8], fields[9], fields[15], fields[16], fields[17]
    walls, movers, (dt, substeps) = scene[0], scene[5], motion[4]
    for n in range(pose.shape[0]):
        if movers[0]:
            steer_world(
                n, velocity, marks, bodies, pose, past, steps[n], walls, movers, seeds[n],
                dt * substeps, room[2][4],
            )  # fmt: skip
        for m in range(pose.shape[1]):
            if steps[n] == 0:
                sensing.begin(past, n, m, pose, odom, twist)


@kernel(allocates=True)
def end_period(packed, true, before, wheels, counted):  # type: ignore[no-untyped-def]
    """Measures what the robots sense at the end of a period.

    Args:
        packed: see `kernels.step_worlds`; all bodies are at their poses as the period ends.
        true: (N, M, 3) true twist at its end.
        before: (N, M, 3) pose by wheel odometry alone at its beginning.
        wheels: (N, M, 3) pose by wheel odometry alone at its end.
        counted: (N, M, 3) twist by wheel odometry at its end.
    """
    fields, scene, view, motion, room = packed.content
    (
        pose, _, _, bodies, odom, twist, ranges, _, steps, seeds, faults, _, _, age, noise,
        velocity, past, _,
    ) = fields  # fmt: skip
    walls, crowded, scattered = scene[0], scene[3], scene[4]
    series, (dt, substeps) = motion[3], motion[4]
    sensors, crowding = room[4], room[3]
    robots, first, together = pose.shape[1], velocity.shape[1], 0
    for n in range(pose.shape[0]):
        steps[n] += 1
        row = past[n, :, steps[n] % past.shape[2]]
        for m in range(robots):
            put_body(bodies, n, first + m, pose[n, m])
            sensing.measure(
                odom, twist, past, before[n, m], wheels, n, m, counted[n, m], noise, steps[n],
                seeds[n], steps[n] * robots + m, age[n, m], dt, substeps, series,
            )  # fmt: skip
            for i in range(3):  # the lidar scans from the true pose, not from wheel odometry
                row[m, sensing.POSE + i] = pose[n, m, i]
                row[m, sensing.TWIST + i] = true[n, m, i]
        if crowded:
            crowd.sort_bodies(bodies, n, crowding[0])
        together = sight.look_or_wait(
            n, together, pose, bodies, ranges, steps, faults, age, velocity, past, walls,
            scattered, view, sensors, crowding, dt, substeps,
        )  # fmt: skip
    sight.look_together(together, pose, bodies, ranges, first, walls, view, sensors)
    sight.distort(0, pose.shape[0], ranges, faults, steps, seeds, view)
