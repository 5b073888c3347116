"""Compiled sensors of the simulator: odometry and scans, both possibly delayed.

At the end of each period:

1. `measure_odometry` adds the displacement measured by the wheels, and noise, to the
   odometry pose, in the ring buffer `State.past`. `record_truth` keeps the true pose and
   twist beside it.
2. `scan_or_wait` scans worlds with a delayed or skewed scan immediately. The other
   worlds wait for `scan_together`, which is faster per scan.
3. `distort_scans` applies the faults of each robot's lidar.

An observation is `State.age` substeps old. Poses and twists between the ends of two periods are
interpolated linearly. No observation is older than its episode.
"""

import math

from nics_drl_bridge import random_kernels as random
from nics_drl_bridge.kernels import kernel
from nics_drl_bridge.lidar import fault_kernels
from nics_drl_bridge.lidar.beam_kernels import locate_lidar
from nics_drl_bridge.lidar.exact_kernels import COS, HEADING, RADIUS, SIN, X, Y
from nics_drl_bridge.lidar.scan_kernels import scan_robot
from nics_drl_bridge.robot.kernels import move, wrap
from nics_drl_bridge.sim.collision_kernels import find_around
from nics_drl_bridge.sim.state import (
    BODY_COLUMNS,
    ODOM,
    ODOM_ANGULAR,
    ODOM_LINEAR,
    ODOM_TWIST,
    POSE,
    TRUE_TWIST,
    Array,
    Dynamics,
    Part,
    State,
)

# Maximum time by which obstacles of a delayed scan are extrapolated backwards [s]. A
# pedestrian changes velocity within about this time, and could otherwise be moved
# through walls.
FURTHEST_BACK = 1.0


@kernel(inline=True)
def measure_odometry(
    n: int,
    m: int,
    start: Array,
    end: Array,
    twist: Array,
    data: State,
    motion: Dynamics,
) -> None:
    """Measure the odometry of robot m of world n, at the end of a period.

    The odometry pose drifts, because its displacements are noisy; the twist has the
    same noise.

    Args:
        n: the world.
        m: the robot.
        start: (3,) pose at the start of the period: by the wheels of another engine, or the true
            one, so that the odometry of the fast simulator notices drift and contacts.
        end: (3,) pose at the end of the period, likewise.
        twist: (3,) or more; body twist at the end of the period, by the wheels.
        data: the state, whose `past`, `odom` and `twist` are written.
        motion: length of the period.
    """
    steps = data.steps[n]
    rows = data.past.shape[2]
    substeps = motion.substeps
    new = steps % rows
    last = data.past[n, m, new - 1 if new > 0 else rows - 1]
    noise_x = _draw_odometry_noise(n, m, 0, data)
    noise_y = _draw_odometry_noise(n, m, 1, data)
    noise_turn = _draw_odometry_noise(n, m, 2, data)
    # the displacement in the robot's frame at the start of the period
    c = math.cos(start[2])
    s = math.sin(start[2])
    dx = end[0] - start[0]
    dy = end[1] - start[1]
    ahead = c * dx + s * dy
    left = c * dy - s * dx
    turn = end[2] - start[2]
    # the same displacement from the last odometry pose
    heading = last[ODOM + 2]
    c = math.cos(heading)
    s = math.sin(heading)
    x = last[ODOM] + (c * ahead - s * left)
    y = last[ODOM + 1] + (s * ahead + c * left)
    heading += turn
    if noise_x != 0.0 or noise_y != 0.0 or noise_turn != 0.0:
        period = motion.dt * substeps
        c = math.cos(heading)
        s = math.sin(heading)
        turn = noise_turn * period
        x, y, _, _ = move(x, y, c, s, noise_x, noise_y, turn, period, motion.series)
        heading = wrap(heading + turn)
    row = data.past[n, m, new]
    row[ODOM] = x
    row[ODOM + 1] = y
    row[ODOM + 2] = wrap(heading)
    row[ODOM_TWIST] = twist[0] + noise_x
    row[ODOM_TWIST + 1] = twist[1] + noise_y
    row[ODOM_TWIST + 2] = twist[2] + noise_turn
    odom = data.odom[n, m]
    odom_twist = data.twist[n, m]
    # This branch avoids a division by `substeps`, which takes 1/30 of a step.
    if data.age[n, m] == 0:
        for i in range(3):
            odom[i] = row[ODOM + i]
            odom_twist[i] = row[ODOM_TWIST + i]
        return
    past = data.past[n, m]
    lag = limit_lag(data.age[n, m], steps, rows, substeps)
    interpolate_past(past, ODOM, lag, steps, substeps, odom)
    interpolate_past(past, ODOM_TWIST, lag, steps, substeps, odom_twist)


