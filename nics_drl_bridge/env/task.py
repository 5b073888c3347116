"""Task: written once for one robot over ROS 2 and for thousands of robots in arrays."""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, Literal

import gymnasium
import numpy as np
from numpy.typing import ArrayLike, NDArray

from nics_drl_bridge.env import kernels
from nics_drl_bridge.errors import ConfigError, suggest
from nics_drl_bridge.interface import Array, RobotView
from nics_drl_bridge.kernels import Packed, pack
from nics_drl_bridge.lidar.arrays import AnyArray, Integers, Singles
from nics_drl_bridge.lidar.sector_kernels import SectorPlan
from nics_drl_bridge.lidar.sectors import NO_PLAN, ScanLayout, make_sector_plan
from nics_drl_bridge.lidar.sensor import Sensor
from nics_drl_bridge.lidar.spec import LidarSpec
from nics_drl_bridge.robot.kinds import find_command, has_textbook, reach
from nics_drl_bridge.robot.spec import RobotSpec

Observation = NDArray[np.float32]
Flags = NDArray[np.bool_]
Actions = Literal["continuous", "discrete"]
# Memory of a task during an episode: name -> array with leading (n, M), or (n,) per world.
Memory = dict[str, AnyArray]
Facts = dict[str, AnyArray]  # for `info`, by name
Info = dict[str, Any]  # Gymnasium's `info`
Terms = dict[str, Array]  # of the reward, by name
BoundStep = Callable[[Memory], tuple[Observation, dict[str, float], bool, Info]]
"""Judges a step: observation (O,), reward terms, True at the end, and facts for `info`."""
DRIVES = (
    (0, 0, 0),
    (1, 0, 0),
    (1, 0, 1),
    (1, 0, -1),
    (-1, 0, 0),
    (-1, 0, 1),
    (-1, 0, -1),
)
"""Signs of linear.x, linear.y, angular.z: stop, then forward and backward, each straight,
left and right, as in the paper's code (efc-robot/MultiVehicleEnv). A robot that can't
reverse turns in place instead, if possible."""
SIDEWAYS = ((0, 1, 0), (0, -1, 0))  # additional commands of a robot that moves sideways
PARTS = ("update", "observation", "judge", "reward", "end", "info")
"""Methods of a step, see `Task.take_step`."""
CONTACT_ANGLE = math.radians(4.0)  # 2 cm at a distance of 0.3 m
# Defaults that the shipped tasks share.
GOAL_RADIUS_M = 0.3
SUCCESS_REWARD = 10.0  # once, at the goal
COLLISION_REWARD = -10.0  # per step with a contact
PROGRESS_REWARD = 1.0  # per metre of approach
TIME_REWARD = -0.01  # per step


@dataclass(frozen=True)
class Episodes:
    """Starting episodes in n worlds with M robots."""

    # (n,) seeds, the only source of randomness, for `random_kernels.uniform`
    seeds: Integers
    starts: Array  # (n, M, 3) poses of the robots: x [m], y [m], heading [rad] in `map`
    goals: Array  # (n, M, 2) free points drawn by the world, one per robot [m]


@dataclass(frozen=True)
class Outcome:
    """Outcome of a step: reward terms (their sum is the reward), ended robots, and `info`."""

    terms: Terms
    ended: Flags
    info: Facts

    def stop_rewards(self, ended: Flags) -> "Outcome":
        """Returns the outcome without rewards for robots that had `ended` before the step."""
        if not ended.any():
            return self
        terms = {name: np.where(ended, 0.0, term) for name, term in self.terms.items()}
        return Outcome(terms, ended | self.ended, self.info)


@dataclass(frozen=True)
class Sight:
    """Scan parts: directions (P,) [rad], origin (2,) [m], and range of a fraction of 1 [m]."""

    angles: Array
    origin: Array
    range_max: float


