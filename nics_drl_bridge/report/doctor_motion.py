"""Whether a robot's odometry is consistent with itself, with its limits, and with its commands."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.geometry import wrap_angle
from nics_drl_bridge.interface import S_PER_NS
from nics_drl_bridge.kinematics.spec import RobotSpec
from nics_drl_bridge.report.doctor_facts import CMD_VEL, ODOM, Facts

Array = NDArray[np.float64]
Word = tuple[str, str, bool]
"""What is wrong, what to do, and whether it is severe."""

LEAST_PATH_M, LEAST_TURN_RAD = 0.3, 0.3
"""Below, a drive says nothing about scales."""
TOLERANCE = 1.4
"""Pose differences and twist agree within this factor."""
ALIKE = 0.8
"""Below this correlation the two have nothing to do with each other, and a factor says nothing."""
LEAST_ALIKE = 0.3
"""The same for commands, which the robot follows late and within its limits."""
JUMP = 5.0
"""Farther than so many times what the greatest speed allows is a jump,"""
JUMP_M = 0.2
"""if it is farther than this as well [m]."""
QUATERNION_TOLERANCE = 0.05
LEAST_STEPS = 10
UNITS = ((1000.0, "mm/s"), (100.0, "cm/s"), (3.6, "km/h"), (180.0 / np.pi, "degrees per second"))


def motion(facts: Facts, robot: RobotSpec) -> Iterator[Word]:
    """What is wrong with odometry."""
    poses, twists = np.array(facts.poses), np.array(facts.twists)
    if not len(poses):
        return
    if not (np.isfinite(poses).all() and np.isfinite(twists).all()):
        yield "holds NaN or inf", "find out why its driver sends them", True
        return
    length = np.array(facts.lengths)
    off = np.abs(length - 1.0) > QUATERNION_TOLERANCE
    if off.any():
        what = f"{off.sum()} quaternions are not of length 1 but of up to {length.max():.3g}"
        yield what, "send a quaternion, not a heading in its z, nor zeros", True
        return
    if facts.uncovered:
        what = f"{facts.uncovered} of {len(poses)} messages have a covariance of zeros"
        yield what, "fill in pose.covariance and twist.covariance: zeros mean unknown", False
    yield from _moves(facts, poses, twists, _fastest(robot))


def _moves(facts: Facts, poses: Array, twists: Array, fastest: float) -> Iterator[Word]:
    stamps = np.array(facts.heard[ODOM].stamps_ns, dtype=np.int64)
    dt = np.diff(stamps) * S_PER_NS
    going = dt > 0.0
    if going.sum() < LEAST_STEPS:
        return
    step = np.diff(poses[:, :2], axis=0)
    far = np.hypot(step[:, 0], step[:, 1])
    jumps = going & (far > JUMP_M) & (far > JUMP * fastest * dt)
    share = float(jumps.sum() / going.sum())
    if share > 0.2:
        speed = float(np.median((far[going] / dt[going])[jumps[going]]))
        what = f"positions change by {speed:.0f} a second, the robot reaches {fastest:.2g} m/s"
        yield what, "let positions be metres, not millimetres", True
        return
    if jumps.any():
        what = f"jumps {jumps.sum()} times, by up to {far[jumps].max():.2f} m"
        fix = "odom must be continuous (REP-105): corrections belong into map -> odom"
        yield what, fix, True
    keep = going & ~jumps
    turn = np.asarray(wrap_angle(np.diff(poses[:, 2])))
    mean = 0.5 * (twists[1:] + twists[:-1])
    middle = poses[:-1, 2] + 0.5 * turn
    ahead = np.cos(middle) * step[:, 0] + np.sin(middle) * step[:, 1]
    moved = bool(far[keep].sum() > LEAST_PATH_M or (np.abs(mean[:, 0]) * dt)[keep].sum() > 1.0)
    if moved:
        yield from _compared("linear.x", ahead[keep], (mean[:, 0] * dt)[keep], 3)
    turned = np.abs(turn[keep]).sum() > LEAST_TURN_RAD
    if turned or (np.abs(mean[:, 2]) * dt)[keep].sum() > 2.0:
        yield from _compared("angular.z", turn[keep], (mean[:, 2] * dt)[keep], 4)


def _compared(field: str, real: Array, told: Array, unit: int) -> Iterator[Word]:
    """Compares what the pose did (T,) with what the twist says of it (T,)."""
    ratio = _slope(real, told)
    if 1.0 / TOLERANCE < ratio < TOLERANCE:
        return
    size = float(np.sqrt((real @ real) * (told @ told)))
    if size == 0.0 or abs(real @ told) < ALIKE * size:
        what = f"the pose does not do what twist.{field} says"
        fix = "free the robot if it is stuck; else let both come from the same odometry"
        yield what, fix, False
        return
    if -TOLERANCE < ratio < -1.0 / TOLERANCE:
        what = f"twist.{field} has the sign opposite to what the pose does"
        yield what, "turn the sign: forward and counter-clockwise are positive (REP-103)", True
        return
    units = UNITS[:3] if unit == 3 else UNITS[3:]
    for factor, name in units:
        if 1.0 / TOLERANCE < ratio / factor < TOLERANCE:
            good = "m/s" if unit == 3 else "rad/s"
            what = f"twist.{field} is {ratio:.3g} times what the pose does: {name}"
            yield what, f"let the twist be in {good}", True
            return
        if 1.0 / TOLERANCE < ratio * factor < TOLERANCE:
            what = f"the pose changes {1 / ratio:.3g} times as fast as twist.{field} says"
            yield what, "let the pose be in metres and radians", True
            return
    what = f"twist.{field} is {ratio:.3g} times what the pose does"
    yield what, "let both come from the same odometry, the twist in the body's frame", True


def _slope(x: Array, y: Array) -> float:
    """Least-squares factor of y by x; inf where x does not move."""
    power = float(x @ x)
    return float(x @ y) / power if power > 0.0 else float("inf")


def _fastest(robot: RobotSpec) -> float:
    """The greatest speed that a command asks for [m/s]."""
    corners = np.array([robot.command_low, robot.command_high])
    speeds = [np.hypot(*robot.to_cmd_vel(row)[:2]) for row in corners]
    return max(float(max(speeds)), 0.1)


def scale(facts: Facts) -> float | None:
    """Factor by which the robot turns as it is told to; None where it was not told to turn."""
    heard, odometry = facts.heard.get(CMD_VEL), facts.heard.get(ODOM)
    if heard is None or odometry is None or len(facts.poses) < LEAST_STEPS:
        return None
    told = np.array(facts.commands)
    place = np.searchsorted(heard.arrivals_ns, odometry.arrivals_ns[:-1], side="right") - 1
    known = place >= 0
    turn = np.asarray(wrap_angle(np.diff(np.array(facts.poses)[:, 2])))[known]
    forward = np.array(facts.twists)[:-1, 0][known] >= 0.0  # a car that backs turns the other way
    wish = told[place[known], 2]
    if np.abs(turn[forward]).sum() < LEAST_TURN_RAD or np.abs(wish[forward]).sum() < 1.0:
        return None
    wish, turn = wish[forward], turn[forward]
    alike = abs(wish @ turn) / np.sqrt((wish @ wish) * (turn @ turn))
    return _slope(wish, turn) if alike > LEAST_ALIKE else None
