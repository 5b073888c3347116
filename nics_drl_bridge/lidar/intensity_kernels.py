"""Compiled inner loops of intensities: which surface each beam meets, and at what angle.

Apart from the kernels of the ranges, which know nothing of it: who wants no intensities pays
nothing for them. `nearest` (B,) holds the ranges of what was fused so far, `light` (B,) the
reflectance of the same, reflectivity times the cosine of the angle of incidence to an exponent.
Each object lowers `nearest` by the same functions as a scan; where it did, the light is its own.
"""

from __future__ import annotations

import math

import numpy as np

from nics_drl_bridge.kernels import kernel
from nics_drl_bridge.lidar import bake_kernels, exact_kernels, map_kernels, scan_kernels
from nics_drl_bridge.lidar import baked_kernels as baking
from nics_drl_bridge.lidar.sensor_models import NEAREST

GAIN, SATURATION, EXPONENT, REFLECTIVITY = range(4)
"""Numbers of a device, see `sensor_models.Intensity.device`."""


@kernel
def shine(cosine, exponent, reflectivity):  # type: ignore[no-untyped-def]
    """The reflectance of one point."""
    cosine = min(abs(cosine), 1.0)
    return reflectivity * (cosine if exponent == 1.0 else cosine**exponent)


@kernel
def keep(before, nearest):  # type: ignore[no-untyped-def]
    """Copies `nearest`; a plain assignment would look after arrays that overlap, in a new one."""
    for i in range(nearest.shape[0]):
        before[i] = nearest[i]


@kernel
def circle(scan, directions, beams, x, y, radius, surface, range_max):  # type: ignore[no-untyped-def]
    """As `kernels.circle`: at a point its normal is the direction from the centre.

    Args:
        scan: `nearest`, `light` and scratch, (B,) float32 each.
        directions, beams, x, y, radius, range_max: see `kernels.circle`.
        surface: exponent and reflectivity.
    """
    nearest, light, before = scan
    keep(before, nearest)
    exact_kernels.circle(nearest, directions, beams, x, y, radius, range_max)
    for i in range(nearest.shape[0]):
        if nearest[i] < before[i]:
            along = directions[i, 0] * x + directions[i, 1] * y
            light[i] = shine((nearest[i] - along) / radius, surface[0], surface[1])


@kernel
def segment(scan, directions, beams, x1, y1, x2, y2, surface):  # type: ignore[no-untyped-def]
    """As `kernels.segment`: cos(incidence) is the distance of its line over the range."""
    nearest, light, before = scan
    keep(before, nearest)
    exact_kernels.segment(nearest, directions, beams, x1, y1, x2, y2)
    ex, ey = x2 - x1, y2 - y1
    away = np.float32(abs(x1 * ey - y1 * ex) / math.sqrt(ex * ex + ey * ey))
    if surface[0] == 1.0:  # without a power, many at a time
        white, one = np.float32(surface[1]), np.float32(1.0)
        for i in range(nearest.shape[0]):
            now, held, kept = nearest[i], before[i], light[i]
            value = white * min(away / now, one)
            light[i] = value if now < held else kept
        return
    for i in range(nearest.shape[0]):
        if nearest[i] < before[i]:
            light[i] = shine(away / nearest[i], surface[0], surface[1])


@kernel
def outline(scan, directions, beams, x, y, c, s, corners, radius, surface, range_max):  # type: ignore[no-untyped-def]
    """A circle, which has no corners, or a polygon, turned by (c, s), with its origin at (x, y)."""
    if corners.shape[0] == 0:
        circle(scan, directions, beams, x, y, radius, surface, range_max)
        return
    ax, ay = exact_kernels.turned(x, y, c, s, corners[corners.shape[0] - 1])
    for v in range(corners.shape[0]):
        bx, by = exact_kernels.turned(x, y, c, s, corners[v])
        segment(scan, directions, beams, ax, ay, bx, by, surface)
        ax, ay = bx, by


@kernel
def body(scan, directions, beams, place, body, corners, corner, surface, range_max):  # type: ignore[no-untyped-def]
    """As `kernels.body_into`, from a lidar at `place`: x, y, cos, sin."""
    sx, sy, c, s = place
    dx, dy = body[0] - sx, body[1] - sy
    x, y = c * dx + s * dy, c * dy - s * dx
    cos, sin = body[3] * c + body[4] * s, body[4] * c - body[3] * s
    shape = int(body[6])
    own = corners[corner[shape] : corner[shape + 1]]
    outline(scan, directions, beams, x, y, cos, sin, own, body[5], surface, range_max)


