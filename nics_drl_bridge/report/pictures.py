"""Pictures of trajectories, drives, trainings, policies and worlds, as PNG."""

from collections.abc import Iterable, Mapping, Sequence
from itertools import chain, zip_longest
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Rectangle

from nics_drl_bridge.env.rendering import draw_robot, draw_world
from nics_drl_bridge.geometry import Array
from nics_drl_bridge.lidar.exact_kernels import RADIUS, X, Y
from nics_drl_bridge.policy.evaluation import Episode
from nics_drl_bridge.policy.shadow import Shadow
from nics_drl_bridge.recording.excite import Pattern
from nics_drl_bridge.robot.spec import RobotSpec
from nics_drl_bridge.sim.scenes import Scene, SceneSampler, member_of
from nics_drl_bridge.sim.world import Motion, Patrol, World
from nics_drl_bridge.sim.world_set import AnyWorld
from nics_drl_bridge.style import (
    DARK,
    GOAL,
    GREEN,
    MEASURED,
    MEASURED_LINE,
    MODEL,
    MODEL_LINE,
    OTHER,
    Panel,
    apply_style,
    make_panels,
    render_png,
)

LINES: tuple[dict[str, Any], ...] = (
    MEASURED_LINE | {"linewidth": 3.5},
    MODEL_LINE | {"linestyle": "--"},
    MODEL_LINE | {"linestyle": ":", "color": GREEN},
)
# Sides of the pictures of a square world, and of an episode [inch]
WORLD_SIDE = 7.0
EPISODE_SIDE = 4.0
# Bounds of the size of any world's picture [inch]
LEAST_WIDTH = 2.4
GREATEST_WIDTH = 12.5
LEAST_HEIGHT = 1.2
GREATEST_HEIGHT = 9.0
WORLD_MARGIN = 0.03  # around a world, as a fraction of its longer side
CURVE_PANEL = Panel(4.0, 3.0, left=1.1)  # for the curves on the page of a demo


class View(NamedTuple):
    """The part of a plane that a panel shows, and the panel's size."""

    low: Array  # (2,) minimum x and y [m]
    high: Array  # (2,) maximum x and y [m]
    panel: Panel  # with the same proportions

    def show(self, axes: Axes) -> None:
        """Shows this part in axes with equal scales."""
        axes.set(xlim=(self.low[0], self.high[0]), ylim=(self.low[1], self.high[1]))
        axes.set(aspect="equal", xlabel="x [m]", ylabel="y [m]")


def make_view(low: Array, high: Array, side: float) -> View:
    """Returns the view of a field between two corners (2,) [m].

    The panel has the field's proportions and the area of a square with side `side` [inch], so a
    corridor is flat and a shaft is tall. A panel that would exceed the bounds of a picture is
    smaller. If it would then be too thin, it shows more than the field.
    """
    margin = WORLD_MARGIN * (high - low).max()
    size = high - low + 2.0 * margin
    proportion = np.sqrt(size[0] / size[1])
    wished = side * np.array([proportion, 1.0 / proportion])
    wished *= min(1.0, GREATEST_WIDTH / wished[0], GREATEST_HEIGHT / wished[1])
    panel = np.maximum(wished, [LEAST_WIDTH, LEAST_HEIGHT])
    shown = panel * (size / wished).max()
    centre = (low + high) / 2.0
    return View(centre - shown / 2.0, centre + shown / 2.0, Panel(*panel.tolist()))


def _make_view_of_episodes(world: AnyWorld, episodes: Iterable[Episode]) -> View:
    """Returns the view of a world that also contains the paths of some episodes."""
    corners = np.reshape(world.extent, (2, 2))
    paths = [episode.path[:, :2] for episode in episodes]
    points = np.concatenate([corners, *paths])
    return make_view(np.nanmin(points, axis=0), np.nanmax(points, axis=0), EPISODE_SIDE)


