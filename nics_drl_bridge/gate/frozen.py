"""Data that arrive but are dead: repeated scans, jumps of odometry, no motion when commanded."""
# A lidar without noise may show the same between two long walls: an old scan is moved by odometry,
# and only beams count whose length must have changed by now.

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.gate.state import (
    Cause,
    GateConfig,
    GateState,
    Push,
    Ranges,
    Sameness,
    replace,
)
from nics_drl_bridge.gate.stops import ODOM, SCAN
from nics_drl_bridge.geometry import between, compose
from nics_drl_bridge.interface import Array

Flags = NDArray[np.bool_]
IDENTICAL = 3  # least number of scans that show a frozen picture
PICTURES = 16  # number of remembered pictures: a lidar may repeat several in turn
RESPONSE = 0.1  # least share of the commanded distance or angle that a robot covers
LEAST_PATH, LEAST_TURN = 0.03, 0.25
"""Least motion commanded within the window for the robot to be judged [m, rad]."""
WINDOW = 0.75  # length of the window as a share of `stuck_s`; the rest is for the delay of odometry
MARK_S = 0.05  # between two marks
PAUSE_S = 0.2  # least time without motion between pushes [s]
STILL_LINEAR, STILL_TURN = 0.05, 0.1
"""A robot slower than this, plus the noise of its odometry, stands still [m/s, rad/s]."""
NOISE = 3.0  # noise of odometry that is allowed for, in standard deviations


def look(
    config: GateConfig, seen: tuple[Sameness, ...], ranges: Ranges, pose: Array | None
) -> tuple[tuple[Sameness, ...], str]:
    """Returns the pictures with a scan (B,), newest last, and why it is an old one, or ""."""
    # Bit for bit; one without returns is ignored. The pose (3,) is None before the first odometry.
    if not np.isfinite(ranges).any():
        return seen, ""
    known = next(
        (one for one in reversed(seen) if is_same_scan(one.ranges, ranges)), None
    )
    if known is None:
        return (*seen[1 - PICTURES :], Sameness(ranges, 1, pose)), ""
    others = tuple(one for one in seen if one is not known)
    first = pose if known.first is None else known.first
    known = replace(known, count=known.count + 1, first=first)
    if pose is None or first is None or known.count < IDENTICAL:
        return (*others, known), ""
    moved = between(first, pose)
    path = max(float(np.hypot(moved[0], moved[1])), abs(float(moved[2])))
    if path <= config.frozen_distance:
        return (*others, known), ""
    telling = must_differ(config, known.ranges, moved)
    still = _match_but_for_one(
        (known.ranges == ranges) & telling, telling, TELLING_SHARE
    )
    if np.count_nonzero(telling) >= LEAST_BEAMS and still:
        why = f"{known.count} scans are the same over a motion of {path:.2f} m or rad"
        return (*others, known), why
    return (
        *others,
        Sameness(ranges, 1, pose),
    ), ""  # the scene may really look the same


def is_at_rest(config: GateConfig, twist: Array) -> bool:
    """True if a body twist (3,) is that of a robot at rest, within the noise of odometry."""
    linear, turn = (NOISE * std for std in config.odom_std)
    slow = np.hypot(twist[0], twist[1]) < STILL_LINEAR + linear
    return bool(slow and abs(twist[2]) < STILL_TURN + turn)


def watch_motion(config: GateConfig, state: GateState, now: float) -> GateState:
    """Integrates the commanded motion and marks the robot's poses."""
    if state.odometry is None or config.limits is None:
        return state
    moving = np.zeros(3)
    angles = ~(config.limits.linear | config.limits.turn)
    moving[list(config.fields)] = np.where(angles, 0.0, state.value)
    push = state.push
    if push is None or now - push.moving_s > PAUSE_S:
        if not moving.any():
            return state if push is None else replace(state, push=None)
        mark = (now, np.zeros(3), state.odometry.pose)
        return replace(state, push=Push(now, now, now, np.zeros(3), (mark,)))
    told: Array = push.told + (now - push.last_s) * moving
    marks = push.marks
    if now - marks[-1][0] >= MARK_S:
        start = now - WINDOW * config.stuck_s
        # The first mark that is kept lies at or before the start of the window.
        first = next(
            (k for k, one in enumerate(marks[1:]) if one[0] > start), len(marks) - 1
        )
        marks = (*marks[first:], (now, told, state.odometry.pose))
    moved_s = now if moving.any() else push.moving_s
    return replace(
        state, push=replace(push, last_s=now, moving_s=moved_s, told=told, marks=marks)
    )


def odom_jumped(config: GateConfig, state: GateState, now: float) -> Cause | None:
    """Odometry reports a pose that the robot can't have driven to."""
    return Cause("odom_jumped", ODOM, state.leap) if state.leap else None


