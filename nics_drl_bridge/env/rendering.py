"""Pictures of a world from above, for `render_mode` `rgb_array` and `human`."""

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
from nics_drl_bridge.generator import SimulatorModel
from nics_drl_bridge.lidar.exact_kernels import HEADING, RADIUS, SHAPE
from nics_drl_bridge.sim.world_set import AnyWorld
from nics_drl_bridge.style import DARK, EDGE, GOAL, OTHER, SERIES, VERMILION

Array = NDArray[np.float64]
SIZE_IN, DPI, MARGIN = 5.0, 100, 0.05
WALL, STANDING, SCAN = DARK, OTHER, VERMILION
ROBOTS = tuple(colour for colour in SERIES if colour != SCAN)


class WorldPicture:
    """Picture of a world, redrawn at every step: `rgb_array`, or `human` in a window."""

    def __init__(self, model: SimulatorModel, world: AnyWorld, mode: str, fps: int) -> None:
        self._model, self._world = model, world
        self._human, self._pause_s = mode == "human", 1.0 / fps
        low, high = np.array(world.extent).reshape(2, 2)
        width, depth = (SIZE_IN * (high - low) / (high - low).max()).tolist()
        self._low, self._high = low - MARGIN * (high - low), high + MARGIN * (high - low)
        if self._human:
            import matplotlib.pyplot as plt  # looks for a display, which `rgb_array` does not need

            self._figure = plt.figure(figsize=(width, depth), dpi=DPI)
        else:
            self._figure = Figure(figsize=(width, depth), dpi=DPI)
            FigureCanvasAgg(self._figure)
        self._axes = self._figure.add_axes((0.0, 0.0, 1.0, 1.0))

    def draw(
        self,
        poses: Array,
        ranges: NDArray[Any],
        bodies: Array,
        memory: dict[str, NDArray[Any]],
        member: int = 0,
    ) -> NDArray[np.uint8] | None:
        """Draws robots (M, 3), scans (M, B), bodies (K, 7), goals; pixels unless `human`.

        All in the world `member` of a set.
        """
        axes = self._axes
        axes.clear()
        axes.set_axis_off()
        axes.set_aspect("equal")
        axes.set_xlim(self._low[0], self._high[0])
        axes.set_ylim(self._low[1], self._high[1])
        draw_world(axes, self._world, bodies, member)
        for goal in np.reshape(memory.get("goal", np.zeros((0, 2))), (-1, 2)):
            axes.plot(*goal, marker="*", color=GOAL, markersize=16, markeredgecolor=WALL)
        for m, (pose, scan) in enumerate(zip(poses, ranges, strict=True)):
            self._robot(axes, pose, scan, ROBOTS[m % len(ROBOTS)])
        return self._shown()

    def _robot(self, axes: Axes, pose: Array, ranges: NDArray[np.float32], colour: str) -> None:
        lidar, robot = self._model.lidar, self._model.robot
        mount = geometry.compose(pose, lidar.mount)
        there = np.isfinite(ranges)
        angles = mount[2] + lidar.angles[there]
        hits = mount[:2] + ranges[there, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)
        axes.plot(hits[:, 0], hits[:, 1], ".", color=SCAN, markersize=2.0)
        reach = robot.footprint_radius
        if robot.footprint is None:
            axes.add_patch(Disc((pose[0], pose[1]), reach, color=colour))
        else:
            corners = np.array(robot.footprint)
            reach, outline = corners[:, 0].max(), geometry.rotate(corners, pose[2]) + pose[:2]
            axes.add_patch(Outline(outline, closed=True, color=colour))
        front = pose[:2] + reach * np.array([np.cos(pose[2]), np.sin(pose[2])])
        axes.plot([pose[0], front[0]], [pose[1], front[1]], color="white", linewidth=2.0)

    def _shown(self) -> NDArray[np.uint8] | None:
        canvas: Any = self._figure.canvas
        if not self._human:
            canvas.draw()
            return np.asarray(canvas.buffer_rgba())[..., :3].copy()
        if canvas.required_interactive_framework is None:  # no display: drawn, but not shown
            canvas.draw()
        else:
            canvas.manager.show()
            canvas.draw_idle()
            canvas.start_event_loop(self._pause_s)
        return None

    def close(self) -> None:
        """Closes the window."""
        if self._human:
            import matplotlib.pyplot as plt

            plt.close(self._figure)


def draw_world(axes: Axes, world: AnyWorld, bodies: NDArray[np.float64], member: int = 0) -> None:
    """Draws map, walls and obstacles (K, 7), see `sim.scenes.Scene`; x and y in `map` [m]."""
    place = world.members[member]
    if (grid := place.grid) is not None:
        edges = np.indices((grid.cells.shape[0] + 1, grid.cells.shape[1] + 1)) - 0.5
        x, y = np.moveaxis(grid.cell_to_world(np.moveaxis(edges, 0, -1)), -1, 0)
        shade = np.where(grid.free, 1.0, np.where(grid.blocked, 0.2, 0.8))
        axes.pcolormesh(x, y, shade, cmap="gray", vmin=0.0, vmax=1.0, rasterized=True)
    if place.bounds is not None:
        low, high = np.array(place.bounds).reshape(2, 2)
        axes.add_patch(Rectangle(tuple(low), *(high - low), fill=False, color=EDGE, ls="--"))
    for x1, y1, x2, y2 in place.all_walls():
        axes.plot([x1, x2], [y1, y2], color=WALL, linewidth=2)
    for body in bodies:
        if body[RADIUS] > 0.0:
            axes.add_patch(_patch(world, body))


def _patch(world: AnyWorld, body: NDArray[np.float64]) -> Patch:
    shape = world.shapes[int(body[SHAPE]) % len(world.shapes)]
    if not len(shape.outline):
        return Disc((body[0], body[1]), body[RADIUS], color=STANDING)
    outline = shape.outline * (body[RADIUS] / shape.radius)
    c, s = np.cos(body[HEADING]), np.sin(body[HEADING])
    corners = outline @ np.array([[c, s], [-s, c]]) + body[:2]
    return Outline(corners, closed=len(corners) > 2, facecolor=STANDING, edgecolor=STANDING, lw=2)
