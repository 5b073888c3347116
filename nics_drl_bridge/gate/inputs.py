"""Inputs of the gate: one frozen record for each message, call and tick of its clock."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.interface import Array
from nics_drl_bridge.middleware.measurement import ODOM, SCAN

# topics of the inputs, except those of additional sensors
ESTIMATE = "odometry/filtered"
RAW = "cmd_vel_raw"
E_STOP = "e_stop"


@dataclass(frozen=True)
class Scan:
    """A scan arrived."""

    stamp_ns: int  # of its header
    ranges: NDArray[np.float32]  # (B,) [m], REP-117
    angles: tuple[float, float]  # angle_min and angle_increment of its header [rad]


@dataclass(frozen=True)
class Odometry:
    """An odometry arrived."""

    stamp_ns: int  # of its header
    pose: Array  # (3,) x [m], y [m], heading [rad] in `odom`
    twist: Array  # (3,) vx [m/s], vy [m/s], wz [rad/s] in `base_link`


@dataclass(frozen=True)
class SensorReading:
    """A reading of an additional sensor arrived."""

    stamp_ns: int  # of its header
    name: str
    points: Array  # (Q, 2) points in `base_link` that it shows [m]


@dataclass(frozen=True)
class Estimate:
    """An estimate of the middleware arrived."""

    twist: Array  # (3,) vx [m/s], vy [m/s], wz [rad/s]
    pose: Array  # (3,) x [m], y [m], heading [rad] in `map`
    covariance: Array  # (3, 3) of that pose, which grows with the distance from the origin of `map`


@dataclass(frozen=True)
class Command:
    """A command of the policy arrived."""

    stamp_ns: int  # of the scan it was computed from
    twist: Array  # (3,) linear.x, linear.y, angular.z of `cmd_vel`
    # its publisher, in words; empty if the ROS middleware does not report it
    source: str = ""
    publishers: int = 1  # if empty: number of publishers on its topic


@dataclass(frozen=True)
class EStop:
    """The emergency stop reported whether it is pressed; each message is also a heartbeat."""

    pressed: bool


@dataclass(frozen=True)
class Press:
    """The emergency stop was pressed by a service call, or a press may have been missed."""

    reason: str = ""  # why a press may have been missed; empty for a service call


@dataclass(frozen=True)
class Arm:
    """A request to arm the gate."""

    publishers: int  # number of publishers on `cmd_vel`, the gate included


@dataclass(frozen=True)
class Reset:
    """A request to clear a latched stop."""


@dataclass(frozen=True)
class Tick:
    """The gate's own clock ticked: the only input at which a motion is published."""


Input = (
    Scan
    | Odometry
    | SensorReading
    | Estimate
    | Command
    | EStop
    | Press
    | Arm
    | Reset
    | Tick
)

TOPICS: dict[type, str] = {
    Scan: SCAN,
    Odometry: ODOM,
    Estimate: ESTIMATE,
    Command: RAW,
    EStop: E_STOP,
}


def get_topic(event: Input) -> str:
    """Returns the topic of an input; empty for a call of a service and for a tick."""
    if isinstance(event, SensorReading):
        return event.name
    return TOPICS.get(type(event), "")
