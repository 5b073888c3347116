"""Exploration: commands that excite a robot's whole motion and keep it within a circle.

A drive is a sequence of segments. At the end of each, the next is drawn at random: new levels for
one or more commands, reached smoothly and held for a random time (amplitude-modulated
pseudo-random steps; Nelles: Nonlinear System Identification, ch. 21). A segment is accepted only
if the expected path stays within the circle and the robot can still turn back from its end. Rarely
used levels are preferred, so that each command covers its range independently of the others, and
so are end points from which a path leads close to the centre.

Pattern: the expected course of a drive, before the robot moves.

Prediction of the motion of a robot that has no fitted model yet.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge import geometry
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.recording.joints import POSITION_UNITS
from nics_drl_bridge.robot.kinds import textbook
from nics_drl_bridge.robot.spec import RobotSpec

Array = NDArray[np.float64]

PERIOD_S = 0.05
STILL_S = 1.0
"""Standstill at both ends of a drive [s]."""
RAMP_S = 0.25
SEGMENT_S = (0.4, 1.6)
CANDIDATES = 12
ALONE, REDRAWN = 0.5, 0.6
"""Probability that a segment changes a single command; otherwise, that it changes each further
command."""
BINS = 4
CENTRED = 2.0
"""Weight of the distance from the centre against the familiarity of a command."""
MARGIN_M, REACTION_S, TOLERANCE_M = 0.05, 0.2, 0.005
"""The path stays inside the circle by this margin plus the distance driven in this time at top
speed; tolerance of that limit."""
TURNING_SPEED, TURNING = 0.5, 0.8
"""Commands for turning back, as shares of the greatest: less than possible, as a reserve for a
robot that turns worse than expected."""
WAY_S, WAY_STEP_S = (3.0, 20.0), 0.1
NEAR, NEARER = 0.25, 0.6
"""A path back starts within this share of the circle's radius, or reaches this share of its
initial distance from the centre, or turns by half a turn."""
LOST = 8


class Exploration:
    """Generator of a robot's commands, one per period, that tracks the robot's pose.

    Args:
        spec: the robot.
        bound: radius of the circle around the start that contains the whole robot [m].
        duration: of the drive [s], including 1 s of standstill at both ends.
        rng: draws the segments.
        speed: share of the greatest speeds and rates to use, above 0, up to 1; angles use their
            full range.
    """

    def __init__(
        self,
        spec: RobotSpec,
        bound: float,
        duration: float,
        rng: np.random.Generator,
        speed: float = 1.0,
    ) -> None:
        self._motion, self._rng = expected_motion(spec), rng
        share = np.array([1.0 if c.unit in POSITION_UNITS else speed for c in spec.command])
        self.low, self.high = share * spec.command_low, share * spec.command_high
        self.rest = np.clip(np.zeros(len(spec.command)), self.low, self.high)
        self._ticks, self._still = round(duration / PERIOD_S), round(STILL_S / PERIOD_S)
        self._ramp = round(RAMP_S / PERIOD_S)
        self._visits = np.full((BINS,) * len(spec.command), 1.0 / BINS)
        self._tick, self._lost, self._turn = 0, 0, 0
        self._queue = np.zeros((0, len(spec.command)))
        self._command, self._state = self.rest, np.zeros(self._motion.size)
        self.pose: Array = np.zeros(3)
        self._before, self._seen = self.pose, False
        fastest = np.hypot(*spec.to_cmd_vel(np.maximum(-self.low, self.high))[:2])
        self._outermost = bound - spec.footprint_radius
        self.keep_within = self._outermost - MARGIN_M - REACTION_S * float(fastest)
        turning = np.array([c.turns for c in spec.command])
        self._ways = self._ways_back(np.where(turning, TURNING, TURNING_SPEED))
        self._emergency = self._ways_back(np.where(turning, 1.0, TURNING_SPEED))

    @property
    def done(self) -> bool:
        """True if the drive is over."""
        return self._tick >= self._ticks

    @property
    def stuck(self) -> bool:
        """True if the robot has found no acceptable segment `LOST` times in a row."""
        return self._lost >= LOST

    def see(self, pose: Array) -> None:
        """Observes the robot's pose (3,) at the start of the current period, in the start frame."""
        self.pose = geometry.compose(pose, geometry.between(self._before, self.pose))
        self._before, self._seen = np.asarray(pose, dtype=np.float64), True

    def next(self) -> Array:
        """Returns the command (C,) for the period that begins now."""
        if self._tick < self._still or self.done:
            command = self.rest
        else:
            if len(self._queue) == 0 or self._goes_astray():
                self._queue = self._segment()
            command, self._queue = np.asarray(self._queue[0]), self._queue[1:]
        self._follow(command)
        return command

    def _goes_astray(self) -> bool:
        """True if, from the observed pose, the rest of the segment leads too far out."""
        if not self._seen or self._tick >= self._ticks - self._still:
            return False
        self._seen = False
        return bool(_distance(self._roll(self._queue[None])[0]).max() > self._limit() + MARGIN_M)

    def _limit(self) -> float:
        """Returns the greatest allowed distance from the start, at least the present one [m]."""
        return max(self.keep_within, float(_distance(self.pose))) + TOLERANCE_M

    def _follow(self, command: Array) -> None:
        poses, states = self._roll(command[None, None])
        self._before, self.pose = self.pose, poses[0, -1]
        self._state, self._command = states[0, -1], command
        self._visits[self._cells(command)] += 1.0
        self._tick += 1

    def _roll(self, commands: Array) -> tuple[Array, Array]:
        """Rolls out commands (K, T, C) from the present pose and state."""
        many = len(commands)
        pose, state = np.repeat(self.pose[None], many, 0), np.repeat(self._state[None], many, 0)
        return self._motion.roll(pose, state, commands, PERIOD_S)

    def _cells(self, command: Array) -> tuple[NDArray[np.intp], ...]:
        """Returns the cell indices of commands (..., C), by dimension."""
        share = (command - self.low) / (self.high - self.low)
        return tuple(np.moveaxis(np.clip((share * BINS).astype(np.intp), 0, BINS - 1), -1, 0))

    def _segment(self) -> Array:
        """Returns the commands (T, C) up to the next decision."""
        left = self._ticks - self._still - self._tick
        if left <= self._ramp:
            return np.asarray(self._towards(self.rest[None], left + self._still)[0])
        length = round(self._rng.uniform(*SEGMENT_S) / PERIOD_S)
        length = max(1, min(length, left - self._ramp))
        for alone in (True, False) if self._rng.random() < ALONE else (False,):
            segment = self._best(self._candidates(alone), length)
            if segment is not None:
                self._lost = 0
                return segment
        self._lost += 1
        return self._least_harm(length)

    def _candidates(self, alone: bool) -> Array:
        """Draws random levels (K, C) for one command or for several."""
        size = (CANDIDATES, len(self.low))
        fresh = self._rng.uniform(self.low, self.high, size)
        changed = self._rng.random(size) < (0.0 if alone else REDRAWN)
        changed[:, self._turn % size[1]] = True
        self._turn += 1
        return np.where(changed, fresh, self._command)

    def _best(self, levels: Array, length: int) -> Array | None:
        """Returns commands (T, C) to the best of levels (K, C); None if all lead too far out."""
        commands = self._towards(levels, length)
        poses, states = self._roll(commands)
        limit = self._limit()
        allowed = np.flatnonzero(_distance(poses).max(axis=1) <= limit)
        if len(allowed) == 0:
            return None
        familiar = self._visits[self._cells(levels[allowed])] / self._visits.mean()
        nearest = self._way_to_centre(poses[allowed, -1], states[allowed, -1], limit)
        score = familiar + CENTRED * nearest
        best = int(np.argmin(score))
        return np.asarray(commands[allowed[best]]) if np.isfinite(score[best]) else None

    def _towards(self, levels: Array, length: int) -> Array:
        """Returns commands (K, T, C) that go smoothly from the present one to levels (K, C)."""
        done = np.minimum(np.arange(1, length + 1) / self._ramp, 1.0)
        share = (1.0 - np.cos(np.pi * done)) / 2.0
        return np.asarray(self._command + share[None, :, None] * (levels - self._command)[:, None])

    def _ways_back(self, factor: Array) -> Array:
        """Returns constant commands (E, T, C) for turning back.

        They last long enough for half a turn by the one that turns fastest.
        """
        ends = [
            sorted({low, rest, high})
            for low, rest, high in zip(
                np.minimum(factor * self.low, self.rest), self.rest,
                np.maximum(factor * self.high, self.rest), strict=True,
            )
        ]  # fmt: skip
        ways = np.array(list(product(*ends)))[:, None]
        first, last = round(WAY_S[0] / WAY_STEP_S), round(1.0 / WAY_STEP_S)
        start = np.zeros((len(ways), 3)), np.zeros((len(ways), self._motion.size))
        poses, _ = self._motion.roll(*start, np.repeat(ways, first, axis=1), WAY_STEP_S)
        heading = np.unwrap(poses[..., 2], axis=1)
        turned = float(np.abs(heading[:, -1] - heading[:, -1 - last]).max())
        needed = float(np.clip(np.pi / max(turned, 1e-6) + 1.0, *WAY_S))
        return np.repeat(ways, round(needed / WAY_STEP_S), axis=1)

    def _way_to_centre(self, pose: Array, state: Array, limit: float) -> Array:
        """Returns how close paths back from poses (K, 3) get to the centre, over the radius.

        Infinite if no path stays within `limit` and turns the robot by half a turn or brings it
        back.
        """
        many = len(self._ways)
        start = np.repeat(pose, many, 0), np.repeat(state, many, 0)
        poses, _ = self._motion.roll(*start, np.tile(self._ways, (len(pose), 1, 1)), WAY_STEP_S)
        away = _distance(poses)
        inside = away.max(axis=1) <= limit
        turned = np.abs(np.unwrap(poses[..., 2], axis=1) - poses[:, :1, 2]).max(axis=1) >= np.pi
        near = NEAR * self._outermost
        back = (away.min(axis=1) < NEARER * away[:, 0]) | (away[:, 0] < near)
        useful = (inside & (turned | back)).reshape(len(pose), many).any(axis=1)
        reached = np.where(inside, away.min(axis=1), np.inf).reshape(len(pose), many).min(axis=1)
        return np.where(useful, reached / self._outermost, np.inf)

    def _least_harm(self, length: int) -> Array:
        """Returns commands (T, C) towards the least harmful path back.

        That path leaves the circle least, and among equals gets closest to its centre.
        """
        start = np.repeat(self.pose[None], len(self._emergency), 0)
        state = np.repeat(self._state[None], len(self._emergency), 0)
        away = _distance(self._motion.roll(start, state, self._emergency, WAY_STEP_S)[0])
        outside = np.maximum(away.max(axis=1) - self._outermost, 0.0)
        best = np.lexsort((away.min(axis=1), np.round(outside, 2)))[0]
        return np.asarray(self._towards(self._emergency[[best], 0], length)[0])