@kernel(inline=True)
def record_truth(n: int, m: int, pose: Array, twist: Array, data: State) -> None:
    """Keep the true pose (3,) and body twist (3,) or more of a robot at the end of a period."""
    row = data.past[n, m, data.steps[n] % data.past.shape[2]]
    for i in range(3):
        row[POSE + i] = pose[i]
        row[TRUE_TWIST + i] = twist[i]


@kernel(inline=True)
def _draw_odometry_noise(n: int, m: int, axis: int, data: State) -> float:
    """Draw the noise of the twist: forward (axis 0), left (1), turn rate (2)."""
    std = data.noise[n, m, ODOM_ANGULAR if axis == 2 else ODOM_LINEAR]
    if std <= 0.0:
        return 0.0
    counter = 3 * (data.steps[n] * data.pose.shape[1] + m) + axis
    noise: float = std * random.normal(data.seeds[n], random.ODOMETRY_STREAM, counter)
    return noise


@kernel
def limit_lag(age: int, steps: int, rows: int, substeps: int) -> int:
    """Limit an age [substeps] to the elapsed episode and to the ring buffer."""
    return max(min(age, min(steps, rows - 1) * substeps), 0)


@kernel
def interpolate_past(
    past: Array,
    column: int,
    lag: int,
    steps: int,
    substeps: int,
    out: Array,
) -> None:
    """Write a robot's record `lag` substeps before the end of period `steps` to `out`.

    `past` (R, PAST_COLUMNS) is its ring buffer, `out` (3,); `column` is the first of
    three columns: `POSE`, `TRUE_TWIST`, `ODOM` or `ODOM_TWIST`.
    """
    newer = steps - lag // substeps
    fraction = (lag % substeps) / substeps
    new = past[newer % len(past)]
    old = past[(newer - 1) % len(past)]
    is_pose = column in (POSE, ODOM)
    for i in range(3):
        out[i] = new[column + i]
        if fraction > 0.0:
            change = old[column + i] - out[i]
            if i == 2 and is_pose:
                out[i] = wrap(out[i] + fraction * wrap(change))
            else:
                out[i] += fraction * change


@kernel(inline=True)
def scan_or_wait(n: int, waiting_count: int, part: Part) -> int:
    """Scan world n, or let it wait for `scan_together`; return how many worlds wait."""
    data = part.data
    any_late = False
    for m in range(data.age.shape[1]):
        is_skewed = data.faults[n, m, fault_kernels.SKEW] != 0.0
        any_late = any_late or data.age[n, m] > 0 or is_skewed
    if any_late:
        for m in range(data.pose.shape[1]):
            _scan_from_past(n, m, part)
        return waiting_count
    part.scans.waiting[waiting_count] = n
    return waiting_count + 1


@kernel
def scan_together(waiting_count: int, part: Part) -> None:
    """Scan the waiting worlds at their current state."""
    data = part.data
    lidar = part.lidar
    scans = part.scans
    cells = part.cells
    for n in scans.waiting[:waiting_count]:
        for m in range(data.pose.shape[1]):
            pose = locate_lidar(data.pose[n, m], lidar.mount)
            count = find_around(n, pose.x, pose.y, lidar.range_max, cells)
            scan_robot(
                data.ranges[n, m],
                n,
                pose,
                data.bodies[n],
                cells.found[:count],
                data.velocity.shape[1] + m,
                part.world_set.fixtures,
                lidar,
                scans.scratch,
            )


