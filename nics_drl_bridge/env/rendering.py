"""Top-view pictures of a world, for `render_mode="rgb_array"` and videos."""

from collections.abc import Sequence
from itertools import cycle
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Circle as Disc
from matplotlib.patches import Patch, Rectangle
from matplotlib.patches import Polygon as Outline
from numpy.typing import NDArray

from nics_drl_bridge import geometry
from nics_drl_bridge.env.snapshot import Snapshot, locate_hits
from nics_drl_bridge.generator import SimulatorModel
from nics_drl_bridge.geometry import Array
from nics_drl_bridge.lidar.exact_kernels import HEADING, RADIUS
from nics_drl_bridge.lidar.maps import GridMap
from nics_drl_bridge.lidar.shapes import find_outline
from nics_drl_bridge.sim.world_set import AnyWorld
from nics_drl_bridge.style import DARK, EDGE, GOAL, OTHER, SERIES, VERMILION

SIZE_IN = 5.0
DPI = 100
MARGIN = 0.05
LEAST_SIDE_IN = 1.0  # minimum side of a picture, for long and narrow worlds
WALL = DARK
STANDING = OTHER
SCAN = VERMILION
ROBOTS = tuple(colour for colour in SERIES if colour != SCAN)


class WorldPicture:
    """Picture of a world, redrawn for each snapshot."""

    def __init__(self, model: SimulatorModel, world: AnyWorld) -> None:
        self._model = model
        self._world = world
        low, high = np.array(world.extent).reshape(2, 2)
        metre_in = SIZE_IN / (high - low).max()
        size = np.maximum(metre_in * (high - low), LEAST_SIDE_IN)
        shown = size / metre_in * (1.0 + 2.0 * MARGIN)
        self._low = (low + high - shown) / 2.0
        self._high = (low + high + shown) / 2.0
        width, depth = size.tolist()
        figure = Figure(figsize=(width, depth), dpi=DPI)
        self._canvas: Any = FigureCanvasAgg(figure)
        self._axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))

    def draw(self, shot: Snapshot, trails: Sequence[Array] = ()) -> NDArray[np.uint8]:
        """Returns a snapshot's pixels (H, W, 3), with the robots' past paths (T, 2)."""
        axes = self._axes
        axes.clear()
        axes.set_axis_off()
        axes.set_aspect("equal")
        axes.set_xlim(self._low[0], self._high[0])
        axes.set_ylim(self._low[1], self._high[1])
        draw_world(axes, self._world, shot.bodies, shot.member)
        for goal in shot.goals:
            axes.plot(
                *goal, marker="*", color=GOAL, markersize=16, markeredgecolor=WALL
            )
        for trail, colour in zip(trails, cycle(ROBOTS), strict=False):
            axes.plot(*np.transpose(trail), color=colour, linewidth=1.5)
        robot = self._model.robot
        robots = zip(shot.poses, shot.ranges, cycle(ROBOTS), strict=False)
        for pose, scan, colour in robots:
            hits = locate_hits(self._model.lidar, pose, scan)
            axes.plot(hits[:, 0], hits[:, 1], ".", color=SCAN, markersize=2.0)
            draw_robot(
                axes,
                pose,
                robot.footprint_radius,
                robot.footprint,
                color=colour,
                zorder=1.0,
            )
        self._canvas.draw()
        return np.asarray(self._canvas.buffer_rgba())[..., :3].copy()


def draw_robot(
    axes: Axes,
    pose: Array,
    radius: float,
    outline: Sequence[tuple[float, float]] | None,
    zorder: float,
    **look: Any,
) -> None:
    """Draws a robot, round or with an outline (V, 2) [m], and a line to its front."""
    if outline is None:
        axes.add_patch(Disc((pose[0], pose[1]), radius, zorder=zorder, **look))
    else:
        radius = np.max(outline, axis=0)[0]
        corners = geometry.rotate(outline, pose[2]) + pose[:2]
        axes.add_patch(Outline(corners, closed=True, zorder=zorder, **look))
    front = geometry.compose(pose, (radius, 0.0, 0.0))
    x = (pose[0], front[0])
    y = (pose[1], front[1])
    axes.plot(x, y, color="white", linewidth=2.0, zorder=zorder + 1.0)


def draw_world(
    axes: Axes, world: AnyWorld, bodies: NDArray[np.float64], member: int = 0
) -> None:
    """Draws map, walls and obstacles (K, 7), see `sim.scenes.Scene`; x and y in `map` [m]."""
    place = world.members[member]
    if place.grid is not None:
        _draw_map(axes, place.grid)
    if place.bounds is not None:
        x1, y1, x2, y2 = place.bounds
        border = Rectangle(
            (x1, y1), x2 - x1, y2 - y1, fill=False, color=EDGE, linestyle="--"
        )
        axes.add_patch(border)
    for x1, y1, x2, y2 in place.all_walls():
        axes.plot([x1, x2], [y1, y2], color=WALL, linewidth=2)
    for body in bodies:
        if body[RADIUS] > 0.0:
            axes.add_patch(_make_patch(world, body))


def _draw_map(axes: Axes, grid: GridMap) -> None:
    rows, columns = grid.cells.shape
    corners = np.indices((rows + 1, columns + 1)) - 0.5
    places = grid.cell_to_world(np.moveaxis(corners, 0, -1))
    shade = np.where(grid.blocked, 0.2, 0.8)
    shade[grid.free] = 1.0
    x = places[..., 0]
    y = places[..., 1]
    axes.pcolormesh(x, y, shade, cmap="gray", vmin=0.0, vmax=1.0, rasterized=True)


def _make_patch(world: AnyWorld, body: NDArray[np.float64]) -> Patch:
    outline = find_outline(body, world.shapes)
    if not len(outline):
        return Disc((body[0], body[1]), body[RADIUS], color=STANDING)
    corners = geometry.rotate(outline, body[HEADING]) + body[:2]
    return Outline(
        corners,
        closed=len(corners) > 2,
        facecolor=STANDING,
        edgecolor=STANDING,
        lw=2,
    )