def _distance(pose: Array) -> Array:
    """Returns the distance of poses (..., 3) from the start [m]."""
    return np.asarray(np.hypot(pose[..., 0], pose[..., 1]))


@dataclass(frozen=True)
class Pattern:
    """The expected course of a drive; the robot starts at the origin and faces along x.

    Attributes:
        period: time for which each command is held [s].
        command: (T, C).
        pose: (T + 1, 3) at the start of each period, and at the end.
        bound: radius of the circle around the start that contains the whole robot [m].
        footprint: radius of the robot [m].
    """

    period: float
    command: Array
    pose: Array
    bound: float
    footprint: float

    @property
    def duration(self) -> float:
        """Duration of the drive [s]."""
        return self.period * len(self.command)

    @property
    def box(self) -> Array:
        """Least and greatest x and y (2, 2) that the robot's body reaches [m]."""
        place = self.pose[:, :2]
        return np.array([place.min(axis=0) - self.footprint, place.max(axis=0) + self.footprint])

    @property
    def reach(self) -> float:
        """Greatest distance of the robot's body from the start [m]."""
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

    def lines(self) -> tuple[str, ...]:
        """Returns the lines that an operator must read before the robot moves."""
        (left, low), (right, high) = self.box
        return (
            f"preview of {self.duration:.0f} s: a path of {self.speed.sum() * self.period:.1f} m, "
            f"up to {self.speed.max():.2f} m/s and {np.abs(self.twist[:, 2]).max():.2f} rad/s",
            f"the robot's body needs x {left:+.2f} to {right:+.2f} m and y {low:+.2f} to "
            f"{high:+.2f} m, seen from where it stands and looks along x",
            f"it is stopped where its odometry says that it leaves the circle of "
            f"{self.bound:g} m around its start; it looks out for nothing else: clear that "
            "circle, and keep an emergency stop at hand",
        )


