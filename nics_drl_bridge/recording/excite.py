"""Exploration: commands that show a robot's whole motion and keep it within a circle.

A drive is a row of segments. At the end of each, the next is drawn at random: new levels for
one or more of the commands, reached smoothly and held for a random time (amplitude-modulated
pseudo-random steps; Nelles: Nonlinear System Identification, ch. 21). A segment is taken only if
the expected path stays within the circle, and if from its end the robot can still turn back.
Levels that were used least are preferred, so that each command covers its range independently
of the others, and so are ends from which a way leads near the centre.

Pattern: a drive for a recording as it is expected, before the robot moves.

Prediction: where commands are expected to lead a robot that no model is known of yet.
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
from nics_drl_bridge.recording.textbook import textbook
from nics_drl_bridge.robot.spec import RobotSpec

Array = NDArray[np.float64]

PERIOD_S = 0.05
STILL_S = 1.0
"""The robot stands for so long at both ends of a drive."""
RAMP_S = 0.25
SEGMENT_S = (0.4, 1.6)
CANDIDATES = 12
ALONE, REDRAWN = 0.5, 0.6
"""Probability that a segment changes one command alone; else, that it changes each more one."""
BINS = 4
CENTRED = 2.0
"""What nearness to the centre weighs against the novelty of a command."""
MARGIN_M, REACTION_S, TOLERANCE_M = 0.05, 0.2, 0.005
"""The path keeps this far inside, and what the robot drives in this time at its fastest."""
TURNING_SPEED, TURNING = 0.5, 0.8
"""How the robot turns back, as shares of the greatest commands: less than it could, as a reserve
for a robot that turns worse than expected."""
WAY_S, WAY_STEP_S = (3.0, 20.0), 0.1
NEAR, NEARER = 0.25, 0.6
"""A way back begins within this share of the circle's radius, or ends at this share of its first
distance from the centre, or turns half round."""
LOST = 8


class Exploration:
    """Gives a robot's commands, one per period, and follows where it goes.

    Args:
        spec: the robot.
        bound: radius of the circle around the start that the whole robot keeps within [m].
        duration: of the drive [s], with 1 s of standing at both ends.
        rng: draws the segments.
        speed: share of the greatest speeds and rates to use, above 0, up to 1; angles are used
            whole.
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
        turning = np.array([c.cmd_vel == "angular.z" for c in spec.command])
        self._ways = self._ways_back(np.where(turning, TURNING, TURNING_SPEED))
        self._emergency = self._ways_back(np.where(turning, 1.0, TURNING_SPEED))

    @property
    def done(self) -> bool:
        """Whether the drive is over."""
        return self._tick >= self._ticks

    @property
    def stuck(self) -> bool:
        """Whether the robot has not found a way back for many segments."""
        return self._lost >= LOST

    def see(self, pose: Array) -> None:
        """Takes notice of where the robot is in the present period: (3,) seen from the start."""
        self.pose = geometry.compose(pose, geometry.between(self._before, self.pose))
        self._before, self._seen = np.asarray(pose, dtype=np.float64), True

    def next(self) -> Array:
        """The command (C,) for the period that begins now."""
        if self._tick < self._still or self.done:
            command = self.rest
        else:
            if len(self._queue) == 0 or self._goes_astray():
                self._queue = self._segment()
            command, self._queue = np.asarray(self._queue[0]), self._queue[1:]
        self._follow(command)
        return command

    def _goes_astray(self) -> bool:
        """Whether what was seen since leads the rest of the segment too far out."""
        if not self._seen or self._tick >= self._ticks - self._still:
            return False
        self._seen = False
        return bool(_distance(self._roll(self._queue[None])[0]).max() > self._limit() + MARGIN_M)

    def _limit(self) -> float:
        """How far out the robot may go: where it already is too far, no farther [m]."""
        return max(self.keep_within, float(_distance(self.pose))) + TOLERANCE_M

    def _follow(self, command: Array) -> None:
        poses, states = self._roll(command[None, None])
        self._before, self.pose = self.pose, poses[0, -1]
        self._state, self._command = states[0, -1], command
        self._visits[self._cells(command)] += 1.0
        self._tick += 1

    def _roll(self, commands: Array) -> tuple[Array, Array]:
        """Poses and states that commands (K, T, C) lead through from here."""
        many = len(commands)
        pose, state = np.repeat(self.pose[None], many, 0), np.repeat(self._state[None], many, 0)
        return self._motion.roll(pose, state, commands, PERIOD_S)

    def _cells(self, command: Array) -> tuple[NDArray[np.intp], ...]:
        """The cell of commands (..., C), by dimension."""
        share = (command - self.low) / (self.high - self.low)
        return tuple(np.moveaxis(np.clip((share * BINS).astype(np.intp), 0, BINS - 1), -1, 0))

    def _segment(self) -> Array:
        """Commands (T, C) up to the next decision."""
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
        """Levels (K, C) at random, of one of the commands or of some."""
        size = (CANDIDATES, len(self.low))
        fresh = self._rng.uniform(self.low, self.high, size)
        changed = self._rng.random(size) < (0.0 if alone else REDRAWN)
        changed[:, self._turn % size[1]] = True
        self._turn += 1
        return np.where(changed, fresh, self._command)

    def _best(self, levels: Array, length: int) -> Array | None:
        """Commands (T, C) towards the best of levels (K, C); None if all lead too far out."""
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
        """Commands (K, T, C) that go smoothly from the present one to levels (K, C)."""
        done = np.minimum(np.arange(1, length + 1) / self._ramp, 1.0)
        share = (1.0 - np.cos(np.pi * done)) / 2.0
        return np.asarray(self._command + share[None, :, None] * (levels - self._command)[:, None])

    def _ways_back(self, factor: Array) -> Array:
        """Constant commands (E, T, C), long enough for half a turn by the one that turns best."""
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
        """How near the centre ways back lead from poses (K, 3), as a share of the radius.

        Infinite where none keeps within a limit and turns the robot half round, or brings it
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
        """The way that leads farthest in, of those that keep the robot within the circle."""
        start = np.repeat(self.pose[None], len(self._emergency), 0)
        state = np.repeat(self._state[None], len(self._emergency), 0)
        away = _distance(self._motion.roll(start, state, self._emergency, WAY_STEP_S)[0])
        outside = np.maximum(away.max(axis=1) - self._outermost, 0.0)
        best = np.lexsort((away.min(axis=1), np.round(outside, 2)))[0]
        return np.asarray(self._towards(self._emergency[[best], 0], length)[0])


def _distance(pose: Array) -> Array:
    """Of poses (..., 3) from the start [m]."""
    return np.asarray(np.hypot(pose[..., 0], pose[..., 1]))


@dataclass(frozen=True)
class Pattern:
    """A drive as it is expected; the robot starts at the origin and looks along x.

    Attributes:
        period: how long each command is held [s].
        command: (T, C).
        pose: (T + 1, 3) at the start of each period, and at the end.
        bound: radius of the circle around the start that the whole robot keeps within [m].
        footprint: radius of the robot [m].
    """

    period: float
    command: Array
    pose: Array
    bound: float
    footprint: float

    @property
    def duration(self) -> float:
        """Of the drive [s]."""
        return self.period * len(self.command)

    @property
    def box(self) -> Array:
        """(2, 2) least and greatest x and y [m] that the robot's body reaches."""
        place = self.pose[:, :2]
        return np.array([place.min(axis=0) - self.footprint, place.max(axis=0) + self.footprint])

    @property
    def reach(self) -> float:
        """Greatest distance of the robot's body from the start [m]."""
        return float(np.hypot(*self.pose[:, :2].T).max()) + self.footprint

    @property
    def twist(self) -> Array:
        """(T, 3) mean body twist of each period [m/s, m/s, rad/s]."""
        moved = geometry.log(geometry.between(self.pose[:-1], self.pose[1:]))
        return np.asarray(moved / self.period)

    @property
    def speed(self) -> Array:
        """(T,) speed of each period [m/s]."""
        return np.asarray(np.hypot(*self.twist[:, :2].T))

    def lines(self) -> tuple[str, ...]:
        """What somebody has to know before the robot moves, for people."""
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


