"""Compiled search of the dynamic-window planner. Shapes: N robots, P parts of a scan, K twists."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.kernels import kernel

Array = NDArray[np.float64]


class ScanRays(NamedTuple):
    """Rays of a scan in `base_link`; a share of 1 stands for `range_max`."""

    directions: Array  # (P, 2) unit vectors
    origin: Array  # (2,) [m]
    range_max: float  # [m]


class LookAhead(NamedTuple):
    """Parameters of the roll-outs of a robot."""

    reach: Array  # (3,) greatest change of a twist in one period
    radius: float  # of the footprint with its margin [m]
    period: float  # time step [s]
    steps: int
    rest: float  # time to come to rest [s]


class TwistWeights(NamedTuple):
    """Weights of the cost of a twist."""

    gap: float  # to the goal [1/m]
    aim: float  # of the heading at the goal
    clearance: float  # of the nearest obstacle on the way
    time: float  # until a contact


@kernel(allocates=True)
def choose_all(out, scans, goals, twists, candidates, rays, ahead, weights):  # type: ignore[no-untyped-def]
    """Writes for N robots the index of the candidate that `choose` returns into out (N,)."""
    hits = np.empty((scans.shape[1], 2))
    for n in range(out.shape[0]):
        count = hits_of(hits, scans[n], rays)
        out[n] = choose(hits[:count], goals[n], twists[n], candidates, ahead, weights)


@kernel(allocates=True)
def hits_of(hits, shares, rays):  # type: ignore[no-untyped-def]
    """Writes a scan's end points, by range shares (P,), into hits (P, 2) [m]; returns the count."""
    count = 0
    for p in range(shares.shape[0]):
        if shares[p] < 1.0:
            share = shares[p] * rays.range_max
            hits[count, 0] = rays.origin[0] + share * rays.directions[p, 0]
            hits[count, 1] = rays.origin[1] + share * rays.directions[p, 1]
            count += 1
    return count


@kernel(allocates=True)
def choose(hits, goal, twist, candidates, ahead, weights):  # type: ignore[no-untyped-def]
    """Returns the index of the cheapest candidate (K, 3), preferring those within the window."""
    best, least = 0, math.inf
    for k in range(candidates.shape[0]):
        far = False
        for i in range(3):
            far |= abs(candidates[k, i] - twist[i]) > ahead.reach[i]
        cost = cost_of(hits, goal, candidates[k], ahead, weights)
        cost += 1e6 if far else 0.0
        if cost < least:
            best, least = k, cost
    return best


@kernel(allocates=True)
def cost_of(hits, goal, aimed, ahead, weights):  # type: ignore[no-untyped-def]
    """Cost of holding a twist (3,), which is inadmissible if it hits before it can be stopped."""
    period, steps = ahead.period, ahead.steps
    x, y, heading = 0.0, 0.0, 0.0
    gap, clearance, free = math.hypot(goal[0], goal[1]), math.inf, steps
    now = nearest_hit(hits, 0.0, 0.0)
    limit = min(ahead.radius, 0.98 * now)  # already nearer than that: only away
    for step in range(steps):
        middle = heading + 0.5 * aimed[2] * period
        x += (aimed[0] * math.cos(middle) - aimed[1] * math.sin(middle)) * period
        y += (aimed[0] * math.sin(middle) + aimed[1] * math.cos(middle)) * period
        heading += aimed[2] * period
        room = nearest_hit(hits, x, y)
        if room < limit:
            free = step
            break
        clearance = min(clearance, room - ahead.radius)
        gap = min(gap, math.hypot(goal[0] - x, goal[1] - y))
        if gap < 0.15:
            break  # anything behind the goal does not matter
    turn = math.atan2(goal[1] - y, goal[0] - x) - heading
    turn = abs((turn + math.pi) % (2.0 * math.pi) - math.pi) / math.pi
    cost = weights.gap * gap + weights.aim * turn * min(gap, 1.0)
    cost += weights.clearance * (1.0 - min(max(clearance, 0.0), 0.4) / 0.4)
    cost += weights.time * (1.0 - free / steps)
    moves = abs(aimed[0]) + abs(aimed[1]) > 1e-9
    return cost + (1e3 if moves and free * period < ahead.rest else 0.0)


@kernel(allocates=True)
def nearest_hit(hits, x, y):  # type: ignore[no-untyped-def]
    """Distance [m] from a point to the nearest of hits (H, 2)."""
    least = math.inf
    for h in range(hits.shape[0]):
        dx, dy = hits[h, 0] - x, hits[h, 1] - y
        least = min(least, dx * dx + dy * dy)
    return math.sqrt(least)
