"""Consistency of a robot's odometry with itself, with its limits, and with its commands.

Checks of a robot's scans against the expected lidar.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.geometry import wrap_angle
from nics_drl_bridge.interface import S_PER_NS
from nics_drl_bridge.report.doctor_facts import (
    CMD_VEL,
    ODOM,
    SCAN,
    Expected,
    Facts,
    Layout,
    Mismatch,
    filling,
)
from nics_drl_bridge.robot.spec import RobotSpec

Array = NDArray[np.float64]
Word = tuple[str, str, bool]
"""Fault, remedy, and True if it is severe."""

LEAST_PATH_M, LEAST_TURN_RAD = 0.3, 0.3
"""A drive with less motion than this does not determine scales."""
TOLERANCE = 1.4
"""Differences of the pose and the twist must agree within this factor."""
ALIKE = 0.8
"""Below this correlation pose and twist are unrelated, and their ratio is meaningless."""
LEAST_ALIKE = 0.3
"""The same for commands, which the robot follows with delay and within its limits."""
JUMP = 5.0
"""A step of more than this multiple of what the maximum speed allows is a jump,"""
JUMP_M = 0.2
"""if it is also longer than this [m]."""
QUATERNION_TOLERANCE = 0.05
LEAST_STEPS = 10
UNITS = ((1000.0, "mm/s"), (100.0, "cm/s"), (3.6, "km/h"), (180.0 / np.pi, "degrees per second"))


def motion(facts: Facts, robot: RobotSpec) -> Iterator[Word]:
    """Yields the faults of odometry."""
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
    """Compares the changes of the pose (T,) with those according to the twist (T,)."""
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
    """Least-squares slope of y over x; inf if x is zero."""
    power = float(x @ x)
    return float(x @ y) / power if power > 0.0 else float("inf")


def _fastest(robot: RobotSpec) -> float:
    """Maximum speed that can be commanded, at least 0.1 [m/s]."""
    corners = np.array([robot.command_low, robot.command_high])
    speeds = [np.hypot(*robot.to_cmd_vel(row)[:2]) for row in corners]
    return max(float(max(speeds)), 0.1)


def scale(facts: Facts) -> float | None:
    """Slope of the turns per odometry step over the commanded turn rates; None if undetermined."""
    heard, odometry = facts.heard.get(CMD_VEL), facts.heard.get(ODOM)
    if heard is None or odometry is None or len(facts.poses) < LEAST_STEPS:
        return None
    told = np.array(facts.commands)
    place = np.searchsorted(heard.arrivals_ns, odometry.arrivals_ns[:-1], side="right") - 1
    known = place >= 0
    turn = np.asarray(wrap_angle(np.diff(np.array(facts.poses)[:, 2])))[known]
    forward = np.array(facts.twists)[:-1, 0][known] >= 0.0  # a car turns the other way in reverse
    wish = told[place[known], 2]
    if np.abs(turn[forward]).sum() < LEAST_TURN_RAD or np.abs(wish[forward]).sum() < 1.0:
        return None
    wish, turn = wish[forward], turn[forward]
    alike = abs(wish @ turn) / np.sqrt((wish @ wish) * (turn @ turn))
    return _slope(wish, turn) if alike > LEAST_ALIKE else None


LAYOUT = "beam layout"
ANGLE_TOLERANCE = 0.5
"""Tolerance of a beam's direction, in increments."""
ODD_SHARE = 0.01
"""A value in more than this share of the beams is taken to be intended by the lidar."""


def layout(facts: Facts, expected: Expected) -> Iterator[Mismatch]:
    """Checks number and directions of the beams, and the limits of their ranges."""
    name = facts.names[SCAN]
    if len(facts.layouts) > 1:
        counts = sorted({one.beams for one in facts.layouts})
        what = f"its header changes; numbers of beams are {', '.join(map(str, counts))}"
        fix = "use the driver's mode of fixed angles (as `angle_compensate`), or resample"
        yield Mismatch("error", LAYOUT, name, what, fix)
    for have in facts.layouts[:1]:
        yield from _header(have, name)
        unfilled = _unfilled(have, expected)
        if unfilled:
            fix = "turn or set the lidar, or train a policy with what it sees"
            yield Mismatch("error", LAYOUT, name, unfilled, fix)
        else:
            yield from _beams(have, expected, name)


