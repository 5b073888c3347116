"""Guide: remaining path lengths of robots to their goals, around the obstacles of a scene.

Only a simulator knows them; they are used as a reward in training.
"""

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.env import guide_kernels as kernels
from nics_drl_bridge.geometry import compute_depths
from nics_drl_bridge.lidar.arrays import Array
from nics_drl_bridge.lidar.shapes import Circle, Polygon
from nics_drl_bridge.sim.scenes import Scenes, SceneSampler
from nics_drl_bridge.sim.state import State

CELL = 0.15  # side of a cell [m]
MOST_CELLS = 10_000  # larger fields get larger cells


class Guide:
    """Path lengths from the robots to their goals, in `worlds` copies of a world or set.

    Args:
        sampler: sampler of the scenes.
        footprint: outline of the robots.
        worlds: N, number of copies.
    """

    def __init__(
        self, sampler: SceneSampler, footprint: Circle | Polygon, worlds: int
    ) -> None:
        members = [scene_sampler.world for scene_sampler in sampler.samplers]
        extents = np.array([member.extent for member in members])
        spans = extents[:, 2:] - extents[:, :2]
        cells = np.maximum(CELL, np.sqrt(spans.prod(axis=1) / MOST_CELLS))
        counts = np.maximum(np.ceil(spans / cells[:, None]), 2.0)
        sizes = counts[:, ::-1].astype(np.int64)
        rows, columns = sizes.max(axis=0)
        walls = np.full((len(members), rows, columns), np.inf, np.float32)
        stands = np.zeros((len(members), sampler.count), np.bool_)
        for p, scene_sampler in enumerate(sampler.samplers):
            kernels.sample_walls(
                walls[p, : sizes[p, 0], : sizes[p, 1]],
                extents[p],
                cells[p],
                scene_sampler.plan.space.cells,
            )
            stands[p, : scene_sampler.count] = [
                motion is None for motion in scene_sampler.motions
            ]
        self._grid = kernels.GuideGrid(
            walls,
            np.column_stack([extents[:, :2], cells]),
            sizes,
            stands,
            sampler.samplers[0].plan.outlines,
            _find_inner_radius(footprint),
            footprint.radius,
        )
        shape = (worlds, sampler.robots, *walls.shape[1:])
        self.fields = np.zeros(shape, np.float32)

    def begin(self, worlds: NDArray[np.intp], scenes: Scenes) -> None:
        """Compute the path lengths in the scenes of episodes that begin in some worlds (n,)."""
        member = scenes.member
        kernels.find_ways(
            self.fields, worlds, member, scenes.bodies, scenes.goals, self._grid
        )

    def measure_lengths(self, rows: slice | NDArray[np.intp], data: State) -> Array:
        """Path lengths (n, M) [m] from the current positions of the robots of some worlds.

        Near obstacles, a metre counts as more than one; see `guide_kernels`.
        """
        poses = data.pose[rows]
        out = np.empty(poses.shape[:2])
        kernels.measure_lengths(
            out, poses, data.member[rows], self.fields[rows], self._grid
        )
        return out


def _find_inner_radius(footprint: Circle | Polygon) -> float:
    """Return the radius of the circle around the origin that touches the outline [m]."""
    if isinstance(footprint, Circle):
        return footprint.radius
    depths = compute_depths(np.zeros((1, 2)), np.array(footprint.outline))
    return abs(float(depths[0]))
