"""Data that arrive but are invalid: repeated scans, odometry jumps, no commanded motion."""
# Between two long walls, a noise-free lidar may repeat a scan. The old scan is
# therefore moved by odometry, and only beams whose length must have changed are
# compared.

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.gate.scan_motion import make_directions
from nics_drl_bridge.gate.scan_motion_kernels import predict_scan
from nics_drl_bridge.gate.state import (
    GateConfig,
    GateState,
    Push,
    Ranges,
    Sameness,
    replace,
)
from nics_drl_bridge.geometry import between, compose
from nics_drl_bridge.interface import Array

Flags = NDArray[np.bool_]
IDENTICAL = 3  # minimum number of identical scans that count as frozen
PICTURES = 16  # number of remembered scans; a lidar may cycle through several
RESPONSE = 0.1  # minimum fraction of the commanded path or turn that a robot covers
# minimum motion commanded within the window for the robot to be judged [m], [rad]
MIN_COMMANDED = np.array([0.03, 0.25])
WINDOW = 0.75  # window as a fraction of `stuck_s`; the rest allows for odometry's delay
MARK_S = 0.05  # between two marks
PAUSE_S = 0.2  # minimum time without motion between pushes [s]
# A robot slower than this, plus the noise of its odometry, stands still [m/s], [rad/s].
REST = np.array([0.05, 0.1])
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
    path = measure_motion(moved).max()
    if path <= config.frozen_distance or len(ranges) < MIN_CHANGED_BEAMS:
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
    fastest = REST + NOISE * np.array(config.odom_std)
    return bool((measure_motion(twist) < fastest).all())


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


def find_stuck(config: GateConfig, state: GateState, now: float) -> str:
    """Returns the fault of a robot that does not follow its commands, or ""."""
    push = state.push
    if push is None or state.odometry is None or now - push.since_s <= config.stuck_s:
        return ""
    time, before, _ = push.marks[0]
    commanded = measure_motion(push.commanded - before)
    is_commanded = commanded >= MIN_COMMANDED
    if not is_commanded.any():
        return ""
    for _, _, pose in push.marks:  # moving back and forth also counts as motion
        moved = measure_motion(between(pose, state.odometry.pose))
        if (is_commanded & (moved >= RESPONSE * commanded)).any():
            return ""
    path, turn = commanded
    request = f"{path:.2f} m and {turn:.2f} rad were commanded"
    return f"no motion in {now - time:.2f} s, but {request}"


def measure_motion(motion: Array) -> Array:
    """Returns the path [m] and the turn [rad] (2,) of a motion (3,)."""
    return np.array([np.hypot(motion[0], motion[1]), abs(motion[2])])


# two scans with this fraction of equal beams are the same; one beam may always differ
SAME_FRACTION = 0.99
# a scan is frozen if this fraction of the beams that must have changed did not
FROZEN_FRACTION = 0.9
CHANGE = 0.02  # minimum change of a beam that must have changed [m]
# heading errors of odometry; a beam must have changed under all of them [rad]
HEADING_ERRORS = (-0.03, 0.0, 0.03)
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
    far = config.range_max or float(ranges[np.isfinite(ranges)].max())
    ends = np.where(np.isposinf(ranges), far, ranges).astype(np.float32)
    nearest_open = far - measure_motion(moved)[0]  # end of a beam that did not return
    predicted = np.empty_like(ends)
    directions = make_directions(config, len(ranges), half_window=0)
    must_change = np.isfinite(ranges)
    for error in HEADING_ERRORS:
        turned = moved + np.array([0.0, 0.0, error])
        predict_scan(ends, directions, turned, predicted)
        # Both are False where the old scan does not show what comes (NaN).
        nearer = ranges < predicted - CHANGE
        farther = (ranges > predicted + CHANGE) & (predicted < nearest_open)
        must_change &= nearer | farther
    return must_change
