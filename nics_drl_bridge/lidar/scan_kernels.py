"""Compiled inner loops of the lidar: scans of whole worlds."""

from __future__ import annotations

from numba import njit

from nics_drl_bridge.lidar import baked_kernels as baking
from nics_drl_bridge.lidar import kernels, map_kernels


@njit(cache=True, error_model="numpy", _nrt=False)
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
    shape_of, grid_of, row_of, cell_of, rows, shift, hulls = lookup
    doubles, singles, wholes = room
    x, y, distance, bearing, right, left = doubles
    rx, ry, lx, ly, blend = singles
    which, cell_at = wholes
    low, high = limits[0], limits[1]
    for n in chosen:
        for m in range(poses.shape[1]):
            me = first + m if first >= 0 else -1
            sx, sy, heading, c, s = kernels.to_sensor(poses, n, m, mount)
            found, missed = baking.in_sight(
                bodies, n, me, sx, sy, high, baked, which, x, y, distance
            )
            baking.directions(found, x, y, distance, bearing)
            baking.cells_of(
                found, bodies, n, limits, shape_of, grid_of, cell_of, hulls, which, x, y, distance,
                bearing, rx, ry, lx, ly, blend, cell_at,
            )  # fmt: skip
            kernels.clear(ranges, n, m)
            baking.spans(found, heading, beams, rx, ry, lx, ly, bearing, right, left)
            baking.fuse(
                ranges, n, m, found, beams, limits, row_of, cell_of, rows, shift, bearing, right,
                left, blend, which, cell_at,
            )  # fmt: skip
            if missed > 0 or walls.shape[0] > 0:
                out = ranges[n, m]
                for k in range(bodies.shape[1] if missed > 0 else 0):
                    if baking.left_out(bodies, n, k, me, sx, sy, high, baked):
                        kernels.body_into(
                            out, directions, beams, sx, sy, c, s, bodies[n, k], corners, corner,
                            high,
                        )  # fmt: skip
                near = kernels.walls_into(out, directions, beams, sx, sy, c, s, walls, high)
                if near > 0 or missed > 0:
                    kernels.finish(out, low, high)


@njit(cache=True)
def add_map(ranges, poses, chosen, sensor, map_arrays, exact):  # type: ignore[no-untyped-def]
    """Fuses a static map into the scans of some worlds.

    Args:
        ranges: (N, M, B) scans, in place.
        poses: (N, M, 3) of `base_link` in the world.
        chosen: (n,) which worlds.
        sensor: see `scanner.Scanner.arguments`.
        map_arrays: see `maps_grid.GridMap.arrays`.
        exact: whether to walk from cell to cell.
    """
    mount, directions, beams, limits = sensor[0], sensor[1], sensor[2], sensor[3]
    for n in chosen:
        for m in range(poses.shape[1]):
            sx, sy, _, c, s = kernels.to_sensor(poses, n, m, mount)
            out = ranges[n, m]
            if exact:
                map_kernels.exact_map_into(
                    out, directions, beams, sx, sy, c, s, limits[1], map_arrays
                )
            else:
                map_kernels.map_into(out, directions, beams, sx, sy, c, s, limits[1], map_arrays)
            kernels.finish(out, limits[0], limits[1])
