"""Pictures that a lidar shows: is one shown again, although the robot moved and must see another?

A lidar without noise may well show the same between two long walls, or from the middle of a round
room. So an old scan is moved by what odometry tells, and only those of its beams speak that must be
of another length by now, however wrong the heading is.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.geometry import between, compose
from nics_drl_bridge.safety.state import GateConfig

Array = NDArray[np.float64]
Ranges = NDArray[np.float32]
SAME_SHARE = 0.99
"""Of the beams, from which on two scans are the same picture; of few beams one may flicker, too."""
TELLING_SHARE = 0.9
"""Of those that must have changed, from which on it is none of now; a lidar that lives has none."""
CHANGE = 0.02
"""A beam that must have changed did so by more than this [m],"""
HEADINGS = (-0.03, 0.0, 0.03)
"""by whichever of these errors odometry's heading is wrong [rad]."""
NEIGHBOURS = 1.5
"""So many beams away at most lies what an old beam is compared with."""
LEAST_BEAMS = 3


def same(one: Ranges, other: Ranges) -> bool:
    """Whether two scans (B,) show the same picture bit for bit, but for a few beams.

    Only beams that return in one of them count.
    """
    returned = np.isfinite(one) | np.isfinite(other)
    count = int(np.count_nonzero(returned))
    equal = int(np.count_nonzero((one == other) & returned))
    return _but_for_one(equal, count, SAME_SHARE)


def shown_again(config: GateConfig, old: Ranges, ranges: Ranges, moved: Array) -> bool:
    """Whether a scan (B,) is an old one (B,), although the robot has moved (3,) [m, m, rad]."""
    telling = must_differ(config, old, moved)
    count = int(np.count_nonzero(telling))
    equal = int(np.count_nonzero((old == ranges) & telling))
    return count >= LEAST_BEAMS and _but_for_one(equal, count, TELLING_SHARE)


def _but_for_one(equal: int, count: int, share: float) -> bool:
    """Whether such a share of some beams is equal, or all but one of them."""
    return equal > 0 and equal >= min(share * count, count - 1)


def must_differ(config: GateConfig, ranges: Ranges, moved: Array) -> NDArray[np.bool_]:
    """(B,) beams of a scan that must be of another length after a motion.

    Args:
        config: of the gate, for its lidar.
        ranges: (B,) [m], before.
        moved: (3,) relative pose of `base_link` since [m, m, rad].
    """
    mount = np.array(config.mount)
    moved = between(mount, compose(moved, mount))
    open_ = np.isposinf(ranges)
    known = np.isfinite(ranges) | open_
    far = config.range_max or float(ranges[np.isfinite(ranges)].max())
    length = np.where(open_, far, ranges)[known].astype(np.float64)
    angles = config.beam_angles[known]
    ends = np.stack([length * np.cos(angles), length * np.sin(angles), 0.0 * length], axis=1)
    changed = np.isfinite(ranges)
    for error in HEADINGS:
        seen = between(moved + np.array([0.0, 0.0, error]), ends)
        changed &= _changed(config.beam_angles, ranges, seen, open_[known])
    return np.asarray(changed)


def _changed(
    angles: Array, ranges: Ranges, seen: Array, open_: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """(B,) which beams differ from where the ends of the old ones (K, 2 or more) are seen now.

    An open beam tells only that nothing is nearer.
    """
    bearing = np.arctan2(seen[:, 1], seen[:, 0])
    order = np.argsort(bearing)
    bearing, length = bearing[order], np.hypot(seen[order, 0], seen[order, 1])
    turn = 2.0 * np.pi
    bearing = np.concatenate([bearing[-1:] - turn, bearing, bearing[:1] + turn])
    length = np.concatenate([length[-1:], length, length[:1]])
    is_open = open_[order]
    is_open = np.concatenate([is_open[-1:], is_open, is_open[:1]])
    wrapped = np.mod(angles + np.pi, turn) - np.pi
    above = np.clip(np.searchsorted(bearing, wrapped), 1, len(bearing) - 1)
    below = above - 1
    spacing = abs(angles[1] - angles[0]) if len(angles) > 1 else turn
    low, high = np.minimum(length[below], length[above]), np.maximum(length[below], length[above])
    nearest = np.where(wrapped - bearing[below] < bearing[above] - wrapped, below, above)
    close = np.abs(wrapped - bearing[nearest]) <= NEIGHBOURS * spacing
    nearer = (ranges < low - CHANGE) & close
    farther = (ranges > high + CHANGE) & close & ~is_open[below] & ~is_open[above]
    return np.asarray(nearer | farther)
