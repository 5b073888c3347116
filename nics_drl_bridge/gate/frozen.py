"""Data that arrive but are invalid: repeated scans, odometry jumps, no commanded motion."""
# Between two long walls, a noise-free lidar may repeat a scan. The old scan is
# therefore moved by odometry, and only beams whose length must have changed are
# compared.

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
from nics_drl_bridge.gate.stops import make_cause
from nics_drl_bridge.geometry import between, compose
from nics_drl_bridge.interface import Array
from nics_drl_bridge.middleware.measurement import ODOM, SCAN

Flags = NDArray[np.bool_]
IDENTICAL = 3  # minimum number of identical scans that count as frozen
PICTURES = 16  # number of remembered scans; a lidar may cycle through several
RESPONSE = (
    0.1  # minimum fraction of the commanded distance or angle that a robot covers
)
# minimum motion commanded within the window for the robot to be judged [m], [rad]
MIN_PATH = 0.03
MIN_TURN = 0.25
WINDOW = 0.75  # window as a fraction of `stuck_s`; the rest allows for odometry's delay
MARK_S = 0.05  # between two marks
PAUSE_S = 0.2  # minimum time without motion between pushes [s]
# A robot slower than this, plus the noise of its odometry, stands still [m/s], [rad/s].
REST_SPEED = 0.05
REST_TURN_RATE = 0.1
NOISE = 3.0  # tolerated noise of odometry, in standard deviations


def watch_pictures(
    config: GateConfig, seen: tuple[Sameness, ...], ranges: Ranges, pose: Array | None
) -> tuple[tuple[Sameness, ...], str]:
    """Returns the remembered scans with a new one (B,), and why it is frozen, or ""."""
    # Compares bit for bit; scans without returns are ignored. The pose (3,) is None
    # before the first odometry.
    if not np.isfinite(ranges).any():
        return seen, ""
    new_picture = Sameness(ranges, 1, pose)
    same = (old for old in reversed(seen) if is_same_scan(old.ranges, ranges))
    picture = next(same, None)
    if picture is None:
        return (*seen[1 - PICTURES :], new_picture), ""
    others = tuple(old for old in seen if old is not picture)
    first = pose if picture.first is None else picture.first
    picture = replace(picture, count=picture.count + 1, first=first)
    if pose is None or first is None or picture.count < IDENTICAL:
        return (*others, picture), ""
    moved = between(first, pose)
    path = max(float(np.hypot(moved[0], moved[1])), abs(float(moved[2])))
    if path <= config.frozen_distance:
        return (*others, picture), ""
    must_change = must_differ(config, picture.ranges, moved)
    unchanged = (picture.ranges == ranges) & must_change
    is_frozen = _match_but_for_one(unchanged, must_change, FROZEN_FRACTION)
    if np.count_nonzero(must_change) >= MIN_CHANGED_BEAMS and is_frozen:
        fault = (
            f"{picture.count} scans are the same over a motion of {path:.2f} m or rad"
        )
        return (*others, picture), fault
    # The scene itself may look the same.
    return (*others, new_picture), ""


def is_at_rest(config: GateConfig, twist: Array) -> bool:
    """True if a body twist (3,) is that of a robot at rest, within the noise of odometry."""
    linear, turn = (NOISE * std for std in config.odom_std)
    slow = np.hypot(twist[0], twist[1]) < REST_SPEED + linear
    return bool(slow and abs(twist[2]) < REST_TURN_RATE + turn)


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
    commanded: Array = push.commanded + (now - push.last_s) * moving
    marks = push.marks
    if now - marks[-1][0] >= MARK_S:
        start = now - WINDOW * config.stuck_s
        # The first remaining mark is at or before the start of the window.
        later = (k for k, (time, _, _) in enumerate(marks[1:]) if time > start)
        first = next(later, len(marks) - 1)
        marks = (*marks[first:], (now, commanded, state.odometry.pose))
    push = replace(push, last_s=now, commanded=commanded, marks=marks)
    if moving.any():
        push = replace(push, moving_s=now)
    return replace(state, push=push)


