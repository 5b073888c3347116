"""Compiled inner loops of the lidar: scans of whole worlds."""

from __future__ import annotations

from numba import njit

from nics_drl_bridge.lidar import baked_kernels as baking
from nics_drl_bridge.lidar import kernels


@njit(cache=True, error_model="numpy")
def scan_worlds(ranges, poses, chosen, bodies, first, walls, sensor, room):  # type: ignore[no-untyped-def]
    """Scans of the robots of some worlds.

    All arrays are taken out of their tuples once, here: to do so for each scan took as long as
    the look-ups.

    Args:
        ranges: (N, M, B) result.
        poses: (N, M, 3) of `base_link` in the world.
        chosen: (n,) which worlds.
        bodies: (N, K, 7), see `shapes.BODY`.
        first: the body that robot 0 is, the others follow; -1 when robots are no bodies.
        walls: (W, 4) x1, y1, x2, y2 [m], the same in every world.
        sensor: see `scanner.Scanner.arguments`.
        room: see `scanner.Scanner.room`.
    """
    mount, directions, beams, limits, baked, outlines, lookup = sensor
    corners, corner = outlines
    shape_of, row_of, cell_of, rows, shift, hulls = lookup
    line, work, cells = room
    count = ranges.shape[2]
    seen = line[:count]
    low, high = limits[0], limits[1]
    for n in chosen:
        for m in range(poses.shape[1]):
            me = first + m if first >= 0 else -1
            sx, sy, heading, c, s = kernels.to_sensor(poses, n, m, mount)
            found, left = baking.in_sight(bodies, n, me, sx, sy, high, baked, work, cells)
            baking.directions(found, work)
            baking.cells_of(found, bodies, n, shape_of, cell_of, hulls, work, cells)
            kernels.clear(line)
            baking.spans(found, heading, beams, work)
            baking.fuse(line, found, beams, row_of, cell_of, rows, shift, work, cells)
            if left > 0:
                for k in range(bodies.shape[1]):
                    if baking.left_out(bodies, n, k, me, sx, sy, high, baked):
                        kernels.body_into(
                            seen, directions, beams, sx, sy, c, s, bodies[n, k], corners, corner,
                            high,
                        )  # fmt: skip
            if walls.shape[0] > 0:
                kernels.walls_into(seen, directions, beams, sx, sy, c, s, walls)
            kernels.finish(ranges, n, m, line, low, high)
