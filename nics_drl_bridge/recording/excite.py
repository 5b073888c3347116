"""Excitation: random drives within a circle that excite all of a robot's motion."""
# Segments reach new levels smoothly and hold them for a random time (Nelles: Nonlinear System
# Identification, ch. 21). A segment is accepted if it stays in the circle and the robot can turn
# back from its end.

from dataclasses import dataclass
from functools import cached_property
from itertools import product

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge import defaults, geometry
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.geometry import Array
from nics_drl_bridge.recording.messages import POSITION_UNITS
from nics_drl_bridge.robot.kinds import (
    NO_LAG_S,
    Textbook,
    has_textbook,
    reach,
    textbook,
)
from nics_drl_bridge.robot.spec import RobotSpec
from nics_drl_bridge.seeds import check_seeds

PERIOD_S = 0.05
STILL_S = 1.0  # standstill at both ends of a drive
RAMP_S = 0.25
SEGMENT_S = (0.4, 1.6)
CANDIDATES = 12
ALONE = 0.5  # probability of changing a single command
REDRAWN = 0.6  # otherwise, probability of changing each additional one
BINS = 4
# weight of the distance from the centre against the familiarity of a command
CENTRED = 2.0
# The path keeps this margin to the circle, plus the distance of a reaction at top speed.
MARGIN_M = 0.05
REACTION_S = 0.2
TOLERANCE_M = 0.005
# Turning back uses fractions of the maximum commands, as a reserve for a robot that turns less.
TURNING_SPEED = 0.5
TURNING = 0.8
RETURN_S = (3.0, 20.0)
RETURN_STEP_S = 0.1
# A path back starts within a fraction of the circle's radius, or reaches a fraction of its initial
# distance from the centre, or makes half a turn.
NEAR = 0.25
NEARER = 0.6
MAX_FAILURES = 8
MIN_DRIVE_S = 20.0
LONGEST_S = 3600.0
WIDEST_M = 1000.0  # maximum radius of the circle
SLOWEST = 0.05  # minimum fraction of the maximum speeds
# minimum standard deviation of a command, as a fraction of its range (0.29 if uniform)
SPREAD = 0.17
MAX_COMMAND_CORRELATION = 0.6  # maximum correlation of two commands
ATTEMPTS = 8


