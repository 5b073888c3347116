"""Compiled: sweep of a footprint along arcs, what moves, and ground that was seen or stood on."""

import math
from typing import NamedTuple

import numpy as np

from nics_drl_bridge.kernels import kernel
from nics_drl_bridge.sim.collision_kernels import Outline, outline_point

ROUNDING = 1e-9  # tolerance for the distance that must not become smaller [m]
BISECTIONS = 24  # that find when a braking robot has moved by a path
WIDTH = 0.02  # old beams within this angle of a bearing are compared [rad]


@kernel
def place(twist, time):  # type: ignore[no-untyped-def]
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
def fill_grid(low, high, counts):  # type: ignore[no-untyped-def]
    """Returns twists (K, 3) evenly between two (3,), so many along each axis."""
    out = np.empty((counts[0] * counts[1] * counts[2], 3))
    for k in range(out.shape[0]):
        left = k
        for axis in range(3):
            at = left % counts[axis]
            left = left // counts[axis]
            gaps = max(counts[axis] - 1, 1)
            out[k, axis] = at * ((high[axis] - low[axis]) / gaps) + low[axis]
            if at == gaps:
                out[k, axis] = high[axis]
    return out


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
        turn_deceleration: of a turn that brakes apart from the speed [rad/s^2]; 0 if it does not.
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
def compute_clearance(x, y, body):  # type: ignore[no-untyped-def]
    """Returns the signed distance from a point to a footprint [m]; negative inside."""
    if body.outline.begin == body.outline.end:
        return math.sqrt(x * x + y * y) - body.radius
    return outline_point(x, y, body.outline)


@kernel(allocates=True)
def is_free(points, twists, body, blind, deceleration, step):  # type: ignore[no-untyped-def]
    """True if no point (P, 3) comes within the margin of twists (K, 3) until the robot rests."""
    # One that is already that near must not come nearer. Points are x, y [m] and greatest speed
    # [m/s]; the robot keeps its twist for `blind` [s], then brakes, a turn as the speed of what it
    # moves most. Places are a `step` [m] apart; those are skipped that a point is too far from.
    longest = 0.0
    rest = 0.0
    most = 0
    for k in range(twists.shape[0]):
        path, pace = _bound_path(twists[k], body, blind, deceleration)
        longest = max(longest, path)
        rest = max(rest, _compute_rest_time(twists[k], pace, body, blind, deceleration))
        most = max(most, math.ceil(path / step))
    near = _select_near(points, body, longest, rest)
    places = np.empty((most + 1, 5))
    for k in range(twists.shape[0]):
        path, pace = _bound_path(twists[k], body, blind, deceleration)
        steps = math.ceil(path / step)
        if steps == 0:
            continue
        duration = blind + pace / (2.0 * deceleration)
        each = duration / steps
        slowest = each + math.sqrt(
            2.0 * pace * each / deceleration
        )  # time of the last step
        made = False
        if body.turn_deceleration > 0.0 and near.shape[0] > 0:
            made = True
            some = places[: steps + 1]
            slowest = _follow_apart(
                some, twists[k], path, pace, body, blind, deceleration
            )
        for p in range(near.shape[0]):
            most_each = path / steps + near[p, 2] * slowest
            s = _steps_apart(near[p, 4] - near[p, 3], most_each, steps)
            if s <= steps and not made:
                made = True
                _follow(
                    places[: steps + 1], twists[k], duration, pace, blind, deceleration
                )
            while s <= steps:
                dx = near[p, 0] - places[s, 0]
                dy = near[p, 1] - places[s, 1]
                c = places[s, 2]
                sine = places[s, 3]
                away = compute_clearance(c * dx + sine * dy, c * dy - sine * dx, body)
                spare = away - near[p, 3] - near[p, 2] * places[s, 4]
                if spare < 0.0:
                    return False
                s += _steps_apart(spare, most_each, steps)
    return True


@kernel
def _steps_apart(spare, each, steps):  # type: ignore[no-untyped-def]
    """Returns how many places further on a point may be too near for the first time, at least 1."""
    return max(1, math.floor(min(spare / each, steps + 1.0)))


@kernel
def _bound_path(twist, body, blind, deceleration):  # type: ignore[no-untyped-def]
    """Returns the longest path of a point of the footprint [m], and the speed that brakes [m/s]."""
    speed = math.hypot(twist[0], twist[1])
    turn = abs(twist[2]) * body.reach
    across = speed
    if body.order == 1.0:
        across = abs(twist[0]) + abs(twist[1])
    elif body.order == math.inf:
        across = max(abs(twist[0]), abs(twist[1]))
    if body.turn_deceleration > 0.0:
        turn_blind = blind + body.turn_later
        turn_time = turn_blind + abs(twist[2]) / (2.0 * body.turn_deceleration)
        return speed * (
            blind + across / (2.0 * deceleration)
        ) + turn * turn_time, across
    pace = max(across + abs(twist[2]) * body.lever, turn)
    return (speed + turn) * (blind + pace / (2.0 * deceleration)), pace


