"""Compiled inner loops of the simulator: odometry, drift of the motion, and scans.

Observations may be delayed: `past` (N, M, R, 12) is a ring buffer of the last R periods' ends, step
i in row i % R: true pose, true twist, pose by odometry, measured twist, interpolated linearly. The
true twist is the model's at the end of the period: a robot that a wall holds has the twist with
which it drives against the wall, as its wheels turn.
"""

import math

from nics_drl_bridge import random_kernels as random
from nics_drl_bridge.kernels import kernel
from nics_drl_bridge.lidar import fault_kernels, scan_kernels
from nics_drl_bridge.lidar.baked_kernels import LidarArrays
from nics_drl_bridge.lidar.cell_kernels import BodyCells, around
from nics_drl_bridge.lidar.exact_kernels import COS, HEADING, RADIUS, SIN, X, Y
from nics_drl_bridge.lidar.fixture_kernels import fixtures_around
from nics_drl_bridge.robot.kernels import move, wrap
from nics_drl_bridge.sim.state import Array, Dynamics, Members, Scratch, State

# Columns of `past`
POSE = 0
TWIST = 3
ODOM = 6
MEASURED = 9
PAST = 12
# Obstacles of a late scan are moved back by their velocity for so long at most [s]: a pedestrian
# changes it in about this time, and would else be moved back through walls.
FURTHEST_BACK = 1.0


@kernel
def begin(n: int, m: int, state: State) -> None:
    """Record the true state of a robot at the start of an episode."""
    past = state.past
    pose = state.pose
    odom = state.odom
    twist = state.twist
    for i in range(3):
        past[n, m, 0, POSE + i] = pose[n, m, i]
        past[n, m, 0, TWIST + i] = 0.0
        past[n, m, 0, ODOM + i], past[n, m, 0, MEASURED + i] = (
            odom[n, m, i],
            twist[n, m, i],
        )


@kernel
def lag_of(age: int, steps: int, rows: int, substeps: int) -> int:
    """Age of an observation [substeps], limited to the present episode and the ring buffer."""
    return max(min(age, min(steps, rows - 1) * substeps), 0)