class Exploration:
    """Commands, one per period, that keep a robot in its plan's circle, at rest at both ends."""

    def __init__(self, plan: "DrivePlan", rng: np.random.Generator) -> None:
        spec = plan.robot
        self._plan = plan
        self._motion = find_motion(spec)
        self._rng = rng
        fraction = np.array(
            [1.0 if c.unit in POSITION_UNITS else plan.speed for c in spec.command]
        )
        self.low = fraction * spec.command_low
        self.high = fraction * spec.command_high
        self.rest = np.clip(np.zeros(len(spec.command)), self.low, self.high)
        self._ticks = round(plan.duration / PERIOD_S)
        self._still = round(STILL_S / PERIOD_S)
        self._ramp = round(RAMP_S / PERIOD_S)
        self._visits = np.full((BINS,) * len(spec.command), 1.0 / BINS)
        self._tick = 0
        self._failures = 0
        self._varied = 0
        self._queue = np.zeros((0, len(spec.command)))
        self._command = self.rest
        self._state = np.zeros(len(self._motion.lag))
        self.pose: Array = np.zeros(3)
        self._before = self.pose
        self._has_observed = False
        fastest = np.hypot(*(plan.speed * reach(spec)[:2]))
        self._outermost = plan.bound - spec.footprint_radius
        self.keep_within = self._outermost - MARGIN_M - REACTION_S * float(fastest)
        turning = np.array([c.turns for c in spec.command])
        self._returns = self._list_return_commands(
            np.where(turning, TURNING, TURNING_SPEED)
        )
        self._fast_returns = self._list_return_commands(
            np.where(turning, 1.0, TURNING_SPEED)
        )

    @property
    def done(self) -> bool:
        """True if the drive is over."""
        return self._tick >= self._ticks

    def observe(self, pose: Array) -> None:
        """Observes the pose (3,) at the start of the current period, in the start frame."""
        self.pose = geometry.compose(pose, geometry.between(self._before, self.pose))
        self._before = np.asarray(pose, dtype=np.float64)
        self._has_observed = True

    def choose_command(self) -> Array:
        """Returns the command (C,) for the period that begins now."""
        command = self.rest
        if self._still <= self._tick < self._ticks:
            if len(self._queue) == 0 or self._is_astray():
                self._queue = self._plan_segment()
            command = np.asarray(self._queue[0])
            self._queue = self._queue[1:]
        poses, states = self._predict(command[None, None])
        self._before = self.pose
        self.pose = poses[0, -1]
        self._state = states[0, -1]
        self._command = command
        self._visits[self._find_cells(command)] += 1.0
        self._tick += 1
        return command

    def simulate(self) -> "Pattern | None":
        """Simulates the whole drive; None if it can't return, or the commands vary too little."""
        poses = [self.pose]
        commands = []
        while not self.done:
            commands.append(self.choose_command())
            poses.append(self.pose)
            if self._failures >= MAX_FAILURES:
                return None
        command = np.array(commands)
        plan = self._plan
        if (command.std(axis=0) < SPREAD * (self.high - self.low)).any():
            return None
        footprint = plan.robot.footprint_radius
        pattern = Pattern(PERIOD_S, command, np.array(poses), plan.bound, footprint)
        alike = np.corrcoef(command, rowvar=False).reshape(len(self.low), -1)
        varied = (np.abs(alike - np.eye(len(alike))) < MAX_COMMAND_CORRELATION).all()
        return pattern if varied and pattern.reach <= plan.bound else None

    def _is_astray(self) -> bool:
        """True if, from the observed pose, the rest of the segment leads too far out."""
        if not self._has_observed or self._tick >= self._ticks - self._still:
            return False
        self._has_observed = False
        return bool(
            _compute_distance(self._predict(self._queue[None])[0]).max()
            > self._limit() + MARGIN_M
        )

    def _limit(self) -> float:
        """Returns the maximum allowed distance from the start, at least the current one [m]."""
        return max(self.keep_within, float(_compute_distance(self.pose))) + TOLERANCE_M

    def _predict(
        self, commands: Array, period: float = PERIOD_S
    ) -> tuple[Array, Array]:
        count = len(commands)
        pose = np.repeat(self.pose[None], count, 0)
        state = np.repeat(self._state[None], count, 0)
        return predict(self._motion, pose, state, commands, period)

    def _find_cells(self, command: Array) -> tuple[NDArray[np.intp], ...]:
        fraction = (command - self.low) / (self.high - self.low)
        return tuple(
            np.moveaxis(np.clip((fraction * BINS).astype(np.intp), 0, BINS - 1), -1, 0)
        )

    def _plan_segment(self) -> Array:
        remaining = self._ticks - self._still - self._tick
        if remaining <= self._ramp:
            return np.asarray(
                self._interpolate_commands(self.rest[None], remaining + self._still)[0]
            )
        length = round(self._rng.uniform(*SEGMENT_S) / PERIOD_S)
        length = max(1, min(length, remaining - self._ramp))
        choices = [False]
        if self._rng.random() < ALONE:
            choices = [True, False]
        for alone in choices:
            segment = self._choose_best(self._draw_levels(alone), length)
            if segment is not None:
                self._failures = 0
                return segment
        self._failures += 1
        return self._return_to_circle(length)

    def _draw_levels(self, alone: bool) -> Array:
        size = (CANDIDATES, len(self.low))
        fresh = self._rng.uniform(self.low, self.high, size)
        changed = self._rng.random(size) < (0.0 if alone else REDRAWN)
        changed[:, self._varied % size[1]] = True
        self._varied += 1
        return np.where(changed, fresh, self._command)

    def _choose_best(self, levels: Array, length: int) -> Array | None:
        """Returns commands (T, C) to the best of levels (K, C); None if all lead too far out."""
        commands = self._interpolate_commands(levels, length)
        poses, states = self._predict(commands)
        limit = self._limit()
        allowed = np.flatnonzero(_compute_distance(poses).max(axis=1) <= limit)
        if len(allowed) == 0:
            return None
        familiar = self._visits[self._find_cells(levels[allowed])] / self._visits.mean()
        nearest = self._measure_return(poses[allowed, -1], states[allowed, -1], limit)
        score = familiar + CENTRED * nearest
        best = int(np.argmin(score))
        if not np.isfinite(score[best]):
            return None
        return np.asarray(commands[allowed[best]])

    def _interpolate_commands(self, levels: Array, length: int) -> Array:
        """Returns commands (K, T, C) that change smoothly from the current one to levels (K, C)."""
        fraction = (
            1.0 - np.cos(np.pi * np.minimum(np.arange(1, length + 1) / self._ramp, 1.0))
        ) / 2.0
        return np.asarray(
            self._command + fraction[None, :, None] * (levels - self._command)[:, None]
        )

    def _list_return_commands(self, factor: Array) -> Array:
        """Returns constant commands (E, T, C) for turning back; the fastest makes half a turn."""
        low = np.minimum(factor * self.low, self.rest)
        high = np.maximum(factor * self.high, self.rest)
        ends = [sorted(set(three)) for three in zip(low, self.rest, high, strict=True)]
        returns = np.array(list(product(*ends)))[:, None]
        first = round(RETURN_S[0] / RETURN_STEP_S)
        last = round(1.0 / RETURN_STEP_S)
        poses, _ = self._predict(np.repeat(returns, first, axis=1), RETURN_STEP_S)
        heading = np.unwrap(poses[..., 2], axis=1)
        turned = float(np.abs(heading[:, -1] - heading[:, -1 - last]).max())
        needed = float(np.clip(np.pi / max(turned, 1e-6) + 1.0, *RETURN_S))
        return np.repeat(returns, round(needed / RETURN_STEP_S), axis=1)

    def _measure_return(self, pose: Array, state: Array, limit: float) -> Array:
        """Returns how close to the centre return paths lead, over the radius; inf if none."""
        count = len(self._returns)
        start = np.repeat(pose, count, 0), np.repeat(state, count, 0)
        returns = np.tile(self._returns, (len(pose), 1, 1))
        poses, _ = predict(self._motion, *start, returns, RETURN_STEP_S)
        away = _compute_distance(poses)
        is_inside = away.max(axis=1) <= limit
        turned = (
            np.abs(np.unwrap(poses[..., 2], axis=1) - poses[:, :1, 2]).max(axis=1)
            >= np.pi
        )
        back = (away.min(axis=1) < NEARER * away[:, 0]) | (
            away[:, 0] < NEAR * self._outermost
        )
        useful = (is_inside & (turned | back)).reshape(-1, count).any(axis=1)
        nearest = np.where(is_inside, away.min(axis=1), np.inf)
        reached = nearest.reshape(-1, count).min(axis=1)
        return np.where(useful, reached / self._outermost, np.inf)

    def _return_to_circle(self, length: int) -> Array:
        """Returns commands (T, C) for the return path that leaves the circle least."""
        away = _compute_distance(self._predict(self._fast_returns, RETURN_STEP_S)[0])
        outside = np.maximum(away.max(axis=1) - self._outermost, 0.0)
        best = np.lexsort((away.min(axis=1), np.round(outside, 2)))[0]
        return np.asarray(
            self._interpolate_commands(self._fast_returns[[best], 0], length)[0]
        )