@kernel
def walls(scan, directions, beams, place, lines, surface):  # type: ignore[no-untyped-def]
    """As `kernels.walls_into`."""
    sx, sy, c, s = place
    for w in range(lines.shape[0]):
        ax, ay = lines[w, 0] - sx, lines[w, 1] - sy
        bx, by = lines[w, 2] - sx, lines[w, 3] - sy
        ax, ay = c * ax + s * ay, c * ay - s * ax
        bx, by = c * bx + s * by, c * by - s * bx
        segment(scan, directions, beams, ax, ay, bx, by, surface)


@kernel(allocates=True)
def grid(  # type: ignore[no-untyped-def]
    scan, directions, beams, place, range_max, surface, map_arrays, exact, room
):
    """A static map: its surfaces are sides of cells, and the beam ends at the nearer line."""
    nearest, light, before = scan
    squares, frame = map_arrays
    if squares.size == 0:
        return
    sx, sy, c, s = place
    keep(before, nearest)
    if exact:
        map_kernels.exact_map_into(
            nearest, directions, beams, sx, sy, c, s, range_max, map_arrays, room
        )
    else:
        map_kernels.map_into(nearest, directions, beams, sx, sy, c, s, range_max, map_arrays, room)
    u, v, gc, gs = map_kernels.to_grid(sx, sy, c, s, frame)
    for i in range(nearest.shape[0]):
        if nearest[i] < before[i]:
            du = gc * directions[i, 0] - gs * directions[i, 1]
            dv = gs * directions[i, 0] + gc * directions[i, 1]
            cells = nearest[i] / frame[4]
            x, y = u + du * cells, v + dv * cells
            upright = abs(x - math.floor(x + 0.5)) < abs(y - math.floor(y + 0.5))
            light[i] = shine(du if upright else dv, surface[0], surface[1])


@kernel
def fuse(scan, beams, bearing, half, ranges, reflectance):  # type: ignore[no-untyped-def]
    """Fuses a body that was looked up alone: its ranges (B,) and its reflectance (B,).

    Only the beams between `bearing - half` and `bearing + half` [rad] can meet it.
    """
    nearest, light, _ = scan
    count, turns = nearest.shape[0], 1 if beams[2] > 0.0 else 3
    for turn in range(turns):
        middle = bearing + (0.0 if turns == 1 else (turn - 1) * exact_kernels.TWO_PI)
        first, hits = exact_kernels.beam_span(middle - half, middle + half, beams, count)
        for k in range(hits):
            i = first + k
            i -= count if i >= count else 0
            if ranges[i] < nearest[i]:
                nearest[i], light[i] = ranges[i], reflectance[i]


@kernel
def report(intensities, ranges, scan, device, range_min):  # type: ignore[no-untyped-def]
    """Intensities (B,) of the beams that return anything, 0 of the others.

    What is too close, and reported nevertheless, is as bright as at `range_min`.
    """
    nearest, light, _ = scan
    gain, most = np.float32(device[GAIN]), np.float32(device[SATURATION])
    least, nothing = np.float32(max(NEAREST, range_min)), np.float32(0.0)
    for i in range(nearest.shape[0]):
        away = max(nearest[i], least)
        value = min(gain * light[i] / (away * away), most)
        intensities[i] = value if abs(ranges[i]) < np.float32(np.inf) else nothing


@kernel
def set_apart(apart, pose, bodies, n, me, sx, sy, range_max, baked):  # type: ignore[no-untyped-def]
    """Puts every body of a world that can be looked up into a world of its own, with the robot.

    Args:
        apart: poses (K, 1, 3) and bodies (K, 1, 7), results; a radius of 0 where there is none.
        pose: (3,) of the robot.
        bodies, n, me, sx, sy, range_max, baked: see `baked_kernels.left_out`.
    """
    poses, alone = apart
    for k in range(bodies.shape[1]):
        for i in range(poses.shape[2]):
            poses[k, 0, i] = pose[i]
        for i in range(alone.shape[2]):
            alone[k, 0, i] = bodies[n, k, i]
        reach = range_max + bodies[n, k, 5]
        near = math.hypot(bodies[n, k, 0] - sx, bodies[n, k, 1] - sy) <= reach
        if k == me or not near or baking.left_out(bodies, n, k, me, sx, sy, range_max, baked):
            alone[k, 0, 5] = 0.0


