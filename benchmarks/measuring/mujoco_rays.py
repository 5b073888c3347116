"""The rays of a lidar in MuJoCo, among the same walls and shapes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge import geometry
from nics_drl_bridge.extras.mujoco.machines import load_mujoco
from nics_drl_bridge.lidar.shapes import Circle, Polygon, Rectangle, Shape
from nics_drl_bridge.lidar.spec import LidarSpec

Array = NDArray[np.float64]
HEIGHT = 0.5
LIDAR_HEIGHT = 0.2
THIN = 0.01


def geoms(shape: Shape, pose: Array, number: int) -> tuple[str, str]:
    """A shape as an asset for MuJoCo (or nothing), and as a geom that stands on the floor."""
    x, y, heading = pose
    at = f'pos="{x} {y} {HEIGHT / 2}" euler="0 0 {heading}"'
    if isinstance(shape, Circle):
        return "", f'<geom type="cylinder" size="{shape.radius} {HEIGHT / 2}" {at}/>'
    if isinstance(shape, Rectangle):
        length, width = shape.size
        return (
            "",
            f'<geom type="box" size="{length / 2} {width / 2} {HEIGHT / 2}" {at}/>',
        )
    if isinstance(shape, Polygon):
        mesh = f'<mesh name="polygon{number}" {prism(shape)}/>'
        return mesh, f'<geom type="mesh" mesh="polygon{number}" {at}/>'
    raise ValueError(f"{shape.kind}: is not drawn in MuJoCo.")


def prism(shape: Polygon) -> str:
    """The sides of a polygon as triangles; rays are level, so it needs neither floor nor roof."""
    corners = shape.outline
    low = [f"{x} {y} {-HEIGHT / 2}" for x, y in corners]
    high = [f"{x} {y} {HEIGHT / 2}" for x, y in corners]
    count = len(corners)
    faces = []
    for i in range(count):
        j = (i + 1) % count
        faces += [f"{i} {j} {count + j}", f"{i} {count + j} {count + i}"]
    return f'inertia="shell" vertex="{" ".join(low + high)}" face="{" ".join(faces)}"'


def wall(ends: Array) -> str:
    """A thin box behind the straight wall x1, y1, x2, y2, which runs with the room on its left."""
    along = ends[2:] - ends[:2]
    length = float(np.hypot(*along))
    right = np.array([along[1], -along[0]]) / length
    x, y = (ends[:2] + ends[2:]) / 2.0 + THIN * right
    heading = np.arctan2(along[1], along[0])
    size = f"{length / 2} {THIN} {HEIGHT / 2}"
    return f'<geom type="box" size="{size}" pos="{x} {y} {HEIGHT / 2}" euler="0 0 {heading}"/>'


def scan(
    spec: LidarSpec, path: Array, shapes: Sequence[Shape], poses: Array, walls: Array
) -> NDArray[np.float32]:
    """(N, B) ranges from each pose (N, 3) of a path; `inf` where nothing is hit.

    Raises:
        ConfigError: MuJoCo is not installed.
    """
    mujoco = load_mujoco()
    placed = [
        geoms(shape, pose, k)
        for k, (shape, pose) in enumerate(zip(shapes, poses, strict=True))
    ]
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><compiler angle="radian"/><asset>'
        + "".join(mesh for mesh, _ in placed)
        + "</asset><worldbody>"
        + "".join([geom for _, geom in placed] + [wall(each) for each in walls])
        + "</worldbody></mujoco>"
    )
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    ranges = np.full((len(path), spec.beams), np.inf, np.float32)
    hit = np.zeros(1, np.int32)
    for n, base in enumerate(path):
        x, y, heading = geometry.compose(base, np.array(spec.mount))
        start = np.array([x, y, LIDAR_HEIGHT])
        for b, angle in enumerate(heading + spec.angles):
            ray = np.array([np.cos(angle), np.sin(angle), 0.0])
            distance = mujoco.mj_ray(model, data, start, ray, None, 1, -1, hit)
            if 0.0 <= distance <= spec.range_max:
                ranges[n, b] = distance
    return ranges