@dataclass(frozen=True)
class Task(ABC):
    """Observation, action, reward and end of a task: pure functions over leading dimensions.

    Subclass it as a frozen dataclass and implement `observation_space`, `reset`, `observation`,
    `reward` and `end`; `docs/tasks.md` walks through an example. Every view has the leading
    dimensions (n, M): n worlds of M robots. A task of one robot with only element-wise
    operations also accepts the view () of a robot over ROS 2. Results per element must
    not depend on n: use `bearing` and `distance` instead of numpy's trigonometric
    functions.
    """

    # True if a method uses `before.ranges`; see `needs_last_scan`
    keeps_last_scan: ClassVar[bool] = True
    # True if the task observes the additional `sensors`
    observes_sensors: ClassVar[bool] = False
    # names of memory arrays that `info` always contains
    shown: ClassVar[tuple[str, ...]] = ()

    robot: RobotSpec  # commands, their limits, and the footprint
    lidar: LidarSpec  # lidar of the scan
    # a Box, or `discrete`: the paper's motion commands, see `DRIVES`
    actions: Actions = "continuous"
    # returns this close to the footprint, averaged over `CONTACT_ANGLE`, count as a
    # contact [m]
    contact_margin: float = 0.02
    # additional limit of the commands with unit m/s [m/s]
    top_speed: float | None = None
    # observed sectors, the same for any lidar, instead of beams; contacts still use the
    # beams
    scan: ScanLayout | None = None
    # additional sensors, whose fractions come last in each observation
    sensors: tuple[Sensor, ...] = ()

    def __post_init__(self) -> None:
        if self.actions not in ("continuous", "discrete"):
            known = suggest(str(self.actions), ("continuous", "discrete"))
            raise ConfigError(f"task option actions={self.actions!r}: unknown; {known}")
        if self.top_speed is not None and not self.top_speed > 0.0:
            raise ConfigError(
                f"task option top_speed={self.top_speed!r}: must be above 0 m/s."
            )
        if self.sensors and not self.observes_sensors:
            name = type(self).__name__
            raise ConfigError(
                f"task option sensors: {name} does not observe additional sensors."
            )
        _ = self.plan  # raises if the lidar can't fill the layout

    def check_above_zero(self, option: str, metres: float) -> None:
        """Raises ConfigError unless a length option is above 0 m."""
        if not metres > 0.0:
            raise ConfigError(f"task option {option}={metres!r}: must be above 0 m.")

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
        """Action space of one robot: Box [-1, 1] of its commands, or Discrete."""
        if self.actions == "discrete":
            return gymnasium.spaces.Discrete(len(self.discrete_commands))
        shape = (len(self.robot.command),)
        return gymnasium.spaces.Box(-1.0, 1.0, shape, np.float32)

    @abstractmethod
    def reset(self, episodes: Episodes) -> Memory:
        """Returns the memory of starting episodes; the env takes ownership of the arrays."""

    @abstractmethod
    def observation(self, view: RobotView, memory: Memory) -> Observation:
        """Returns the observation of each robot, (..., O) float32."""

    @abstractmethod
    def reward(self, before: RobotView, after: RobotView, memory: Memory) -> Terms:
        """Returns the terms (...) of the reward for a step."""

    @abstractmethod
    def end(self, view: RobotView, memory: Memory) -> Flags:
        """Returns True for robots (...) whose episode is over; a team ends with its last."""

    def info(self, view: RobotView, memory: Memory) -> Facts:
        """Returns facts for `info`; an evaluation reads `is_success` and `collision`."""
        return {}

    def update(self, before: RobotView, after: RobotView, memory: Memory) -> None:  # noqa: B027
        """Updates the memory in place after a step, before it is used."""

    def command(self, action: ArrayLike) -> Array:
        """Returns commands (..., C) for actions: discrete, or (..., C) clamped to [-1, 1]."""
        if self.actions == "discrete":
            return np.asarray(self.discrete_commands[np.asarray(action)])
        actions = np.ascontiguousarray(action)
        out = np.empty(actions.shape)
        rows = actions.reshape(-1, actions.shape[-1])
        low, high = self.command_limits
        kernels.scale_actions(out.reshape(rows.shape), rows, low, high)
        # Do not teach infeasible motions: a car commanded by turn rates can't turn at
        # rest.
        if self._takes_turn_rate:
            return self.robot.pass_through_cmd_vel(out)
        return out

    @cached_property
    def _takes_turn_rate(self) -> bool:
        return self.robot.takes_turn_rate

    def drive(self, actions: ArrayLike, ended: Flags) -> Array:
        """Returns the checked commands (n, M, C) for actions; robots that have ended stop."""
        shape = (*ended.shape, len(self.robot.command))
        command = self.command(actions)
        # Since the limits are finite, only a user's own `command` can return inf.
        if type(self).command is not Task.command or command.shape != shape:
            command = np.asarray(self.check_result("command", command, shape), float)
        if self.robots > 1 and ended.any():
            command = np.where(ended[..., None], still(self.robot), command)
        return command

    def _covers_all(self, declared: str, parts: Iterable[str] = PARTS) -> bool:
        """Returns True if no class below the one that declares a name overrides a part."""
        for base in type(self).__mro__:
            if declared in vars(base):
                return True
            if any(part in vars(base) for part in parts):
                return False
        return False

    @cached_property
    def is_fused(self) -> bool:
        """True if the class's own `step_into` implements all parts of a step."""
        return self._covers_all("step_into")

    @cached_property
    def binds_all(self) -> bool:
        """True if the class's own `bind` implements all parts of a step."""
        return self._covers_all("bind", (*PARTS, "step_into", "take_step"))

    @cached_property
    def needs_last_scan(self) -> bool:
        """False if `before.ranges` may hold the new ranges, which saves a copy."""
        return self.keeps_last_scan or not self._covers_all("keeps_last_scan")

    def take_step(
        self, out: Observation, before: RobotView, after: RobotView, memory: Memory
    ) -> Outcome:
        """Returns the outcome of a step and writes the observation, for an env.

        A class's `step_into` is skipped if a subclass overrides a part that it would
        not call.
        """
        if self.is_fused:
            return self.step_into(out, before, after, memory)
        return Task.step_into(self, out, before, after, memory)

    def step_into(
        self, out: Observation, before: RobotView, after: RobotView, memory: Memory
    ) -> Outcome:
        """Computes the parts of a step one by one; a class may override it with a single pass."""
        kept = dict(memory)
        self.update(before, after, memory)
        self._keep_rows(kept, memory)
        out[...] = self.check_result(
            "observation", self.observation(after, memory), out.shape
        )
        terms = self.reward(before, after, memory)
        each = out.shape[:-1]
        info = self.info(after, memory)
        for what, part in {"reward": terms, "info": info}.items():
            if not isinstance(part, dict):
                raise self._make_error(what, "must be a dictionary of arrays")
        for name, term in terms.items():
            self.check_result(f"reward term {name!r}", term, each)
        for name, fact in info.items():
            self._check_lead(f"info {name!r}", fact, each)
        ended = self.check_result("end", self.end(after, memory), each)
        if np.asarray(ended).dtype != np.bool_:
            kind = np.asarray(ended).dtype
            raise self._make_error(
                "end", f"must be True or False for each robot, not {kind}"
            )
        return Outcome(terms, ended, info)

    def _keep_rows(self, kept: Memory, memory: Memory) -> None:
        """Copies arrays that `update` replaced into the env's own rows, which were `kept`."""
        if memory.keys() != kept.keys():
            raise self._make_error(
                f"memory {sorted(memory)}", f"must keep {sorted(kept)} from `reset`"
            )
        # Read all of them first: they may alias.
        replaced = {
            name: np.array(memory[name])
            for name, rows in kept.items()
            if memory[name] is not rows
        }
        for name, new in replaced.items():
            rows = memory[name] = kept[name]
            if new.shape != rows.shape or not np.can_cast(
                new.dtype, rows.dtype, "same_kind"
            ):
                like = f"must stay {rows.dtype} of shape {rows.shape} in `update`"
                raise self._make_error(
                    f"memory {name!r}", f"{like}, not {new.dtype} of shape {new.shape}"
                )
            rows[...] = new

    def bind(self, before: Array, view: RobotView) -> BoundStep | None:
        """Binds steps of one robot to its view (1, 1) and last pose (1, 1, 3), updated in place.

        A class may override it to compute all parts of a step in one small kernel call,
        which saves most of the time in the fast simulator. The returned function is
        called with the memory after each move, and returns new arrays. It is not used
        if a subclass overrides a part or `step_into`.
        """
        return None

    def start_episodes(self, episodes: Episodes) -> Memory:
        """Returns the memory of `reset`. Raises ConfigError if it does not fit or lacks `shown`."""
        memory = self.reset(episodes)
        if not isinstance(memory, dict) or not memory.keys() >= set(self.shown):
            raise self._make_error(
                "reset", f"must return a dictionary of arrays with {[*self.shown]}"
            )
        lead = episodes.starts.shape[:2]
        for name, rows in memory.items():
            self._check_lead(f"memory {name!r}", rows, lead[:1])
        for name in self.shown:
            self._check_lead(f"memory {name!r}, which is shown,", memory[name], lead)
        return memory

    def _check_lead(self, what: str, given: Any, lead: tuple[int, ...]) -> None:
        if not isinstance(given, np.ndarray) or given.shape[: len(lead)] != lead:
            fault = f"must be an array whose shape begins with {lead}"
            raise self._make_error(
                what, f"{fault}, not {type(given).__name__} of shape {np.shape(given)}"
            )

    def _make_error(self, what: str, fault: str) -> ConfigError:
        return ConfigError(f"task {type(self).__name__}: its {what} {fault}.")

    def check_result(self, what: str, given: Any, shape: tuple[int, ...]) -> Any:
        """Returns a user's result. Raises ConfigError unless it is finite and has this shape."""
        if np.shape(given) != shape or not _is_finite(given):
            raise self._make_error(
                what,
                f"must be finite, of shape {shape}, not {given!r:.80} of {np.shape(given)}",
            )
        return given

    def check_observation_space(self) -> None:
        """Raises ConfigError unless `observation_space` is a Box (O,), as `box` makes it."""
        space: Any = self.observation_space
        if not isinstance(space, gymnasium.spaces.Box) or len(space.shape) != 1:
            raise self._make_error(
                "observation_space",
                "must be a property that returns a Box of one dimension; see `box`",
            )

    @cached_property
    def command_limits(self) -> tuple[Array, Array]:
        """Commands (C,) of the minimum and the maximum action."""
        low = self.robot.command_low
        high = self.robot.command_high
        if self.top_speed is None:
            return low, high
        speeds = np.array([command.unit == "m/s" for command in self.robot.command])
        top = np.where(speeds, self.top_speed, np.inf)
        return np.maximum(low, -top), np.minimum(high, top)

    @cached_property
    def discrete_commands(self) -> Array:
        """(A, C) commands of the discrete actions."""
        return np.clip(discrete_commands(self.robot), *self.command_limits)

    # Building blocks of tasks.

    def box(self, low: ArrayLike, high: ArrayLike) -> gymnasium.spaces.Box:
        """Returns the space of P scan fractions, values with these limits, Q sensor fractions."""
        parts = self.scan_parts
        further = sum(sensor.parts for sensor in self.sensors)
        low = np.asarray(low, np.float32)
        high = np.asarray(high, np.float32)
        return gymnasium.spaces.Box(
            np.pad(low, (parts, further)),
            np.pad(high, (parts, further), constant_values=1.0),
            dtype=np.float32,
        )

    def free_share(self, ranges: Singles) -> Observation:
        """Returns ranges (..., B) as fractions (..., P): 1 free, 0 too close or unknown."""
        return self._look(ranges)[0]

    def touches(self, ranges: Singles) -> Flags:
        """Returns True where a scan (..., B) shows a contact with the footprint, (...)."""
        return self._look(ranges)[1]

    def _look(self, ranges: Singles) -> tuple[Observation, Flags]:
        lead = ranges.shape[:-1]
        beams = ranges.shape[-1]
        parts = beams if self.scan is None else self.scan.sectors
        shares = np.empty((*lead, parts), np.float32)
        touched = np.empty(lead, np.bool_)
        rows = np.ascontiguousarray(ranges, np.float32)
        kernels.looks(
            shares.reshape(-1, parts),
            touched.reshape(-1),
            rows.reshape(-1, beams),
            self.scale,
        )
        return shares, touched

    def sensor_shares(self, view: RobotView) -> Observation:
        """Returns the fractions (..., Q) of `sensors`, in their order; Q may be 0."""
        shares = [np.zeros((*view.pose.shape[:-1], 0), np.float32)]
        for sensor in self.sensors:
            readings = view.sensed[sensor.name]
            shares.append(sensor.shares(readings))
        return np.concatenate(shares, axis=-1)

    @property
    def scan_parts(self) -> int:
        """P, the number of scan parts in an observation: sectors of `scan`, or beams."""
        return self.lidar.beams if self.scan is None else self.scan.sectors

    @cached_property
    def sight(self) -> Sight:
        """Directions, origin and range of the scan parts."""
        layout = self.scan
        if layout is not None:
            return Sight(layout.angles, np.array(layout.viewpoint), layout.range_max)
        x, y, heading = self.lidar.mount
        angles = self.lidar.angles + heading
        return Sight(angles, np.array([x, y]), self.lidar.range_max)

    @cached_property
    def plan(self) -> SectorPlan:
        """Mapping of the lidar's beams to the sectors of `scan`; empty without `scan`."""
        return NO_PLAN if self.scan is None else make_sector_plan(self.lidar, self.scan)

    @cached_property
    def scale(self) -> Any:
        """Conversion of a scan, for the kernels: a ScanScale, packed."""
        leaves = find_contact_ranges(self.robot, self.lidar, self.contact_margin)
        sectors = 0 if self.scan is None else self.scan.sectors
        per_metre = np.float32(1.0 / self.sight.range_max)
        beside = int(CONTACT_ANGLE / 2.0 / abs(self.lidar.angle_increment))
        return pack(kernels.ScanScale(per_metre, leaves, beside, sectors, self.plan))

    def __getstate__(self) -> dict[str, Any]:
        state = {}
        for name, value in vars(self).items():
            if not isinstance(value, Packed):  # each copy packs its own
                state[name] = value
        return state


