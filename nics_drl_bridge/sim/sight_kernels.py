"""Compiled inner loops of the simulator: the scans, from where and when each lidar takes them.

Shapes: N worlds, M robots, K obstacles, W walls, B beams, G slices of a sweep, R periods of `past`,
see `sensing_kernels`.
"""

from __future__ import annotations

import math

from nics_drl_bridge.kernels import kernel
from nics_drl_bridge.lidar import fault_kernels, scan_kernels
from nics_drl_bridge.sim import cell_kernels as crowd
from nics_drl_bridge.sim import sensing_kernels as sensing


@kernel
def needs_own(n, age, faults):  # type: ignore[no-untyped-def]
    """Whether a robot of world n needs a scan that is not of its pose at the moment."""
    for m in range(age.shape[1]):
        if age[n, m] > 0 or faults[n, m, fault_kernels.SKEW] != 0.0:
            return True
    return False


@kernel
def look_alone(  # type: ignore[no-untyped-def]
    n, pose, bodies, ranges, steps, faults, age, velocity, past, walls, crowded, view, sensors,
    crowding, dt, substeps,
):  # fmt: skip
    """Scans of world n, each robot's from its own place and time.

    Args:
        n: which world.
        pose and others: fields of `worlds.Worlds`.
        walls: (W, 4).
        crowded: whether the bodies are in cells.
        view, sensors, crowding: see `worlds.arguments`.
        dt, substeps: [s], and substeps in a period.
    """
    for m in range(pose.shape[1]):
        lag = sensing.lag_of(age[n, m], steps[n], past.shape[2], substeps)
        _look_alone(
            n, m, lag, pose, bodies, ranges, steps, faults[n, m, fault_kernels.SKEW], velocity,
            past, walls, crowded, view, sensors, crowding, dt, substeps,
        )  # fmt: skip


@kernel(inline=True)
def look_or_wait(  # type: ignore[no-untyped-def]
    n, together, pose, bodies, ranges, steps, faults, age, velocity, past, walls, crowded, view,
    sensors, crowding, dt, substeps,
):  # fmt: skip
    """Scans of world n, unless `look_together` can take them; how many worlds now wait for it.

    Args:
        n: which world.
        together: how many waited before.
        pose and others: see `look_alone`.
    """
    if crowded or needs_own(n, age, faults):
        look_alone(
            n, pose, bodies, ranges, steps, faults, age, velocity, past, walls, crowded, view,
            sensors, crowding, dt, substeps,
        )  # fmt: skip
        return together
    sensors[1][together] = n
    return together + 1


@kernel
def look_together(together, pose, bodies, ranges, first, walls, view, sensors):  # type: ignore[no-untyped-def]
    """Scans the first `together` worlds of the list in `sensors`, as they stand."""
    chosen, scan_room = sensors[1][:together], sensors[8]
    sensor, map_arrays, exact = view[0], view[1], view[2]
    scan_kernels.scan_worlds(ranges, pose, chosen, bodies, first, walls, sensor, scan_room)
    if map_arrays[0].size > 0:
        scan_kernels.add_map(ranges, pose, chosen, sensor, map_arrays, exact, scan_room)


@kernel
def distort(low, high, ranges, faults, steps, seeds, view):  # type: ignore[no-untyped-def]
    """Does to the scans of the worlds [low, high) what the device of each robot does to them."""
    limits, robots = view[4], ranges.shape[1]
    for n in range(low, high):
        for m in range(robots):
            counter = steps[n] * robots + m
            fault_kernels.distort(ranges[n, m], limits, faults[n, m], seeds[n], counter)


