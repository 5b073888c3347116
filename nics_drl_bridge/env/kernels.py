"""Compiled inner loops of the tasks: actions, observations, and the navigation task.

The batched loops call a scalar function per robot, even for bearings, because numpy's vectorised
functions round the remainder of a batch differently from its body. Shapes: R robots in all worlds,
B beams, C commands, P scan parts of an observation.
"""

import math
from typing import Any, NamedTuple

import numpy as np

from nics_drl_bridge.geometry import Array
from nics_drl_bridge.kernels import kernel
from nics_drl_bridge.lidar.arrays import Integers, Mask, Singles
from nics_drl_bridge.lidar.sector_kernels import SectorPlan, resample
from nics_drl_bridge.random_kernels import episode_seed

# Maximum distance [m], speed [m/s] and turn rate [rad/s] in an observation.
LIMIT = 1000.0
ONE_BITS = np.float32(1.0).view(np.int32)
BLOCK = 64  # number of beams checked together
# limit of a beam's contribution to a contact [m]
FURTHEST = np.float32(0.04)


class ScanScale(NamedTuple):
    """Conversion of a scan to observation parts and contacts."""

    # inverse of the range of a fraction of 1 [1/m], float32
    per_metre: np.float32
    # (B,) float32 range at which each beam leaves the footprint [m]
    leaves: Singles
    # number of neighbouring beams on either side that are averaged for contacts
    beside: int
    sectors: int  # number of observed sectors; 0 if beams are observed
    plan: SectorPlan  # mapping of beams to sectors


class NavigationRules(NamedTuple):
    """Parameters of `navigation.Navigation`; see its fields."""

    scale: Any  # a ScanScale, packed
    goal_radius: float
    progress_reward: float
    time_reward: float
    success_reward: float
    collision_reward: float


@kernel
def compute_episode_seeds(seeds: Integers, numbers: Integers, out: Integers) -> None:
    """Computes seeds (n,) of episodes from their numbers (n,) and their envs' seeds (n,)."""
    for i in range(len(seeds)):
        out[i] = episode_seed(seeds[i], numbers[i])


@kernel
def scale_actions(out: Array, actions: Singles, low: Array, high: Array) -> bool:
    """Scales actions (R, C), clamped to [-1, 1], to commands (R, C) between their limits (C,).

    Returns False if an action is not finite.
    """
    for i in range(len(out)):
        for c in range(out.shape[1]):
            action = min(max(float(actions[i, c]), -1.0), 1.0)
            share = (action + 1.0) / 2.0
            out[i, c] = low[c] + share * (high[c] - low[c])
    return is_finite(actions)


@kernel
def is_finite(values: Array | Singles) -> bool:
    """Returns True if all values (R, C) are finite."""
    for i in range(len(values)):
        for c in range(values.shape[1]):
            if not math.isfinite(values[i, c]):
                return False
    return True


@kernel(allocates=True)
def look(shares: Singles, ranges: Singles, scale: ScanScale) -> bool:
    """Writes a scan (B,) as fractions (P,), 1 free, 0 too close; returns True for a contact."""
    seen = ranges
    if scale.sectors > 0:
        resample(shares, ranges, scale.plan)
        seen = shares
    for p in range(len(shares)):
        # NaN (unknown) compares False, so it becomes 0, as does -inf (too close).
        share = seen[p] * scale.per_metre
        share = share if share > np.float32(0.0) else np.float32(0.0)
        # Compare as integers, which keeps the order: LLVM turns two float limits into masks.
        bits = np.float32(share).view(np.int32)
        shares[p] = np.int32(min(bits, ONE_BITS)).view(np.float32)
    return has_contact(ranges, scale)