def odom_jumped(config: GateConfig, state: GateState, now: float) -> Cause | None:
    """Odometry reports a pose that the robot can't have reached."""
    return make_cause("odom_jumped", ODOM, state.leap)


def scan_frozen(config: GateConfig, state: GateState, now: float) -> Cause | None:
    """The same scan repeats although odometry shows motion."""
    return make_cause("scan_frozen", SCAN, state.frozen)


def no_motion(config: GateConfig, state: GateState, now: float) -> Cause | None:
    """The robot is commanded to move but odometry shows none: stuck, unpowered, or frozen data."""
    push = state.push
    if push is None or state.odometry is None or now - push.since_s <= config.stuck_s:
        return None
    time, before, _ = push.marks[0]
    commanded = push.commanded - before
    path = float(np.hypot(commanded[0], commanded[1]))
    turn = abs(float(commanded[2]))
    if path < MIN_PATH and turn < MIN_TURN:
        return None
    for _, _, pose in push.marks:  # moving back and forth also counts as motion
        moved = between(pose, state.odometry.pose)
        drove = path >= MIN_PATH and np.hypot(moved[0], moved[1]) >= RESPONSE * path
        turned = turn >= MIN_TURN and abs(moved[2]) >= RESPONSE * turn
        if drove or turned:
            return None
    request = f"{path:.2f} m and {turn:.2f} rad were commanded"
    detail = f"no motion in {now - time:.2f} s, but {request}"
    return Cause("no_motion", ODOM, detail)


# two scans with this fraction of equal beams are the same; one beam may always differ
SAME_FRACTION = 0.99
# a scan is frozen if this fraction of the beams that must have changed did not
FROZEN_FRACTION = 0.9
CHANGE = 0.02  # minimum change of a beam that must have changed [m]
# heading errors of odometry; a beam must have changed under all of them [rad]
HEADING_ERRORS = (-0.03, 0.0, 0.03)
# an old beam is compared with beams at most this many beam spacings away
NEIGHBOURS = 1.5
MIN_CHANGED_BEAMS = 3


def is_same_scan(old: Ranges, new: Ranges) -> bool:
    """True if two scans (B,) are bit-identical except for a few beams that return in either."""
    returned = np.isfinite(old) | np.isfinite(new)
    return _match_but_for_one((old == new) & returned, returned, SAME_FRACTION)


def _match_but_for_one(same: Flags, counted: Flags, fraction: float) -> bool:
    """True if this fraction of the counted beams is the same, or all except one."""
    equal = int(np.count_nonzero(same))
    count = int(np.count_nonzero(counted))
    return equal > 0 and equal >= min(fraction * count, count - 1)


def must_differ(config: GateConfig, ranges: Ranges, moved: Array) -> Flags:
    """Returns which beams (B,) of a scan must have changed their length after a motion (3,)."""
    mount = np.array(config.mount)
    moved = between(mount, compose(moved, mount))
    is_open = np.isposinf(ranges)
    is_known = np.isfinite(ranges) | is_open
    far = config.range_max or float(ranges[np.isfinite(ranges)].max())
    length = np.where(is_open, far, ranges)[is_known].astype(np.float64)
    angles = config.beam_angles[is_known]
    ends = np.stack(
        [length * np.cos(angles), length * np.sin(angles), 0.0 * length], axis=1
    )
    changed = np.isfinite(ranges)
    for error in HEADING_ERRORS:
        moved_ends = between(moved + np.array([0.0, 0.0, error]), ends)
        changed &= _find_changed(
            config.beam_angles, ranges, moved_ends, is_open[is_known]
        )
    return np.asarray(changed)


def _find_changed(angles: Array, ranges: Ranges, ends: Array, is_open: Flags) -> Flags:
    """Returns which beams (B,) differ from the moved ends (K, 2) of old ones.

    Next to an old beam that was open, only shorter ranges count.
    """
    bearing = np.arctan2(ends[:, 1], ends[:, 0])
    order = np.argsort(bearing)
    order = np.concatenate(
        [order[-1:], order, order[:1]]
    )  # wrap around by one at both ends
    bearing = bearing[order]
    is_open = is_open[order]
    turn = 2.0 * np.pi
    length = np.hypot(ends[order, 0], ends[order, 1])
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
