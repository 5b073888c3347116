"""Compiled draws of domain randomisation, each fixed by seed, robot, group and column alone.

Shared arguments: `seeds` (n,) of the episodes; `group` is the purpose of the numbers, one of the
constants below; `place` is a column. A column whose bounds are equal takes that value and draws
nothing, and a group never shifts the draws of another.
"""

from __future__ import annotations

import math

import numpy as np

from nics_drl_bridge import random_kernels as random
from nics_drl_bridge.kernels import kernel

KINEMATICS, LATENCY, ODOMETRY, LIDAR, CHOICES, OBSTACLES = range(6)
PLACES = 1 << 20
"""More than a group has columns; the counters of two groups never collide."""
GROUPS = 8


@kernel(allocates=True)
def _share(seed, robot, group, place):  # type: ignore[no-untyped-def]
    """Returns the draw in [0, 1) of one column."""
    counter = (robot * GROUPS + group) * PLACES + place
    return random.uniform(seed, random.RANDOMISATION_STREAM, counter)


@kernel(allocates=True)
def _between(low, high, seed, robot, group, place):  # type: ignore[no-untyped-def]
    """Draws a number between `low` and `high`; exactly `low` if they are equal."""
    return low if high == low else low + _share(seed, robot, group, place) * (high - low)


@kernel(allocates=True)
def draw_between(out, low, high, seeds, group):  # type: ignore[no-untyped-def]
    """Fills out (n, M, Q) uniformly between low (Q,) and high (Q,)."""
    for n in range(out.shape[0]):
        for m in range(out.shape[1]):
            for q in range(out.shape[2]):
                out[n, m, q] = _between(low[q], high[q], seeds[n], m, group, q)


@kernel(allocates=True)
def draw_whole(out, low, high, seeds, group):  # type: ignore[no-untyped-def]
    """Fills out (n, M, Q) with integers: uniform between low (Q,) and high (Q,), floored."""
    for n in range(out.shape[0]):
        for m in range(out.shape[1]):
            for q in range(out.shape[2]):
                value = _between(low[q], high[q], seeds[n], m, group, q)
                out[n, m, q] = np.int64(math.floor(value))


@kernel(allocates=True)
def draw_choice(out, column, values, seeds):  # type: ignore[no-untyped-def]
    """Fills one column of out (n, M, P) with one of the values (V,), all equally likely."""
    for n in range(out.shape[0]):
        for m in range(out.shape[1]):
            share = _share(seeds[n], m, CHOICES, column)
            out[n, m, column] = values[int(share * values.shape[0])]
