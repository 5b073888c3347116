"""A picture of a drive that is planned: its path, its space, its commands."""

from __future__ import annotations

import io

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from nics_drl_bridge.kinematics.pattern import Pattern
from nics_drl_bridge.kinematics.spec import RobotSpec

PATH, EDGE, START = "#1f6fb2", "#d1495b", "#2f855a"


def drive_picture(pattern: Pattern, spec: RobotSpec) -> bytes:
    """The expected path within its circle, and each command over time.

    Args:
        pattern: of the drive.
        spec: the robot.

    Returns:
        A PNG.
    """
    rows = len(spec.command)
    figure = Figure(figsize=(11.0, 5.5), layout="constrained")
    grid = figure.add_gridspec(rows, 2, width_ratios=(1.0, 1.2))
    _path(figure.add_subplot(grid[:, 0]), pattern)
    t = pattern.period * np.arange(len(pattern.command))
    for row, command in enumerate(spec.command):
        axes = figure.add_subplot(grid[row, 1])
        axes.step(t, pattern.command[:, row], where="post", color=PATH, linewidth=1.0)
        for limit in (command.min, command.max):
            axes.axhline(limit, color=EDGE, linewidth=0.8, linestyle="--")
        axes.set_ylabel(f"{command.name}\n[{command.unit}]", fontsize=8)
    axes.set_xlabel("time [s]")
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    return buffer.getvalue()


def _path(axes: Axes, pattern: Pattern) -> None:
    axes.add_patch(
        Circle((0.0, 0.0), pattern.bound, fill=False, color=EDGE, linestyle="--", label="bound")
    )
    axes.add_patch(
        Circle((0.0, 0.0), pattern.footprint, color=START, alpha=0.5, label="robot at the start")
    )
    axes.plot(pattern.pose[:, 0], pattern.pose[:, 1], color=PATH, linewidth=1.0, label="path")
    axes.set_aspect("equal")
    axes.set_xlabel("x, ahead of the robot [m]")
    axes.set_ylabel("y, to its left [m]")
    axes.legend(fontsize=8, loc="upper right")
