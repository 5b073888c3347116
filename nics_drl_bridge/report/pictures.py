"""Pictures of trajectories, drives, trainings, policies and worlds, each a PNG."""

from collections.abc import Mapping, Sequence
from dataclasses import astuple
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Rectangle

from nics_drl_bridge.env.rendering import draw_robot, draw_world
from nics_drl_bridge.lidar.exact_kernels import RADIUS, X, Y
from nics_drl_bridge.policy.evaluation import ConfidenceInterval, Episode
from nics_drl_bridge.policy.shadow import Shadow
from nics_drl_bridge.recording.excite import Pattern
from nics_drl_bridge.robot.spec import RobotSpec
from nics_drl_bridge.sim.obstacles import Motion, Patrol
from nics_drl_bridge.sim.scenes import Scene, SceneSampler, member_of
from nics_drl_bridge.sim.world import World
from nics_drl_bridge.sim.world_set import AnyWorld
from nics_drl_bridge.style import (
    DARK,
    GOAL,
    GREEN,
    MEASURED,
    MODEL,
    OTHER,
    panels,
    png,
    styled,
)

LINES: tuple[dict[str, Any], ...] = (
    {"color": MEASURED, "linewidth": 3.5, "alpha": 0.55, "linestyle": "-"},
    {"color": MODEL, "linewidth": 1.4, "linestyle": "--"},
    {"color": GREEN, "linewidth": 1.4, "linestyle": ":"},
)
# of the pictures of a world, and of an episode [inch]
LEAST_WIDTH = 5.5
LEAST_PANEL = 4.6
WORLD_SIDE = 7.5  # the longer side of a world's picture [inch]


