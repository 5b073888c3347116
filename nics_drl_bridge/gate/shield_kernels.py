"""Compiled: sweep of a footprint along arcs, what moves, and ground that was seen or stood on."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.interface import Array
from nics_drl_bridge.kernels import kernel
from nics_drl_bridge.sim.collision_kernels import Outline, outline_point

Ranges = NDArray[np.float32]
Flags = NDArray[np.bool_]
ROUNDING = 1e-9  # tolerance for the distance that must not become smaller [m]
TIME_BISECTIONS = 24  # that find when a braking robot has moved by a path
WIDTH = 0.02  # old beams within this angle of a bearing are compared [rad]


@kernel
def place(twist: Array, time: float) -> tuple[float, float, float, float]:
    """Returns x, y, cosine and sine of heading after a time on the exact arc of a twist (3,)."""
    turn = twist[2] * time
    cosine = math.cos(turn)
    sine = math.sin(turn)
    if abs(turn) < 1e-6:
        a = 1.0
        b = turn / 2.0
    else:
        a = sine / turn
        b = (1.0 - cosine) / turn
    x = (a * twist[0] - b * twist[1]) * time
    y = (b * twist[0] + a * twist[1]) * time
    return x, y, cosine, sine


@kernel(allocates=True)
def fill_grid(low: Array, high: Array, counts: NDArray[np.int64]) -> Array:
    """Returns a grid of twists (K, 3) between two (3,), with so many along each axis."""
    twists = np.empty((counts[0] * counts[1] * counts[2], 3))
    for k in range(twists.shape[0]):
        remainder = k
        for axis in range(3):
            index = remainder % counts[axis]
            remainder = remainder // counts[axis]
            gaps = max(counts[axis] - 1, 1)
            twists[k, axis] = index * ((high[axis] - low[axis]) / gaps) + low[axis]
            if index == gaps:
                twists[k, axis] = high[axis]
    return twists


class Body(NamedTuple):
    """The footprint that is swept, and the clearance that is kept around it.

    Attributes:
        outline: of the footprint, in the robot's frame; without corners for a circle.
        radius: of the circle around it [m].
        reach: by which a turn moves it, [m/rad]; 0 for a circle.
        margin: clearance [m].
        lever: by which a turn rate adds to the speed that is braked, [m/rad].
        order: of the norm of ahead and sideways that is braked; see `robot.braking.Braking`.
        turn_later: time by which the braking of a turn begins later than that of the speed [s].
        turn_deceleration: of a turn that brakes by itself [rad/s^2]; 0 if it does not.
    """

    outline: Outline
    radius: float
    reach: float
    margin: float
    lever: float = 0.0
    order: float = 2.0
    turn_later: float = 0.0
    turn_deceleration: float = 0.0


@kernel
def compute_clearance(x: float, y: float, body: Body) -> float:
    """Returns the signed distance from a point to a footprint [m]; negative inside."""
    if body.outline.begin == body.outline.end:
        return math.sqrt(x * x + y * y) - body.radius
    clearance: float = outline_point(x, y, body.outline)
    return clearance


@kernel(allocates=True)
def is_free(
    points: Array,
    twists: Array,
    body: Body,
    reaction: float,
    deceleration: float,
    step: float,
) -> bool:
    """True if no point (P, 3) comes within the margin of twists (K, 3) until the robot rests."""
    # A point that is already within the margin must not come nearer. Points are x, y [m] and
    # maximum speed [m/s]. The robot keeps its twist for the reaction time [s], then brakes; a turn
    # brakes like the speed of the part that it moves most. Places along an arc are a `step` [m]
    # apart; those that a point cannot reach are skipped.
    longest_path = 0.0
    longest_time = 0.0
    most_steps = 0
    for k in range(twists.shape[0]):
        path, speed = _bound_path(twists[k], body, reaction, deceleration)
        rest_time = _compute_rest_time(twists[k], speed, body, reaction, deceleration)
        longest_path = max(longest_path, path)
        longest_time = max(longest_time, rest_time)
        most_steps = max(most_steps, math.ceil(path / step))
    near = _select_near(points, body, longest_path, longest_time)
    all_places = np.empty((most_steps + 1, 5))
    for k in range(twists.shape[0]):
        path, speed = _bound_path(twists[k], body, reaction, deceleration)
        steps = math.ceil(path / step)
        if steps == 0:
            continue
        places = all_places[: steps + 1]
        duration = reaction + speed / (2.0 * deceleration)
        step_time = duration / steps
        last_step_time = step_time + math.sqrt(2.0 * speed * step_time / deceleration)
        is_filled = False
        if body.turn_deceleration > 0.0 and near.shape[0] > 0:
            is_filled = True
            last_step_time = _fill_places_of_separate_turn(
                places, twists[k], path, speed, body, reaction, deceleration
            )
        for p in range(near.shape[0]):
            approach = path / steps + near[p, 2] * last_step_time  # per step, at most
            s = _count_safe_steps(near[p, 4] - near[p, 3], approach, steps)
            if s <= steps and not is_filled:
                is_filled = True
                _fill_places(places, twists[k], duration, speed, reaction, deceleration)
            while s <= steps:
                dx = near[p, 0] - places[s, 0]
                dy = near[p, 1] - places[s, 1]
                cosine = places[s, 2]
                sine = places[s, 3]
                clearance = compute_clearance(
                    cosine * dx + sine * dy, cosine * dy - sine * dx, body
                )
                spare = clearance - near[p, 3] - near[p, 2] * places[s, 4]
                if spare < 0.0:
                    return False
                s += _count_safe_steps(spare, approach, steps)
    return True


@kernel
def _count_safe_steps(spare: float, approach: float, steps: int) -> int:
    """Returns after how many steps a point may be too near for the first time, at least 1."""
    return max(1, math.floor(min(spare / approach, steps + 1.0)))


@kernel
def _bound_path(
    twist: Array, body: Body, reaction: float, deceleration: float
) -> tuple[float, float]:
    """Returns the longest path of a point of the footprint [m], and the speed that brakes [m/s]."""
    speed = math.hypot(twist[0], twist[1])
    turn_speed = abs(twist[2]) * body.reach
    braked_speed = speed
    if body.order == 1.0:
        braked_speed = abs(twist[0]) + abs(twist[1])
    elif body.order == math.inf:
        braked_speed = max(abs(twist[0]), abs(twist[1]))
    if body.turn_deceleration > 0.0:
        turn_reaction = reaction + body.turn_later
        turn_time = turn_reaction + abs(twist[2]) / (2.0 * body.turn_deceleration)
        path = speed * (reaction + braked_speed / (2.0 * deceleration))
        return path + turn_speed * turn_time, braked_speed
    braked_speed = max(braked_speed + abs(twist[2]) * body.lever, turn_speed)
    duration = reaction + braked_speed / (2.0 * deceleration)
    return (speed + turn_speed) * duration, braked_speed


@kernel
def _compute_rest_time(
    twist: Array, speed: float, body: Body, reaction: float, deceleration: float
) -> float:
    """Returns the time until a braking robot rests [s]."""
    rest_time = reaction + speed / deceleration
    if body.turn_deceleration > 0.0:
        turn_time = abs(twist[2]) / body.turn_deceleration
        rest_time = max(rest_time, reaction + body.turn_later + turn_time)
    return rest_time


@kernel(allocates=True)
def _select_near(
    points: Array, body: Body, longest_path: float, longest_time: float
) -> Array:
    """Returns points that may come too near (Q, 5): x, y, speed, distances to keep and of now."""
    near = np.empty((points.shape[0], 5))
    count = 0
    for p in range(points.shape[0]):
        x = points[p, 0]
        y = points[p, 1]
        speed = points[p, 2]
        reach = body.margin + longest_path + speed * longest_time
        if math.hypot(x, y) - body.radius >= reach:
            continue
        clearance = compute_clearance(x, y, body)
        if clearance < reach:
            near[count, 0] = x
            near[count, 1] = y
            near[count, 2] = speed
            near[count, 3] = min(body.margin, clearance) - ROUNDING
            near[count, 4] = clearance
            count += 1
    return near[:count]


@kernel(allocates=True)
def _fill_places(
    places: Array,
    twist: Array,
    duration: float,
    speed: float,
    reaction: float,
    deceleration: float,
) -> None:
    """Fills places (S + 1, 5) of a braking robot: x, y, cosine and sine of heading, time [s]."""
    steps = len(places) - 1
    for s in range(1, steps + 1):
        time = duration * s / steps
        x, y, cosine, sine = place(twist, time)
        places[s, 0] = x
        places[s, 1] = y
        places[s, 2] = cosine
        places[s, 3] = sine
        places[s, 4] = _compute_arrival(time, speed, reaction, deceleration)


@kernel
def _compute_arrival(
    time: float, speed: float, reaction: float, deceleration: float
) -> float:
    """Returns when a braking robot is where it would be after a time at its initial speed [s]."""
    if time <= reaction:
        return time
    square = speed * speed - 2.0 * deceleration * speed * (time - reaction)
    return reaction + (speed - math.sqrt(max(square, 0.0))) / deceleration


@kernel
def _compute_full_speed_time(
    time: float, speed: float, reaction: float, deceleration: float
) -> float:
    """Returns the time at full speed in which a robot gets as far as in a time of braking [s]."""
    if time <= reaction or speed == 0.0:
        return min(time, reaction)
    braked = min(time - reaction, speed / deceleration)
    return reaction + braked * (1.0 - deceleration * braked / (2.0 * speed))


@kernel(allocates=True)
def _fill_places_of_separate_turn(
    places: Array,
    twist: Array,
    path: float,
    braked_speed: float,
    body: Body,
    reaction: float,
    deceleration: float,
) -> float:
    """Fills places as `_fill_places` if the turn brakes by itself; returns the longest step [s].

    The footprint moves by the same path, at most, from each place to the next.
    """
    speed = math.hypot(twist[0], twist[1])
    turn_rate = abs(twist[2])
    turn_reaction = reaction + body.turn_later
    rest_time = _compute_rest_time(twist, braked_speed, body, reaction, deceleration)
    steps = len(places) - 1
    places[0, 0] = 0.0
    places[0, 1] = 0.0
    places[0, 2] = 1.0
    places[0, 3] = 0.0
    places[0, 4] = 0.0
    time = 0.0
    drive_time = 0.0
    turn_time = 0.0
    longest_step = 0.0
    for s in range(1, steps + 1):
        low = time
        high = rest_time
        for _ in range(TIME_BISECTIONS if s < steps else 0):
            middle = 0.5 * (low + high)
            next_drive_time = _compute_full_speed_time(
                middle, braked_speed, reaction, deceleration
            )
            next_turn_time = _compute_full_speed_time(
                middle, turn_rate, turn_reaction, body.turn_deceleration
            )
            moved = speed * next_drive_time + turn_rate * body.reach * next_turn_time
            if moved < path * s / steps:
                low = middle
            else:
                high = middle
        next_drive_time = _compute_full_speed_time(
            high, braked_speed, reaction, deceleration
        )
        next_turn_time = _compute_full_speed_time(
            high, turn_rate, turn_reaction, body.turn_deceleration
        )
        drive = next_drive_time - drive_time
        turn = next_turn_time - turn_time
        x, y, cosine, sine = place(
            (twist[0] * drive, twist[1] * drive, twist[2] * turn), 1.0
        )
        c = places[s - 1, 2]
        d = places[s - 1, 3]
        places[s, 0] = places[s - 1, 0] + c * x - d * y
        places[s, 1] = places[s - 1, 1] + d * x + c * y
        places[s, 2] = c * cosine - d * sine
        places[s, 3] = d * cosine + c * sine
        places[s, 4] = high
        longest_step = max(longest_step, high - time)
        time = high
        drive_time = next_drive_time
        turn_time = next_turn_time
    return longest_step


class MountedBeams(NamedTuple):
    """Angle of beam 0 and between beams [rad], and the mount: x, y [m], heading [rad]."""

    first: float
    step: float
    x: float
    y: float
    heading: float


class Tolerance(NamedTuple):
    """Tolerance of a range, as a + b * range."""

    constant: float  # [m]
    proportional: float


@kernel(allocates=True)
def mark_entered(
    out: Flags,
    ranges: Ranges,
    old: Ranges,
    lidar: MountedBeams,
    moved: Array,
    range_max: float,
    tolerance: Tolerance,
) -> None:
    """Marks in `out` (B,) the beams of a scan (B,) that end where an old one saw free space.

    The motion (3,) of the robot since the old scan is compensated. Beams that end in places which
    the old scan did not show stay as they are.
    """
    beams = len(ranges)
    circle = 2.0 * math.pi / abs(lidar.step)  # in beams
    whole_circle = round(circle)
    neighbours = math.ceil(WIDTH / abs(lidar.step))
    cosine = math.cos(moved[2])
    sine = math.sin(moved[2])
    for b in range(beams):
        if out[b] or not np.isfinite(ranges[b]):
            continue
        angle = lidar.first + b * lidar.step + lidar.heading
        x = lidar.x + ranges[b] * math.cos(angle)
        y = lidar.y + ranges[b] * math.sin(angle)
        dx = moved[0] + cosine * x - sine * y - lidar.x
        dy = moved[1] + sine * x + cosine * y - lidar.y
        distance = math.hypot(dx, dy)
        bearing = (math.atan2(dy, dx) - lidar.heading - lidar.first) / lidar.step
        middle = round(bearing - circle * math.floor(bearing / circle))
        free = range_max
        for i in range(middle - neighbours, middle + neighbours + 1):
            index = i % whole_circle
            old_range = old[index] if index < beams else np.nan
            free = _take_shorter(free, old_range)
        if distance < free - tolerance.constant - tolerance.proportional * distance:
            out[b] = True


@kernel
def _take_shorter(length: float, other: float) -> float:
    """Returns the shorter of two ranges; NaN as soon as either of them is unknown."""
    if math.isnan(length) or other >= length:
        return length
    return other


class Cells(NamedTuple):
    """Where square cells lie, whose rows run along y of odometry, as seen from the robot.

    Attributes:
        x: of their first corner from the robot, along x of odometry [m].
        y: the same along y [m].
        width: of a cell [m].
        cosine: of the robot's heading.
        sine: of it.
    """

    x: float
    y: float
    width: float
    cosine: float
    sine: float


class Look(NamedTuple):
    """Terms by which a scan is judged.

    Attributes:
        now: its time [s].
        oldest: time of ground that is still remembered [s].
        range_max: of the lidar [m].
        tolerance: margin before a return that is not free [m].
    """

    now: float
    oldest: float
    range_max: float
    tolerance: float


@kernel
def _locate_cell(i: int, j: int, cells: Cells) -> tuple[float, float]:
    """Returns the middle of a cell in the robot's frame [m]."""
    dx = cells.x + (j + 0.5) * cells.width
    dy = cells.y + (i + 0.5) * cells.width
    return cells.cosine * dx + cells.sine * dy, cells.cosine * dy - cells.sine * dx


