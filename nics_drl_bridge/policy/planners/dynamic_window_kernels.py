"""Compiled search of the dynamic-window planner. Shapes: N robots, K twists."""

import math
from typing import NamedTuple

from nics_drl_bridge.geometry import Array
from nics_drl_bridge.kernels import kernel
from nics_drl_bridge.lidar.arrays import Integers
from nics_drl_bridge.policy.planners import local_map_kernels as maps

# Weights in the cost of a twist: remaining path length [1/m]; heading error, from 0
# towards the goal to 1 away from it; nearest obstacle on the path, from 0 far away to 1
# at the margin; and time until a contact
WAY_WEIGHT = 1.0
AIM_WEIGHT = 0.6
CLEARANCE_WEIGHT = 0.3
TIME_WEIGHT = 1.5
# half the cost of a twist that hits something before the robot can stop
INADMISSIBLE = 500.0
MOVING = 0.05  # speed above which stopping takes time [m/s]


class LookAhead(NamedTuple):
    """Parameters of the rollouts of a robot."""

    reach: Array  # (3,) maximum change of the twist in one period
    period: float  # time step [s]
    steps: int
    reaction: float  # time from a stop command to the start of braking [s]
    slowness: float  # inverse of the braking deceleration [s^2/m]
    lever: float  # factor that converts a turn rate to the speed it adds to braking [m]
    # reaction time of a turn that brakes independently of the speed, else 0 [s]
    turn_reaction: float
    turn_slowness: float  # inverse of the turn's deceleration [s^2/rad]
    far: float  # distance along an axis beyond which the map is unknown [m]


@kernel
def choose_twists(
    out: Integers,
    scans: Array,
    goals: Array,
    twists: Array,
    candidates: Array,
    ahead: LookAhead,
    around: maps.Situation,
) -> None:
    """Writes the index of the cheapest candidate (K, 3) for each of N robots into out (N,).

    Candidates within the window are preferred.
    """
    brakes = ahead.slowness > 0.0
    for n in range(len(out)):
        maps.map_scan(scans[n], goals[n], around)
        twist = twists[n]
        # If braking takes time, a robot that could no longer stop one period later must stop now.
        must_stop = brakes and math.hypot(twist[0], twist[1]) > MOVING
        must_stop = must_stop and find_cost(around, twist, twist, ahead) > INADMISSIBLE
        least = math.inf
        for k in range(len(candidates)):
            far = False
            moves = False
            for i in range(3):
                moves |= candidates[k, i] != 0.0
                far |= abs(candidates[k, i] - twist[i]) > ahead.reach[i]
            cost = find_cost(around, candidates[k], twist, ahead)
            # If braking takes time, the cost starts from the current twist, so every
            # twist is allowed.
            cost += 1e6 if far and not brakes else 0.0
            cost += 1e6 if must_stop and moves else 0.0
            if cost < least:
                out[n] = k
                least = cost


@kernel
def find_cost(
    around: maps.Situation, aimed: Array, twist: Array, ahead: LookAhead
) -> float:
    """Returns the cost of holding a twist (3,), inadmissible if it hits something before stopping.

    If braking takes time, the robot starts from its current twist (3,), which may be
    faster.
    """
    period = ahead.period
    steps = ahead.steps
    keep = around.clearance
    x = 0.0
    y = 0.0
    heading = 0.0
    c = 1.0
    s = 0.0
    least = maps.find_way(x, y, around)
    near = math.inf
    free = steps
    limit = maps.find_contact_limit(around)
    for step in range(steps):
        middle = heading + 0.5 * aimed[2] * period
        x += (aimed[0] * math.cos(middle) - aimed[1] * math.sin(middle)) * period
        y += (aimed[0] * math.sin(middle) + aimed[1] * math.cos(middle)) * period
        heading += aimed[2] * period
        c = math.cos(heading)
        s = math.sin(heading)
        room = maps.find_room(x, y, c, s, around)
        if room < limit or max(abs(x), abs(y)) > ahead.far:
            free = step
            break
        near = min(near, room - keep.margin)
        least = min(least, maps.find_way(x, y, around))
        if math.hypot(around.goal[0] - x, around.goal[1] - y) < maps.ARRIVED_M:
            break
    turn = maps.score_heading(x, y, c, s, maps.find_way(x, y, around), around)
    cost = WAY_WEIGHT * least + AIM_WEIGHT * turn * min(least, 1.0)
    cost += CLEARANCE_WEIGHT * (1.0 - min(max(near, 0.0), keep.soft) / keep.soft)
    cost += TIME_WEIGHT * (1.0 - free / steps)
    moves = abs(aimed[0]) + abs(aimed[1]) > 1e-9
    # Uniform braking covers as much distance as half its duration at full speed.
    speed = math.hypot(aimed[0], aimed[1])
    pace = speed + ahead.lever * abs(aimed[2])
    faster = 1.0
    if ahead.slowness > 0.0 and speed > 0.0:
        present = math.hypot(twist[0], twist[1])
        faster = max(1.0, present / speed)
        pace = max(pace, present + ahead.lever * abs(twist[2]))
    rest = faster * (ahead.reaction + 0.5 * pace * ahead.slowness)
    if aimed[2] != 0.0:
        rest = max(
            rest, ahead.turn_reaction + 0.5 * abs(aimed[2]) * ahead.turn_slowness
        )
    return cost + (2.0 * INADMISSIBLE if moves and free * period < rest else 0.0)