def _is_finite(given: Any) -> bool:
    """Returns True if all entries are finite numbers."""
    values = np.asarray(given)
    if values.dtype.kind not in "fiub":
        return False
    return bool(np.isfinite(values).all())


def discrete_commands(robot: RobotSpec) -> Array:
    """Returns the discrete actions' commands (A, C): `DRIVES`, or single commands at limits."""
    drives = np.array(DRIVES)
    if robot.moves_sideways:
        drives = np.concatenate([drives, SIDEWAYS])
    if robot.takes_cmd_vel:
        signs = robot.from_fields(drives)
    elif has_textbook(robot):
        return find_command(robot, drives * reach(robot))
    else:
        ones = np.eye(len(robot.command))
        signs = np.concatenate([0.0 * ones[:1], ones, -ones])
    limits = np.where(signs > 0, robot.command_high, robot.command_low)
    commands: Array = np.where(signs == 0, still(robot), limits)
    return commands


def still(robot: RobotSpec) -> Array:
    """Returns the allowed command (C,) closest to zero, which stops a robot."""
    nearest_zero: Array = np.clip(0.0, robot.command_low, robot.command_high)
    return nearest_zero


def make_team_space(space: gymnasium.Space[Any], robots: int) -> gymnasium.Space[Any]:
    """Returns M robots' joint space: Box (M L,) of a Box (L,), MultiDiscrete of a Discrete."""
    if robots == 1:
        return space
    several = gymnasium.vector.utils.batch_space(space, robots)
    if not isinstance(several, gymnasium.spaces.Box):
        return several
    return gymnasium.spaces.Box(
        several.low.ravel(), several.high.ravel(), dtype=np.float32
    )