def scan_frozen(config: GateConfig, state: GateState, now: float) -> Cause | None:
    """The same scan repeats although odometry shows motion."""
    return Cause("scan_frozen", SCAN, state.frozen) if state.frozen else None


def no_motion(config: GateConfig, state: GateState, now: float) -> Cause | None:
    """The robot is commanded to move but odometry shows none: stuck, unpowered, or frozen data."""
    push = state.push
    if push is None or state.odometry is None or now - push.since_s <= config.stuck_s:
        return None
    time, before, _ = push.marks[0]
    told = push.told - before
    path = float(np.hypot(told[0], told[1]))
    turn = abs(float(told[2]))
    if path < LEAST_PATH and turn < LEAST_TURN:
        return None
    for _, _, pose in push.marks:  # there and back again is motion, too
        moved = between(pose, state.odometry.pose)
        drove = path >= LEAST_PATH and np.hypot(moved[0], moved[1]) >= RESPONSE * path
        turned = turn >= LEAST_TURN and abs(moved[2]) >= RESPONSE * turn
        if drove or turned:
            return None
    detail = (
        f"no motion in {now - time:.2f} s, told were {path:.2f} m and {turn:.2f} rad"
    )
    return Cause("no_motion", ODOM, detail)


# two scans with this share of equal beams are the same; one may always differ
SAME_SHARE = 0.99
# a scan is old if this share of the beams that must have changed did not
TELLING_SHARE = 0.9
CHANGE = 0.02  # least change of a beam that must have changed [m]
HEADINGS = (
    -0.03,
    0.0,
    0.03,
)  # errors of odometry for all of which a beam must have changed [rad]
# an old beam is compared with beams at most this many beam spacings away
NEIGHBOURS = 1.5
LEAST_BEAMS = 3


def is_same_scan(one: Ranges, other: Ranges) -> bool:
    """True if two scans (B,) are bit-identical, but for a few of the beams that return in one."""
    returned = np.isfinite(one) | np.isfinite(other)
    return _match_but_for_one((one == other) & returned, returned, SAME_SHARE)


def _match_but_for_one(same: Flags, counted: Flags, share: float) -> bool:
    """True if this share of the counted beams is the same, or all but one of them."""
    equal = int(np.count_nonzero(same))
    count = int(np.count_nonzero(counted))
    return equal > 0 and equal >= min(share * count, count - 1)


def must_differ(config: GateConfig, ranges: Ranges, moved: Array) -> Flags:
    """Returns which beams (B,) of a scan must have changed their length after a motion (3,)."""
    mount = np.array(config.mount)
    moved = between(mount, compose(moved, mount))
    open_ = np.isposinf(ranges)
    known = np.isfinite(ranges) | open_
    far = config.range_max or float(ranges[np.isfinite(ranges)].max())
    length = np.where(open_, far, ranges)[known].astype(np.float64)
    angles = config.beam_angles[known]
    ends = np.stack(
        [length * np.cos(angles), length * np.sin(angles), 0.0 * length], axis=1
    )
    changed = np.isfinite(ranges)
    for error in HEADINGS:
        seen = between(moved + np.array([0.0, 0.0, error]), ends)
        changed &= _find_changed(config.beam_angles, ranges, seen, open_[known])
    return np.asarray(changed)


def _find_changed(angles: Array, ranges: Ranges, seen: Array, open_: Flags) -> Flags:
    """Returns which beams (B,) differ from moved old ends (K, 2); of open ones, the nearer."""
    bearing = np.arctan2(seen[:, 1], seen[:, 0])
    order = np.argsort(bearing)
    order = np.concatenate([order[-1:], order, order[:1]])  # the ends, once more around
    bearing = bearing[order]
    is_open = open_[order]
    turn = 2.0 * np.pi
    length = np.hypot(seen[order, 0], seen[order, 1])
    bearing[0] -= turn
    bearing[-1] += turn
    wrapped = np.mod(angles + np.pi, turn) - np.pi
    above = np.clip(np.searchsorted(bearing, wrapped), 1, len(bearing) - 1)
    below = above - 1
    spacing = abs(angles[1] - angles[0]) if len(angles) > 1 else turn
    low = np.minimum(length[below], length[above])
    high = np.maximum(length[below], length[above])
    nearest = np.where(
        wrapped - bearing[below] < bearing[above] - wrapped, below, above
    )
    close = np.abs(wrapped - bearing[nearest]) <= NEIGHBOURS * spacing
    nearer = (ranges < low - CHANGE) & close
    farther = (ranges > high + CHANGE) & close & ~is_open[below] & ~is_open[above]
    return np.asarray(nearer | farther)