@kernel
def _compute_rest_time(twist, pace, body, blind, deceleration):  # type: ignore[no-untyped-def]
    """Returns the time until a braking robot rests [s]."""
    rest = blind + pace / deceleration
    if body.turn_deceleration > 0.0:
        rest = max(
            rest, blind + body.turn_later + abs(twist[2]) / body.turn_deceleration
        )
    return rest


@kernel(allocates=True)
def _select_near(points, body, longest, rest):  # type: ignore[no-untyped-def]
    """Returns points that may come too near (Q, 5), with the distances to keep and of now."""
    near = np.empty((points.shape[0], 5))
    count = 0
    for p in range(points.shape[0]):
        x = points[p, 0]
        y = points[p, 1]
        speed = points[p, 2]
        room = body.margin + longest + speed * rest
        if math.hypot(x, y) - body.radius >= room:
            continue
        away = compute_clearance(x, y, body)
        if away < room:
            near[count, 0] = x
            near[count, 1] = y
            near[count, 2] = speed
            near[count, 3] = min(body.margin, away) - ROUNDING
            near[count, 4] = away
            count += 1
    return near[:count]


@kernel(allocates=True)
def _follow(places, twist, duration, pace, blind, deceleration):  # type: ignore[no-untyped-def]
    """Fills places (S + 1, 5) of a braking robot: x, y, cosine and sine of heading, time [s]."""
    steps = len(places) - 1
    for s in range(1, steps + 1):
        part = duration * s / steps
        x, y, cosine, sine = place(twist, part)
        places[s, 0] = x
        places[s, 1] = y
        places[s, 2] = cosine
        places[s, 3] = sine
        places[s, 4] = _compute_arrival(part, pace, blind, deceleration)


@kernel
def _compute_arrival(part, speed, blind, deceleration):  # type: ignore[no-untyped-def]
    """Returns when a braking robot is where it would be at `part` at its initial speed [s]."""
    if part <= blind:
        return part
    left = speed * speed - 2.0 * deceleration * speed * (part - blind)
    return blind + (speed - math.sqrt(max(left, 0.0))) / deceleration


@kernel
def _compute_full_speed_time(time, speed, blind, deceleration):  # type: ignore[no-untyped-def]
    """Returns the time at full speed in which a robot gets as far as in a time of braking [s]."""
    if time <= blind or speed == 0.0:
        return min(time, blind)
    braked = min(time - blind, speed / deceleration)
    return blind + braked * (1.0 - deceleration * braked / (2.0 * speed))


@kernel(allocates=True)
def _follow_apart(places, twist, path, pace, body, blind, deceleration):  # type: ignore[no-untyped-def]
    """Fills places as `_follow` of a turn that brakes apart; returns the longest time between two.

    The footprint moves by the same path, at most, from each place to the next.
    """
    speed = math.hypot(twist[0], twist[1])
    rate = abs(twist[2])
    turn_blind = blind + body.turn_later
    rest = _compute_rest_time(twist, pace, body, blind, deceleration)
    steps = len(places) - 1
    places[0, 0] = 0.0
    places[0, 1] = 0.0
    places[0, 2] = 1.0
    places[0, 3] = 0.0
    places[0, 4] = 0.0
    before = 0.0
    moved = 0.0
    turned = 0.0
    longest = 0.0
    for s in range(1, steps + 1):
        low = before
        high = rest
        for _ in range(BISECTIONS if s < steps else 0):
            middle = 0.5 * (low + high)
            straight = _compute_full_speed_time(middle, pace, blind, deceleration)
            about = _compute_full_speed_time(
                middle, rate, turn_blind, body.turn_deceleration
            )
            if speed * straight + rate * body.reach * about < path * s / steps:
                low = middle
            else:
                high = middle
        straight = _compute_full_speed_time(high, pace, blind, deceleration)
        about = _compute_full_speed_time(high, rate, turn_blind, body.turn_deceleration)
        along = straight - moved
        step = (twist[0] * along, twist[1] * along, twist[2] * (about - turned))
        x, y, cosine, sine = place(step, 1.0)
        c = places[s - 1, 2]
        d = places[s - 1, 3]
        places[s, 0] = places[s - 1, 0] + c * x - d * y
        places[s, 1] = places[s - 1, 1] + d * x + c * y
        places[s, 2] = c * cosine - d * sine
        places[s, 3] = d * cosine + c * sine
        places[s, 4] = high
        longest = max(longest, high - before)
        before = high
        moved = straight
        turned = about
    return longest


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
def mark_entered(out, ranges, old, lidar, moved, far, tolerance):  # type: ignore[no-untyped-def]
    """Marks in `out` (B,) the beams of a scan (B,) that end where an old one saw free space."""
    # The robot's own motion, `moved` (3,), is compensated; hidden or unknown places, and other
    # flags, stay. `far` is the greatest range [m]; the tolerance is in metres and of the range.
    beams = len(ranges)
    circle = 2.0 * math.pi / abs(lidar.step)
    whole = round(circle)
    wide = math.ceil(WIDTH / abs(lidar.step))
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
        away = math.hypot(dx, dy)
        at = (math.atan2(dy, dx) - lidar.heading - lidar.first) / lidar.step
        middle = round(at - circle * math.floor(at / circle))
        seen = far
        for i in range(middle - wide, middle + wide + 1):
            index = i % whole
            beyond = old[index] if index < beams else np.nan
            # Not `min`: with NaN, or an old beam that was too close, the beam must stay unmarked.
            seen = beyond if not beyond >= seen else seen
        if away < seen - tolerance.constant - tolerance.proportional * away:
            out[b] = True


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
        far: greatest range [m].
        tolerance: margin before a return that is not free [m].
    """

    now: float
    oldest: float
    far: float
    tolerance: float


@kernel
def _locate_cell(i, j, cells):  # type: ignore[no-untyped-def]
    """Returns the middle of a cell in the robot's frame [m]."""
    dx = cells.x + (j + 0.5) * cells.width
    dy = cells.y + (i + 0.5) * cells.width
    return cells.cosine * dx + cells.sine * dy, cells.cosine * dy - cells.sine * dx


