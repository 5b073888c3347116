"""A MuJoCo scene: robots with bumpers, walls, map and obstacles, cut into convex parts."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.extras.mujoco.machines import Machine, Physics
from nics_drl_bridge.interface import Array
from nics_drl_bridge.lidar.exact_kernels import RADIUS, SHAPE
from nics_drl_bridge.lidar.maps import GridMap
from nics_drl_bridge.lidar.shapes import (
    Circle,
    Rectangle,
    Segment,
    Shape,
    find_convex_hull,
)
from nics_drl_bridge.sim.world import Motion, World

HEIGHT = 0.5  # height of walls and obstacles [m]
WALL_THICKNESS = 0.002  # thickness of walls [m]; for the lidar they have none
BUMPER = 4  # bit for bumper contacts in MuJoCo's `contype` and `conaffinity`
BUMPER_FRICTION = 0.3
BUMPER_NAME = "bumper_"
OBSTACLE_NAME = "obstacle_"
SLIVER = 1e-9  # minimum area of a triangle, relative to the outline's size squared


def make_prefix(robot: int) -> str:
    """Returns the prefix of the names of a robot's parts."""
    return f"robot_{robot}/" if robot else ""


def compile_scene(
    mujoco: Any,
    machine: Machine,
    physics: Physics,
    footprint: Shape,
    robots: int,
    world: World,
    motions: Sequence[Motion | None],
    shapes: Sequence[Shape],
    bodies: Array,
) -> Any:
    """Compiles robots of one kind in a world; moving bodies among the (K, 7) are mocap bodies."""
    spec = mujoco.MjSpec.from_string(machine.xml)
    maker = _Maker(mujoco, spec, physics)
    maker.bumper(spec.body("base_link"), footprint)
    for m in range(1, robots):
        another = mujoco.MjSpec.from_string(machine.xml)
        another.delete(another.geom("floor"))
        _Maker(mujoco, another, physics).bumper(another.body("base_link"), footprint)
        spec.attach(another, prefix=make_prefix(m), frame=spec.worldbody.add_frame())
    for wall in world.all_walls():
        maker.wall(spec.worldbody, wall[:2], wall[2:])
    if world.grid is not None:
        maker.map(world.grid)
    for k, body in enumerate(bodies):
        if body[RADIUS] > 0.0:
            maker.obstacle(
                k, shapes[int(body[SHAPE])], body[:3], motions[k] is not None
            )
    return spec.compile()


def find_bumpers(model: Any, robots: int) -> NDArray[np.int64]:
    """Returns (geoms,) the robot whose bumper each geom of a scene belongs to; -1 if none."""
    names = [model.geom(i).name for i in range(model.ngeom)]
    heads = [f"{make_prefix(m)}{BUMPER_NAME}" for m in range(robots)]
    owners = np.full(len(names), -1, np.int64)
    for m, head in reversed(list(enumerate(heads))):
        owners[[name.startswith(head) for name in names]] = m
    return owners