@kernel(allocates=True)
def shift_cells(times: Ranges, columns_moved: int, rows_moved: int) -> Ranges:
    """Returns times (n, n) of cells that moved by so many columns and rows; -inf of new ones."""
    shifted = np.full(times.shape, -np.inf, times.dtype)
    rows, columns = times.shape
    for i in range(max(0, -rows_moved), min(rows, rows - rows_moved)):
        for j in range(max(0, -columns_moved), min(columns, columns - columns_moved)):
            shifted[i, j] = times[i + rows_moved, j + columns_moved]
    return shifted


@kernel
def cover(times: Ranges, cells: Cells, body: Body, distance: float, now: float) -> None:
    """Notes in times (n, n) that cells up to a distance from the footprint are free."""
    for i in range(times.shape[0]):
        for j in range(times.shape[1]):
            x, y = _locate_cell(i, j, cells)
            is_far = x * x + y * y > (body.radius + distance) ** 2
            if not is_far and compute_clearance(x, y, body) <= distance:
                times[i, j] = now


@kernel(allocates=True)
def mark_seen_cells(
    times: Ranges,
    cells: Cells,
    ranges: Ranges,
    lidar: MountedBeams,
    kept_radius: float,
    look: Look,
) -> Flags:
    """Notes in times (n, n) what a scan (B,) shows; returns which cells it sees as a whole.

    Older times are forgotten, but cells within `kept_radius` [m] of the robot stay as they are.
    """
    is_seen = np.zeros(times.shape, np.bool_)
    beams = len(ranges)
    for i in range(times.shape[0]):
        for j in range(times.shape[1]):
            x, y = _locate_cell(i, j, cells)
            is_beside = x * x + y * y <= kept_radius * kept_radius
            if times[i, j] >= look.oldest and is_beside:
                times[i, j] = look.now
            dx = x - lidar.x
            dy = y - lidar.y
            distance = max(math.sqrt(dx * dx + dy * dy), cells.width)
            middle = _find_beam(x, y, lidar)
            half_width = math.ceil(0.5 * cells.width / (distance * abs(lidar.step)))
            first = middle - half_width
            last = middle + half_width
            if first >= 0 and last < beams:
                is_seen[i, j] = True
                free = look.range_max
                for b in range(first, last + 1):
                    free = _take_shorter(free, ranges[b])
                if free > distance + look.tolerance:
                    times[i, j] = look.now
            if not times[i, j] >= look.oldest:
                times[i, j] = -np.inf
    _note_returns(times, cells, ranges, lidar)
    return is_seen