def _compute_distance(pose: Array) -> Array:
    return np.asarray(np.hypot(pose[..., 0], pose[..., 1]))


@dataclass(frozen=True)
class Pattern:
    """The expected course of a drive; the robot starts at the origin and faces along x."""

    period: float  # time for which each command is held [s]
    command: Array  # (T, C)
    pose: Array  # (T + 1, 3) at the start of each period, and at the end
    # radius of the circle around the start that contains the whole robot [m]
    bound: float
    footprint: float  # radius of the robot [m]

    @property
    def duration(self) -> float:
        """Duration of the drive [s]."""
        return self.period * len(self.command)

    @property
    def box(self) -> Array:
        """Minimum and maximum x and y (2, 2) that the robot's body reaches [m]."""
        place = self.pose[:, :2]
        return np.array(
            [place.min(axis=0) - self.footprint, place.max(axis=0) + self.footprint]
        )

    @property
    def reach(self) -> float:
        """Maximum distance of the robot's body from the start [m]."""
        return float(np.hypot(*self.pose[:, :2].T).max()) + self.footprint

    @property
    def twist(self) -> Array:
        """Mean body twist (T, 3) of each period [m/s, m/s, rad/s]."""
        moved = geometry.log(geometry.between(self.pose[:-1], self.pose[1:]))
        return np.asarray(moved / self.period)

    @property
    def speed(self) -> Array:
        """Speed (T,) of each period [m/s]."""
        return np.asarray(np.hypot(*self.twist[:, :2].T))

    def describe(self) -> tuple[str, ...]:
        """Returns the text that an operator must read before the robot moves."""
        (left, low), (right, high) = self.box
        return (
            f"preview of {self.duration:.0f} s: a path of {self.speed.sum() * self.period:.1f} m, "
            f"up to {self.speed.max():.2f} m/s and {np.abs(self.twist[:, 2]).max():.2f} rad/s",
            f"the robot's body needs x {left:+.2f} to {right:+.2f} m and y {low:+.2f} to "
            f"{high:+.2f} m, with the origin at its start and x ahead",
            f"it is stopped if, by its odometry, it leaves the circle of "
            f"{self.bound:g} m around its start; it detects no obstacles: clear that "
            "circle, and keep an emergency stop at hand",
        )