@kernel(allocates=True)
def shift_cells(times, across, up):  # type: ignore[no-untyped-def]
    """Returns times (n, n) of cells that moved by so many columns and rows; -inf of new ones."""
    out = np.full(times.shape, -np.inf, times.dtype)
    rows, columns = times.shape
    for i in range(max(0, -up), min(rows, rows - up)):
        for j in range(max(0, -across), min(columns, columns - across)):
            out[i, j] = times[i + up, j + across]
    return out


@kernel
def cover(times, cells, body, away, now):  # type: ignore[no-untyped-def]
    """Notes in times (n, n) that cells up to a distance from the footprint are free."""
    for i in range(times.shape[0]):
        for j in range(times.shape[1]):
            x, y = _locate_cell(i, j, cells)
            far = x * x + y * y > (body.radius + away) ** 2
            if not far and compute_clearance(x, y, body) <= away:
                times[i, j] = now


@kernel(allocates=True)
def mark_seen_cells(times, cells, ranges, lidar, room, look):  # type: ignore[no-untyped-def]
    """Notes in times (n, n) what a scan (B,) shows; returns which cells it sees as a whole."""
    # What is older is forgotten, but for cells within `room` [m] of the robot.
    sees = np.zeros(times.shape, np.bool_)
    beams = len(ranges)
    for i in range(times.shape[0]):
        for j in range(times.shape[1]):
            x, y = _locate_cell(i, j, cells)
            if times[i, j] >= look.oldest and x * x + y * y <= room * room:
                times[i, j] = look.now
            dx = x - lidar.x
            dy = y - lidar.y
            away = max(math.sqrt(dx * dx + dy * dy), cells.width)
            middle = _find_beam(x, y, lidar)
            beside = math.ceil(0.5 * cells.width / (away * abs(lidar.step)))
            if middle - beside >= 0 and middle + beside < beams:
                sees[i, j], least = True, look.far
                for b in range(middle - beside, middle + beside + 1):
                    # Not `min`: an unknown beam shows nothing.
                    least = ranges[b] if not ranges[b] >= least else least
                if least > away + look.tolerance:
                    times[i, j] = look.now
            if not times[i, j] >= look.oldest:
                times[i, j] = -np.inf
    _note_returns(times, cells, ranges, lidar)
    return sees


@kernel
def _note_returns(times, cells, ranges, lidar):  # type: ignore[no-untyped-def]
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
def _find_beam(x, y, lidar):  # type: ignore[no-untyped-def]
    """Returns the number of the beam towards a point, beyond those of a scan if there is none."""
    circle = 2.0 * math.pi / abs(lidar.step)
    at = (
        math.atan2(y - lidar.y, x - lidar.x) - lidar.heading - lidar.first
    ) / lidar.step
    return math.floor(at - circle * math.floor((at + 0.5) / circle) + 0.5)


@kernel(allocates=True)
def find_unseen(times, sees, cells):  # type: ignore[no-untyped-def]
    """Returns the middles (Q, 2) of the cells in which free or seen ground ends [m]."""
    # What lies beyond the outermost cells is not known.
    last_i = times.shape[0] - 1
    last_j = times.shape[1] - 1
    out = np.empty((times.size, 2))
    count = 0
    for i in range(last_i + 1):
        for j in range(last_j + 1):
            inner = 0 < i < last_i and 0 < j < last_j
            if sees[i, j] or (inner and times[i, j] > -np.inf):
                continue
            known = False
            for across, up in ((-1, 0), (1, 0), (0, -1), (0, 1)):
                k = min(max(i + up, 0), last_i)
                m = min(max(j + across, 0), last_j)
                known = known or sees[k, m] or times[k, m] > -np.inf
            if known:
                out[count, 0], out[count, 1] = _locate_cell(i, j, cells)
                count += 1
    return out[:count].copy()