def bearing(pose: ArrayLike, points: ArrayLike) -> Array:
    """Returns distance [m], cosine, sine of the bearing of points (..., 2) from poses (..., 3)."""
    poses = np.asarray(pose, np.float64)
    ways = np.asarray(points, np.float64) - poses[..., :2]
    out = np.empty((*ways.shape[:-1], 3))
    headings = np.empty(ways.shape[:-1])
    headings[...] = poses[..., 2]
    kernels.find_bearings(
        out.reshape(-1, 3),
        ways.reshape(-1, 2),
        headings.reshape(-1),
    )
    return out


def distance(pose: ArrayLike, points: ArrayLike) -> Array:
    """Returns distances (...) [m] from poses (..., 2 or 3) to points (..., 2), broadcast."""
    places = np.asarray(pose, np.float64)[..., :2]
    offset = np.asarray(points, np.float64) - places
    x = offset[..., 0]
    y = offset[..., 1]
    return np.asarray(np.sqrt(x * x + y * y))


def limited(twist: Array) -> Array:
    """Clamps a twist (..., 3) to +-`kernels.LIMIT`, the limits of the observation space."""
    return np.minimum(np.maximum(twist, -kernels.LIMIT), kernels.LIMIT)


def total(values: Array) -> Array:
    """Sums over the last axis in order, so that results are bit-identical for any batch size."""
    summed = values[..., 0].copy()
    for k in range(1, values.shape[-1]):
        summed += values[..., k]
    return summed


