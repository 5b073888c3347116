"""Exploration: commands that show a robot's whole motion and keep it within a space.

A drive is a row of segments. At the end of each, the next is drawn at random: new levels for
some of the commands, reached smoothly. A segment is taken only if the predicted path stays
within the space, and if from its end the robot can still turn back. Levels that were visited
least are preferred, so that each command varies over its whole range, independently of the
others, and ends from which a way leads to the centre.
"""

from __future__ import annotations

from itertools import product

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge import geometry
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.kinematics.pattern import Pattern, Space
from nics_drl_bridge.kinematics.prediction import PERIOD_S, Motion
from nics_drl_bridge.kinematics.spec import RobotSpec

Array = NDArray[np.float64]

STILL_S = 2.0
RAMP_S = 0.25
SEGMENT_S = (0.4, 1.2)
CANDIDATES = 24
REDRAWN = 0.6
"""Probability that a segment changes a command."""
BINS = 4
CENTRED = 2.0
"""What nearness to the centre weighs against the novelty of a command."""
MARGIN_M, REACTION_S, TOLERANCE_M = 0.05, 0.1, 0.005
"""The path keeps this far inside, and what the robot drives in this time at its fastest."""
ESCAPE_SHARE = 0.5
"""Speed at which the robot turns back, as a share of the greatest."""
ESCAPE_S = (3.0, 20.0)
NEAR, NEARER = 0.25, 0.6
"""A way back has to begin within this share of the space's shorter half, or end at this share of
its first distance from the centre, or turn half round."""
SLOWER = (1.0, 0.75, 0.5, 0.35, 0.25)
SHORTEST_S = 10.0
COVERED, ALIKE = 0.6, 0.4
"""Share of its range that each command has to cover; greatest correlation of two."""
ATTEMPTS = 3


class Exploration:
    """Gives a robot's commands, one per period, and follows where it goes.

    Args:
        spec: the robot.
        motion: predicts where commands lead, in steps of `period`.
        space: to keep within.
        duration: of the drive [s], with 2 s of standing at both ends.
        rng: draws the segments.
        slower: share of the greatest speeds to use.
        period: between commands [s].
    """

    def __init__(
        self,
        spec: RobotSpec,
        motion: Motion,
        space: Space,
        duration: float,
        rng: np.random.Generator,
        slower: float = 1.0,
        period: float = PERIOD_S,
    ) -> None:
        self._motion, self._space, self._period, self._rng = motion, space, period, rng
        linear = np.array([c.cmd_vel != "angular.z" for c in spec.command])
        factor = np.where(linear, slower, 1.0)
        self.low, self.high = factor * spec.command_low, factor * spec.command_high
        self._rest = np.clip(np.zeros(len(spec.command)), self.low, self.high)
        self.ticks, self._still = round(duration / period), round(STILL_S / period)
        self._visits = np.full((BINS,) * len(spec.command), 1.0 / BINS)
        self._tick, self._queue = 0, np.zeros((0, len(spec.command)))
        self._command, self.pose, self._state = self._rest, np.zeros(3), np.zeros(len(spec.state))
        self._seen, self._then = self.pose, self.pose
        fastest = np.hypot(*spec.to_cmd_vel(np.maximum(-self.low, self.high))[:2])
        self._radius = spec.footprint_radius
        self.keep = self._radius + MARGIN_M + REACTION_S * float(fastest)
        self._escapes = self._ways_back(np.where(linear, ESCAPE_SHARE, 1.0))

    @property
    def done(self) -> bool:
        """Whether the drive is over."""
        return self._tick >= self.ticks

    def see(self, pose: Array) -> None:
        """Takes notice of where the robot is: pose (3,) seen from the start."""
        self._seen, self._then = np.asarray(pose, dtype=np.float64), self.pose

    def next(self) -> Array:
        """The command (C,) for the period that begins now."""
        if self._tick < self._still or self.done:
            command = self._rest
        else:
            if len(self._queue) == 0:
                self._arrive()
                self._queue = self._segment()
            command, self._queue = np.asarray(self._queue[0]), self._queue[1:]
        self._follow(command)
        return command

    def _arrive(self) -> None:
        """Corrects the prediction by what was seen last."""
        self.pose = geometry.compose(self._seen, geometry.between(self._then, self.pose))
        self._seen = self._then = self.pose

    def _follow(self, command: Array) -> None:
        poses, states = self._motion(self.pose[None], self._state[None], command[None, None])
        self.pose, self._state, self._command = poses[0, -1], states[0, -1], command
        self._visits[self._cells(command)] += 1.0
        self._tick += 1

    def _cells(self, command: Array) -> tuple[NDArray[np.intp], ...]:
        """The cell of commands (..., C), by dimension."""
        share = (command - self.low) / (self.high - self.low)
        return tuple(np.moveaxis(np.clip((share * BINS).astype(np.intp), 0, BINS - 1), -1, 0))

    def _segment(self) -> Array:
        """Commands (T, C) up to the next decision."""
        left = self.ticks - self._still - self._tick
        ramp = round(RAMP_S / self._period)
        if left <= ramp:
            return np.asarray(self._towards(self._rest[None], left + self._still)[0])
        length = round(self._rng.uniform(*SEGMENT_S) / self._period)
        length = max(1, min(length, left - ramp))
        levels = self._candidates()
        commands = self._towards(levels, length)
        poses, states = self._roll(commands)
        # Where the robot came a little too far out, it may go on, but not farther out.
        limit = max(0.0, float(self._space.excess(self.pose, self.keep))) + TOLERANCE_M
        allowed = np.flatnonzero(self._space.excess(poses, self.keep).max(axis=1) <= limit)
        if len(allowed) > 0:
            familiar = self._visits[self._cells(levels[allowed])] / self._visits.mean()
            nearest = self._way_to_centre(poses[allowed, -1], states[allowed, -1], limit)
            score = familiar + CENTRED * nearest
            if np.isfinite(score).any():
                return np.asarray(commands[allowed[int(np.argmin(score))]])
        return self._least_harm(length)

    def _candidates(self) -> Array:
        """Levels (K, C) at random."""
        size = (CANDIDATES, len(self.low))
        fresh = self._rng.uniform(self.low, self.high, size)
        changed = self._rng.random(size) < REDRAWN
        changed[np.arange(CANDIDATES), self._rng.integers(size[1], size=CANDIDATES)] = True
        return np.where(changed, fresh, self._command)

    def _towards(self, levels: Array, length: int) -> Array:
        """Commands (K, T, C) that go smoothly from the present one to levels (K, C)."""
        ramp = max(1, round(RAMP_S / self._period))
        share = (1.0 - np.cos(np.pi * np.minimum(np.arange(1, length + 1) / ramp, 1.0))) / 2.0
        return np.asarray(self._command + share[None, :, None] * (levels - self._command)[:, None])

    def _roll(self, commands: Array) -> tuple[Array, Array]:
        """Poses and states that commands (K, T, C) lead through from here."""
        many = len(commands)
        return self._motion(
            np.repeat(self.pose[None], many, 0), np.repeat(self._state[None], many, 0), commands
        )

    def _ways_back(self, factor: Array) -> Array:
        """Constant commands (E, T, C) that may turn the robot, long enough for half a turn."""
        low, high = factor * self.low, factor * self.high
        ends = [sorted({a, r, b}) for a, r, b in zip(low, self._rest, high, strict=True)]
        ways = np.array(list(product(*ends)))[:, None]
        first, last = round(ESCAPE_S[0] / self._period), round(1.0 / self._period)
        heading = np.unwrap(self._roll(np.repeat(ways, first, axis=1))[0][..., 2], axis=1)
        turned = float(np.abs(heading[:, -1] - heading[:, -1 - last]).max())
        needed = float(np.clip(np.pi / max(turned, 1e-6) + 1.0, *ESCAPE_S))
        return np.repeat(ways, round(needed / self._period), axis=1)

    def _way_to_centre(self, pose: Array, state: Array, limit: float) -> Array:
        """How near the centre ways back lead from poses (K, 3), as a share of the shorter half.

        Infinite where none keeps within a limit and turns the robot half round, or brings it
        back.
        """
        ways = len(self._escapes)
        poses, _ = self._motion(
            np.repeat(pose, ways, 0),
            np.repeat(state, ways, 0),
            np.tile(self._escapes, (len(pose), 1, 1)),
        )
        inside = self._space.excess(poses, self.keep).max(axis=1) <= limit
        turned = np.abs(np.unwrap(poses[..., 2], axis=1) - poses[:, :1, 2]).max(axis=1) >= np.pi
        away = np.hypot(poses[..., 0], poses[..., 1])
        half = min(self._space.length, self._space.width) / 2.0
        back = (away.min(axis=1) < NEARER * away[:, 0]) | (away[:, 0] < NEAR * half)
        useful = (inside & (turned | back)).reshape(len(pose), ways).any(axis=1)
        reached = np.where(inside, away.min(axis=1), np.inf).reshape(len(pose), ways).min(axis=1)
        return np.where(useful, reached / half, np.inf)

    def _least_harm(self, length: int) -> Array:
        """The way back that leads farthest in, of those that keep the body within the space."""
        poses, _ = self._roll(self._escapes)
        outside = np.maximum(self._space.excess(poses, self._radius).max(axis=1), 0.0)
        end = self._space.excess(poses[:, -1])
        best = np.lexsort((end, np.round(outside, 2)))[0]
        return np.asarray(self._towards(self._escapes[[best], 0], length)[0])