def trajectories(
    runs: Mapping[str, Sequence[Episode]], world: AnyWorld, footprint: float
) -> bytes:
    """Draws a panel per episode with its path in each run, of equal seeds (the paper's Fig. 7)."""
    count = max(len(episodes) for episodes in runs.values())
    columns = min(count, 3)
    rows = -(-count // 3)
    figure, grid = panels(
        rows, columns, (max(4.2 * columns, LEAST_PANEL), 4.2 * rows + 0.5)
    )
    for axes, *episodes in zip(grid, *runs.values(), strict=False):
        _panel(axes, dict(zip(runs, episodes, strict=True)), world, footprint)
    return png(figure, grid[0])


def _panel(
    axes: Axes, episodes: Mapping[str, Episode], world: AnyWorld, footprint: float
) -> None:
    first = next(iter(episodes.values()))
    draw_world(axes, world, first.bodies, member_of(world, first.seed))
    axes.add_patch(Circle(tuple(first.goal), 0.3, color=GOAL, alpha=0.7, label="goal"))
    start = Circle(
        tuple(first.path[0, :2]), footprint, fill=False, color=DARK, label="start"
    )
    axes.add_patch(start)
    for line, (name, episode) in zip(LINES, episodes.items(), strict=False):
        axes.plot(episode.path[:, 0], episode.path[:, 1], label=name, **line)
    results = ", ".join(dict.fromkeys(episode.result for episode in episodes.values()))
    axes.set_title(f"seed {first.seed}: {results}")
    axes.set(aspect="equal", xlabel="x [m]", ylabel="y [m]")


@styled()
def drive_picture(pattern: Pattern, spec: RobotSpec) -> bytes:
    """Draws the expected path within its bounding circle, and each command over time."""
    rows = len(spec.command)
    figure = Figure(figsize=(11.0, 5.5), layout="constrained")
    grid = figure.add_gridspec(rows, 2, width_ratios=(1.0, 1.2))
    path = figure.add_subplot(grid[:, 0])
    robot = {"color": GREEN, "alpha": 0.5, "label": "robot at the start"}
    bound = {"fill": False, "color": MODEL, "linestyle": "--", "label": "bound"}
    path.add_patch(Circle((0.0, 0.0), pattern.bound, **bound))
    path.add_patch(Circle((0.0, 0.0), pattern.footprint, **robot))
    path.plot(
        pattern.pose[:, 0],
        pattern.pose[:, 1],
        color=MEASURED,
        linewidth=1.0,
        label="path",
    )
    path.set(
        aspect="equal", xlabel="x, ahead of the robot [m]", ylabel="y, to its left [m]"
    )
    path.legend(loc="upper right")
    t = pattern.period * np.arange(len(pattern.command))
    for row, command in enumerate(spec.command):
        axes = figure.add_subplot(grid[row, 1])
        axes.step(
            t, pattern.command[:, row], where="post", color=MEASURED, linewidth=1.0
        )
        for limit in (command.min, command.max):
            axes.axhline(limit, color=MODEL, linewidth=0.8, linestyle="--")
        axes.set_ylabel(f"{command.name}\n[{command.unit}]")
    axes.set_xlabel("time [s]")
    return png(figure)


class Point(NamedTuple):
    """Progress of a training: shares of the last 1000 episodes, NaN before the first has ended."""

    steps: int
    success: float
    collision: float


def training_curve(points: Sequence[Point]) -> bytes:
    """Draws success and collisions [%] over the environment steps."""
    figure, (axes,) = panels(1, 1, (5.2, 3.6))
    steps, *shares = np.array(points, np.float64).T
    for name, share, line in zip(
        ("success", "collision"), shares, ("-", "--"), strict=True
    ):
        axes.plot(steps / 1e3, 100.0 * share, line, linewidth=2.0, label=name)
    axes.set(
        xlabel="environment steps [thousands]", ylabel="of the last 1000 episodes [%]"
    )
    axes.set_ylim(0.0, 100.0)
    axes.set_xlim(left=0.0)
    axes.legend()
    return png(figure)


def robustness(shares: Mapping[str, ConfidenceInterval]) -> bytes:
    """Draws success [%] with its interval, by what was perturbed."""
    figure, (axes,) = panels(1, 1, (5.2, 3.6))
    value, low, high = 100.0 * np.array([astuple(share) for share in shares.values()]).T
    names = [name.replace("_", " ") for name in shares]
    ends = (value - low, high - value)
    axes.errorbar(value, names, xerr=ends, fmt="o", color=MODEL, capsize=3.0)
    axes.invert_yaxis()
    axes.set(xlabel="success [%]", xlim=(min(90.0, low.min() - 2.0), 100.5))
    return png(figure)


def shadow_picture(shadow: Shadow) -> bytes:
    """Draws each command over time, as driven and as chosen by the policy."""
    count = len(shadow.names)
    figure, grid = panels(count, 2, (11.0, 2.4 * count + 0.6), width_ratios=(4.0, 1.0))
    for c, (wide, narrow) in enumerate(zip(grid[::2], grid[1::2], strict=True)):
        driven = shadow.driven[:, c]
        wanted = shadow.policy[:, c]
        wide.step(
            shadow.time,
            driven,
            where="post",
            color=MEASURED,
            linewidth=1.6,
            label="driven",
        )
        wide.step(
            shadow.time,
            wanted,
            where="post",
            color=MODEL,
            linewidth=1.0,
            label="policy",
        )
        wide.set_ylabel(f"{shadow.names[c]} [{shadow.units[c]}]")
        narrow.hist(wanted - driven, bins=31, color=OTHER)
        narrow.set_xlabel(f"policy less driven [{shadow.units[c]}]")
    grid[-2].set_xlabel("time [s]")
    return png(figure, grid[0])


def world_picture(
    world: World,
    footprint: float,
    seed: int,
    outline: Sequence[tuple[float, float]] | None = None,
) -> bytes:
    """Draws a world as the episode of a seed finds it.

    Args:
        world: the world.
        footprint: radius of the robot [m].
        seed: of the scene.
        outline: corners (V, 2) of the robot [m], if it is not round.

    Raises:
        ConfigError: the world has no room for the robot, or for the scene.
    """
    sampler = SceneSampler(world, footprint)
    scene = sampler.draw([seed])[0]
    low, high = np.array(world.extent).reshape(2, 2)
    size = high - low
    width, depth = WORLD_SIDE * size / size.max()
    figure, (axes,) = panels(
        1, 1, (max(width, LEAST_WIDTH) + 0.8, max(depth, 1.6) + 1.3)
    )
    draw_world(axes, world, scene.bodies)
    for kind, places, colour in (
        ("starts", world.starts, GREEN),
        ("goals", world.goals, GOAL),
    ):
        for number, (x1, y1, x2, y2) in enumerate(places.regions if places else ()):
            area: dict[str, Any] = {
                "facecolor": (colour, 0.12),
                "edgecolor": colour,
                "ls": "--",
            }
            area["label"] = None if number else f"region of {kind}"
            axes.add_patch(Rectangle((x1, y1), x2 - x1, y2 - y1, zorder=0.5, **area))
    _movers(axes, sampler.motions, scene)
    look: dict[str, Any] = {
        "facecolor": MEASURED,
        "edgecolor": DARK,
        "label": "robot at its start",
    }
    draw_robot(axes, scene.starts[0], footprint, outline, zorder=4.0, **look)
    goal: dict[str, Any] = {
        "marker": "*",
        "markersize": 18,
        "color": GOAL,
        "markeredgecolor": DARK,
    }
    axes.plot(*scene.goals[0], linestyle="none", zorder=5, label="goal", **goal)
    margin = 0.03 * size.max()
    axes.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
    axes.set(
        xlim=(low[0] - margin, high[0] + margin),
        ylim=(low[1] - margin, high[1] + margin),
    )
    count = np.count_nonzero(scene.bodies[:, RADIUS])
    about = f"{size[0]:.3g} m x {size[1]:.3g} m, {count} obstacles, seed {seed}"
    axes.set_title(f"{world.name}: {about}")
    return png(figure, axes)


def _movers(axes: Axes, motions: Sequence[Motion | None], scene: Scene) -> None:
    """Draws rings around obstacles that move, and the ways of those that patrol."""
    moving = [
        k
        for k, motion in enumerate(motions)
        if motion and scene.bodies[k, RADIUS] > 0.0
    ]
    ring: dict[str, Any] = {"fill": False, "edgecolor": MODEL, "linewidth": 2.0}
    for number, k in enumerate(moving):
        x, y, radius = scene.bodies[k, [X, Y, RADIUS]]
        axes.add_patch(
            Circle((x, y), radius, label=None if number else "moves", **ring)
        )
    patrols = [
        motion for motion in dict.fromkeys(motions) if isinstance(motion, Patrol)
    ]
    for number, patrol in enumerate(patrols):
        way = np.array([*patrol.waypoints, *patrol.waypoints[: int(patrol.loop)]])
        label = None if number else "its way"
        axes.plot(*way.T, color=MODEL, linewidth=1.2, linestyle=":", label=label)