@kernel
def _note_returns(
    times: Ranges, cells: Cells, ranges: Ranges, lidar: MountedBeams
) -> None:
    """Notes in times (n, n) that cells in which beams (B,) end are not free."""
    for b in range(len(ranges)):
        if np.isfinite(ranges[b]):
            angle = lidar.first + b * lidar.step + lidar.heading
            x = lidar.x + ranges[b] * math.cos(angle)
            y = lidar.y + ranges[b] * math.sin(angle)
            j = math.floor((cells.cosine * x - cells.sine * y - cells.x) / cells.width)
            i = math.floor((cells.sine * x + cells.cosine * y - cells.y) / cells.width)
            if 0 <= i < times.shape[0] and 0 <= j < times.shape[1]:
                times[i, j] = -np.inf


@kernel
def _find_beam(x: float, y: float, lidar: MountedBeams) -> int:
    """Returns the index of the beam towards a point, beyond those of a scan if there is none."""
    circle = 2.0 * math.pi / abs(lidar.step)  # in beams
    angle = math.atan2(y - lidar.y, x - lidar.x)
    bearing = (angle - lidar.heading - lidar.first) / lidar.step
    return math.floor(bearing - circle * math.floor((bearing + 0.5) / circle) + 0.5)


@kernel(allocates=True)
def find_unseen(times: Ranges, is_seen: Flags, cells: Cells) -> Array:
    """Returns the middles (Q, 2) of the cells in which free or seen ground ends [m]."""
    # What lies beyond the outermost cells is not known.
    last_i = times.shape[0] - 1
    last_j = times.shape[1] - 1
    middles = np.empty((times.size, 2))
    count = 0
    for i in range(last_i + 1):
        for j in range(last_j + 1):
            is_inner = 0 < i < last_i and 0 < j < last_j
            if is_seen[i, j] or (is_inner and times[i, j] > -np.inf):
                continue
            has_known_neighbour = False
            for di, dj in ((0, -1), (0, 1), (-1, 0), (1, 0)):
                row = min(max(i + di, 0), last_i)
                column = min(max(j + dj, 0), last_j)
                is_known = is_seen[row, column] or times[row, column] > -np.inf
                has_known_neighbour = has_known_neighbour or is_known
            if has_known_neighbour:
                x, y = _locate_cell(i, j, cells)
                middles[count, 0] = x
                middles[count, 1] = y
                count += 1
    return middles[:count].copy()