@kernel(inline=True)
def _look_alone(  # type: ignore[no-untyped-def]
    n, m, lag, pose, bodies, ranges, steps, skew, velocity, past, walls, crowded, view, sensors,
    crowding, dt, substeps,
):  # fmt: skip
    """Scan of one robot `lag` substeps ago, maybe skewed; see `look_alone`."""
    _, _, _, mount, limits, sweep_time = view
    spot, slices, part, drive, none = sensors[3], sensors[4], sensors[5], sensors[6], sensors[7]
    this, beams = steps[n] % past.shape[2], ranges.shape[2]
    for i in range(3):
        spot[0, 0, i] = pose[n, m, i]
        drive[i] = past[n, m, this, sensing.TWIST + i] if steps[n] > 0 else 0.0
    if lag > 0:
        x, y, heading = sensing.at_lag(past, n, m, sensing.POSE, lag, steps[n], substeps)
        spot[0, 0, 0], spot[0, 0, 1], spot[0, 0, 2] = x, y, heading
        x, y, heading = sensing.at_lag(past, n, m, sensing.TWIST, lag, steps[n], substeps)
        drive[0], drive[1], drive[2] = x, y, heading
    reach = limits[1] + math.hypot(mount[0], mount[1])
    if skew != 0.0:
        reach += math.hypot(drive[0], drive[1]) * sweep_time
    count = _gather(
        n, m, lag, spot[0, 0], reach, bodies, velocity, past, steps[n], crowded, sensors[2],
        crowding, dt, substeps,
    )  # fmt: skip
    seen = sensors[2][: count * 7].reshape((1, count, 7))
    begin = (n * ranges.shape[1] + m) * beams
    scan = ranges.reshape(-1)[begin : begin + beams].reshape((1, 1, beams))
    sensor, map_arrays, exact = view[0], view[1], view[2]
    groups = 1 if skew == 0.0 else slices.shape[0]
    if groups > 1:
        fault_kernels.slice_poses(slices, spot[0, 0], drive, sweep_time, skew)
    for g in range(groups):  # what is called below is large: once is enough to compile
        out = scan if groups == 1 else part
        for i in range(3 if groups > 1 else 0):
            spot[0, 0, i] = slices[g, i]
        scan_kernels.scan_worlds(out, spot, none, seen, -1, walls, sensor, sensors[8])
        if map_arrays[0].size > 0:
            scan_kernels.add_map(out, spot, none, sensor, map_arrays, exact, sensors[8])
        for i in range(g * beams // groups, (g + 1) * beams // groups if groups > 1 else 0):
            scan[0, 0, i] = part[0, 0, i]


@kernel
def _gather(  # type: ignore[no-untyped-def]
    n, m, lag, spot, reach, bodies, velocity, past, steps, crowded, seen, crowding, dt, substeps
):
    """Copies to `seen` the bodies around a spot, where they were `lag` substeps ago; how many."""
    cells, found = crowding
    first = velocity.shape[1]
    several, in_cells = bodies.shape[1], crowded and lag == 0  # the cells are of this period
    if in_cells:
        several = crowd.bodies_around(spot[0], spot[1], reach, cells, found)
    count, ago = 0, lag * dt
    for i in range(several):
        k = found[i] if in_cells else i
        radius = bodies[n, k, 5]
        if k == first + m or radius <= 0.0:
            continue
        at = 7 * count
        for j in range(7):
            seen[at + j] = bodies[n, k, j]
        turned = False
        if lag > 0 and k >= first:
            x, y, heading = sensing.at_lag(past, n, k - first, sensing.POSE, lag, steps, substeps)
            seen[at], seen[at + 1], seen[at + 2], turned = x, y, heading, True
        elif lag > 0:
            seen[at] -= velocity[n, k, 0] * ago
            seen[at + 1] -= velocity[n, k, 1] * ago
            turned = velocity[n, k, 2] != 0.0
            seen[at + 2] -= velocity[n, k, 2] * ago
        if turned:
            seen[at + 3], seen[at + 4] = math.cos(seen[at + 2]), math.sin(seen[at + 2])
        dx, dy = seen[at] - spot[0], seen[at + 1] - spot[1]
        if dx * dx + dy * dy <= (reach + radius) * (reach + radius):
            count += 1
    return count
