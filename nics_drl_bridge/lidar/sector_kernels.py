"""Compiled inner loops of the canonical scan: from the beams of a lidar to sectors of a layout.

Ranges follow REP-117: `inf` no return, `-inf` too close, NaN unknown. Shapes: B beams, S sectors.
"""

import math
from typing import NamedTuple

import numpy as np

from nics_drl_bridge.kernels import kernel
from nics_drl_bridge.lidar.arrays import Array, ShortIntegers, Singles

TURN = 2.0 * math.pi
INF_BITS, UNKNOWN = np.array([np.inf, np.nan], np.float32).view(np.int32)


class SectorPlan(NamedTuple):
    """Assignment of the beams of one lidar to the sectors of one layout."""

    first: ShortIntegers  # (S,) first beam of each sector
    # (S,) number of beams of each sector; beam 0 follows the last
    hits: ShortIntegers
    directions: Array  # (B, 2) of the beams in `base_link`
    # (2,) position of the lidar relative to the viewpoint [m]; if zero, sectors are filled by beam
    shift: Array
    angle_min: float  # start of sector 0 [rad]
    width: float  # of the sectors [rad]
    range_min: float  # of the lidar [m]
    range_max: float
    closed: bool  # True if the last beam and the first are neighbours


@kernel(allocates=True)
def resample(out: Singles, ranges: Singles, plan: SectorPlan) -> None:
    """Write the nearest return in each sector (S,) of one scan (B,) [m], REP-117; NaN is unknown.

    A sector without a beam takes the nearer return of the two adjacent beams.
    """
    if plan.shift[0] != 0.0 or plan.shift[1] != 0.0:
        _fill_by_place(out, ranges, plan)
        return
    # Each sector from its own beams; as whole numbers, ranges have the same order.
    beams = len(ranges)
    whole = ranges.view(np.int32)
    nearest = out.view(np.int32)
    known = np.empty(2 * beams, np.int32)  # twice, because a sector may span the seam
    for b in range(beams):
        is_known = np.int32(whole[b] & np.int32(0x7FFFFFFF)) <= INF_BITS
        known[b] = whole[b] if is_known else UNKNOWN
        known[beams + b] = known[b]
    for s in range(len(out)):
        begin = np.uintp(plan.first[s])
        near = UNKNOWN
        for b in range(plan.hits[s]):
            near = min(near, known[begin + np.uintp(b)])
        nearest[s] = near


@kernel(allocates=True)
def _fill_by_place(out: Singles, ranges: Singles, plan: SectorPlan) -> None:
    """Fill each sector from its returns, or else from the nearer of the adjacent beams."""
    sectors = len(out)
    beams = len(ranges)
    where = np.empty(beams, np.int32)
    value = np.empty(beams, np.float32)
    has_return = np.zeros(sectors, np.bool_)
    for s in range(sectors):
        out[s] = np.nan
    for b in range(beams):
        where[b], value[b] = _locate_return(ranges[b], plan.directions[b], plan)
        s = where[b]
        if 0 <= s < sectors:
            has_return[s] = True
            out[s] = _choose_nearer(out[s], value[b])
    around = round(TURN / plan.width)
    for b in range(beams if plan.closed else beams - 1):
        after = (b + 1) % beams
        if where[b] < 0 or where[after] < 0:
            continue
        gap = (where[after] - where[b]) % around
        if gap > around // 2:  # the other direction is shorter
            gap -= around
        near = min(value[b], value[after])
        for k in range(1, abs(gap)):
            s = (where[b] + (k if gap > 0 else -k)) % around
            if s < sectors and not has_return[s]:
                out[s] = _choose_nearer(out[s], near)


@kernel
def _locate_return(
    r: np.float32, direction: Array, plan: SectorPlan
) -> tuple[int, np.float32]:
    """Sector of a return seen from the viewpoint, -1 if unknown, and its distance."""
    if r != r:
        return -1, np.float32(np.nan)
    reach = min(max(float(r), 0.5 * plan.range_min), plan.range_max)
    x = plan.shift[0] + reach * direction[0]
    y = plan.shift[1] + reach * direction[1]
    angle = (math.atan2(y, x) - plan.angle_min) % TURN
    s = 0
    if angle < TURN:  # a tiny negative angle is rounded to TURN
        s = int(angle / plan.width)
    if not math.isfinite(r):
        return s, r
    return s, np.float32(math.sqrt(x * x + y * y))


@kernel
def _choose_nearer(first: np.float32, second: np.float32) -> np.float32:
    return first if first <= second else second
