"""Compiled search of the dynamic-window planner. Shapes: N robots, K twists."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.geometry import Array
from nics_drl_bridge.kernels import kernel
from nics_drl_bridge.policy.planners import local_map_kernels as kernels
from nics_drl_bridge.policy.planners.local_map_kernels import (
    Clearance,
    FootprintDiscs,
    MapScratch,
    ScanRays,
    Situation,
)

# half the cost of a twist that hits something before the robot can stop
INADMISSIBLE = 500.0
MOVING = 0.05  # speed above which stopping takes time [m/s]


class LookAhead(NamedTuple):
    """Parameters of the rollouts of a robot."""

    reach: Array  # (3,) maximum change of the twist in one period
    period: float  # time step [s]
    steps: int
    reaction: float  # time from a stop command to the start of braking [s]
    slowness: float  # inverse of the deceleration then [s^2/m]
    lever: float  # factor that converts a turn rate to the speed it adds to braking [m]
    # reaction time of a turn that brakes independently of the speed, else 0 [s]
    turn_reaction: float
    turn_slowness: float  # inverse of the turn's deceleration [s^2/rad]
    far: float  # distance along an axis beyond which the map is unknown [m]


class TwistWeights(NamedTuple):
    """Weights of the terms in the cost of a twist."""

    gap: float  # weight of the path length left to the goal [1/m]
    # weight of the heading error, which is 0 towards the goal and 1 away from it
    aim: float
    # weight of the nearest obstacle on the path: 0 if far away, 1 at the margin
    clearance: float
    time: float  # weight of the time until a contact


@kernel(allocates=True)
def choose_all(
    out: NDArray[np.int64],
    scans: Array,
    goals: Array,
    twists: Array,
    candidates: Array,
    ahead: LookAhead,
    weights: TwistWeights,
    sense: tuple[ScanRays, FootprintDiscs, Clearance, MapScratch],
) -> None:
    """Writes the index of the candidate that `choose` picks for each of N robots into out (N,)."""
    for n in range(out.shape[0]):
        around = kernels.look(scans[n], goals[n], *sense)
        out[n] = choose(around, twists[n], candidates, ahead, weights)


@kernel
def choose(
    around: Situation,
    twist: Array,
    candidates: Array,
    ahead: LookAhead,
    weights: TwistWeights,
) -> int:
    """Returns the index of the cheapest candidate (K, 3), preferring those within the window."""
    best = 0
    least = math.inf
    # If braking takes time, a robot that could no longer stop one period later must stop now.
    late = ahead.slowness > 0.0 and math.hypot(twist[0], twist[1]) > MOVING
    late = late and cost_of(around, twist, twist, ahead, weights) > INADMISSIBLE
    for k in range(candidates.shape[0]):
        far = False
        moves = False
        for i in range(3):
            moves |= candidates[k, i] != 0.0
            far |= abs(candidates[k, i] - twist[i]) > ahead.reach[i]
        cost = cost_of(around, candidates[k], twist, ahead, weights)
        # If braking takes time, `cost_of` starts from the present twist, so every twist is allowed.
        cost += 1e6 if far and ahead.slowness == 0.0 else 0.0
        cost += 1e6 if late and moves else 0.0
        if cost < least:
            best = k
            least = cost
    return best


@kernel
def cost_of(
    around: Situation,
    aimed: Array,
    twist: Array,
    ahead: LookAhead,
    weights: TwistWeights,
) -> float:
    """Returns the cost of holding a twist (3,), inadmissible if it hits something before stopping.

    If braking takes time, the robot starts from its present twist (3,), which may be faster.
    """
    period = ahead.period
    steps = ahead.steps
    keep = around.clearance
    x = 0.0
    y = 0.0
    heading = 0.0
    c = 1.0
    s = 0.0
    least = kernels.way_at(x, y, around)
    near = math.inf
    free = steps
    limit = kernels.touching(around)
    for step in range(steps):
        middle = heading + 0.5 * aimed[2] * period
        x += (aimed[0] * math.cos(middle) - aimed[1] * math.sin(middle)) * period
        y += (aimed[0] * math.sin(middle) + aimed[1] * math.cos(middle)) * period
        heading += aimed[2] * period
        c = math.cos(heading)
        s = math.sin(heading)
        room = kernels.room_at(x, y, c, s, around)
        if room < limit or max(abs(x), abs(y)) > ahead.far:
            free = step
            break
        near = min(near, room - keep.margin)
        least = min(least, kernels.way_at(x, y, around))
        if math.hypot(around.goal[0] - x, around.goal[1] - y) < kernels.ARRIVED_M:
            break
    turn = kernels.astray(x, y, c, s, kernels.way_at(x, y, around), around)
    cost = weights.gap * least + weights.aim * turn * min(least, 1.0)
    cost += weights.clearance * (1.0 - min(max(near, 0.0), keep.soft) / keep.soft)
    cost += weights.time * (1.0 - free / steps)
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
