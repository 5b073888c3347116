"""Coverage: how well a drive moved each command, told before anything is fitted."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.kinematics.excitation import commands_together, levels, unmoved_variables
from nics_drl_bridge.kinematics.recording import Recording, samples_on_one_clock
from nics_drl_bridge.kinematics.spec import RobotSpec

Array = NDArray[np.float64]

GRID_S = 0.05
ENDS = (2.0, 98.0)
"""Percentiles between which a command is said to have moved."""


@dataclass(frozen=True)
class CommandCoverage:
    """How a drive moved one command.

    Attributes:
        name: of the command.
        unit: its unit.
        low, high: between which it moved, but for 2 % at each end.
        share: of the range that the robot's limits allow.
        own: share of its spread that the other commands do not explain.
        levels: how many different values it took; more than ten count as ten.
        fault: why nothing can be learnt of it; empty if something can.
    """

    name: str
    unit: str
    low: float
    high: float
    share: float
    own: float
    levels: int
    fault: str

    def line(self) -> str:
        """For people."""
        if self.fault:
            return f"{self.name}: {self.fault}"
        return (
            f"{self.name}: moved from {self.low:.2f} to {self.high:.2f} {self.unit} "
            f"({100.0 * self.share:.0f} % of its range), {100.0 * self.own:.0f} % of it on its own"
        )


def coverage(recording: Recording, spec: RobotSpec) -> tuple[CommandCoverage, ...]:
    """How a recording's commands moved, by the rules that a fit judges a drive by.

    Args:
        recording: of the robot.
        spec: the robot.

    Returns:
        One for each command, in the order of the spec.
    """
    t, row = recording.command.t, recording.command.values
    grid = np.arange(t[0], t[-1], GRID_S)
    command = row[np.searchsorted(t, grid, side="right") - 1]
    none = np.zeros((len(grid), 0))
    samples = samples_on_one_clock(grid, np.zeros((len(grid), 3)), none, command)
    stateless = spec.model_copy(update={"state": ()})
    still = unmoved_variables(samples, stateless)
    together = commands_together(samples, stateless)
    count, own = levels(samples, stateless), _own(samples.x)
    low, high = np.percentile(command, ENDS, axis=0)
    share = (high - low) / (spec.command_high - spec.command_low)
    return tuple(
        CommandCoverage(
            c.name, c.unit, float(low[i]), float(high[i]), float(share[i]), float(own[i]),
            count[c.name],
            "never moved" if c.name in still
            else "moved only together with others" if c.name in together
            else "",
        )
        for i, c in enumerate(spec.command)
    )  # fmt: skip


def _own(x: Array) -> Array:
    """Share (C,) of each column's spread that no linear combination of the others explains."""
    centred = x - x.mean(axis=0)
    own = np.zeros(x.shape[1])
    for i, size in enumerate(np.linalg.norm(centred, axis=0)):
        others = np.delete(centred, i, axis=1)
        rest = centred[:, i] - others @ np.linalg.lstsq(others, centred[:, i], rcond=None)[0]
        own[i] = np.linalg.norm(rest) / size if size > 0.0 else 0.0
    return own