def find_contact_ranges(robot: RobotSpec, lidar: LidarSpec, margin: float) -> Singles:
    """Returns ranges (B,) at which beams leave the footprint plus a margin [m]; -inf if never."""
    x, y, heading = lidar.mount
    angles = lidar.angles + heading
    ray = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    if robot.footprint is not None:
        corners = np.array(robot.footprint) - [x, y]
        leaves = _leaves_outline(ray, corners) + margin
    else:
        start = np.array([x, y])
        radius = robot.footprint_radius + margin
        along = ray @ start
        rest = radius * radius - start @ start + along * along
        half_chord = np.sqrt(np.maximum(rest, 0.0))
        leaves = np.where(rest >= 0.0, half_chord - along, -np.inf)
    return np.asarray(leaves, np.float32)


def _leaves_outline(ray: Array, corners: Array) -> Array:
    """Returns distances (B,) at which rays (B, 2) from the origin last cross an outline (V, 2)."""
    edge = np.roll(corners, -1, axis=0) - corners
    turned = np.stack([-edge[:, 1], edge[:, 0]], axis=-1)
    steep = ray @ turned.T  # (B, V): each ray and side
    with np.errstate(divide="ignore", invalid="ignore"):
        away = np.sum(corners * turned, axis=-1) / steep
        points = away[..., None] * ray[:, None]
        along = np.sum((points - corners) * edge, axis=-1)
        share = along / np.sum(edge * edge, axis=-1)
    crossed = (share >= -1e-9) & (share <= 1.0 + 1e-9)
    crossed &= (steep != 0.0) & (away >= 0.0)
    return np.asarray(np.where(crossed, away, -np.inf).max(axis=1))
