"""What the gate's topics say, read from the bytes that travel (`wire`) into inputs of `safety`.

rclpy would make a Python object of each field first, which at 50 Hz costs the gate more than to
decide.
"""

from __future__ import annotations

import numpy as np

from nics_drl_bridge.lidar.rep117 import from_device
from nics_drl_bridge.lidar.spec import LidarSpec
from nics_drl_bridge.nodes import wire
from nics_drl_bridge.nodes.conversions import is_rotation
from nics_drl_bridge.safety.inputs import Command, Estimate, EStop, Odometry, Scan

ROTATION = slice(3, 7)
"""Where an odometry's quaternion stands among its numbers."""
VARIANCES = wire.POSE_COVARIANCE, wire.POSE_COVARIANCE + 7, wire.POSE_COVARIANCE + 35
"""Where those of x, y and heading stand."""


def scan(lidar: LidarSpec, content: bytes) -> Scan:
    """A serialised LaserScan. Raises `wire.UNREADABLE`."""
    ranges = from_device(wire.ranges_of(content), lidar)
    return Scan(wire.stamp_of(content), ranges, wire.angles_of(content))


def odometry(content: bytes) -> Odometry:
    """A serialised Odometry; its pose is NaN without a rotation. Raises `wire.UNREADABLE`."""
    pose, twist = wire.odometry_of(content)
    if not is_rotation(*wire.numbers_of(content)[ROTATION].tolist()):
        pose = np.full(3, np.nan)
    return Odometry(wire.stamp_of(content), pose, twist)


def estimate(content: bytes) -> Estimate:
    """A serialised Odometry of an estimator. Raises `wire.UNREADABLE`."""
    x, y, heading = (wire.numbers_of(content)[place] for place in VARIANCES)
    with np.errstate(invalid="ignore"):  # a variance below 0 is no number, either
        std = np.sqrt([np.maximum(x, y), heading])
    return Estimate(wire.odometry_of(content)[1], std)


def command(content: bytes) -> Command:
    """A serialised TwistStamped. Raises `wire.UNREADABLE`."""
    return Command(wire.stamp_of(content), np.array(wire.stamped_twist_of(content)))


def e_stop(content: bytes) -> EStop:
    """A serialised Bool. Raises `wire.UNREADABLE`."""
    return EStop(wire.truth_of(content))
