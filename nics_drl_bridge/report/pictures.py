"""Pictures of trajectories, planned drives, trainings and policies in shadow mode, each a PNG."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from nics_drl_bridge.env.rendering import draw_world
from nics_drl_bridge.policy.evaluation import Episode
from nics_drl_bridge.policy.shadow import Shadow
from nics_drl_bridge.recording.excite import Pattern
from nics_drl_bridge.report.page import DARK, MEASURED, MODEL, OTHER, panels, png
from nics_drl_bridge.robot.spec import RobotSpec
from nics_drl_bridge.sim.world import World

GREEN = "#2f855a"
LINES: tuple[dict[str, Any], ...] = (
    {"color": MEASURED, "linewidth": 3.5, "alpha": 0.55},
    {"color": MODEL, "linewidth": 1.4, "linestyle": "--"},
    {"color": GREEN, "linewidth": 1.4, "linestyle": ":"},
)
LEAST_WIDTH = 5.5


def trajectories(runs: Mapping[str, Sequence[Episode]], world: World, footprint: float) -> bytes:
    """Draws one panel per episode with the paths of all runs (the paper's Fig. 7).

    The runs are by name, with the same seeds in each; the footprint is the robot's radius [m].
    """
    count = max(len(episodes) for episodes in runs.values())
    columns, rows = min(count, 3), -(-count // 3)
    size = max(4.2 * columns, LEAST_WIDTH), 4.2 * rows + 0.5
    figure, grid = panels(rows, columns, size)
    for axes, *episodes in zip(grid, *runs.values(), strict=False):
        _panel(axes, dict(zip(runs, episodes, strict=True)), world, footprint)
    return png(figure, grid[0])


def _panel(axes: Axes, episodes: Mapping[str, Episode], world: World, footprint: float) -> None:
    first = next(iter(episodes.values()))
    draw_world(axes, world, first.bodies)
    axes.add_patch(Circle(tuple(first.goal), 0.3, color="#f2c14e", alpha=0.7, label="goal"))
    axes.add_patch(
        Circle(tuple(first.path[0, :2]), footprint, fill=False, color=DARK, label="start")
    )
    for line, (name, episode) in zip(LINES, episodes.items(), strict=False):
        axes.plot(episode.path[:, 0], episode.path[:, 1], label=name, **line)
    results = ", ".join(dict.fromkeys(episode.result for episode in episodes.values()))
    axes.set_title(f"seed {first.seed}: {results}", fontsize=10)
    axes.set(aspect="equal", xlabel="x [m]", ylabel="y [m]")


def drive_picture(pattern: Pattern, spec: RobotSpec) -> bytes:
    """Draws the expected path within its bounding circle, and each command over time."""
    rows = len(spec.command)
    figure = Figure(figsize=(11.0, 5.5), layout="constrained")
    grid = figure.add_gridspec(rows, 2, width_ratios=(1.0, 1.2))
    path = figure.add_subplot(grid[:, 0])
    robot = {"color": GREEN, "alpha": 0.5, "label": "robot at the start"}
    path.add_patch(
        Circle((0.0, 0.0), pattern.bound, fill=False, color=MODEL, linestyle="--", label="bound")
    )
    path.add_patch(Circle((0.0, 0.0), pattern.footprint, **robot))
    path.plot(pattern.pose[:, 0], pattern.pose[:, 1], color=MEASURED, linewidth=1.0, label="path")
    path.set(aspect="equal", xlabel="x, ahead of the robot [m]", ylabel="y, to its left [m]")
    path.legend(fontsize=8, loc="upper right")
    t = pattern.period * np.arange(len(pattern.command))
    for row, command in enumerate(spec.command):
        axes = figure.add_subplot(grid[row, 1])
        axes.step(t, pattern.command[:, row], where="post", color=MEASURED, linewidth=1.0)
        for limit in (command.min, command.max):
            axes.axhline(limit, color=MODEL, linewidth=0.8, linestyle="--")
        axes.set_ylabel(f"{command.name}\n[{command.unit}]", fontsize=8)
    axes.set_xlabel("time [s]")
    return png(figure)


class Point(NamedTuple):
    """Progress of a training: shares of the last 1000 episodes, NaN before the first has ended."""

    steps: int
    success: float
    collision: float


def training_curve(points: Sequence[Point]) -> bytes:
    """Draws success and collisions [%] over the environment steps."""
    figure, (axes,) = panels(1, 1, (7.5, 3.8))
    steps, *shares = np.array(points, np.float64).T
    for name, share, color in zip(("success", "collision"), shares, (MEASURED, MODEL), strict=True):
        axes.plot(steps / 1e3, 100.0 * share, color=color, linewidth=2.0, label=name)
    axes.set(xlabel="environment steps [thousands]", ylabel="of the last 1000 episodes [%]")
    axes.set_ylim(0.0, 100.0)
    axes.set_xlim(left=0.0)
    axes.grid(alpha=0.3)
    axes.legend(frameon=False)
    return png(figure)


def shadow_picture(shadow: Shadow) -> bytes:
    """Draws each command over time, as driven and as chosen by the policy."""
    count = len(shadow.names)
    figure, grid = panels(count, 2, (11.0, 2.4 * count + 0.6), width_ratios=(4.0, 1.0))
    for c, (wide, narrow) in enumerate(zip(grid[::2], grid[1::2], strict=True)):
        driven, wanted = shadow.driven[:, c], shadow.policy[:, c]
        wide.step(shadow.time, driven, where="post", color=MEASURED, linewidth=1.6, label="driven")
        wide.step(shadow.time, wanted, where="post", color=MODEL, linewidth=1.0, label="policy")
        wide.set_ylabel(f"{shadow.names[c]} [{shadow.units[c]}]")
        narrow.hist(wanted - driven, bins=31, color=OTHER)
        narrow.set_xlabel(f"policy less driven [{shadow.units[c]}]")
    grid[-2].set_xlabel("time [s]")
    return png(figure, grid[0])