@kernel
def has_contact(ranges: Singles, scale: ScanScale) -> bool:
    """Returns True if a beam (B,), and its mean with its neighbours, end in the footprint.

    A single beam is too noisy: among hundreds, one is nearly always off by three
    standard deviations.
    """
    count = len(ranges)
    for begin in range(0, count, BLOCK):
        beams = min(BLOCK, count - begin)
        hits = np.int32(0)
        for k in range(beams):
            i = np.uintp(begin + k)
            is_hit = ranges[i] < scale.leaves[i]
            hits = np.int32(hits | np.int32(is_hit))
        if hits == 0:
            continue
        for b in range(begin, begin + beams):
            if not ranges[b] < scale.leaves[b]:
                continue
            gap = np.float32(0.0)
            end = min(b + scale.beside + 1, count)
            for k in range(max(b - scale.beside, 0), end):
                beyond = ranges[k] - scale.leaves[k]
                if beyond == beyond:  # False for NaN (unknown)
                    gap += min(max(beyond, -FURTHEST), FURTHEST)
            if gap < np.float32(0.0):
                return True
    return False


@kernel(allocates=True)
def looks(
    shares: Singles,
    touched: Mask,
    ranges: Singles,
    packed: Any,
) -> None:
    """Applies `look` to the scans (R, B) of R robots; writes its results to touched (R,).

    `packed` is a ScanScale, packed by `kernels.pack`.
    """
    for i in range(len(ranges)):
        touched[i] = look(shares[i], ranges[i], packed.content)


@kernel
def find_bearing(dx: float, dy: float, heading: float) -> tuple[float, float, float]:
    """Returns the distance [m] to a point at (dx, dy), and cosine and sine of its bearing."""
    distance = math.sqrt(dx * dx + dy * dy)
    if distance == 0.0:
        return 0.0, 1.0, 0.0
    c = math.cos(heading)
    s = math.sin(heading)
    forward = (c * dx + s * dy) / distance
    left = (c * dy - s * dx) / distance
    forward = min(max(forward, -1.0), 1.0)
    left = min(max(left, -1.0), 1.0)
    return distance, forward, left


@kernel(allocates=True)
def navigate(
    out: Singles,
    terms: Array,
    flags: Mask,
    before: Array,
    pose: Array,
    twist: Array,
    ranges: Singles,
    goals: Array,
    packed: Any,
) -> None:
    """Takes a step of `navigation.Navigation`, whose NavigationRules are packed.

    Writes the observations (R, P + 6); the terms (5, R) progress, time, success, collision, and
    last the approach [m]; and the flags (4, R) reached, touched, succeeded, and ended.
    """
    rules = packed.content
    parts = out.shape[1] - 6
    for i in range(len(out)):
        touched = look(out[i, :parts], ranges[i], rules.scale.content)
        dx = goals[i, 0] - pose[i, 0]
        dy = goals[i, 1] - pose[i, 1]
        distance, c, s = find_bearing(dx, dy, pose[i, 2])
        dx = goals[i, 0] - before[i, 0]
        dy = goals[i, 1] - before[i, 1]
        approach = math.sqrt(dx * dx + dy * dy) - distance
        reached = distance < rules.goal_radius
        succeeded = reached and not touched
        terms[0, i] = rules.progress_reward * approach
        terms[1, i] = rules.time_reward
        terms[2, i] = rules.success_reward * succeeded
        terms[3, i] = rules.collision_reward * touched
        terms[4, i] = approach
        flags[0, i] = reached
        flags[1, i] = touched
        flags[2, i] = succeeded
        flags[3, i] = reached or touched
        out[i, parts] = min(distance, LIMIT)
        out[i, parts + 1] = c
        out[i, parts + 2] = s
        for k in range(3):
            out[i, parts + 3 + k] = min(max(twist[i, k], -LIMIT), LIMIT)


@kernel
def find_bearings(out: Array, ways: Array, headings: Array) -> None:
    """Writes `find_bearing` (R, 3) of points at displacements `ways` (R, 2) from headings (R,)."""
    for r in range(len(out)):
        distance, out[r, 1], out[r, 2] = find_bearing(
            ways[r, 0], ways[r, 1], headings[r]
        )
        out[r, 0] = min(distance, LIMIT)