def plan(
    spec: RobotSpec,
    motion: Motion,
    space: Space,
    duration: float,
    seed: int = 0,
    period: float = PERIOD_S,
) -> Pattern:
    """A drive that varies every command and keeps within the space, by prediction.

    Speeds are reduced, down to a quarter, as far as the space asks for.

    Raises:
        ConfigError: the space is too small, or the drive too short.
    """
    if not duration >= SHORTEST_S:
        raise ConfigError(f"--duration {duration:g}: must be {SHORTEST_S:g} s or more.")
    for slower in SLOWER:
        for attempt in range(ATTEMPTS):
            rng = np.random.default_rng([seed, attempt])
            drive = Exploration(spec, motion, space, duration, rng, slower, period)
            pattern = _driven(drive, space, slower, period)
            outside = space.excess(pattern.pose, spec.footprint_radius).max() > 0.0
            if not outside and _varied(pattern.command, drive):
                return pattern
    raise ConfigError(
        f"--space {space.length:g}x{space.width:g}: too small for robot {spec.name!r} to show all "
        "of its motion in it, also at a quarter of its speed; give it more space, or more time."
    )


def _driven(drive: Exploration, space: Space, slower: float, period: float) -> Pattern:
    """The whole drive, as predicted."""
    commands, poses = [], []
    while not drive.done:
        poses.append(drive.pose)
        commands.append(drive.next())
    t = period * np.arange(len(poses), dtype=np.float64)
    return Pattern(t, np.array(commands), np.array(poses), space, slower)


def _varied(command: Array, drive: Exploration) -> bool:
    """Whether every command covers its range, none of them following another."""
    low, high = np.percentile(command, (2, 98), axis=0)
    if ((high - low) < COVERED * (drive.high - drive.low)).any():
        return False
    alike = np.corrcoef(command, rowvar=False).reshape(command.shape[1], -1)
    return bool((np.abs(alike - np.eye(len(alike))) < ALIKE).all())
