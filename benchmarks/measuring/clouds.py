"""The path of the paper's Fig. 4 among its obstacles: point clouds, a map by SLAM, the picture."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from measuring.environments import python_with, run
from nics_drl_bridge import geometry
from nics_drl_bridge.lidar.shapes import Circle, Polygon, Rectangle, Shape
from nics_drl_bridge.lidar.spec import LidarSpec
from nics_drl_bridge.style import DARK, MEASURED, MODEL, OTHER, make_panels

Array = NDArray[np.float64]
HERE = Path(__file__).resolve().parent
SLAM = (
    "yag-slam==0.3.0",
    "opencv-python-headless==5.0.0.93",
    "numpy==2.4.6",
    "numba==0.68.1",
)
ROOM = np.array([(-4.0, -3.0), (4.0, -3.0), (4.0, 3.0), (-4.0, 3.0)])
WALLS = np.concatenate([ROOM, np.roll(ROOM, -1, axis=0)], axis=1)
CORNER = Polygon(
    points=(
        (-0.5, -0.4),
        (0.5, -0.4),
        (0.5, -0.1),
        (-0.2, -0.1),
        (-0.2, 0.5),
        (-0.5, 0.5),
    )
)
OBSTACLES: tuple[Shape, ...] = (
    Circle(radius=0.35),
    CORNER,
    Rectangle(size=(0.6, 0.6)),
    Rectangle(size=(1.4, 0.14)),
)
POSES = np.array(
    [(-1.1, 0.3, 0.0), (1.0, -0.2, 0.3), (3.1, 2.2, 0.5), (-3.0, -2.1, -0.7)]
)
LAPS = 1.15
DRIFT = np.array([1.02, 1.0, 1.04])
ODOMETRY_NOISE = np.array([0.004, 0.002, 0.004])


def make_path(scans: int) -> Array:
    """(N, 3) poses on an ellipse around the middle of the room, a little more than once."""
    t = np.linspace(-0.5 * np.pi, (2.0 * LAPS - 0.5) * np.pi, scans)
    x = 2.7 * np.cos(t)
    y = 1.8 * np.sin(t)
    return np.stack([x, y, np.arctan2(1.8 * np.cos(t), -2.7 * np.sin(t))], axis=1)


def let_drift(poses: Array, seed: int) -> Array:
    """(N, 3) the path as an odometry that overrates speed and turning, and is noisy."""
    moves = geometry.log(geometry.between(poses[:-1], poses[1:]))
    noise = np.random.default_rng(seed).normal(size=moves.shape) * ODOMETRY_NOISE
    odometry = [poses[0]]
    for move in moves * DRIFT + noise:
        odometry.append(geometry.compose(odometry[-1], geometry.exp(move)))
    return np.array(odometry)


def make_cloud(spec: LidarSpec, poses: Array, ranges: NDArray[np.float32]) -> Array:
    """(P, 2) where the returns of all scans lie in the world [m]."""
    angles = poses[:, 2:] + spec.angles
    x = poses[:, :1] + ranges * np.cos(angles)
    y = poses[:, 1:2] + ranges * np.sin(angles)
    seen = np.isfinite(ranges)
    return np.stack([x[seen], y[seen]], axis=1)


def find_cloud_rmse(points: Array, reference: Array) -> float:
    """Root mean square distance of points to their nearest neighbours in a reference [m]."""
    return float(np.sqrt((cKDTree(reference).query(points)[0] ** 2).mean()))


def make_map(
    spec: LidarSpec, ranges: NDArray[np.float32], odometry: Array
) -> dict[str, Array]:
    """Poses and map of yag-slam. Raises NotInstalledError where it can't be had."""
    python = python_with("yag_slam", SLAM)
    with tempfile.TemporaryDirectory() as folder:
        asked = Path(folder) / "scans.npz"
        answered = Path(folder) / "map.npz"
        limits = np.array([spec.range_min, spec.range_max])
        np.savez(
            asked, ranges=ranges, odometry=odometry, angles=spec.angles, limits=limits
        )
        run(python, HERE / "yag_slam_map.py", str(asked), str(answered))
        with np.load(answered) as found:
            return dict(found)


def find_beam_rmse(ranges: NDArray[np.float32], exact: NDArray[np.float32]) -> float:
    """Root mean square over the beams that return in both [m]; NaN where a range is none."""
    known = np.isfinite(exact) & ~np.isinf(ranges)
    return float(np.sqrt(np.mean((ranges[known] - exact[known]) ** 2.0)))


