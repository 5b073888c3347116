"""Data that arrive and yet are dead: the same scan again and again, or no motion when told."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.geometry import between
from nics_drl_bridge.safety.inputs import Scan
from nics_drl_bridge.safety.records import replace
from nics_drl_bridge.safety.state import Cause, GateConfig, GateState, Push, Sameness

IDENTICAL = 3
"""So many scans in a row must be identical."""
RESPONSE = 0.1
"""A robot covers at least this share of the path that it is told,"""
LEAST_PATH, LEAST_TURN = 0.03, 0.25
"""if it is told more than this within the time [m, rad]."""
STILL_LINEAR, STILL_TURN = 0.05, 0.1
"""A robot that moves less stands still [m/s, rad/s],"""
NOISE = 3.0
"""or less than that and so many standard deviations of its odometry."""


def compare(state: GateState, scan: Scan) -> Sameness:
    """Whether a scan is the one before, bit for bit. One without a return may well be."""
    pose = None if state.odometry is None else state.odometry.pose
    before, returned = state.scan, np.isfinite(scan.ranges).any()
    if before is None or not returned or before.ranges.tobytes() != scan.ranges.tobytes():
        return Sameness(1, pose, pose)
    return Sameness(
        state.same.count + 1, pose if state.same.first is None else state.same.first, pose
    )


def stands_still(config: GateConfig, twist: NDArray[np.float64]) -> bool:
    """Whether a body twist (3,) is that of a robot at rest, as far as its noise lets one tell."""
    linear, turn = (NOISE * std for std in config.odom_std)
    slow = np.hypot(twist[0], twist[1]) < STILL_LINEAR + linear
    return bool(slow and abs(twist[2]) < STILL_TURN + turn)


def watch_motion(config: GateConfig, state: GateState, now: float) -> GateState:
    """Sums up what the robot was told, in windows of `stuck_s`."""
    if state.odometry is None or config.limits is None:
        return state
    push, value = state.push, state.value
    if push is None or now - push.since_s > config.stuck_s:
        return replace(state, push=Push(now, now, state.odometry.pose, np.zeros(3)))
    moving = np.zeros(3)
    angles = ~(config.limits.linear | config.limits.turn)
    moving[list(config.fields)] = np.where(angles, 0.0, value)
    told = push.told + (now - push.last_s) * moving
    return replace(state, push=replace(push, last_s=now, told=told))


def scan_frozen(config: GateConfig, state: GateState, now: float) -> Cause | None:
    """The same scan again and again although odometry shows motion."""
    same = state.same
    if same.count < IDENTICAL or same.first is None or same.last is None:
        return None
    moved = between(same.first, same.last)
    path = max(float(np.hypot(moved[0], moved[1])), abs(float(moved[2])))
    if path <= config.frozen_distance:
        return None
    detail = f"{same.count} identical scans over a motion of {path:.2f} m or rad"
    return Cause("scan_frozen", "scan", detail)


def no_motion(config: GateConfig, state: GateState, now: float) -> Cause | None:
    """The robot is told to move and odometry shows none: stuck, unpowered, or frozen data."""
    push = state.push
    if push is None or state.odometry is None or now - push.since_s <= config.stuck_s:
        return None
    path, turn = float(np.hypot(push.told[0], push.told[1])), abs(float(push.told[2]))
    if path < LEAST_PATH and turn < LEAST_TURN:
        return None
    moved = between(push.pose, state.odometry.pose)
    drove = path >= LEAST_PATH and np.hypot(moved[0], moved[1]) >= RESPONSE * path
    turned = turn >= LEAST_TURN and abs(moved[2]) >= RESPONSE * turn
    if drove or turned:
        return None
    detail = f"no motion in {now - push.since_s:.2f} s, told were {path:.2f} m and {turn:.2f} rad"
    return Cause("no_motion", "odom", detail)
