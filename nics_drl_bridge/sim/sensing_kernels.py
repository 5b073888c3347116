"""Compiled inner loops of the simulator: noise and latency of the odometry, drift of the motion.

Observations may be delayed: `past` (N, M, R, 12) is a ring buffer of the values at the ends of the
last R periods, step i in row i % R: true pose, true twist, pose by odometry, measured twist.
Between two rows, values are interpolated linearly.

Shapes: N worlds, M robots, S state, R periods.

Compiled inner loops of the simulator: scans from the place and time of each lidar.

Shapes: N worlds, M robots, K obstacles, W walls, B beams, G slices of a sweep, R periods of `past`,
see `sensing_kernels`.
"""

from __future__ import annotations

import math

from nics_drl_bridge import random_kernels as random
from nics_drl_bridge.kernels import kernel
from nics_drl_bridge.lidar import fault_kernels, scan_kernels
from nics_drl_bridge.robot.kernels import move, wrap
from nics_drl_bridge.sim import contact_kernels as crowd

POSE, TWIST, ODOM, MEASURED, PAST = 0, 3, 6, 9, 12
"""Columns of `past`."""


@kernel
def begin(past, n, m, pose, odom, twist):  # type: ignore[no-untyped-def]
    """Records the values of a robot at the beginning of an episode."""
    for i in range(3):
        past[n, m, 0, POSE + i], past[n, m, 0, TWIST + i] = pose[n, m, i], 0.0
        past[n, m, 0, ODOM + i], past[n, m, 0, MEASURED + i] = odom[n, m, i], twist[n, m, i]


@kernel
def lag_of(age, steps, rows, substeps):  # type: ignore[no-untyped-def]
    """Age of an observation [substeps], limited to the present episode and the ring buffer."""
    return max(min(age, min(steps, rows - 1) * substeps), 0)