@dataclass(frozen=True)
class ExpectedMotion:
    """Expected motion of a robot.

    Attributes:
        size: S, the size of the state.
        respond: gives the state (K, S) after a command (K, C) was held for some time [s].
        twist: gives the body twist (K, 3) for a state (K, S) and a command (K, C).
    """

    size: int
    respond: Callable[[Array, Array, float], Array]
    twist: Callable[[Array, Array], Array]

    def roll(self, pose: Array, state: Array, command: Array, period: float) -> tuple[Array, Array]:
        """Rolls out commands, one arc per command at the state in the middle of its period.

        Args:
            pose: (K, 3).
            state: (K, S).
            command: (K, T, C), each held for a period.
            period: [s].

        Returns:
            Poses (K, T + 1, 3) and states (K, T + 1, S), the given ones first.
        """
        poses, states = [pose], [state]
        for n in range(command.shape[1]):
            now = command[:, n]
            middle = self.respond(state, now, period / 2.0)
            pose = geometry.compose(pose, geometry.exp(self.twist(middle, now) * period))
            state = self.respond(state, now, period)
            poses.append(pose)
            states.append(state)
        return np.stack(poses, axis=1), np.stack(states, axis=1)


def expected_motion(spec: RobotSpec) -> ExpectedMotion:
    """Returns the motion of a robot's textbook kinematics, else its `cmd_vel` as body twist.

    Raises:
        ConfigError: the spec names no textbook, and a command is not part of a twist.
    """
    if spec.textbook is not None:
        book = textbook(spec)
        return ExpectedMotion(
            len(spec.state),
            lambda state, command, t: book.respond(state, book.target(command), t),
            lambda state, _: book.twist(state),
        )
    for command in spec.command:
        if not command.is_twist:
            raise ConfigError(
                f"robot {spec.name!r}: where {command.name!r} in {command.unit} leads can't be "
                "predicted; add `textbook:` and its `parameters:` to the robot's YAML file."
            )
    return ExpectedMotion(
        len(spec.state), lambda state, *_: state, lambda _, command: spec.to_cmd_vel(command)
    )
