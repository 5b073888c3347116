"""Task: what a robot is to do, written once for one robot over ROS 2 and thousands in arrays.

When a return of the lidar means that something touches the robot.
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
from nics_drl_bridge.lidar.sectors import NO_PLAN, Plan, ScanLayout, plan_of
from nics_drl_bridge.lidar.spec import LidarSpec
from nics_drl_bridge.robot.spec import RobotSpec

Array = NDArray[np.float64]
Observation = NDArray[np.float32]
Flags = NDArray[np.bool_]
Memory = dict[str, NDArray[Any]]
"""What a task remembers of an episode: name -> array with leading (n, M), or (n,) of the world."""


@dataclass(frozen=True)
class Episodes:
    """Episodes as they begin, of n worlds with M robots.

    Attributes:
        seeds: (n,) of each episode. All that a task draws must follow from them, see
            `random_kernels.uniform`.
        starts: (n, M, 3) where the robots stand: x [m], y [m], heading [rad] in `map`.
        goals: (n, M, 2) free places that the world drew, one for each robot [m].
    """

    seeds: NDArray[np.int64]
    starts: Array
    goals: Array


@dataclass(frozen=True)
class Outcome:
    """What a step came to. All arrays have the leading dimensions of the view.

    Attributes:
        terms: name -> term of the reward; their sum is the reward.
        ended: whether the episode has ended for a robot.
        info: further facts by name, for `info`.
    """

    terms: dict[str, Array]
    ended: Flags
    info: dict[str, NDArray[Any]]


@dataclass(frozen=True)
class Sight:
    """What the parts of a scan in an observation mean.

    Attributes:
        angles: (P,) of each part, counter-clockwise, in `base_link` [rad].
        origin: (2,) where they are seen from, in `base_link` [m].
        range_max: what a share of 1 stands for [m].
    """

    angles: Array
    origin: Array
    range_max: float


@dataclass(frozen=True)
class Task(ABC):
    """Observation, action, reward and end of a task: pure functions over leading dimensions.

    Subclass it as a frozen dataclass and write `observation_space`, `reset`, `observation`,
    `reward` and `end`; `docs/tasks.md` leads through one. Every view has the leading dimensions
    (n, M): n worlds of M robots. A task of one robot that works element by element also serves
    the view () of a robot over ROS 2. Whatever is computed per element must not depend on n:
    use `bearing` and `distance` instead of numpy's functions of angles.

    Attributes:
        robot: gives commands, their limits, and the footprint.
        lidar: what gives the scan.
        actions: `continuous` (Box) or `discrete` (the paper's drives, see `actions.DRIVES`).
        contact_margin: a return this close to the footprint counts as a touch [m].
        scan: the sectors that observations hold instead of the lidar's beams, so that they mean
            the same for any lidar; None holds the beams as they are. Touches are always judged
            of the beams.
        keeps_last_scan: whether `before.ranges` is wanted in `reward`, `update` or `step_into`;
            without it they are the new ones, which spares a copy.
        shown: names of the memory that `info` always holds.
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
        """M, robots in each world."""
        return 1

    @property
    @abstractmethod
    def observation_space(self) -> gymnasium.spaces.Box:
        """Of one robot, float32 and finite; see `box`."""

    @cached_property
    def action_space(self) -> gymnasium.Space[Any]:
        """Of one robot."""
        return action_space(self.robot, self.actions)

    @abstractmethod
    def reset(self, episodes: Episodes) -> Memory:
        """What is to be remembered of episodes that begin; the arrays become the env's own."""

    @abstractmethod
    def observation(self, view: RobotView, memory: Memory) -> Observation:
        """What each robot sees, (..., O) float32."""

    @abstractmethod
    def reward(self, before: RobotView, after: RobotView, memory: Memory) -> dict[str, Array]:
        """The terms (...) of the reward for a step."""

    @abstractmethod
    def end(self, view: RobotView, memory: Memory) -> Flags:
        """Whether the episode is over for each robot, (...). A team ends with its last one."""

    def info(self, view: RobotView, memory: Memory) -> dict[str, NDArray[Any]]:
        """Facts for `info`; `is_success` and `collision` are what an evaluation reads."""
        return {}

    def update(self, before: RobotView, after: RobotView, memory: Memory) -> None:  # noqa: B027
        """Brings the memory up to date after a step, in place, before anything is judged."""

    def command(self, action: ArrayLike) -> Array:
        """The command (..., C) of an action: (..., C) continuous, or (...) discrete."""
        if self.actions == "discrete":
            return np.asarray(self._commands[np.asarray(action)])
        return scaled(action, self.robot)

    def observe_into(self, out: Observation, view: RobotView, memory: Memory) -> None:
        """Writes the observation into (..., O)."""
        out[...] = self.observation(view, memory)

    def step_into(
        self, out: Observation, before: RobotView, after: RobotView, memory: Memory
    ) -> Outcome:
        """All that a step comes to, the observation written into `out`.

        A task overrides it where one pass over the scan gives several of them.
        """
        self.update(before, after, memory)
        self.observe_into(out, after, memory)
        terms = self.reward(before, after, memory)
        return Outcome(terms, self.end(after, memory), self.info(after, memory))

    @cached_property
    def _commands(self) -> Array:
        return discrete_commands(self.robot)

    # What tasks are made of.

    def box(self, low: ArrayLike, high: ArrayLike) -> gymnasium.spaces.Box:
        """The space of a scan in shares (P parts), then of parts with these limits."""
        parts = self.scan_parts
        low, high = np.asarray(low, np.float32), np.asarray(high, np.float32)
        return gymnasium.spaces.Box(
            np.concatenate([np.zeros(parts, np.float32), low]),
            np.concatenate([np.ones(parts, np.float32), high]),
            dtype=np.float32,
        )

    def free_share(self, ranges: NDArray[np.float32]) -> Observation:
        """Ranges (..., B) in shares (..., P): 1 no return, 0 too close or unknown.

        A share is one of the lidar's greatest range, or of that of the layout `scan`.
        """
        return self._look(ranges)[0]

    def touches(self, ranges: NDArray[np.float32]) -> Flags:
        """Whether a scan (..., B) says that something is within the footprint, (...)."""
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
        """P, parts of an observation that are a scan: sectors of `scan`, or beams."""
        return self.lidar.beams if self.scan is None else self.scan.sectors

    @cached_property
    def sight(self) -> Sight:
        """What these parts mean."""
        if self.scan is not None:
            layout = self.scan
            return Sight(layout.angles, np.array(layout.viewpoint), layout.range_max)
        x, y, heading = self.lidar.mount
        return Sight(self.lidar.angles + heading, np.array([x, y]), self.lidar.range_max)

    @cached_property
    def plan(self) -> Plan:
        """How the lidar's beams fill the sectors of `scan`; of no sectors without one."""
        return NO_PLAN if self.scan is None else plan_of(self.lidar, self.scan)

    @cached_property
    def sensor(self) -> tuple[Any, ...]:
        """What the kernels take: `per_metre`, `contact_ranges`, and the plan's arrays."""
        return self.per_metre, self.contact_ranges, self.plan.arguments

    @cached_property
    def per_metre(self) -> np.float32:
        """1 / the range that a share of 1 stands for [1/m]."""
        return np.float32(1.0 / self.sight.range_max)

    @cached_property
    def contact_ranges(self) -> NDArray[np.float32]:
        """(B,) range at which each beam leaves the footprint and its margin [m]."""
        return contact_ranges(self.robot, self.lidar, self.contact_margin)


def bearing(pose: ArrayLike, points: ArrayLike) -> Array:
    """Points (..., 2) as seen from poses (..., 3): distance [m], cosine, sine of the bearing.

    The leading dimensions are broadcast. A point where the robot stands lies straight ahead; a
    distance is cut at `kernels.LIMIT`.
    """
    poses, places, shape = _rows(pose, points)
    out = np.empty((len(poses), 3))
    kernels.bearings(out, poses, places)
    return out.reshape(*shape, 3)


def distance(pose: ArrayLike, points: ArrayLike) -> Array:
    """Distances (...) [m] from poses (..., 2 or 3) to points (..., 2); leads are broadcast."""
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
    """A twist (..., 3) cut at `kernels.LIMIT`, so that observations stay in their space."""
    return np.minimum(np.maximum(twist, -LIMIT), LIMIT)


def override(memory: Memory, options: Mapping[str, Any] | None) -> None:
    """Puts what `reset(options=...)` gives for a memory's name into all of its rows."""
    for name, rows in memory.items():
        if options and name in options:
            give(rows, name, options[name])


def give(rows: NDArray[Any], name: str, value: Any) -> None:
    """Puts what `reset(options=...)` gives for a name into rows (n, ...).

    Raises:
        ConfigError: it has another shape, or holds NaN or inf.
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
        robot: with a round footprint, or one of corners.
        lidar: where it is mounted, and its beams.
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
    """(B,) where rays (B, 2) from the origin cross an outline (V, 2) for the last time."""
    edge = np.roll(corners, -1, axis=0) - corners
    turned = np.stack([-edge[:, 1], edge[:, 0]], axis=-1)
    steep = ray @ turned.T  # (B, V) of each ray and side
    with np.errstate(divide="ignore", invalid="ignore"):
        away = np.sum(corners * turned, axis=-1) / steep
        where = (away[..., None] * ray[:, None] - corners) * edge
        share = where.sum(axis=-1) / np.sum(edge * edge, axis=-1)
    crossed = (steep != 0.0) & (away >= 0.0) & (share >= -1e-9) & (share <= 1.0 + 1e-9)
    return np.asarray(np.where(crossed, away, -np.inf).max(axis=1))