@kernel
def at_lag(past, n, m, column, lag, steps, substeps):  # type: ignore[no-untyped-def]
    """Returns three columns of `past`, `lag` substeps before the end of period `steps`."""
    rows = past.shape[2]
    new, share = (steps - lag // substeps) % rows, (lag % substeps) / substeps
    x, y, z = past[n, m, new, column], past[n, m, new, column + 1], past[n, m, new, column + 2]
    if share > 0.0:
        old = (steps - lag // substeps - 1) % rows
        turn = past[n, m, old, column + 2] - z
        if column in (POSE, ODOM):
            turn = wrap(turn)
        x += share * (past[n, m, old, column] - x)
        y += share * (past[n, m, old, column + 1] - y)
        z += share * turn
        if column in (POSE, ODOM):
            z = wrap(z)
    return x, y, z


@kernel
def advanced(x, y, heading, vx, vy, turn, dt, series):  # type: ignore[no-untyped-def]
    """Returns the pose after the exact arc of a body twist; see `robot.kernels.move`."""
    x, y, _, _ = move(x, y, math.cos(heading), math.sin(heading), vx, vy, turn, dt, series)
    return x, y, wrap(heading + turn)


@kernel
def measure(  # type: ignore[no-untyped-def]
    odom, twist, past, before, pose, n, m, now, std, steps, seed, counter, age, dt, substeps,
    series,
):  # fmt: skip
    """Measures a robot's odometry of one period: a drifting pose and a noisy twist, maybe delayed.

    Args:
        odom: (N, M, 3) odometry pose, result.
        twist: (N, M, 3) measured twist, result.
        past: the ring buffer, see the module; the row of this period is written.
        before: (3,) true pose at the start of the period.
        pose: (N, M, 3) true poses at its end.
        n, m: indices of world and robot.
        now: (3 + S,) true rates at its end.
        std: (N, M, 2 + 3 + S) standard deviation of the linear [m/s] and the angular twist
            [rad/s], then of the drift.
        steps: periods since the reset, this one included.
        seed, counter: of the random draws.
        age: of the observation [substeps].
        dt, substeps: length of a substep [s], and substeps in a period.
        series: see `robot.kernels`.
    """
    rows = past.shape[2]
    this = steps % rows
    last = this - 1 if this > 0 else rows - 1
    noise_x = noise_y = noise_turn = 0.0
    if std[n, m, 0] > 0.0:
        noise_x = std[n, m, 0] * random.normal(seed, random.ODOMETRY_STREAM, 3 * counter)
        noise_y = std[n, m, 0] * random.normal(seed, random.ODOMETRY_STREAM, 3 * counter + 1)
    if std[n, m, 1] > 0.0:
        noise_turn = std[n, m, 1] * random.normal(seed, random.ODOMETRY_STREAM, 3 * counter + 2)
    c, s = math.cos(before[2]), math.sin(before[2])
    dx, dy = pose[n, m, 0] - before[0], pose[n, m, 1] - before[1]
    ahead, aside, turned = c * dx + s * dy, c * dy - s * dx, pose[n, m, 2] - before[2]
    x, y, heading = past[n, m, last, ODOM], past[n, m, last, ODOM + 1], past[n, m, last, ODOM + 2]
    c, s = math.cos(heading), math.sin(heading)
    x, y, heading = x + (c * ahead - s * aside), y + (s * ahead + c * aside), heading + turned
    period = dt * substeps
    if noise_x != 0.0 or noise_y != 0.0 or noise_turn != 0.0:
        x, y, heading = advanced(
            x, y, heading, noise_x, noise_y, noise_turn * period, period, series
        )
    row = past[n, m, this]
    row[ODOM], row[ODOM + 1], row[ODOM + 2] = x, y, wrap(heading)
    row[MEASURED], row[MEASURED + 1], row[MEASURED + 2] = (
        now[0] + noise_x, now[1] + noise_y, now[2] + noise_turn,
    )  # fmt: skip
    for i in range(3):
        row[POSE + i], row[TWIST + i] = pose[n, m, i], now[i]
    lag = lag_of(age, steps, rows, substeps) if age > 0 else 0
    if lag == 0:
        for i in range(3):
            odom[n, m, i], twist[n, m, i] = row[ODOM + i], row[MEASURED + i]
        return
    x, y, heading = at_lag(past, n, m, ODOM, lag, steps, substeps)
    odom[n, m, 0], odom[n, m, 1], odom[n, m, 2] = x, y, heading
    x, y, heading = at_lag(past, n, m, MEASURED, lag, steps, substeps)
    twist[n, m, 0], twist[n, m, 1], twist[n, m, 2] = x, y, heading


@kernel
def most_drift(std, n, m, period):  # type: ignore[no-untyped-def]
    """Upper bound on the distance by which `drift_of` can move a robot in a period [m]."""
    return math.sqrt(3.0 * period) * (std[n, m, 2] + std[n, m, 3])


@kernel
def drift_of(state, std, n, m, seed, counter, period):  # type: ignore[no-untyped-def]
    """Draws the motion of a robot in addition to its model: it grows with the root of the time.

    Args:
        state: (N, M, S), in place.
        std: (N, M, 2 + 3 + S) of the odometry, then along x, y and heading of the body, and of
            the state, after a second.
        n, m: indices of world and robot.
        seed, counter: of the random draws.
        period: [s].

    Returns:
        Displacement forwards and to the left [m], and turn [rad].
    """
    # Uniform draws of this variance are cheap; over several periods their sum is nearly normal.
    count, scale = std.shape[2] - 2, math.sqrt(12.0 * period)
    ahead = aside = turn = 0.0
    for i in range(count):
        if std[n, m, 2 + i] > 0.0:
            share = random.uniform(seed, random.DRIFT_STREAM, counter * count + i) - 0.5
            draw = scale * std[n, m, 2 + i] * share
            if i == 0:
                ahead = draw
            elif i == 1:
                aside = draw
            elif i == 2:
                turn = draw
            else:
                state[n, m, i - 3] += draw
    return ahead, aside, turn


@kernel
def needs_own(n, age, faults):  # type: ignore[no-untyped-def]
    """True if a robot of world n needs a delayed or skewed scan."""
    for m in range(age.shape[1]):
        if age[n, m] > 0 or faults[n, m, fault_kernels.SKEW] != 0.0:
            return True
    return False


@kernel
def look_alone(  # type: ignore[no-untyped-def]
    n, pose, bodies, ranges, steps, faults, age, velocity, past, walls, crowded, view, sensors,
    crowding, dt, substeps,
):  # fmt: skip
    """Scans world n, each robot from its own place and time.

    Args:
        n: index of the world.
        pose and others: fields of `worlds.Worlds`.
        walls: (W, 4).
        crowded: whether the bodies are in cells.
        view, sensors, crowding: see `worlds.arguments`.
        dt, substeps: length of a substep [s], and substeps in a period.
    """
    for m in range(pose.shape[1]):
        lag = lag_of(age[n, m], steps[n], past.shape[2], substeps)
        _look_alone(
            n, m, lag, pose, bodies, ranges, steps, faults[n, m, fault_kernels.SKEW], velocity,
            past, walls, crowded, view, sensors, crowding, dt, substeps,
        )  # fmt: skip


@kernel(inline=True)
def look_or_wait(  # type: ignore[no-untyped-def]
    n, together, pose, bodies, ranges, steps, faults, age, velocity, past, walls, crowded, view,
    sensors, crowding, dt, substeps,
):  # fmt: skip
    """Scans world n, or queues it for `look_together`; returns the number of queued worlds.

    Args:
        n: index of the world.
        together: number of worlds queued before.
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
    """Scans the first `together` worlds queued in `sensors`, at the present poses."""
    chosen, scan_room = sensors[1][:together], sensors[8]
    sensor, map_arrays, exact = view[0], view[1], view[2]
    scan_kernels.scan_worlds(ranges, pose, chosen, bodies, first, walls, sensor, scan_room)
    if map_arrays[0].size > 0:
        scan_kernels.add_map(ranges, pose, chosen, sensor, map_arrays, exact, scan_room)


@kernel
def distort(low, high, ranges, faults, steps, seeds, view):  # type: ignore[no-untyped-def]
    """Applies noise and faults of each robot's lidar to the scans of the worlds [low, high)."""
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
    """Scans from one robot `lag` substeps ago, maybe skewed; see `look_alone`."""
    _, _, _, mount, limits, sweep_time = view
    spot, slices, part, drive, none = sensors[3], sensors[4], sensors[5], sensors[6], sensors[7]
    this, beams = steps[n] % past.shape[2], ranges.shape[2]
    for i in range(3):
        spot[0, 0, i] = pose[n, m, i]
        drive[i] = past[n, m, this, TWIST + i] if steps[n] > 0 else 0.0
    if lag > 0:
        x, y, heading = at_lag(past, n, m, POSE, lag, steps[n], substeps)
        spot[0, 0, 0], spot[0, 0, 1], spot[0, 0, 2] = x, y, heading
        x, y, heading = at_lag(past, n, m, TWIST, lag, steps[n], substeps)
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
    for g in range(groups):  # a single call site: the functions below take long to compile
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
    """Copies to `seen` the bodies near a spot as of `lag` substeps ago; returns their number."""
    cells, found = crowding
    first = velocity.shape[1]
    several, in_cells = bodies.shape[1], crowded and lag == 0  # cells are of this period only
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
            x, y, heading = at_lag(past, n, k - first, POSE, lag, steps, substeps)
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
