"""Data that arrive and yet are dead: the same scan again and again, or no motion when told."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.geometry import between
from nics_drl_bridge.safety.inputs import Scan
from nics_drl_bridge.safety.state import Cause, GateConfig, GateState, Sameness

IDENTICAL = 3
"""So many scans in a row must be identical."""
PUSH_LINEAR, PUSH_TURN = 0.05, 0.1
"""A command above this must move the robot [m/s, rad/s],"""
RESPONSE = 0.1
"""at least at this share of it."""
STILL_LINEAR, STILL_TURN = 0.02, 0.05
"""A robot that moves less stands still [m/s, rad/s]."""


def compare(state: GateState, scan: Scan) -> Sameness:
    """Whether a scan is the one before, bit for bit. One without a return may well be."""
    pose = None if state.odometry is None else state.odometry.pose
    before, returned = state.scan, np.isfinite(scan.ranges).any()
    if before is None or not returned or before.ranges.tobytes() != scan.ranges.tobytes():
        return Sameness(1, pose, pose)
    return Sameness(
        state.same.count + 1, pose if state.same.first is None else state.same.first, pose
    )


def stands_still(twist: NDArray[np.float64]) -> bool:
    """Whether a body twist (3,) is that of a robot at rest."""
    return bool(np.hypot(twist[0], twist[1]) < STILL_LINEAR and abs(twist[2]) < STILL_TURN)


def watch_motion(config: GateConfig, state: GateState, now: float) -> GateState:
    """Notes whether the robot does what it was told."""
    if state.odometry is None or config.limits is None:
        return state
    linear = float(np.linalg.norm(state.value[config.limits.linear]))
    turn = float(np.abs(state.value[config.limits.turn]).sum())
    pushed = linear > PUSH_LINEAR or turn > PUSH_TURN
    twist = state.odometry.twist
    moves = np.hypot(twist[0], twist[1]) > RESPONSE * max(linear, PUSH_LINEAR) or abs(
        twist[2]
    ) > RESPONSE * max(turn, PUSH_TURN)
    since = state.pushing_s if state.pushing_s is not None else now
    return replace(state, pushing_s=since if pushed and not moves else None)


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
    if state.pushing_s is None or now - state.pushing_s <= config.stuck_s:
        return None
    return Cause(
        "no_motion", "odom", "no motion although commanded", now - state.pushing_s, config.stuck_s
    )