TWIST_UNITS = {"linear.x": "m/s", "linear.y": "m/s", "angular.z": "rad/s"}


@dataclass(frozen=True)
class Motion:
    """How a robot is expected to move.

    Attributes:
        size: S of the state.
        respond: the state (K, S) after a command (K, C) was held for some time [s].
        twist: body twist (K, 3) of state (K, S) and command (K, C).
    """

    size: int
    respond: Callable[[Array, Array, float], Array]
    twist: Callable[[Array, Array], Array]

    def roll(self, pose: Array, state: Array, command: Array, period: float) -> tuple[Array, Array]:
        """Where commands lead, by one arc for each at the state in the middle of its period.

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


def expected_motion(spec: RobotSpec) -> Motion:
    """The motion of a robot's textbook kinematics, or that its `cmd_vel` is its body twist.

    Raises:
        ConfigError: it names no textbook, and a command is no part of a twist.
    """
    if spec.textbook is not None:
        book = textbook(spec)
        return Motion(
            len(spec.state),
            lambda state, command, t: book.respond(state, book.target(command), t),
            lambda state, _: book.twist(state),
        )
    for command in spec.command:
        if command.cmd_vel is None or TWIST_UNITS[command.cmd_vel] != command.unit:
            raise ConfigError(
                f"robot {spec.name!r}: where {command.name!r} in {command.unit} leads can't be "
                "predicted; add `textbook:` and its `parameters:` to the robot's YAML file."
            )
    return Motion(
        len(spec.state), lambda state, *_: state, lambda _, command: spec.to_cmd_vel(command)
    )