def predict(
    motion: Textbook, pose: Array, state: Array, command: Array, period: float
) -> tuple[Array, Array]:
    """Predicts poses (K, T + 1, 3) and states from commands (K, T, C), one arc a period [s]."""
    poses = [pose]
    states = [state]
    for goal in np.moveaxis(motion.target(command), 1, 0):
        middle = motion.respond(state, goal, period / 2.0)
        pose = geometry.compose(pose, geometry.exp(motion.twist(middle) * period))
        state = motion.respond(state, goal, period)
        poses.append(pose)
        states.append(state)
    return np.stack(poses, axis=1), np.stack(states, axis=1)


def find_motion(spec: RobotSpec) -> Textbook:
    """Returns the motion by textbook, else by `cmd_vel`. Raises ConfigError if there is neither."""
    if has_textbook(spec):
        return textbook(spec)
    for command in spec.command:
        if not command.is_twist:
            raise ConfigError(
                f"robot {spec.name!r}: the effect of {command.name!r} in "
                f"{command.unit} can't be predicted; add `textbook:` and its "
                "`parameters:` to the robot's YAML file."
            )
    return Textbook(
        twist=lambda state: state,
        target=spec.to_cmd_vel,
        lag=np.full(3, NO_LAG_S),
        rate=np.full(3, np.inf),
        structure={},
    )


@dataclass(frozen=True)
class DrivePlan:
    """Options of a drive. Raises ConfigError if a value is out of its range."""

    robot: RobotSpec  # the robot that drives
    # radius of the circle around the start that contains the whole robot [m]
    bound: float = defaults.DRIVE_BOUND_M
    duration: float = defaults.DRIVE_S  # [s]
    speed: float = 1.0  # fraction of the maximum speeds and rates to use
    seed: int = 0  # seed of the pattern

    def __post_init__(self) -> None:
        check_seeds(self.seed)
        for name, value, low, high, unit in (
            ("bound", self.bound, self.robot.footprint_radius, WIDEST_M, " m"),
            ("duration", self.duration, MIN_DRIVE_S, LONGEST_S, " s"),
            ("speed", self.speed, SLOWEST, 1.0, ""),
        ):
            if not low <= value <= high:
                raise ConfigError(
                    f"{name} {value:g}: must be from {low:g} to {high:g}{unit}."
                )

    def begin(self) -> Exploration:
        """Returns the previewed drive, at its start. Raises ConfigError like `preview`."""
        return self._start_attempt(self._accepted[0])

    def preview(self) -> Pattern:
        """Returns the expected pattern. Raises ConfigError if the circle is too small."""
        return self._accepted[1]

    def _start_attempt(self, number: int) -> Exploration:
        return Exploration(self, np.random.default_rng([self.seed, number]))

    @cached_property
    def _accepted(self) -> tuple[int, Pattern]:
        """Number and pattern of the first attempt that varies all commands within the circle."""
        for number in range(ATTEMPTS):
            drive = self._start_attempt(number)
            pattern = drive.simulate() if drive.keep_within > 0.0 else None
            if pattern is not None:
                return number, pattern
        raise ConfigError(
            f"bound {self.bound:g}: a circle of {self.bound:g} m around the start is "
            f"too small for robot {self.robot.name!r} to show its motion within "
            f"{self.duration:g} s; give it more space, less speed, or more time."
        )
