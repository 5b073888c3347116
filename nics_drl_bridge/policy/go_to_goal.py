"""A hand-written policy: drives to the goal and turns away from obstacles."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.env.navigation import Navigation

Array = NDArray[np.float64]
STEP_M = 0.08
BLOCKED_COST = 10.0
AIM_COST = 0.35
SHORT_COST = 0.4


@dataclass(frozen=True)
class GoToGoal:
    """Checks pairs of arcs against the scan and starts on the best free one.

    A small dynamic-window planner (Fox, Burgard, Thrun 1997) over curvature alone; the second
    arc keeps a car out of places that it can't leave again. It uses only the observation of the
    navigation task.

    Attributes:
        task: defines observations and actions.
        turn_radius: of the tightest arc [m].
        margin: clearance to keep around the footprint [m].
        first, second: lengths of the two arcs [m].
        curvatures: number of first arcs, and of second arcs for each.
        beams: maximum number of beams of the scan that are used.
        cruise: speed as a share of the maximum.
    """

    task: Navigation
    turn_radius: float = 0.45
    margin: float = 0.08
    first: float = 0.5
    second: float = 1.0
    curvatures: tuple[int, int] = (13, 5)
    beams: int = 144
    cruise: float = 0.6

    @cached_property
    def _paths(self) -> tuple[Array, Array, Array]:
        """First curvature (P,), points (P, L, 2) and headings (P, L) of the paths."""
        begin = np.linspace(-1.0, 1.0, self.curvatures[0]) / self.turn_radius
        end = np.linspace(-1.0, 1.0, self.curvatures[1]) / self.turn_radius
        one, two = (array.ravel() for array in np.meshgrid(begin, end, indexing="ij"))
        steps = round((self.first + self.second) / STEP_M)
        along = (np.arange(steps) + 0.5) * STEP_M
        curvature = np.where(along < self.first, one[:, None], two[:, None])
        heading = np.cumsum(curvature * STEP_M, axis=1)
        middle = heading - curvature * STEP_M / 2.0
        points = np.cumsum(STEP_M * np.stack([np.cos(middle), np.sin(middle)], axis=-1), axis=1)
        return one, points, heading

    @cached_property
    def _chosen(self) -> tuple[NDArray[np.intp], Array]:
        """Indices of the scan parts that are used, and their directions (H, 2) in `base_link`."""
        count = self.task.scan_parts
        index = np.unique(np.linspace(0, count - 1, min(count, self.beams)).astype(np.intp))
        angles = self.task.sight.angles[index]
        return index, np.stack([np.cos(angles), np.sin(angles)], axis=-1)

    def act(self, observation: NDArray[np.float32]) -> NDArray[np.float32]:
        """Returns the action (C,) for an observation (O,); or (N, C) for (N, O)."""
        if observation.ndim == 2:
            return np.stack([self.act(one) for one in observation])
        distance, cosine, sine = observation[self.task.scan_parts :][:3].astype(float)
        goal = distance * np.array([cosine, sine])
        curvature, points, heading = self._paths
        free = self._free_steps(observation, points)
        best = int(np.argmin(_cost(goal, points, heading, free)))
        return self._action(curvature[best], free[best] / points.shape[1])

    def _free_steps(self, observation: NDArray[np.float32], points: Array) -> NDArray[np.int64]:
        """Number of points (P,) of each path that the footprint reaches with enough clearance."""
        index, directions = self._chosen
        share = observation[index].astype(float)
        sight = self.task.sight
        hits = (sight.origin + share[:, None] * sight.range_max * directions)[share < 1.0]
        if not len(hits):
            return np.full(len(points), points.shape[1])
        squared = (points[:, :, None, 0] - hits[:, 0]) ** 2 + (
            points[:, :, None, 1] - hits[:, 1]
        ) ** 2
        room = self.task.robot.footprint_radius + self.margin
        # If something is already nearer, a path only has to lead away; none would start free.
        limit = min(room * room, 0.98 * float((hits**2).sum(axis=-1).min()))
        close = squared.min(axis=-1) < limit
        return np.asarray(np.where(close.any(axis=1), close.argmax(axis=1), points.shape[1]))

    def _action(self, curvature: float, free: float) -> NDArray[np.float32]:
        """Speed and turn for an arc, scaled to [-1, 1] in the robot's own commands."""
        robot = self.task.robot
        fastest = next(c.max for c in robot.command if c.cmd_vel == "linear.x")
        speed = self.cruise * fastest * (0.3 + 0.7 * free)
        wanted = np.zeros(len(robot.command))
        for i, command in enumerate(robot.command):
            if command.cmd_vel == "linear.x":
                wanted[i] = speed
            elif command.cmd_vel == "angular.z" and command.unit == "rad":
                wanted[i] = command.max * curvature * self.turn_radius
            elif command.cmd_vel == "angular.z":
                wanted[i] = curvature * speed
        low, high = robot.command_low, robot.command_high
        return np.clip(2.0 * (wanted - low) / (high - low) - 1.0, -1.0, 1.0).astype(np.float32)


def _cost(goal: Array, points: Array, heading: Array, free: NDArray[np.int64]) -> Array:
    """Cost of each path (P,): the gap left at its best reachable point, and its dangers."""
    offset = goal - points
    gap = np.hypot(offset[..., 0], offset[..., 1])
    turn = np.arctan2(offset[..., 1], offset[..., 0]) - heading
    aim = np.abs((turn + np.pi) % (2.0 * np.pi) - np.pi)
    cost = gap + AIM_COST * np.minimum(aim, gap / 0.1)
    steps = points.shape[1]
    reachable = np.arange(steps) < np.maximum(free, 1)[:, None]
    least: Array = np.where(reachable, cost, np.inf).min(axis=1)
    arrived = np.where(reachable, gap, np.inf).min(axis=1) < 0.2
    danger = np.where(arrived, 0.0, SHORT_COST * (1.0 - free / steps))
    blocked = (free < steps) & ~arrived
    return least + danger + np.where(blocked, BLOCKED_COST * (1.0 - free / steps), 0.0)