@kernel(allocates=True)
def intensities_of_worlds(  # type: ignore[no-untyped-def]
    intensities, ranges, poses, chosen, bodies, first, lines, sensors, room, scan, apart, found,
    surfaces, device, map_arrays, exact,
):  # fmt: skip
    """Intensities that belong to the scans of the robots of some worlds.

    What a body gives is looked up as scans are, twice: from the ranges, and from the reflectances
    in their place.

    Args:
        intensities: (N, M, B) float32 result [the device's unit].
        ranges: (N, M, B) what the robots measured: where it is not finite the intensity is 0.
        poses, chosen, bodies, first, room: see `scan_kernels.scan_worlds`.
        lines: (W, 4) walls.
        sensors: see `scanner.Scanner.arguments`, and the same with reflectances for ranges.
        scan: scratch, (B,) float32 three times.
        apart: scratch, see `set_apart`.
        found: scratch, (K, 1, B) float32 twice, and all the numbers up to K.
        surfaces: (H,) reflectivity of each shape.
        device: (4,) see `sensor_models.Intensity.device`.
        map_arrays, exact: see `scan_kernels.add_map`.
    """
    sensor, bright = sensors
    mount, directions, beams, limits, baked, outlines = sensor[:6]
    corners, corner = outlines
    near, light, every = found
    high, plain, none = limits[1], (device[EXPONENT], device[REFLECTIVITY]), lines[:0]
    for n in chosen:
        for m in range(poses.shape[1]):
            me = first + m if first >= 0 else -1
            sx, sy, _, c, s = exact_kernels.to_sensor(poses, n, m, mount)
            place = (sx, sy, c, s)
            set_apart(apart, poses[n, m], bodies, n, me, sx, sy, high, baked)
            scan_kernels.scan_worlds(near, apart[0], every, apart[1], -1, none, sensor, room)
            scan_kernels.scan_worlds(light, apart[0], every, apart[1], -1, none, bright, room)
            scan[0][:], scan[1][:] = np.float32(np.inf), np.float32(0.0)
            for k in range(bodies.shape[1]):
                radius = apart[1][k, 0, 5]
                if radius > 0.0:
                    dx, dy = bodies[n, k, 0] - sx, bodies[n, k, 1] - sy
                    half = math.asin(min(radius / math.hypot(dx, dy), 1.0)) + beams[1]
                    bearing = exact_kernels.arctan2(c * dy - s * dx, c * dx + s * dy)
                    fuse(scan, beams, bearing, half, near[k, 0], light[k, 0])
                elif baking.left_out(bodies, n, k, me, sx, sy, high, baked):
                    surface = (device[EXPONENT], surfaces[int(bodies[n, k, 6])])
                    body(
                        scan, directions, beams, place, bodies[n, k], corners, corner, surface, high
                    )
            walls(scan, directions, beams, place, lines, plain)
            grid(scan, directions, beams, place, high, plain, map_arrays, exact, room)
            report(intensities[n, m], ranges[n, m], scan, device, limits[0])


@kernel(allocates=True)
def cosines_of_turn(cosines, layout, shape, distances, turn, edges, step, phases):  # type: ignore[no-untyped-def]
    """The cosine of the angle of incidence at every point of the rows of one rotation.

    Beyond the edges of the shape it is that at the edge, as for the ranges.

    Args:
        cosines: (R,) float32 result, laid out as the ranges.
        layout, shape, distances, turn, edges, step, phases: see `bake_kernels.rows_of_turn`.
    """
    c, s = math.cos(turn), math.sin(turn)
    corners, radius = shape
    for d in range(distances.shape[0]):
        start, begin, width = layout[0, d], layout[1, d], layout[2, d]
        count = width * phases
        angles = (begin * phases + np.arange(count)) * (step / phases)
        inside = bake_kernels.EDGE * (edges[d, 1] - edges[d, 0])
        low, high = edges[d, 0] + inside, edges[d, 1] - inside
        fine = incidences(angles, step / phases, corners, radius, distances[d], c, s)
        at = np.array([low, high])
        ends = np.empty(2, np.float32)
        for side in range(2):
            ends[side] = incidences(at[side : side + 1], 1.0, corners, radius, distances[d], c, s)[
                0
            ]
        fine[angles < low] = ends[0]
        fine[angles > high] = ends[1]
        bake_kernels.into_phases(cosines[start : start + count], fine, width, phases)


@kernel(allocates=True)
def incidences(angles, step, corners, radius, distance, c, s):  # type: ignore[no-untyped-def]
    """Cosines (P,) of the incidence on a shape straight ahead, 0 where a ray misses it."""
    directions = np.stack((np.cos(angles), np.sin(angles)), axis=1)
    beams = (angles[0], step, 0.0)
    scan = (
        np.full(len(angles), np.inf, np.float32),
        np.zeros(len(angles), np.float32),
        np.empty(len(angles), np.float32),
    )
    outline(scan, directions, beams, distance, 0.0, c, s, corners, radius, (1.0, 1.0), np.inf)
    return scan[1]