@kernel
def at_lag(
    past: Array, n: int, m: int, column: int, lag: int, steps: int, substeps: int
) -> tuple[float, float, float]:
    """Return three columns of `past`, `lag` substeps before the end of period `steps`."""
    rows = past.shape[2]
    new = (steps - lag // substeps) % rows
    share = (lag % substeps) / substeps
    x = past[n, m, new, column]
    y = past[n, m, new, column + 1]
    z = past[n, m, new, column + 2]
    if share > 0.0:
        old = (steps - lag // substeps - 1) % rows
        x += share * (past[n, m, old, column] - x)
        y += share * (past[n, m, old, column + 1] - y)
        turn = past[n, m, old, column + 2] - z
        z = wrap(z + share * wrap(turn)) if column in (POSE, ODOM) else z + share * turn
    return x, y, z


@kernel
def _odometry_noise(n: int, m: int, axis: int, state: State) -> float:
    std = state.noise[n, m, axis // 2]
    if std <= 0.0:
        return 0.0
    counter = 3 * (state.steps[n] * state.pose.shape[1] + m) + axis
    noise: float = std * random.normal(state.seeds[n], random.ODOMETRY_STREAM, counter)
    return noise


@kernel
def measure(
    n: int,
    m: int,
    state: State,
    pose: Array,
    before: Array,
    now: Array,
    motion: Dynamics,
) -> None:
    """Measure a robot's odometry of one period: a drifting pose and a noisy twist, maybe delayed.

    From the pose (3,) `before`, poses (N, M, 3) by the wheels, and rates (3 + S,) at the end.
    """
    steps = state.steps[n]
    rows = state.past.shape[2]
    substeps = motion.substeps
    this = steps % rows
    last = state.past[n, m, this - 1 if this > 0 else rows - 1]
    noise_x = _odometry_noise(n, m, 0, state)
    noise_y = _odometry_noise(n, m, 1, state)
    noise_turn = _odometry_noise(n, m, 2, state)
    c = math.cos(before[2])
    s = math.sin(before[2])
    dx = pose[n, m, 0] - before[0]
    dy = pose[n, m, 1] - before[1]
    ahead = c * dx + s * dy
    aside = c * dy - s * dx
    turned = pose[n, m, 2] - before[2]
    x = last[ODOM]
    y = last[ODOM + 1]
    heading = last[ODOM + 2]
    c = math.cos(heading)
    s = math.sin(heading)
    x = x + (c * ahead - s * aside)
    y = y + (s * ahead + c * aside)
    heading = heading + turned
    if noise_x != 0.0 or noise_y != 0.0 or noise_turn != 0.0:
        period = motion.dt * substeps
        c = math.cos(heading)
        s = math.sin(heading)
        turn = noise_turn * period
        x, y, _, _ = move(x, y, c, s, noise_x, noise_y, turn, period, motion.series)
        heading = wrap(heading + turn)
    row = state.past[n, m, this]
    row[ODOM], row[ODOM + 1], row[ODOM + 2] = x, y, wrap(heading)
    row[MEASURED], row[MEASURED + 1] = now[0] + noise_x, now[1] + noise_y
    row[MEASURED + 2] = now[2] + noise_turn
    for i in range(3):
        row[POSE + i], row[TWIST + i] = pose[n, m, i], now[i]
    odom = state.odom[n, m]
    twist = state.twist[n, m]
    if state.age[n, m] == 0:  # dividing for each robot takes a thirtieth of a step
        for i in range(3):
            odom[i], twist[i] = row[ODOM + i], row[MEASURED + i]
        return
    lag = lag_of(state.age[n, m], steps, rows, substeps)
    odom[0], odom[1], odom[2] = at_lag(state.past, n, m, ODOM, lag, steps, substeps)
    twist[0], twist[1], twist[2] = at_lag(
        state.past, n, m, MEASURED, lag, steps, substeps
    )


@kernel
def drift_of(
    n: int, m: int, state: State, motion: Dynamics
) -> tuple[float, float, float]:
    """Draw drift ahead, aside [m], at most std sqrt(3 period), and turn [rad]; move the state.

    The state stays within the bounds of the model.
    """
    period = motion.dt * motion.substeps
    std = state.noise
    counter = state.steps[n] * state.pose.shape[1] + m
    # It grows with root time. Uniform draws are cheap, and over some periods they add up to normal.
    count = std.shape[2] - 2
    scale = math.sqrt(12.0 * period)
    ahead = aside = turn = 0.0
    for i in range(count):
        if std[n, m, 2 + i] > 0.0:
            share = (
                random.uniform(state.seeds[n], random.DRIFT_STREAM, counter * count + i)
                - 0.5
            )
            draw = scale * std[n, m, 2 + i] * share
            if i == 0:
                ahead = draw
            elif i == 1:
                aside = draw
            elif i == 2:
                turn = draw
            else:
                moved = state.state[n, m, i - 3] + draw
                low = motion.terms.low[i - 3]
                high = motion.terms.high[i - 3]
                state.state[n, m, i - 3] = min(max(moved, low), high)
    return ahead, aside, turn


@kernel(inline=True)
def scan_or_wait(
    n: int,
    waiting: int,
    state: State,
    members: Members,
    lidar: LidarArrays,
    motion: Dynamics,
    scratch: Scratch,
) -> int:
    """Scan world n, unless `scan_together` can; return how many worlds now wait for it."""
    alone = False
    for m in range(state.age.shape[1]):  # a scan that is not of a robot's present pose
        alone = (
            alone
            or state.age[n, m] > 0
            or state.faults[n, m, fault_kernels.SKEW] != 0.0
        )
    if alone:
        for m in range(state.pose.shape[1]):
            _scan_alone(n, m, state, members, lidar, motion, scratch)
        return waiting
    scratch.scans.waiting[waiting] = n
    return waiting + 1


@kernel
def scan_together(
    waiting: int, state: State, members: Members, lidar: LidarArrays, scratch: Scratch
) -> None:
    """Scan the first `waiting` worlds of the list in the scratch memory, as they stand."""
    scans = scratch.scans
    chosen = scans.waiting[:waiting]
    first = state.velocity.shape[1]
    scan_kernels.scan_worlds(
        state.ranges,
        state.pose,
        chosen,
        state.bodies,
        first,
        members.fixtures,
        lidar,
        scratch.cells,
        scans.lookup,
    )


@kernel
def distort(low: int, high: int, state: State, lidar: LidarArrays) -> None:
    """Apply the faults of each robot's device to the scans of the worlds [low, high)."""
    limits = lidar.range_min, lidar.range_max
    for n in range(low, high):
        for m in range(state.ranges.shape[1]):
            counter = state.steps[n] * state.ranges.shape[1] + m
            fault_kernels.distort(
                state.ranges[n, m], limits, state.faults[n, m], state.seeds[n], counter
            )


@kernel
def _scan_alone(
    n: int,
    m: int,
    state: State,
    members: Members,
    lidar: LidarArrays,
    motion: Dynamics,
    scratch: Scratch,
) -> None:
    scans = scratch.scans
    beams = state.ranges.shape[2]
    spot = scans.spot
    drive = scans.drive
    skew = state.faults[n, m, fault_kernels.SKEW]
    past = state.past
    steps = state.steps[n]
    substeps = motion.substeps
    here = spot[0, 0]
    lag = lag_of(state.age[n, m], steps, past.shape[2], substeps)
    here[0], here[1], here[2] = at_lag(past, n, m, POSE, lag, steps, substeps)
    drive[0], drive[1], drive[2] = at_lag(past, n, m, TWIST, lag, steps, substeps)
    reach = lidar.range_max + math.hypot(lidar.mount[0], lidar.mount[1])
    if skew != 0.0:
        reach += math.hypot(drive[0], drive[1]) * lidar.sweep_time
    count = _gather(n, m, lag, reach, state, members, motion, scratch)
    seen = scans.seen[:count].reshape((1, count, 7))
    every = scans.every
    every = BodyCells(
        every.first, every.then, every.ordered, every.frame, every.found[:count]
    )
    begin = (n * state.ranges.shape[1] + m) * beams
    scan = state.ranges.reshape(-1)[begin : begin + beams].reshape((1, 1, beams))
    around = fixtures_around(n, members.fixtures)
    groups = 1 if skew == 0.0 else scans.slices.shape[0]
    if groups > 1:
        moving = (steps * substeps - lag) * motion.dt
        fault_kernels.slice_poses(
            scans.slices, spot[0, 0], drive, lidar.sweep_time, skew, moving
        )
    # a loop, because the large functions below are then compiled only once
    for g in range(groups):
        out = scan if groups == 1 else scans.part
        for i in range(3 if groups > 1 else 0):
            spot[0, 0, i] = scans.slices[g, i]
        scan_kernels.scan_worlds(
            out, spot, scans.none, seen, -1, around, lidar, every, scans.lookup
        )
        for i in range(
            g * beams // groups, (g + 1) * beams // groups if groups > 1 else 0
        ):
            scan[0, 0, i] = scans.part[0, 0, i]


@kernel
def _gather(
    n: int,
    m: int,
    lag: int,
    reach: float,
    state: State,
    members: Members,
    motion: Dynamics,
    scratch: Scratch,
) -> int:
    """Copy the bodies around `spot`, as they were `lag` substeps ago; return their number.

    Robots are interpolated in the past. Of obstacles no past is kept: they are moved back by their
    present velocity, which is exact within the period, and beyond it for those that keep their
    velocity. The extrapolation ends at `FURTHEST_BACK`.
    """
    scans = scratch.scans
    cells = scratch.cells
    bodies = state.bodies
    velocity = state.velocity
    spot = scans.spot[0, 0]
    first = velocity.shape[1]
    several = bodies.shape[1]
    # the cells of a crowd hold the present positions
    in_cells = members.standing or (members.crowded and lag == 0)
    if in_cells:
        several = around(n, spot[0], spot[1], reach, cells)
    count = 0
    ago = min(lag * motion.dt, FURTHEST_BACK)
    for i in range(several):
        k = cells.found[i] if in_cells else i
        radius = bodies[n, k, RADIUS]
        if k == first + m or radius <= 0.0:
            continue
        body = scans.seen[count]
        for j in range(7):
            body[j] = bodies[n, k, j]
        turned = False
        if lag > 0 and k >= first:
            body[X], body[Y], body[HEADING] = at_lag(
                state.past, n, k - first, POSE, lag, state.steps[n], motion.substeps
            )
            turned = True
        elif lag > 0:
            body[X] -= velocity[n, k, 0] * ago
            body[Y] -= velocity[n, k, 1] * ago
            turned = velocity[n, k, 2] != 0.0
            body[HEADING] -= velocity[n, k, 2] * ago
        if turned:
            body[COS], body[SIN] = math.cos(body[HEADING]), math.sin(body[HEADING])
        dx = body[X] - spot[0]
        dy = body[Y] - spot[1]
        if dx * dx + dy * dy <= (reach + radius) * (reach + radius):
            count += 1
    return count
