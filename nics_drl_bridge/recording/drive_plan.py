"""DrivePlan: a drive for a recording, from its options to its expected pattern."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.recording.excite import PERIOD_S, Exploration, Pattern
from nics_drl_bridge.robot.spec import RobotSpec
from nics_drl_bridge.seeds import checked_seeds

SHORTEST_S, LONGEST_S = 20.0, 3600.0
SPREAD, ALIKE = 0.17, 0.6
"""Minimum standard deviation of each command as a share of its range (0.29 if uniform); maximum
correlation of two commands."""
ATTEMPTS = 8


@dataclass(frozen=True)
class DrivePlan:
    """Options of a drive.

    Attributes:
        robot: the robot that drives.
        bound: radius of the circle around the start that contains the whole robot [m].
        duration: [s].
        speed: share of the greatest speeds and rates to use.
        seed: of the pattern.

    Raises:
        ConfigError: a value is out of its range.
    """

    robot: RobotSpec
    bound: float = 2.0
    duration: float = 60.0
    speed: float = 1.0
    seed: int = 0

    def __post_init__(self) -> None:
        ranges = {
            "bound": (self.robot.footprint_radius, 1000.0),
            "duration": (SHORTEST_S, LONGEST_S),
            "speed": (0.05, 1.0),
        }
        checked_seeds(self.seed)
        for name, (low, high) in ranges.items():
            value = getattr(self, name)
            if not low <= value <= high:
                raise ConfigError(f"{name} {value:g}: must be from {low:g} to {high:g}.")

    def begin(self) -> Exploration:
        """Returns the previewed drive, at its start.

        Raises:
            ConfigError: the circle is too small for the robot to show its motion in it.
        """
        return self._attempt(self._found[0])

    def preview(self) -> Pattern:
        """Returns the pattern of the drive under the expected motion.

        Raises:
            ConfigError: the circle is too small for the robot to show its motion in it.
        """
        return self._found[1]

    def _attempt(self, number: int) -> Exploration:
        rng = np.random.default_rng([self.seed, number])
        return Exploration(self.robot, self.bound, self.duration, rng, self.speed)

    @cached_property
    def _found(self) -> tuple[int, Pattern]:
        """Number and pattern of the first attempt that varies all commands within the circle."""
        for number in range(ATTEMPTS):
            drive = self._attempt(number)
            if drive.keep_within <= 0.0:
                break
            pattern = _driven(drive, self.bound, self.robot.footprint_radius)
            if pattern is not None and pattern.reach <= self.bound and _varied(pattern, drive):
                return number, pattern
        raise ConfigError(
            f"bound {self.bound:g}: a circle of {self.bound:g} m around the start is too small "
            f"for robot {self.robot.name!r} to show its motion within {self.duration:g} s; give "
            "it more space, less speed, or more time."
        )


def _driven(drive: Exploration, bound: float, footprint: float) -> Pattern | None:
    """Returns the expected pattern of a drive; None if it finds no way back into its circle."""
    poses, commands = [drive.pose], []
    while not drive.done:
        commands.append(drive.next())
        poses.append(drive.pose)
        if drive.stuck:
            return None
    return Pattern(PERIOD_S, np.array(commands), np.array(poses), bound, footprint)


def _varied(pattern: Pattern, drive: Exploration) -> bool:
    """True if every command covers its range and no two are correlated."""
    if (pattern.command.std(axis=0) < SPREAD * (drive.high - drive.low)).any():
        return False
    alike = np.corrcoef(pattern.command, rowvar=False).reshape(len(drive.low), -1)
    return bool((np.abs(alike - np.eye(len(alike))) < ALIKE).all())