@kernel
def distort_scans(first_world: int, end_world: int, part: Part) -> None:
    """Apply the faults of each robot's lidar to the scans of worlds [first_world, end_world)."""
    data = part.data
    limits = part.lidar.range_min, part.lidar.range_max
    robots = data.ranges.shape[1]
    for n in range(first_world, end_world):
        for m in range(robots):
            counter = data.steps[n] * robots + m
            fault_kernels.distort(
                data.ranges[n, m], limits, data.faults[n, m], data.seeds[n], counter
            )


@kernel
def _scan_from_past(n: int, m: int, part: Part) -> None:
    """Scan from the pose at which robot m of world n took its reported scan.

    With skew, each group of beams is scanned from its own pose within the sweep.
    """
    data = part.data
    lidar = part.lidar
    scans = part.scans
    steps = data.steps[n]
    substeps = part.motion.substeps
    skew = data.faults[n, m, fault_kernels.SKEW]
    pose = scans.pose
    twist = scans.twist
    past = data.past[n, m]
    lag = limit_lag(data.age[n, m], steps, len(past), substeps)
    interpolate_past(past, POSE, lag, steps, substeps, pose)
    interpolate_past(past, TRUE_TWIST, lag, steps, substeps, twist)
    reach = lidar.range_max + math.hypot(lidar.mount[0], lidar.mount[1])
    if skew != 0.0:
        reach += math.hypot(twist[0], twist[1]) * lidar.sweep_time
    nearby = scans.everybody[: _gather_bodies(n, m, lag, reach, part)]
    ranges = data.ranges[n, m]
    beams = len(ranges)
    groups = 1 if skew == 0.0 else len(scans.slice_poses)
    if groups > 1:
        moving = (steps * substeps - lag) * part.motion.dt
        fault_kernels.slice_poses(
            scans.slice_poses, pose, twist, lidar.sweep_time, skew, moving
        )
    # One call for both cases, because `scan_robot` is large and is compiled per call.
    for group in range(groups):
        out = ranges if groups == 1 else scans.slice_ranges
        if groups > 1:
            for i in range(3):
                pose[i] = scans.slice_poses[group, i]
        scan_robot(
            out,
            n,
            locate_lidar(pose, lidar.mount),
            scans.bodies,
            nearby,
            -1,
            part.world_set.fixtures,
            lidar,
            scans.scratch,
        )
        if groups > 1:
            for i in range(group * beams // groups, (group + 1) * beams // groups):
                ranges[i] = scans.slice_ranges[i]


@kernel
def _gather_bodies(n: int, m: int, lag: int, reach: float, part: Part) -> int:
    """Copy the bodies around `scans.pose` of `lag` substeps ago; return their number.

    Robots are interpolated from their recorded past. The past of obstacles is not
    recorded: they are moved back by their current velocity. This is exact within the
    period, and before it for as long as the velocity was constant. The extrapolation is
    limited to `FURTHEST_BACK`.
    """
    data = part.data
    world_set = part.world_set
    motion = part.motion
    scans = part.scans
    found = part.cells.found
    pose = scans.pose
    first_robot = data.velocity.shape[1]
    candidates = data.bodies.shape[1]
    # The cells of a crowd are sorted by current positions.
    in_cells = world_set.standing or (world_set.crowded and lag == 0)
    if in_cells:
        candidates = find_around(n, pose[0], pose[1], reach, part.cells)
    count = 0
    ago = min(lag * motion.dt, FURTHEST_BACK)
    for i in range(candidates):
        k = found[i] if in_cells else i
        radius = data.bodies[n, k, RADIUS]
        if k == first_robot + m or radius <= 0.0:
            continue
        body = scans.bodies[count]
        for j in range(BODY_COLUMNS):
            body[j] = data.bodies[n, k, j]
        has_turned = False
        if lag > 0 and k >= first_robot:
            past = data.past[n, k - first_robot]
            interpolate_past(past, POSE, lag, data.steps[n], motion.substeps, body)
            has_turned = True
        elif lag > 0:
            velocity = data.velocity[n, k]
            for j in range(3):
                body[j] -= velocity[j] * ago
            has_turned = velocity[2] != 0.0
        if has_turned:
            body[COS] = math.cos(body[HEADING])
            body[SIN] = math.sin(body[HEADING])
        dx = body[X] - pose[0]
        dy = body[Y] - pose[1]
        if dx * dx + dy * dy <= (reach + radius) * (reach + radius):
            count += 1
    return count
