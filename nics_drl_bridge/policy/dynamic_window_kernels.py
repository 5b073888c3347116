"""Compiled search of the dynamic-window planner. Shapes: N robots, K twists."""

import math
from typing import NamedTuple

from nics_drl_bridge.geometry import Array
from nics_drl_bridge.kernels import kernel
from nics_drl_bridge.policy import local_map_kernels as kernels


class LookAhead(NamedTuple):
    """Parameters of the roll-outs of a robot."""

    reach: Array  # (3,) greatest change of a twist in one period
    period: float  # time step [s]
    steps: int
    rest: float  # time to come to rest [s]


class TwistWeights(NamedTuple):
    """Weights of the cost of a twist."""

    gap: float  # left on the way to the goal [1/m]
    aim: float  # of the heading, from 0 along that way to 1 the other way
    clearance: float  # of the nearest obstacle on the way, from 0 far away to 1 at the margin
    time: float  # until a contact


@kernel(allocates=True)
def choose_all(out, scans, goals, twists, candidates, ahead, weights, sense):  # type: ignore[no-untyped-def]
    """Writes for N robots the index of the candidate that `choose` returns into out (N,)."""
    for n in range(out.shape[0]):
        around = kernels.look(scans[n], goals[n], *sense)
        out[n] = choose(around, twists[n], candidates, ahead, weights)


@kernel
def choose(around, twist, candidates, ahead, weights):  # type: ignore[no-untyped-def]
    """Returns the index of the cheapest candidate (K, 3), preferring those within the window."""
    best, least = 0, math.inf
    for k in range(candidates.shape[0]):
        far = False
        for i in range(3):
            far |= abs(candidates[k, i] - twist[i]) > ahead.reach[i]
        cost = cost_of(around, candidates[k], ahead, weights)
        cost += 1e6 if far else 0.0
        if cost < least:
            best, least = k, cost
    return best


@kernel
def cost_of(around, aimed, ahead, weights):  # type: ignore[no-untyped-def]
    """Cost of holding a twist (3,), which is inadmissible if it hits before it can be stopped."""
    period, steps, keep = ahead.period, ahead.steps, around.clearance
    x, y, heading, c, s = 0.0, 0.0, 0.0, 1.0, 0.0
    least, near, free = kernels.way_at(x, y, around), math.inf, steps
    limit = kernels.touching(around)
    for step in range(steps):
        middle = heading + 0.5 * aimed[2] * period
        x += (aimed[0] * math.cos(middle) - aimed[1] * math.sin(middle)) * period
        y += (aimed[0] * math.sin(middle) + aimed[1] * math.cos(middle)) * period
        heading += aimed[2] * period
        c, s = math.cos(heading), math.sin(heading)
        room = kernels.room_at(x, y, c, s, around)
        if room < limit:
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
    return cost + (1e3 if moves and free * period < ahead.rest else 0.0)
