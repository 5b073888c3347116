"""Compiled inner loops of the lidar: scans of whole worlds."""

from __future__ import annotations

import math

from nics_drl_bridge.kernels import kernel
from nics_drl_bridge.lidar import baked_kernels as baking
from nics_drl_bridge.lidar import exact_kernels, fuse_kernels, map_kernels


@kernel
def scan_worlds(ranges, poses, chosen, bodies, first, walls, sensor, room):  # type: ignore[no-untyped-def]
    """Scans from the robots of some worlds.

    Bodies to be looked up are collected in the lanes until these are full, across scans: the
    minimum does not depend on the order. All arrays are unpacked from their tuples once, here:
    doing so for each scan took as long as the look-ups.

    Args:
        ranges: (N, M, B) result, with contiguous beams.
        poses: (N, M, 3) of `base_link` in the world.
        chosen: (n,) indices of the worlds.
        bodies: (N, K, 7), see `shapes.BODY`.
        first: index of the body of robot 0, the others follow; -1 if robots are not bodies.
        walls: (W, 4) x1, y1, x2, y2 [m], the same in every world.
        sensor: see `scanner.Scanner.arguments`.
        room: see `scanner.Scanner.room`.
    """
    mount, directions, beams, limits, baked, outlines, lookup = sensor
    corners, corner = outlines
    wide, _, whole = room
    high, count, found = limits[1], bodies.shape[1], 0
    of_world, of_robot = ranges.strides[0] // 4, ranges.strides[1] // 4
    for n in chosen:
        for m in range(poses.shape[1]):
            exact_kernels.clear(ranges, n, m)
            me = first + m if first >= 0 else -1
            sx, sy, heading = exact_kernels.sensor_pose(poses, n, m, mount)
            scan = sx, sy, heading + beams[0], float(n * of_world + m * of_robot)
            begin, missed = 0, 0
            while begin < count:
                end = min(count, begin + baking.LANES - found)
                found, left = baking.in_sight(
                    found, begin, end, bodies, n, me, scan, high, baked, wide, whole
                )
                begin, missed = end, missed + left
                if found == baking.LANES:
                    fuse_kernels.look_up(found, ranges, beams, limits, lookup, room)
                    found = 0
            if missed > 0 or walls.shape[0] > 0:
                out = ranges[n, m]
                c, s = math.cos(heading), math.sin(heading)
                for k in range(count if missed > 0 else 0):
                    if baking.left_out(bodies, n, k, me, sx, sy, high, baked):
                        exact_kernels.body_into(
                            out, directions, beams, sx, sy, c, s, bodies[n, k], corners, corner,
                            high,
                        )  # fmt: skip
                near = exact_kernels.walls_into(out, directions, beams, sx, sy, c, s, walls, high)
                if near > 0 or missed > 0:
                    exact_kernels.finish(out, limits[0], high)
    fuse_kernels.look_up(found, ranges, beams, limits, lookup, room)


@kernel
def add_map(ranges, poses, chosen, sensor, map_arrays, exact, room):  # type: ignore[no-untyped-def]
    """Fuses a static map into the scans of some worlds.

    Args:
        ranges: (N, M, B) scans, in place.
        poses: (N, M, 3) of `base_link` in the world.
        chosen: (n,) indices of the worlds.
        sensor: see `scanner.Scanner.arguments`.
        map_arrays: see `maps_grid.GridMap.arrays`.
        exact: whether to walk from cell to cell.
        room: see `scanner.Scanner.room`.
    """
    mount, directions, beams, limits = sensor[0], sensor[1], sensor[2], sensor[3]
    for n in chosen:
        for m in range(poses.shape[1]):
            sx, sy, _, c, s = exact_kernels.to_sensor(poses, n, m, mount)
            out = ranges[n, m]
            if exact:
                map_kernels.exact_map_into(
                    out, directions, beams, sx, sy, c, s, limits[1], map_arrays, room
                )
            else:
                map_kernels.map_into(
                    out, directions, beams, sx, sy, c, s, limits[1], map_arrays, room
                )
            exact_kernels.finish(out, limits[0], limits[1])
