"""Data that arrive and yet are dead: the same scan again and again, or no motion when told."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.geometry import between
from nics_drl_bridge.safety import pictures
from nics_drl_bridge.safety.freshness import ODOM, SCAN
from nics_drl_bridge.safety.records import replace
from nics_drl_bridge.safety.state import Cause, GateConfig, GateState, Push, Sameness

Array = NDArray[np.float64]
Ranges = NDArray[np.float32]
IDENTICAL = 3
"""So many scans must show one picture."""
PICTURES = 16
"""So many pictures are remembered: a lidar may repeat several in turn."""
RESPONSE = 0.1
"""A robot covers at least this share of the way that it is told,"""
LEAST_PATH, LEAST_TURN = 0.03, 0.25
"""if it is told more than this within the window [m, rad],"""
WINDOW = 0.75
"""which is this share of `stuck_s`: what is left is for odometry to come."""
MARK_S = 0.05
PAUSE_S = 0.2
"""Between two marks, and for how long at least no motion is told between two pushes [s]."""
STILL_LINEAR, STILL_TURN = 0.05, 0.1
"""A robot that moves less stands still [m/s, rad/s],"""
NOISE = 3.0
"""or less than that and so many standard deviations of its odometry."""


def look(
    config: GateConfig, seen: tuple[Sameness, ...], ranges: Ranges, pose: Array | None
) -> tuple[tuple[Sameness, ...], str]:
    """Compares a scan with the last pictures, bit for bit. One without a return says nothing.

    Args:
        config: of the gate.
        seen: pictures so far, the newest last.
        ranges: (B,) of the scan [m].
        pose: (3,) by odometry now; None when there was none yet.

    Returns:
        The pictures, and why the scan is none of now; nothing when it may be.
    """
    if not np.isfinite(ranges).any():
        return seen, ""
    known = next((one for one in reversed(seen) if pictures.same(one.ranges, ranges)), None)
    if known is None:
        return (*seen[1 - PICTURES :], Sameness(ranges, 1, pose)), ""
    others = tuple(one for one in seen if one is not known)
    known = replace(
        known, count=known.count + 1, first=pose if known.first is None else known.first
    )
    if pose is None or known.first is None or known.count < IDENTICAL:
        return (*others, known), ""
    moved = between(known.first, pose)
    path = max(float(np.hypot(moved[0], moved[1])), abs(float(moved[2])))
    if path <= config.frozen_distance:
        return (*others, known), ""
    if pictures.shown_again(config, known.ranges, ranges, moved):
        return (*others, known), (
            f"{known.count} scans are the same over a motion of {path:.2f} m or rad"
        )
    return (*others, Sameness(ranges, 1, pose)), ""  # what does not change here may be so


def stands_still(config: GateConfig, twist: NDArray[np.float64]) -> bool:
    """Whether a body twist (3,) is that of a robot at rest, as far as its noise lets one tell."""
    linear, turn = (NOISE * std for std in config.odom_std)
    slow = np.hypot(twist[0], twist[1]) < STILL_LINEAR + linear
    return bool(slow and abs(twist[2]) < STILL_TURN + turn)


def watch_motion(config: GateConfig, state: GateState, now: float) -> GateState:
    """Sums up what the robot was told, and marks where it was."""
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
        # The first that is left began before the window, or with it.
        first = next((k for k, one in enumerate(marks[1:]) if one[0] > start), len(marks) - 1)
        marks = (*marks[first:], (now, told, state.odometry.pose))
    moved_s = now if moving.any() else push.moving_s
    return replace(state, push=replace(push, last_s=now, moving_s=moved_s, told=told, marks=marks))


def odom_jumped(config: GateConfig, state: GateState, now: float) -> Cause | None:
    """Odometry shows the robot where it can't have driven to."""
    return Cause("odom_jumped", ODOM, state.leap) if state.leap else None


def scan_frozen(config: GateConfig, state: GateState, now: float) -> Cause | None:
    """The same scans again and again although odometry shows motion."""
    return Cause("scan_frozen", SCAN, state.frozen) if state.frozen else None


def no_motion(config: GateConfig, state: GateState, now: float) -> Cause | None:
    """The robot is told to move and odometry shows none: stuck, unpowered, or frozen data."""
    push = state.push
    if push is None or state.odometry is None or now - push.since_s <= config.stuck_s:
        return None
    time, before, _ = push.marks[0]
    told = push.told - before
    path, turn = float(np.hypot(told[0], told[1])), abs(float(told[2]))
    if path < LEAST_PATH and turn < LEAST_TURN:
        return None
    for _, _, pose in push.marks:  # there and back again is a motion, too
        moved = between(pose, state.odometry.pose)
        drove = path >= LEAST_PATH and np.hypot(moved[0], moved[1]) >= RESPONSE * path
        turned = turn >= LEAST_TURN and abs(moved[2]) >= RESPONSE * turn
        if drove or turned:
            return None
    detail = f"no motion in {now - time:.2f} s, told were {path:.2f} m and {turn:.2f} rad"
    return Cause("no_motion", ODOM, detail)
