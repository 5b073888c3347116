"""Inputs of the gate: one frozen record for each message, call and tick of its clock."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Scan:
    """A scan arrived.

    Attributes:
        stamp_ns: time stamp of its header [ns].
        ranges: (B,) [m], float32, REP-117.
        angles: angle_min and angle_increment of its header [rad].
    """

    stamp_ns: int
    ranges: NDArray[np.float32]
    angles: tuple[float, float]


@dataclass(frozen=True)
class Odometry:
    """An odometry arrived.

    Attributes:
        stamp_ns: time stamp of its header [ns].
        pose: (3,) x [m], y [m], heading [rad] in `odom`.
        twist: (3,) vx [m/s], vy [m/s], wz [rad/s] in `base_link`.
    """

    stamp_ns: int
    pose: Array
    twist: Array


@dataclass(frozen=True)
class Estimate:
    """An estimate of the middleware arrived.

    Attributes:
        twist: (3,) vx [m/s], vy [m/s], wz [rad/s].
        std: (2,) standard deviation of position [m] and heading [rad].
    """

    twist: Array
    std: Array


@dataclass(frozen=True)
class Command:
    """A command of the policy arrived.

    Attributes:
        stamp_ns: time stamp of the scan it was computed from [ns].
        twist: (3,) linear.x, linear.y, angular.z of `cmd_vel`.
    """

    stamp_ns: int
    twist: Array


@dataclass(frozen=True)
class EStop:
    """The emergency stop reported whether it is pressed; each message is also a heartbeat."""

    pressed: bool


@dataclass(frozen=True)
class Press:
    """The emergency stop was pressed by a service call."""


@dataclass(frozen=True)
class Arm:
    """A request to arm the gate.

    Attributes:
        publishers: number of publishers on `cmd_vel`, the gate included.
    """

    publishers: int


@dataclass(frozen=True)
class Reset:
    """A request to clear a latched stop."""


@dataclass(frozen=True)
class Tick:
    """The gate's own clock ticked: the only input at which a motion is published."""


Input = Scan | Odometry | Estimate | Command | EStop | Press | Arm | Reset | Tick