class _Maker:
    def __init__(self, mujoco: Any, spec: Any, physics: Physics) -> None:
        self._kinds = mujoco.mjtGeom
        self._spec = spec
        self._solref = [physics.softness, 1.0]

    def bumper(self, base: Any, footprint: Shape) -> None:
        # The bumper has no mass: the chassis has it.
        half = 0.5 * float(base.pos[2])
        contact = {"contype": BUMPER, "mass": 0.0}
        if isinstance(footprint, Circle):
            # The round edge touches a wall in one point, at the height of the axles.
            size = [footprint.radius, footprint.radius, half]
            kind = self._kinds.mjGEOM_ELLIPSOID
            self._add(base, type=kind, size=size, name=f"{BUMPER_NAME}0", **contact)
        else:
            for i, part in enumerate(split_convex(footprint.outline)):
                self._prism(
                    base, part, (-half, half), name=f"{BUMPER_NAME}{i}", **contact
                )

    def wall(self, body: Any, start: Array, end: Array) -> None:
        middle = 0.5 * (start + end)
        along = end - start
        size = [0.5 * float(np.hypot(*along)), 0.5 * WALL_THICKNESS, 0.5 * HEIGHT]
        self._box(body, middle, float(np.arctan2(along[1], along[0])), size)

    def map(self, grid: GridMap) -> None:
        heading = grid.origin[2]
        side = grid.resolution
        for first_row, first, row, column in merge_into_rectangles(grid.blocked):
            middle = grid.cell_to_world(
                [0.5 * (first_row + row - 1), 0.5 * (first + column - 1)]
            )
            size = [
                0.5 * side * (column - first),
                0.5 * side * (row - first_row),
                0.5 * HEIGHT,
            ]
            self._box(self._spec.worldbody, middle, heading, size)

    def obstacle(self, k: int, shape: Shape, pose: Array, moves: bool) -> None:
        x, y, heading = pose
        body = self._spec.worldbody.add_body(
            name=f"{OBSTACLE_NAME}{k}",
            pos=[x, y, 0.0],
            quat=make_quaternion(heading),
            mocap=moves,
        )
        if isinstance(shape, Circle):
            size = [shape.radius, 0.5 * HEIGHT, 0.0]
            self._add(
                body,
                type=self._kinds.mjGEOM_CYLINDER,
                size=size,
                pos=[0, 0, 0.5 * HEIGHT],
            )
        elif isinstance(shape, Rectangle):
            self._box(
                body, np.zeros(2), 0.0, [*(0.5 * s for s in shape.size), 0.5 * HEIGHT]
            )
        elif isinstance(shape, Segment):
            self.wall(body, *shape.outline)
        else:
            for part in split_convex(shape.outline):
                self._prism(body, part, (0.0, HEIGHT))

    def _box(
        self, body: Any, middle: Array, heading: float, size: Sequence[float]
    ) -> None:
        pos = [middle[0], middle[1], 0.5 * HEIGHT]
        turned = make_quaternion(heading)
        self._add(body, type=self._kinds.mjGEOM_BOX, size=size, pos=pos, quat=turned)

    def _prism(
        self, body: Any, corners: Array, z: tuple[float, float], **others: Any
    ) -> None:
        mesh = self._spec.add_mesh(name=f"prism_{len(self._spec.meshes)}")
        layers = [
            np.column_stack([corners, np.full(len(corners), height)]) for height in z
        ]
        mesh.uservert = np.concatenate(layers).ravel()
        self._add(body, type=self._kinds.mjGEOM_MESH, meshname=mesh.name, **others)

    def _add(self, body: Any, **values: Any) -> None:
        common = {
            "conaffinity": BUMPER,
            "condim": 3,
            "friction": [BUMPER_FRICTION, 0.005, 0.0001],
        }
        body.add_geom(**common, solref=self._solref, **values)


def make_quaternion(heading: float) -> list[float]:
    """Returns the quaternion w, x, y, z of a rotation about the vertical [rad]."""
    return [float(np.cos(0.5 * heading)), 0.0, 0.0, float(np.sin(0.5 * heading))]


def split_convex(outline: Array) -> list[Array]:
    """Splits an outline (V, 2) into convex ones; uses ear clipping (Meisters 1975) if needed."""
    if len(find_convex_hull(outline)) == len(outline):
        return [outline]
    rest = list(range(len(outline)))
    parts = []
    minimum_area = SLIVER * float(np.ptp(outline, axis=0).max()) ** 2
    while len(rest) > 3:
        at = next((i for i in range(len(rest)) if _is_ear(outline, rest, i)), 0)
        parts.append(outline[[rest[at - 1], rest[at], rest[(at + 1) % len(rest)]]])
        del rest[at]
    parts.append(outline[rest])
    return [part for part in parts if _compute_area(*part) > minimum_area]


def _compute_area(a: Array, b: Array, c: Array) -> float:
    return float((b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]))


def _is_ear(outline: Array, rest: list[int], i: int) -> bool:
    before = rest[i - 1]
    here = rest[i]
    after = rest[(i + 1) % len(rest)]
    a = outline[before]
    b = outline[here]
    c = outline[after]
    if _compute_area(a, b, c) <= 0.0:
        return False
    others = (outline[k] for k in rest if k not in (before, here, after))
    return not any(
        min(_compute_area(a, b, p), _compute_area(b, c, p), _compute_area(c, a, p))
        >= 0.0
        for p in others
    )


def merge_into_rectangles(blocked: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Returns rectangles (R, 4) of blocked cells: first row, first column, last ones + 1."""
    done: list[tuple[int, int, int, int]] = []
    open_runs: dict[tuple[int, int], int] = {}
    for row, cells in enumerate(np.pad(blocked, ((0, 1), (1, 1)))):
        edges = np.flatnonzero(cells[1:] != cells[:-1]).reshape(-1, 2)
        runs = {(int(first), int(after)) for first, after in edges}
        for run in open_runs.keys() - runs:
            done.append((open_runs.pop(run), run[0], row, run[1]))
        for run in runs:
            open_runs.setdefault(run, row)
    return np.array(sorted(done), dtype=np.int64).reshape(-1, 4)
