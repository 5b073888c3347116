"""The paper's Fig. 4: a path among obstacles, point clouds, MuJoCo's rays, a map by SLAM."""

import tempfile
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from measuring.environments import clean, python_with, wait_for
from nics_drl_bridge import extensions, geometry
from nics_drl_bridge.geometry import Array
from nics_drl_bridge.lidar.shapes import Circle, Polygon, Rectangle, Shape
from nics_drl_bridge.lidar.spec import LidarSpec
from nics_drl_bridge.style import MEASURED, MODEL, OTHER, make_panels

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
HALF_HEIGHT = 0.25  # of what stands on MuJoCo's floor [m]
THIN = 0.01  # half of MuJoCo's walls [m]
LAPS = 1.15
DRIFT = np.array([1.02, 1.0, 1.04])
ODOMETRY_NOISE = np.array([0.004, 0.002, 0.004])


def make_path(scans: int) -> Array:
    """(N, 3) poses on an ellipse around the middle of the room, a little more than once."""
    t = np.linspace(-0.5 * np.pi, (2.0 * LAPS - 0.5) * np.pi, scans)
    x = 2.7 * np.cos(t)
    y = 1.8 * np.sin(t)
    return np.stack([x, y, np.arctan2(1.8 * np.cos(t), -2.7 * np.sin(t))], axis=1)


def let_drift(poses: Array) -> Array:
    """(N, 3) the path as an odometry that overrates speed and turning, and is noisy."""
    moves = geometry.log(geometry.between(poses[:-1], poses[1:]))
    noise = np.random.default_rng(0).normal(size=moves.shape) * ODOMETRY_NOISE
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
        script = str(HERE / "yag_slam_map.py")
        wait_for([str(python), script, str(asked), str(answered)], HERE, clean())
        with np.load(answered) as found:
            return dict(found)


def find_beam_rmse(ranges: NDArray[np.float32], exact: NDArray[np.float32]) -> float:
    """Root mean square over the beams that return in both [m]; NaN where a range is none."""
    known = np.isfinite(exact) & ~np.isinf(ranges)
    return float(np.sqrt(np.mean((ranges[known] - exact[known]) ** 2.0)))


def find_path_error(poses: Array, truth: Array) -> float:
    """Root mean square distance from the true path [m]."""
    return float(np.sqrt(((poses[:, :2] - truth[:, :2]) ** 2).sum(axis=1).mean()))


def describe_side(ends: Array) -> str:
    """A thin box of MuJoCo behind a straight side x1, y1, x2, y2, which is seen from its left."""
    along = ends[2:] - ends[:2]
    length = float(np.hypot(*along))
    right = np.array([along[1], -along[0]]) / length
    x, y = (ends[:2] + ends[2:]) / 2.0 + THIN * right
    at = f'pos="{x} {y} {HALF_HEIGHT}" euler="0 0 {np.arctan2(along[1], along[0])}"'
    return f'<geom type="box" size="{length / 2} {THIN} {HALF_HEIGHT}" {at}/>'


def list_sides(shape: Shape, pose: Array) -> list[str]:
    """An obstacle in MuJoCo: a cylinder, or its sides, which are all that level rays see."""
    if isinstance(shape, Circle):
        x, y, _ = pose
        size = f'size="{shape.radius} {HALF_HEIGHT}" pos="{x} {y} {HALF_HEIGHT}"'
        return [f'<geom type="cylinder" {size}/>']
    corners = geometry.rotate(shape.outline, pose[2]) + pose[:2]
    sides = np.concatenate([np.roll(corners, -1, axis=0), corners], axis=1)
    return [describe_side(side) for side in sides]


def scan_in_mujoco(spec: LidarSpec, path: Array) -> NDArray[np.float32]:
    """(N, B) ranges of MuJoCo's rays from each pose (N, 3) of a path; `inf` where nothing is hit.

    Raises:
        ConfigError: MuJoCo is not installed.
    """
    extensions.require("MuJoCo", "mujoco")
    import mujoco

    geoms = [describe_side(side) for side in WALLS]
    for shape, pose in zip(OBSTACLES, POSES, strict=True):
        geoms += list_sides(shape, pose)
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><compiler angle="radian"/><worldbody>'
        f"{''.join(geoms)}</worldbody></mujoco>"
    )
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    ranges = np.full((len(path), spec.beams), np.inf, np.float32)
    hit = np.zeros(1, np.int32)
    for n, (x, y, heading) in enumerate(geometry.compose(path, np.array(spec.mount))):
        start = np.array([x, y, HALF_HEIGHT])
        for b, angle in enumerate(heading + spec.angles):
            ray = np.array([np.cos(angle), np.sin(angle), 0.0])
            distance = mujoco.mj_ray(model, data, start, ray, None, 1, -1, hit)
            if 0.0 <= distance <= spec.range_max:
                ranges[n, b] = distance
    return ranges


def draw(
    truth: Array, clouds: dict[str, Array], mapped: dict[str, Array], odometry: Array
) -> Figure:
    """Draws each cloud in a panel of its own, and in that of the `slam` what SLAM made of it.

    Args:
        truth: (N, 3) the path.
        clouds: by name.
        mapped: what yag-slam returned; empty for nothing.
        odometry: (N, 3) the path as yag-slam was told it.
    """
    figure, grid = make_panels(2, 2, (11.0, 8.6), sharex=True, sharey=True)
    for axes, (name, points) in zip(grid, clouds.items(), strict=False):
        axes.set_title(name)
        axes.set_aspect("equal")
        axes.plot(*truth[:, :2].T, color=MODEL, lw=1.2, label="path")
        axes.plot(
            *points.T, ".", ms=1.2, mew=0.0, color=MEASURED, alpha=0.6, rasterized=True
        )
    if mapped:
        cell = float(mapped["resolution"])
        left, low = mapped["origin"] - 0.5 * cell  # the origin is the middle of a cell
        height, width = (side * cell for side in mapped["image"].shape[:2])
        extent = (left, left + width, low, low + height)
        image = mapped["image"]
        axes.imshow(
            image, cmap="gray", alpha=0.4, origin="lower", extent=extent, zorder=0
        )
        axes.plot(*odometry[:, :2].T, "--", color=OTHER, lw=1.2, label="odometry")
        axes.plot(
            *mapped["poses"][:, :2].T, color=MEASURED, lw=1.2, label="path by SLAM"
        )
        axes.legend(loc="lower right")
    return figure
