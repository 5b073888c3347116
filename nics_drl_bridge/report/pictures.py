"""Pictures of trajectories in their worlds.

Picture of a planned drive: its path, its bounds, its commands.

Picture of a training: success and collision rates of its episodes over the steps.

Picture of a policy in shadow mode.
"""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from nics_drl_bridge.env.rendering import draw_world
from nics_drl_bridge.policy.evaluation import Episode
from nics_drl_bridge.policy.shadow import Shadow
from nics_drl_bridge.recording.excite import Pattern
from nics_drl_bridge.report.page import MEASURED, MODEL, png
from nics_drl_bridge.robot.spec import RobotSpec
from nics_drl_bridge.sim.world import World

LINES: tuple[dict[str, Any], ...] = (
    {"color": "#1f6fb2", "linewidth": 3.5, "alpha": 0.55},
    {"color": "#d1495b", "linewidth": 1.4, "linestyle": "--"},
    {"color": "#2f855a", "linewidth": 1.4, "linestyle": ":"},
)
LEAST_WIDTH = 5.5


def trajectories(runs: Mapping[str, Sequence[Episode]], world: World, footprint: float) -> bytes:
    """Draws one panel per episode with the paths of all runs (the paper's Fig. 7).

    Args:
        runs: name -> episodes, the same seeds in each.
        world: the world of the episodes.
        footprint: radius of the robot [m].

    Returns:
        A PNG.
    """
    names = list(runs)
    count = max(len(episodes) for episodes in runs.values())
    columns = min(count, 3)
    rows = -(-count // columns)
    figure = Figure(
        figsize=(max(4.2 * columns, LEAST_WIDTH), 4.2 * rows + 0.5), layout="constrained"
    )
    grid = figure.subplots(rows, columns, squeeze=False).ravel()
    for axes, *episodes in zip(grid, *runs.values(), strict=False):
        _panel(axes, dict(zip(names, episodes, strict=True)), world, footprint)
    for axes in grid[count:]:
        axes.set_axis_off()
    handles, labels = grid[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=len(labels), frameon=False)
    return _png(figure)


def _panel(axes: Axes, episodes: Mapping[str, Episode], world: World, footprint: float) -> None:
    first = next(iter(episodes.values()))
    draw_world(axes, world, first.bodies)
    axes.add_patch(Circle(tuple(first.goal), 0.3, color="#f2c14e", alpha=0.7, label="goal"))
    axes.add_patch(
        Circle(tuple(first.path[0, :2]), footprint, fill=False, color="#333333", label="start")
    )
    for line, (name, episode) in zip(LINES, episodes.items(), strict=False):
        axes.plot(episode.path[:, 0], episode.path[:, 1], label=name, **line)
    results = ", ".join(dict.fromkeys(episode.result for episode in episodes.values()))
    axes.set_title(f"seed {first.seed}: {results}", fontsize=10)
    axes.set_aspect("equal")
    axes.set_xlabel("x [m]")
    axes.set_ylabel("y [m]")


def _png(figure: Figure) -> bytes:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    return buffer.getvalue()


PATH, EDGE, START = "#1f6fb2", "#d1495b", "#2f855a"


def drive_picture(pattern: Pattern, spec: RobotSpec) -> bytes:
    """Draws the expected path within its bounding circle, and each command over time.

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


@dataclass(frozen=True)
class Point:
    """Progress of a training at one time.

    Attributes:
        steps: environment steps done.
        success, collision: shares of the last 1000 episodes; NaN before the first has ended.
    """

    steps: int
    success: float
    collision: float


def training_curve(points: Sequence[Point]) -> bytes:
    """Draws success and collisions [%] over the environment steps, as a PNG."""
    figure = Figure(figsize=(7.5, 3.8), layout="constrained")
    axes = figure.subplots()
    steps = [point.steps / 1e3 for point in points]
    for name, color in (("success", MEASURED), ("collision", MODEL)):
        shares = [100.0 * getattr(point, name) for point in points]
        axes.plot(steps, shares, color=color, linewidth=2.0, label=name)
    axes.set_xlabel("environment steps [thousands]")
    axes.set_ylabel("of the last 1000 episodes [%]")
    axes.set_ylim(0.0, 100.0)
    axes.set_xlim(left=0.0)
    axes.grid(alpha=0.3)
    axes.legend(frameon=False)
    return png(figure)


DRIVEN, POLICY, GAP = "#1f6fb2", "#d1495b", "#777777"


def shadow_picture(shadow: Shadow) -> bytes:
    """Draws each command over time, as driven and as chosen by the policy.

    Args:
        shadow: the policy compared with the drive.

    Returns:
        A PNG.
    """
    count = len(shadow.names)
    figure = Figure(figsize=(11.0, 2.4 * count + 0.6), layout="constrained")
    grid = figure.subplots(count, 2, squeeze=False, width_ratios=(4.0, 1.0))
    for c, (wide, narrow) in enumerate(grid):
        driven, wanted = shadow.driven[:, c], shadow.policy[:, c]
        wide.step(shadow.time, driven, where="post", color=DRIVEN, linewidth=1.6, label="driven")
        wide.step(shadow.time, wanted, where="post", color=POLICY, linewidth=1.0, label="policy")
        wide.set_ylabel(f"{shadow.names[c]} [{shadow.units[c]}]")
        narrow.hist(wanted - driven, bins=31, color=GAP)
        narrow.set_xlabel(f"policy less driven [{shadow.units[c]}]")
    grid[-1][0].set_xlabel("time [s]")
    handles, labels = grid[0][0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=2, frameon=False)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    return buffer.getvalue()