def _unfilled(have: Layout, expected: Expected) -> str:
    """Reason why a lidar does not fill the required sectors; empty if it does, or without any."""
    try:
        if expected.scan is not None:
            filling(have, expected.lidar, expected.scan)
    except ConfigError as error:
        return str(error)
    return ""


def _header(have: Layout, name: str) -> Iterator[Mismatch]:
    """Checks that a header is consistent with itself."""
    if abs(have.last - have.angle_max) > ANGLE_TOLERANCE * max(abs(have.angle_increment), 1e-9):
        what = f"angle_max is {have.angle_max:.5f}, but its beams end at {have.last:.5f} rad"
        yield Mismatch("warning", LAYOUT, name, what, "correct the driver's header")
    if have.in_degrees:
        what = f"angles go from {have.angle_min:.4g} to {have.angle_max:.4g}: degrees"
        yield Mismatch("error", "unit", name, what, "let the driver send radians")


def _beams(have: Layout, expected: Expected, name: str) -> Iterator[Mismatch]:
    """Compares a header's beams and range limits with those of the expected lidar."""
    want = expected.lidar.header
    fix = "set the driver, or make a lidar file of what it sends and generate the model anew"
    if have.beams != expected.lidar.beams:
        what = f"has {have.beams} beams, expected {expected.lidar.beams}"
        yield Mismatch("error", LAYOUT, name, what, fix)
    if have.angle_increment < 0.0:
        if expected.scan is None and not have.in_degrees:
            what = "its beams go clockwise (angle_increment is negative)"
            turn = "turn the order in the driver (`inverted`): they go counter-clockwise (REP-103)"
            yield Mismatch("error", LAYOUT, name, what, turn)
    elif not have.in_degrees and max(
        abs(have.angle_min - want.angle_min), abs(have.last - want.angle_max)
    ) > ANGLE_TOLERANCE * abs(want.angle_increment):
        what = (
            f"beams go from {have.angle_min:.4f} to {have.last:.4f} rad, expected "
            f"{want.angle_min:.4f} to {want.angle_max:.4f}"
        )
        yield Mismatch("error", LAYOUT, name, what, fix)
    for key in ("range_min", "range_max"):
        ours, theirs = getattr(want, key), getattr(have, key)
        if abs(ours - theirs) > 0.01 * max(abs(ours), 1e-3) + 1e-6:
            big = theirs > 100.0 * max(ours, 0.1)
            what = f"{key} is {theirs:.4g}, expected {ours:.4g} m"
            kind = "unit" if big else "range limits"
            yield Mismatch("error" if big else "warning", kind, name, what, fix)


def ranges(facts: Facts, expected: Expected) -> Iterator[Mismatch]:
    """Checks the lidar's values for no return, and the unit of its ranges."""
    if not facts.ranges:
        return
    spec, name = expected.lidar, facts.names[SCAN]
    values = np.concatenate(facts.ranges).astype(np.float64)
    finite = values[np.isfinite(values) & (values > 0.0)]
    beyond = finite > 1.001 * spec.range_max
    if len(finite) and np.median(finite) > 20.0 * spec.range_max:
        what = f"half of the ranges exceed {np.median(finite):.0f}: millimetres"
        yield Mismatch("error", "unit", name, what, "let the driver send metres")
        return
    if len(finite) and beyond.mean() > ODD_SHARE:
        what = f"{100 * beyond.mean():.0f} % of the ranges exceed range_max {spec.range_max:g} m"
        fix = "set the driver's limit, or range_max of the lidar, and generate the model anew"
        yield Mismatch("warning", "range convention", name, what, fix)
    at_max = np.abs(values - spec.range_max) < 1e-4 * spec.range_max
    for word, hit in (
        ("zero", values == 0.0),
        ("nan", np.isnan(values)),
        ("range_max", at_max),
        ("inf", values == np.inf),
    ):
        if hit.mean() > ODD_SHARE and word != spec.no_return:
            what = (
                f"{100 * hit.mean():.0f} % of the ranges are {word}, but no return is expected "
                f"as {spec.no_return}"
            )
            fix = f"set `no_return: {word}` in the lidar and generate the model anew"
            yield Mismatch("error", "range convention", name, what, fix)
    if (values < 0.0).any() and np.isfinite(values[values < 0.0]).any():
        fix = "correct the driver: too close is -inf (REP-117), nothing else is negative"
        yield Mismatch("error", "range convention", name, "holds negative ranges", fix)
