"""Pictures: trajectories in their worlds."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from nics_drl_bridge.env.rendering import draw_world
from nics_drl_bridge.policy.evaluation import Episode
from nics_drl_bridge.sim.world import World

LINES: tuple[dict[str, Any], ...] = (
    {"color": "#1f6fb2", "linewidth": 3.5, "alpha": 0.55},
    {"color": "#d1495b", "linewidth": 1.4, "linestyle": "--"},
    {"color": "#2f855a", "linewidth": 1.4, "linestyle": ":"},
)
LEAST_WIDTH = 5.5


def trajectories(runs: Mapping[str, Sequence[Episode]], world: World, footprint: float) -> bytes:
    """One panel per episode, the paths of all runs in it (the paper's Fig. 7).

    Args:
        runs: name -> episodes, the same seeds in each.
        world: where they were driven.
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
