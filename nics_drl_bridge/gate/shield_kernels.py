"""Compiled: sweeps the footprint of a stopping robot along its arcs and checks for contacts.

The robot keeps a twist for a reaction time and then brakes uniformly. It stays on one
arc, unless its turn brakes separately, see `_fill_places_of_separate_turn`. With speed
v and deceleration a it covers the same path as in the time T = reaction + v / (2 a) at
full speed. `is_free` checks such a stop in four steps:

1. Bound the path of every point of the footprint: (speed + speed due to the turn) * T.
2. Select the obstacles that may come near within this path.
3. Place the footprint along the arc, so densely that no point of it moves further than
   one step.
4. At each place, compare the clearance of each obstacle with the required one: the
   margin (or the current clearance if that is less) plus the distance by which the
   obstacle may have approached. Places that an obstacle can't reach are skipped.

Shared arguments:
    twist (3,): of the robot before it stops: vx, vy [m/s], turn rate [rad/s].
    braked_speed: the speed that limits braking [m/s], as `_bound_path` returns it; `speed` is that
        of the origin.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.interface import Array
from nics_drl_bridge.kernels import kernel
from nics_drl_bridge.sim.collision_kernels import Outline, outline_point

# Columns of obstacles, in the robot's frame: position [m], maximum speed of approach
# [m/s]; for near obstacles also the required and the current clearance [m].
X = 0
Y = 1
APPROACH = 2
REQUIRED = 3
CLEARANCE = 4
# Columns of places of the robot: x, y [m] as above, its heading, and the time of arrival [s].
COSINE = 2
SINE = 3
TIME = 4
ROUNDING = 1e-9  # tolerance of the required clearance [m]
TIME_BISECTIONS = (
    24  # bisections for the time at which a braking robot has covered a path
)
SMALL_TURN = 1e-6  # turn below which an arc is computed by its series [rad]


class Body(NamedTuple):
    """The footprint that is swept, and the clearance that is kept around it.

    Attributes:
        outline: of the footprint, in the robot's frame; without corners for a circle.
        radius: of the circle around the footprint [m].
        farthest_corner: distance of that corner from the robot's origin [m]; 0 for a
            circle, which a turn does not move.
        margin: clearance [m].
        lever: factor of the turn rate in the speed that is braked [m].
        order: of the norm of vx and vy that is braked; see `robot.braking.Braking`.
    """

    outline: Outline
    radius: float
    farthest_corner: float
    margin: float
    lever: float
    order: float


class Stop(NamedTuple):
    """A stop to be swept: the robot keeps its twist for a reaction time, then brakes.

    Attributes:
        body: the footprint, and its margin.
        turn_delay: time by which a turn begins to brake later than the speed [s].
        turn_deceleration: of a turn that brakes independently of the speed [rad/s^2]; 0
            if it does not.
        reaction: time from now until the speed is braked [s].
        deceleration: of the speed [m/s^2].
    """

    body: Body
    turn_delay: float
    turn_deceleration: float
    reaction: float
    deceleration: float


@kernel(allocates=True)
def is_free(obstacles: Array, twists: Array, stop: Stop, step: float) -> bool:
    """True if a robot keeps its margin from all obstacles whichever of the twists it stops from.

    An obstacle that is already within the margin must not come nearer.

    Args:
        obstacles: (P, 3), see the columns above.
        twists: (K, 3) from which the robot may stop.
        stop: how it stops.
        step: maximum path of the footprint between two places [m].
    """
    longest_path = 0.0
    longest_time = 0.0
    for k in range(twists.shape[0]):
        path, braked_speed = _bound_path(twists[k], stop)
        longest_path = max(longest_path, path)
        rest_time = _compute_rest_time(twists[k], braked_speed, stop)
        longest_time = max(longest_time, rest_time)
    near = _select_near(obstacles, stop.body, longest_path, longest_time)
    if near.shape[0] == 0:
        return True
    places = np.empty((math.ceil(longest_path / step) + 1, 5))
    for k in range(twists.shape[0]):  # noqa: SIM110 - kernels have no generators
        if not _is_stop_free(near, places, twists[k], stop, step):
            return False
    return True


@kernel(allocates=True)
def _is_stop_free(
    near: Array, all_places: Array, twist: Array, stop: Stop, step: float
) -> bool:
    """True if a robot keeps its clearance from near obstacles (Q, 5) while it stops from a twist.

    `all_places` has room for the places of the stop.
    """
    path, braked_speed = _bound_path(twist, stop)
    steps = math.ceil(path / step)
    if steps == 0:
        return True
    places = all_places[: steps + 1]
    duration = stop.reaction + braked_speed / (2.0 * stop.deceleration)
    step_time = duration / steps
    # Braking makes the last step longest: it moves by braked_speed * step_time, and ends at rest.
    longest_step_time = step_time + math.sqrt(
        2.0 * braked_speed * step_time / stop.deceleration
    )
    is_filled = False
    if stop.turn_deceleration > 0.0:
        is_filled = True
        longest_step_time = _fill_places_of_separate_turn(
            places, path, twist, braked_speed, stop
        )
    for p in range(near.shape[0]):
        loss_per_step = path / steps + near[p, APPROACH] * longest_step_time
        spare = near[p, CLEARANCE] - near[p, REQUIRED]
        s = _count_safe_steps(spare, loss_per_step, steps)
        if s <= steps and not is_filled:
            is_filled = True
            _fill_places(places, duration, twist, braked_speed, stop)
        while s <= steps:
            spare = _measure_spare(near, p, places, s, stop.body)
            if spare < 0.0:
                return False
            s += _count_safe_steps(spare, loss_per_step, steps)
    return True


@kernel
def _measure_spare(near: Array, p: int, places: Array, s: int, body: Body) -> float:
    """Returns the clearance of obstacle p from place s beyond the required one [m]."""
    dx = near[p, X] - places[s, X]
    dy = near[p, Y] - places[s, Y]
    cosine = places[s, COSINE]
    sine = places[s, SINE]
    clearance = compute_clearance(
        cosine * dx + sine * dy, cosine * dy - sine * dx, body
    )
    spare: float = clearance - near[p, REQUIRED] - near[p, APPROACH] * places[s, TIME]
    return spare


@kernel
def _bound_path(twist: Array, stop: Stop) -> tuple[float, float]:
    """Returns the longest path of a point of the footprint [m], and the speed that brakes [m/s].

    A turn brakes like the speed of the point that it moves most, unless it brakes
    independently.
    """
    speed = math.hypot(twist[0], twist[1])
    turn_speed = abs(twist[2]) * stop.body.farthest_corner
    braked_speed = speed
    if stop.body.order == 1.0:
        braked_speed = abs(twist[0]) + abs(twist[1])
    elif stop.body.order == math.inf:
        braked_speed = max(abs(twist[0]), abs(twist[1]))
    if stop.turn_deceleration > 0.0:
        turn_reaction = stop.reaction + stop.turn_delay
        turn_time = turn_reaction + abs(twist[2]) / (2.0 * stop.turn_deceleration)
        path = speed * (stop.reaction + braked_speed / (2.0 * stop.deceleration))
        return path + turn_speed * turn_time, braked_speed
    braked_speed = max(braked_speed + abs(twist[2]) * stop.body.lever, turn_speed)
    duration = stop.reaction + braked_speed / (2.0 * stop.deceleration)
    return (speed + turn_speed) * duration, braked_speed


@kernel
def _compute_rest_time(twist: Array, braked_speed: float, stop: Stop) -> float:
    """Returns the time until a braking robot rests [s]."""
    rest_time = stop.reaction + braked_speed / stop.deceleration
    if stop.turn_deceleration > 0.0:
        turn_time = abs(twist[2]) / stop.turn_deceleration
        rest_time = max(rest_time, stop.reaction + stop.turn_delay + turn_time)
    return rest_time


@kernel(allocates=True)
def _select_near(
    obstacles: Array, body: Body, longest_path: float, longest_time: float
) -> Array:
    """Returns the obstacles (Q, 5) that may come too near within a path [m] and a time [s]."""
    near = np.empty((obstacles.shape[0], 5))
    count = 0
    for p in range(obstacles.shape[0]):
        x = obstacles[p, X]
        y = obstacles[p, Y]
        approach = obstacles[p, APPROACH]
        reach = body.margin + longest_path + approach * longest_time
        if math.hypot(x, y) - body.radius >= reach:
            continue
        clearance = compute_clearance(x, y, body)
        if clearance < reach:
            near[count, :REQUIRED] = obstacles[p]
            near[count, REQUIRED] = min(body.margin, clearance) - ROUNDING
            near[count, CLEARANCE] = clearance
            count += 1
    return near[:count]


@kernel
def _count_safe_steps(spare: float, loss_per_step: float, steps: int) -> int:
    """Returns after how many steps the spare clearance [m] may be used up, at least 1."""
    return max(1, math.floor(min(spare / loss_per_step, steps + 1.0)))


@kernel
def compute_clearance(x: float, y: float, body: Body) -> float:
    """Returns the signed distance from a point to a footprint [m]; negative inside."""
    if body.outline.begin == body.outline.end:
        return math.sqrt(x * x + y * y) - body.radius
    clearance: float = outline_point(x, y, body.outline)
    return clearance


@kernel(allocates=True)
def _fill_places(
    places: Array, duration: float, twist: Array, braked_speed: float, stop: Stop
) -> None:
    """Fills places (S + 1, 5) evenly along an arc that takes a duration [s] at full speed."""
    steps = len(places) - 1
    for s in range(1, steps + 1):
        full_speed_time = duration * s / steps
        x, y, cosine, sine = follow_arc(twist, full_speed_time)
        places[s, X] = x
        places[s, Y] = y
        places[s, COSINE] = cosine
        places[s, SINE] = sine
        places[s, TIME] = _compute_braking_time(full_speed_time, braked_speed, stop)


@kernel(allocates=True)
def _fill_places_of_separate_turn(
    places: Array, path: float, twist: Array, braked_speed: float, stop: Stop
) -> float:
    """Fills places for a turn that brakes independently; returns the longest step [s].

    The path of the footprint from each place to the next is limited as in
    `_fill_places`. Such a robot leaves its arc, so each place is reached from the
    previous one by a separate arc.
    """
    rest_time = _compute_rest_time(twist, braked_speed, stop)
    steps = len(places) - 1
    places[0] = 0.0
    places[0, COSINE] = 1.0
    drive_time = 0.0
    turn_time = 0.0
    longest_step = 0.0
    for s in range(1, steps + 1):
        time = places[s - 1, TIME]
        next_time = rest_time
        if s < steps:
            next_time = _find_time(
                path * s / steps, time, rest_time, twist, braked_speed, stop
            )
        next_drive_time, next_turn_time = _split_time(
            next_time, twist, braked_speed, stop
        )
        drive = next_drive_time - drive_time
        turn = next_turn_time - turn_time
        _append_place(places, s, (twist[0] * drive, twist[1] * drive, twist[2] * turn))
        places[s, TIME] = next_time
        longest_step = max(longest_step, next_time - time)
        drive_time = next_drive_time
        turn_time = next_turn_time
    return longest_step


@kernel
def _split_time(
    time: float, twist: Array, braked_speed: float, stop: Stop
) -> tuple[float, float]:
    """Returns the times [s] at full speed and full turn rate that cover what braking covers."""
    drive_time = _compute_full_speed_time(
        time, braked_speed, stop.reaction, stop.deceleration
    )
    turn_reaction = stop.reaction + stop.turn_delay
    turn_time = _compute_full_speed_time(
        time, abs(twist[2]), turn_reaction, stop.turn_deceleration
    )
    return drive_time, turn_time


@kernel
def _find_time(
    moved: float,
    low: float,
    high: float,
    twist: Array,
    braked_speed: float,
    stop: Stop,
) -> float:
    """Returns the time, within [low, high], at which the footprint has moved so far [m]."""
    speed = math.hypot(twist[0], twist[1])
    turn_speed = abs(twist[2]) * stop.body.farthest_corner
    for _ in range(TIME_BISECTIONS):
        middle = 0.5 * (low + high)
        drive_time, turn_time = _split_time(middle, twist, braked_speed, stop)
        if speed * drive_time + turn_speed * turn_time < moved:
            low = middle
        else:
            high = middle
    return high


@kernel
def _append_place(places: Array, s: int, arc: tuple[float, float, float]) -> None:
    """Writes place s, which an arc reaches from the place before."""
    x, y, cosine, sine = follow_arc(arc, 1.0)
    before_cosine = places[s - 1, COSINE]
    before_sine = places[s - 1, SINE]
    places[s, X] = places[s - 1, X] + before_cosine * x - before_sine * y
    places[s, Y] = places[s - 1, Y] + before_sine * x + before_cosine * y
    places[s, COSINE] = before_cosine * cosine - before_sine * sine
    places[s, SINE] = before_sine * cosine + before_cosine * sine


@kernel
def _compute_braking_time(full_speed_time: float, speed: float, stop: Stop) -> float:
    """Returns the time [s] in which braking covers what full speed covers in `full_speed_time`."""
    braking_time = full_speed_time - stop.reaction
    if braking_time <= 0.0:
        return full_speed_time
    square = speed * speed - 2.0 * stop.deceleration * speed * braking_time
    return stop.reaction + (speed - math.sqrt(max(square, 0.0))) / stop.deceleration


@kernel
def _compute_full_speed_time(
    braking_time: float, speed: float, reaction: float, deceleration: float
) -> float:
    """Returns the time at full speed in which a robot gets as far as in a time of braking [s].

    This is the inverse of `_compute_braking_time`.
    """
    if braking_time <= reaction or speed == 0.0:
        return min(braking_time, reaction)
    braked = min(braking_time - reaction, speed / deceleration)
    return reaction + braked * (1.0 - deceleration * braked / (2.0 * speed))


@kernel
def follow_arc(
    twist: Array | tuple[float, float, float], time: float
) -> tuple[float, float, float, float]:
    """Returns x, y, cosine and sine of heading after a time on the exact arc of a twist (3,)."""
    turn = twist[2] * time
    cosine = math.cos(turn)
    sine = math.sin(turn)
    if abs(turn) < SMALL_TURN:
        ahead = 1.0
        aside = turn / 2.0
    else:
        ahead = sine / turn
        aside = (1.0 - cosine) / turn
    x = (ahead * twist[0] - aside * twist[1]) * time
    y = (aside * twist[0] + ahead * twist[1]) * time
    return x, y, cosine, sine


@kernel(allocates=True)
def fill_grid(low: Array, high: Array, counts: NDArray[np.int64]) -> Array:
    """Returns a grid of twists (K, 3) between two (3,), with `counts` along each axis."""
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