def draw_trajectories(
    runs: Mapping[str, Sequence[Episode | None]], world: AnyWorld, footprint: float
) -> bytes:
    """Draws a panel per seed with the path of each run (the paper's Fig. 7).

    The runs have the same seeds in the same order; None stands for one that was not driven.
    """
    every_episode = filter(None, chain.from_iterable(runs.values()))
    view = _make_view_of_episodes(world, every_episode)
    by_seed: list[dict[str, Episode]] = []
    for episodes in zip_longest(*runs.values()):
        driven = zip(runs, episodes, strict=True)
        by_seed.append(
            {name: episode for name, episode in driven if episode is not None}
        )
    columns = min(len(by_seed), max(1, int(GREATEST_WIDTH / view.panel.width)))
    figure, grid = make_panels(-(-len(by_seed) // columns), columns)
    for axes, episodes_of_seed in zip(grid, by_seed, strict=False):
        _draw_panel(axes, episodes_of_seed, world, footprint, view)
    return render_png(figure, grid[0], view.panel)


def _draw_panel(
    axes: Axes,
    episodes: Mapping[str, Episode],
    world: AnyWorld,
    footprint: float,
    view: View,
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
    view.show(axes)


@apply_style()
def drive_picture(pattern: Pattern, spec: RobotSpec) -> bytes:
    """Draws the expected path within its bounding circle, and each command over time."""
    rows = len(spec.command)
    figure = Figure(figsize=(11.0, 5.5), layout="constrained")
    grid = figure.add_gridspec(rows, 2, width_ratios=(1.0, 1.2))
    path = figure.add_subplot(grid[:, 0])
    origin = (0.0, 0.0)
    bound = Circle(
        origin, pattern.bound, fill=False, color=MODEL, linestyle="--", label="bound"
    )
    path.add_patch(bound)
    robot = Circle(
        origin, pattern.footprint, color=GREEN, alpha=0.5, label="robot at the start"
    )
    path.add_patch(robot)
    path.plot(*pattern.pose[:, :2].T, color=MEASURED, linewidth=1.0, label="path")
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
    return render_png(figure)


class Point(NamedTuple):
    """Progress of a training: fractions of the last 1000 episodes, NaN before the first ended."""

    steps: int
    success: float
    collision: float


def draw_training_curve(points: Sequence[Point]) -> bytes:
    """Draws success and collisions [%] over the environment steps."""
    figure, (axes,) = make_panels(1, 1)
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
    return render_png(figure, panel=CURVE_PANEL)


def draw_shadow(shadow: Shadow) -> bytes:
    """Draws each command over time, as driven and as chosen by the policy."""
    count = len(shadow.names)
    figure, grid = make_panels(
        count, 2, (11.0, 2.4 * count + 0.6), width_ratios=(4.0, 1.0)
    )
    for c, (wide, narrow) in enumerate(zip(grid[::2], grid[1::2], strict=True)):
        driven = shadow.driven[:, c]
        wanted = shadow.policy[:, c]
        for label, value, line in (
            ("driven", driven, MEASURED_LINE),
            ("policy", wanted, MODEL_LINE),
        ):
            wide.step(shadow.time, value, where="post", label=label, **line)
        wide.set_ylabel(f"{shadow.names[c]} [{shadow.units[c]}]")
        narrow.hist(wanted - driven, bins=31, color=OTHER)
        narrow.set_xlabel(f"policy less driven [{shadow.units[c]}]")
    grid[-2].set_xlabel("time [s]")
    return render_png(figure, grid[0])


def _draw_regions(axes: Any, world: World) -> None:
    """Draws the regions of starts and goals."""
    for kind, places, colour in (
        ("starts", world.starts, GREEN),
        ("goals", world.goals, GOAL),
    ):
        for number, (x1, y1, x2, y2) in enumerate(places.regions if places else ()):
            area = Rectangle(
                (x1, y1),
                x2 - x1,
                y2 - y1,
                facecolor=(colour, 0.12),
                edgecolor=colour,
                ls="--",
                label=None if number else f"region of {kind}",
                zorder=0.5,
            )
            axes.add_patch(area)


def draw_seeded_world(
    world: World,
    footprint: float,
    seed: int,
    outline: Sequence[tuple[float, float]] | None = None,
) -> bytes:
    """Draws a world at the start of the episode with a seed.

    Args:
        world: the world.
        footprint: radius of the robot [m].
        seed: of the scene.
        outline: corners (V, 2) of the robot [m] if it is not round.

    Raises:
        ConfigError: the world has no room for the robot, or for the scene.
    """
    sampler = SceneSampler(world, footprint)
    scene = sampler.draw([seed])[0]
    low, high = np.array(world.extent).reshape(2, 2)
    view = make_view(low, high, WORLD_SIDE)
    figure, (axes,) = make_panels(1, 1)
    draw_world(axes, world, scene.bodies)
    _draw_regions(axes, world)
    _draw_movers(axes, sampler.motions[0], scene)
    _draw_start_and_goal(axes, scene, footprint, outline)
    view.show(axes)
    width, height = high - low
    count = np.count_nonzero(scene.bodies[:, RADIUS])
    about = f"{width:.3g} m x {height:.3g} m, {count} obstacles, seed {seed}"
    axes.set_title(f"{world.name}: {about}")
    return render_png(figure, axes, view.panel)


def _draw_start_and_goal(
    axes: Axes,
    scene: Scene,
    footprint: float,
    outline: Sequence[tuple[float, float]] | None,
) -> None:
    """Draws the robot at its start, and its goal."""
    draw_robot(
        axes,
        scene.starts[0],
        footprint,
        outline,
        zorder=4.0,
        facecolor=MEASURED,
        edgecolor=DARK,
        label="robot at its start",
    )
    x, y = scene.goals[0]
    look: dict[str, Any] = {"marker": "*", "color": GOAL, "edgecolor": DARK}
    axes.scatter(x, y, s=320, zorder=5, label="goal", **look)


def _draw_movers(axes: Axes, motions: Sequence[Motion | None], scene: Scene) -> None:
    """Draws rings around moving obstacles, and the paths of those that patrol."""
    moving = [k for k, m in enumerate(motions) if m and scene.bodies[k, RADIUS] > 0.0]
    for number, k in enumerate(moving):
        x, y, radius = scene.bodies[k, [X, Y, RADIUS]]
        label = None if number else "moves"
        ring = Circle(
            (x, y), radius, fill=False, edgecolor=MODEL, linewidth=2.0, label=label
        )
        axes.add_patch(ring)
    patrols = [m for m in dict.fromkeys(motions) if isinstance(m, Patrol)]
    for number, patrol in enumerate(patrols):
        path = np.array([*patrol.waypoints, *patrol.waypoints[: int(patrol.loop)]])
        label = None if number else "its path"
        axes.plot(*path.T, color=MODEL, linewidth=1.2, linestyle=":", label=label)
