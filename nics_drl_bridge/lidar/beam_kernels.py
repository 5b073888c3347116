"""Beams of a lidar: their directions, the beams between two bearings, and their ranges.

During a scan (B,), its float32 ranges [m] are kept as integers of the same bits.
Positive floats and these integers have the same order, but LLVM would mask the store of
a float minimum. `lower` takes the minimum of Eq. 4 for one beam.
"""

import math
from typing import NamedTuple

import numpy as np

from nics_drl_bridge.kernels import kernel
from nics_drl_bridge.lidar.arrays import Array, ShortIntegers

TWO_PI = 2.0 * math.pi
HALF_PI = 0.5 * math.pi
# Beams this close to a bearing count as inside a span [beams].
ROUNDING = 1e-6
TINY = 1e-300  # avoids NaN for the angle of a zero vector
# Coefficients of r, r^3, r^5... in the arc tangent of r in [0, 1].
ATAN = (
    0.9999999996145,
    -0.3333332366563,
    0.1999959585417,
    -0.1427904841688,
    0.1105378475317,
    -0.0879611755717,
    0.0671011398839,
    -0.0442736682632,
    0.0222034549106,
    -0.0071661648959,
    0.0010844927512,
)
INF_BITS = np.array([np.inf], np.float32).view(np.int32)[0]


class Beams(NamedTuple):
    """Directions of the beams in the frame of the lidar."""

    directions: Array  # (2, B) cosines and sines, in rows that vectorise
    first: float  # angle of beam 0 [rad]
    step: float  # between beams [rad]
    # (2, 2) unit vectors: a body farther along both than its radius is behind all beams
    behind: Array


class LidarPose(NamedTuple):
    """Pose of a lidar in its world."""

    x: float  # [m]
    y: float
    c: float  # cosine and sine of the heading
    s: float
    heading: float  # [rad]


@kernel(allocates=True)
def make_beams(directions: Array, first: float, step: float) -> Beams:
    """Return the beams of directions (2, B) that are a `step` apart, from `first` on [rad]."""
    count = directions.shape[1]
    # Half of the angle without beams, minus half a step so that rounding does not
    # matter.
    blind = min(max(math.pi - 0.5 * step * count, 0.0), HALF_PI)
    back = first + 0.5 * step * (count - 1) + math.pi
    behind = np.empty((2, 2))
    for side in range(2):
        angle = back + (1 - 2 * side) * (blind - HALF_PI)
        behind[side, 0] = math.cos(angle)
        behind[side, 1] = math.sin(angle)
    return Beams(directions, first, step, behind)


@kernel(inline=True)
def locate_lidar(robot_pose: Array, mount: Array) -> LidarPose:
    """Return the pose of a lidar in its world, from its robot's pose (3,)."""
    x = robot_pose[0]
    y = robot_pose[1]
    robot_heading = robot_pose[2]
    if mount[0] != 0.0 or mount[1] != 0.0:
        c = math.cos(robot_heading)
        s = math.sin(robot_heading)
        x = x + c * mount[0] - s * mount[1]
        y = y + s * mount[0] + c * mount[1]
    heading = robot_heading + mount[2]
    return LidarPose(x, y, math.cos(heading), math.sin(heading), heading)


@kernel(contracts=True, inline=True)
def arctan2(y: float, x: float) -> float:
    """Angle of (x, y) within 3e-10 rad, branchless: a polynomial fitted at Chebyshev nodes."""
    ax = abs(x)
    ay = abs(y)
    ratio = min(ax, ay) / (max(ax, ay) + TINY)
    s = ratio * ratio
    r = ATAN[10]
    for k in range(9, -1, -1):
        r = r * s + ATAN[k]
    r *= ratio
    r = HALF_PI - r if ay > ax else r
    r = math.pi - r if x < 0.0 else r
    return math.copysign(r, y)


class Span(NamedTuple):
    """Two bearings as fractional indices of beams, the second to the left of the first.

    The first is in the turn that begins with beam 0. The second may be in the next
    turn, where beam 0 comes again after a full turn.
    """

    right: float
    left: float
    full_turn: float  # [beams]


@kernel(contracts=True, inline=True)
def span_beams(bearing: float, width: float, beams: Beams) -> Span:
    """Return the span from a bearing to `width` further left [rad]."""
    beams_per_rad = 1.0 / beams.step
    full_turn = TWO_PI * beams_per_rad
    turns_per_beam = 1.0 / full_turn
    right = (bearing - beams.first) * beams_per_rad
    right -= np.floor(right * turns_per_beam) * full_turn
    return Span(right, right + width * beams_per_rad, full_turn)


@kernel(inline=True)
def beams_within(span: Span, turned_by: float, beam_count: int) -> tuple[int, int]:
    """Return the first beam in a span, and the one after the last.

    For the part of a span in the next turn, `turned_by` is a full turn.
    """
    right = np.ceil(span.right - turned_by - ROUNDING)
    left = np.floor(span.left - turned_by + ROUNDING)
    return int(max(right, 0.0)), int(min(left, beam_count - 1.0)) + 1


@kernel(inline=True)
def lower(scan: ShortIntegers, i: int, distance: float | np.float32) -> None:
    """Lower the range of beam i to a distance [m], if that is nearer (Eq. 4)."""
    scan[i] = min(scan[i], np.float32(distance).view(np.int32))