def find_path_error(poses: Array, truth: Array) -> float:
    """Root mean square distance from the true path [m]."""
    return float(np.sqrt(((poses[:, :2] - truth[:, :2]) ** 2).sum(axis=1).mean()))


def make_outline(shape: Shape, pose: Array) -> Array:
    """(V, 2) a closed line around an obstacle [m]."""
    t = np.linspace(0.0, 2.0 * np.pi, 60)
    corners = shape.outline
    if isinstance(shape, Circle):
        corners = shape.radius * np.stack([np.cos(t), np.sin(t)], axis=1)
    return geometry.rotate(np.concatenate([corners, corners[:1]]), pose[2]) + pose[:2]


def prepare_panel(axes: Axes, title: str, truth: Array) -> None:
    """What all four have in common."""
    axes.set_title(title)
    axes.set_aspect("equal")
    axes.set_xlim(-4.3, 4.3)
    axes.set_ylim(-3.3, 3.3)
    axes.plot(*truth[:, :2].T, color=MODEL, lw=1.2, label="path")
    axes.plot(*truth[0, :2], "o", color=MODEL, ms=4)


def draw_cloud(axes: Axes, points: Array) -> None:
    """A point cloud."""
    axes.plot(
        *points.T, ".", ms=1.2, mew=0.0, color=MEASURED, alpha=0.6, rasterized=True
    )


def draw_map(
    axes: Axes, found: dict[str, Array], points: Array, odometry: Array
) -> None:
    """The map as yag-slam drew it, the cloud from its path, and the path of the odometry."""
    image = found["image"]
    cell = float(found["resolution"])
    left, low = found["origin"] - 0.5 * cell  # the origin is the middle of a cell
    height, width = (side * cell for side in image.shape[:2])
    axes.imshow(
        image,
        cmap="gray",
        alpha=0.4,
        origin="lower",
        extent=(left, left + width, low, low + height),
        zorder=0,
    )
    draw_cloud(axes, points)
    axes.plot(*odometry[:, :2].T, "--", color=OTHER, lw=1.2, label="odometry")
    axes.plot(*found["poses"][:, :2].T, color=MEASURED, lw=1.2, label="path by SLAM")


def draw(
    truth: Array, clouds: dict[str, Array], result: dict[str, Any], mapped: Any
) -> Figure:
    """Draws the clouds and the map in four panels."""
    titles = make_titles(result)
    figure, grid = make_panels(2, 2, (11.0, 8.6), sharex=True, sharey=True)
    for axes, name in zip(grid, ("exact", "baked", "mujoco"), strict=False):
        prepare_panel(axes, titles[name], truth)
        if name in clouds:
            draw_cloud(axes, clouds[name])
    prepare_panel(grid[3], titles["slam"], truth)
    if mapped is not None:
        draw_map(grid[3], *mapped)
    for axes in grid:
        for shape, pose in zip(OBSTACLES, POSES, strict=True):
            axes.plot(
                *make_outline(shape, pose).T, color=DARK, lw=0.5, alpha=0.5, zorder=1
            )
    grid[3].legend(loc="lower right", bbox_to_anchor=(0.95, 0.08))
    for axes in grid[2:]:
        axes.set_xlabel("x [m]")
    for axes in grid[::2]:
        axes.set_ylabel("y [m]")
    return figure


def make_titles(result: dict[str, Any]) -> dict[str, str]:
    """What stands above each panel."""
    titles = {
        "exact": f"a) scan mode: {result['points']['exact']:,} points of {result['scans']} scans"
    }
    for letter, name, word in (("b", "baked", "baked"), ("c", "mujoco", "MuJoCo")):
        titles[name] = f"{letter}) {word}: not available"
        if name in result["cloud_rmse_m"]:
            apart = max(1e3 * result["cloud_rmse_m"][name], 0.01)
            less = "less than " if apart == 0.01 else ""
            titles[name] = f"{letter}) {word}: {less}{apart:.2f} mm RMSE from a)"
    titles["slam"] = "d) map by yag-slam: not available"
    if result["slam"] is not None:
        before, after = (
            1e3 * result["slam"][key] for key in ("odometry_error_m", "path_error_m")
        )
        titles["slam"] = (
            f"d) yag-slam from b): path off by {after:.0f} mm, odometry {before:.0f} mm"
        )
    return titles
