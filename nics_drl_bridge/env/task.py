"""Task: the job of a robot, written once for one robot over ROS 2 and thousands in arrays.

Ranges below which a lidar return means contact with the robot.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

import gymnasium
import numpy as np
from numpy.typing import ArrayLike, NDArray

from nics_drl_bridge.env import kernels
from nics_drl_bridge.env.actions import Actions, action_space, discrete_commands, scaled
from nics_drl_bridge.env.kernels import LIMIT
from nics_drl_bridge.errors import ConfigError, nearest
from nics_drl_bridge.interface import RobotView
from nics_drl_bridge.lidar.sector_kernels import SectorPlan
from nics_drl_bridge.lidar.sectors import NO_PLAN, ScanLayout, plan_of
from nics_drl_bridge.lidar.spec import LidarSpec
from nics_drl_bridge.robot.spec import RobotSpec

Array = NDArray[np.float64]
Observation = NDArray[np.float32]
Flags = NDArray[np.bool_]
Memory = dict[str, NDArray[Any]]
"""Memory of a task during an episode: name -> array with leading (n, M), or (n,) per world."""


@dataclass(frozen=True)
class Episodes:
    """Episodes at their start, in n worlds with M robots.

    Attributes:
        seeds: (n,) of each episode. All that a task draws must follow from them, see
            `random_kernels.uniform`.
        starts: (n, M, 3) poses of the robots: x [m], y [m], heading [rad] in `map`.
        goals: (n, M, 2) free points that the world drew, one per robot [m].
    """

    seeds: NDArray[np.int64]
    starts: Array
    goals: Array


@dataclass(frozen=True)
class Outcome:
    """Outcome of a step. All arrays have the leading dimensions of the view.

    Attributes:
        terms: name -> term of the reward; their sum is the reward.
        ended: True where the episode has ended for a robot.
        info: further facts by name, for `info`.
    """

    terms: dict[str, Array]
    ended: Flags
    info: dict[str, NDArray[Any]]


@dataclass(frozen=True)
class Sight:
    """Meaning of the scan parts of an observation.

    Attributes:
        angles: (P,) direction of each part, counter-clockwise, in `base_link` [rad].
        origin: (2,) origin of the rays, in `base_link` [m].
        range_max: range that a share of 1 stands for [m].
    """

    angles: Array
    origin: Array
    range_max: float


@dataclass(frozen=True)
class Task(ABC):
    """Observation, action, reward and end of a task: pure functions over leading dimensions.

    Subclass it as a frozen dataclass and implement `observation_space`, `reset`, `observation`,
    `reward` and `end`; `docs/tasks.md` walks through an example. Every view has the leading
    dimensions (n, M): n worlds of M robots. A task of one robot that works element by element also
    accepts the view () of a robot over ROS 2. Results per element must not depend on n: use
    `bearing` and `distance` instead of numpy's trigonometric functions.

    Attributes:
        robot: gives commands, their limits, and the footprint.
        lidar: gives the scan.
        actions: `continuous` (Box) or `discrete` (the paper's drives, see `actions.DRIVES`).
        contact_margin: a return this close to the footprint counts as a contact [m].
        scan: sectors that observations contain instead of the lidar's beams, so that they mean the
            same for any lidar; None keeps the beams. Contact is always judged from the beams.
        keeps_last_scan: True if `reward`, `update` or `step_into` use `before.ranges`; otherwise
            these may be the new ranges, which saves a copy.
        shown: names of memory arrays that `info` always contains.
    """

    keeps_last_scan: ClassVar[bool] = True
    shown: ClassVar[tuple[str, ...]] = ()

    robot: RobotSpec
    lidar: LidarSpec
    actions: Actions = "continuous"
    contact_margin: float = 0.02
    scan: ScanLayout | None = None

    def __post_init__(self) -> None:
        if self.actions not in ("continuous", "discrete"):
            known = nearest(str(self.actions), ("continuous", "discrete"))
            raise ConfigError(f"task option actions={self.actions!r}: no such actions; {known}")
        _ = self.plan  # a lidar that can't fill the layout is refused here

    @property
    def robots(self) -> int:
        """M, the number of robots in each world."""
        return 1

    @property
    @abstractmethod
    def observation_space(self) -> gymnasium.spaces.Box:
        """Observation space of one robot, float32 and finite; see `box`."""

    @cached_property
    def action_space(self) -> gymnasium.Space[Any]:
        """Action space of one robot."""
        return action_space(self.robot, self.actions)

    @abstractmethod
    def reset(self, episodes: Episodes) -> Memory:
        """Returns the memory of episodes that begin; the env takes ownership of the arrays."""

    @abstractmethod
    def observation(self, view: RobotView, memory: Memory) -> Observation:
        """Returns the observation of each robot, (..., O) float32."""

    @abstractmethod
    def reward(self, before: RobotView, after: RobotView, memory: Memory) -> dict[str, Array]:
        """Returns the terms (...) of the reward for a step."""

    @abstractmethod
    def end(self, view: RobotView, memory: Memory) -> Flags:
        """Returns True where a robot's episode is over, (...). A team ends with its last robot."""

    def info(self, view: RobotView, memory: Memory) -> dict[str, NDArray[Any]]:
        """Returns facts for `info`; an evaluation reads `is_success` and `collision`."""
        return {}

    def update(self, before: RobotView, after: RobotView, memory: Memory) -> None:  # noqa: B027
        """Updates the memory after a step, in place, before anything is computed from it."""

    def command(self, action: ArrayLike) -> Array:
        """Returns the command (..., C) of an action: (..., C) continuous, or (...) discrete."""
        if self.actions == "discrete":
            return np.asarray(self._commands[np.asarray(action)])
        return scaled(action, self.robot)

    def observe_into(self, out: Observation, view: RobotView, memory: Memory) -> None:
        """Writes the observation into (..., O)."""
        out[...] = self.observation(view, memory)

    def step_into(
        self, out: Observation, before: RobotView, after: RobotView, memory: Memory
    ) -> Outcome:
        """Returns the outcome of a step and writes the observation into `out`.

        Override it if one pass over the scan gives several of these results.
        """
        self.update(before, after, memory)
        self.observe_into(out, after, memory)
        terms = self.reward(before, after, memory)
        return Outcome(terms, self.end(after, memory), self.info(after, memory))

    @cached_property
    def _commands(self) -> Array:
        return discrete_commands(self.robot)

    # Building blocks of tasks.

    def box(self, low: ArrayLike, high: ArrayLike) -> gymnasium.spaces.Box:
        """Returns the space of a scan in shares (P parts) followed by parts with these limits."""
        parts = self.scan_parts
        low, high = np.asarray(low, np.float32), np.asarray(high, np.float32)
        return gymnasium.spaces.Box(
            np.concatenate([np.zeros(parts, np.float32), low]),
            np.concatenate([np.ones(parts, np.float32), high]),
            dtype=np.float32,
        )

    def free_share(self, ranges: NDArray[np.float32]) -> Observation:
        """Returns ranges (..., B) as shares (..., P): 1 no return, 0 too close or unknown.

        Shares are relative to the maximum range of the lidar, or of the layout `scan`.
        """
        return self._look(ranges)[0]

    def touches(self, ranges: NDArray[np.float32]) -> Flags:
        """Returns True where a scan (..., B) shows a contact with the footprint, (...)."""
        return self._look(ranges)[1]

    def _look(self, ranges: NDArray[np.float32]) -> tuple[Observation, Flags]:
        ranges = np.ascontiguousarray(ranges, np.float32)
        rows = ranges.reshape(-1, ranges.shape[-1])
        parts = rows.shape[-1] if self.scan is None else self.scan.sectors
        shares, touched = np.empty((len(rows), parts), np.float32), np.empty(len(rows), np.bool_)
        kernels.looks(shares, touched, rows, self.sensor)
        lead = ranges.shape[:-1]
        return shares.reshape(*lead, parts), touched.reshape(lead)

    @property
    def scan_parts(self) -> int:
        """P, the number of scan parts of an observation: sectors of `scan`, or beams."""
        return self.lidar.beams if self.scan is None else self.scan.sectors

    @cached_property
    def sight(self) -> Sight:
        """Meaning of the scan parts."""
        if self.scan is not None:
            layout = self.scan
            return Sight(layout.angles, np.array(layout.viewpoint), layout.range_max)
        x, y, heading = self.lidar.mount
        return Sight(self.lidar.angles + heading, np.array([x, y]), self.lidar.range_max)

    @cached_property
    def plan(self) -> SectorPlan:
        """Mapping of the lidar's beams to the sectors of `scan`; without it, one of no sectors."""
        return NO_PLAN if self.scan is None else plan_of(self.lidar, self.scan)

    @cached_property
    def sensor(self) -> kernels.ScanShares:
        """The scan part of an observation for the kernels."""
        return kernels.ScanShares(self.per_metre, self.contact_ranges, self.plan)

    @cached_property
    def per_metre(self) -> np.float32:
        """1 / the range that a share of 1 stands for [1/m]."""
        return np.float32(1.0 / self.sight.range_max)

    @cached_property
    def contact_ranges(self) -> NDArray[np.float32]:
        """(B,) range at which each beam leaves the footprint and its margin [m]."""
        return contact_ranges(self.robot, self.lidar, self.contact_margin)


def bearing(pose: ArrayLike, points: ArrayLike) -> Array:
    """Returns distance [m], cosine and sine of the bearing of points (..., 2) from poses (..., 3).

    The leading dimensions are broadcast. A point at the robot's position lies straight ahead;
    distances are cut at `kernels.LIMIT`.
    """
    poses, places, shape = _rows(pose, points)
    out = np.empty((len(poses), 3))
    kernels.bearings(out, poses, places)
    return out.reshape(*shape, 3)


def distance(pose: ArrayLike, points: ArrayLike) -> Array:
    """Returns distances (...) [m] from poses (..., 2 or 3) to points (..., 2), broadcast."""
    poses, places, shape = _rows(pose, points)
    out = np.empty(len(poses))
    kernels.distances(out, poses, places)
    return out.reshape(shape)


def _rows(pose: ArrayLike, points: ArrayLike) -> tuple[Array, Array, tuple[int, ...]]:
    poses, places = np.asarray(pose, np.float64), np.asarray(points, np.float64)
    shape = poses.shape[:-1]
    if places.shape[:-1] != shape:
        shape = np.broadcast_shapes(shape, places.shape[:-1])
        poses = np.broadcast_to(poses, (*shape, poses.shape[-1]))
        places = np.broadcast_to(places, (*shape, 2))
    return (
        np.ascontiguousarray(poses).reshape(-1, poses.shape[-1]),
        np.ascontiguousarray(places).reshape(-1, 2),
        shape,
    )


def limited(twist: Array) -> Array:
    """Cuts a twist (..., 3) at `kernels.LIMIT`, so that observations stay in their space."""
    return np.minimum(np.maximum(twist, -LIMIT), LIMIT)


def override(memory: Memory, options: Mapping[str, Any] | None) -> None:
    """Writes values of `reset(options=...)` into all rows of the memory arrays that they name."""
    for name, rows in memory.items():
        if options and name in options:
            give(rows, name, options[name])


def give(rows: NDArray[Any], name: str, value: Any) -> None:
    """Writes the value of an option of `reset(options=...)` into rows (n, ...).

    Raises:
        ConfigError: the value has a wrong shape, or contains NaN or inf.
    """
    try:
        given = np.asarray(value)
    except ValueError:  # a ragged list
        given = np.asarray(None)
    fits = given.shape in [rows.shape[k:] for k in range(max(2, rows.ndim))]
    if not fits or given.dtype.kind not in "fiub":
        raise ConfigError(
            f"reset option {name!r}, {value!r}: must be numbers of shape {rows.shape[1:]}, or of "
            "its last dimensions."
        )
    rows[...] = given
    if not np.isfinite(rows).all():
        raise ConfigError(f"reset option {name!r}, {value!r}: must be finite.")


def contact_ranges(robot: RobotSpec, lidar: LidarSpec, margin: float) -> NDArray[np.float32]:
    """Range at which each beam leaves the footprint and a margin around it.

    Args:
        robot: gives the footprint, round or a polygon.
        lidar: gives the mount and the beams.
        margin: [m].

    Returns:
        (B,) [m]; -inf where a beam does not cross the footprint.
    """
    x, y, heading = lidar.mount
    angles = lidar.angles + heading
    ray = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    if robot.footprint is None:
        leaves = _leaves_circle(ray, np.array([x, y]), robot.footprint_radius + margin)
    else:
        leaves = _leaves_outline(ray, np.array(robot.footprint) - [x, y]) + margin
    return leaves.astype(np.float32)


def _leaves_circle(ray: Array, start: Array, radius: float) -> Array:
    along = ray @ start
    rest = radius * radius - start @ start + along * along
    return np.where(rest >= 0.0, np.sqrt(np.maximum(rest, 0.0)) - along, -np.inf)


def _leaves_outline(ray: Array, corners: Array) -> Array:
    """(B,) distances at which rays (B, 2) from the origin last cross an outline (V, 2)."""
    edge = np.roll(corners, -1, axis=0) - corners
    turned = np.stack([-edge[:, 1], edge[:, 0]], axis=-1)
    steep = ray @ turned.T  # (B, V) of each ray and side
    with np.errstate(divide="ignore", invalid="ignore"):
        away = np.sum(corners * turned, axis=-1) / steep
        where = (away[..., None] * ray[:, None] - corners) * edge
        share = where.sum(axis=-1) / np.sum(edge * edge, axis=-1)
    crossed = (steep != 0.0) & (away >= 0.0) & (share >= -1e-9) & (share <= 1.0 + 1e-9)
    return np.asarray(np.where(crossed, away, -np.inf).max(axis=1))
