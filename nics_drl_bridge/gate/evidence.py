"""Obstacles for the shield: the returns of the newest scan, and areas the lidar can't see.

Obstacles are rows (P, 3): x, y [m] in the robot's frame, and the speed [m/s] at which
each may approach: `obstacle_speed` for a mover, otherwise 0. `find_obstacles` collects
them in these steps:

1. Compare the newest scan with earlier ones: a beam that ends where an earlier one saw
   free space hits a mover, which may approach. All other obstacles are static. A wrong
   motion estimate makes static objects appear to move, and wheels do slip (in turns of
   a skid-steer robot) and spin (if the body is held). The motion by odometry is
   therefore replaced if another one clearly fits both scans better. `scan_motion`
   decides separately, over a longer time, whether the body is held.
2. Place an obstacle at the end of each beam that returns.
3. Place one at the minimum range of each beam that was too close to measure.
4. Place a wall on the footprint wherever too many beams are unknown.
5. Add the border of known ground if the lidar does not cover the full circle; see
   `ground`.
"""

import math

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.gate import evidence_kernels
from nics_drl_bridge.gate.evidence_kernels import MountedBeams, Tolerance
from nics_drl_bridge.gate.footprint import sample_footprint
from nics_drl_bridge.gate.inputs import Scan
from nics_drl_bridge.gate.scan_motion import extrapolate_pose
from nics_drl_bridge.gate.state import (
    GateConfig,
    GateState,
    Ground,
    Ranges,
    ShieldConfig,
    View,
)
from nics_drl_bridge.geometry import between, exp, log
from nics_drl_bridge.interface import S_PER_NS, Array

Flags = NDArray[np.bool_]
FULL_CIRCLE = 2.0 * math.pi
MEMORY_S = 0.45  # maximum age of a scan that the newest one is compared with [s]
SPACING_S = 0.09  # minimum time between two such scans [s]
# The end of a beam was free space if the old scan saw further in that direction, by
# this length [m] plus this many standard deviations of its range.
TOLERANCE = 0.03
DEVIATIONS = 3.0
# Odometry is trusted for smaller turns and shorter paths between two scans, because
# their errors are within the angle and the distance over which beams are compared.
MIN_CHECKED_TURN = evidence_kernels.COMPARED_ANGLE
MIN_CHECKED_PATH = TOLERANCE
MAX_TURN_FRACTION = 1.3  # maximum turn that is tried, relative to odometry's
TURN_SPACING = 0.03  # maximum spacing of the turns that are tried [rad]
MIN_TURNS = 14  # minimum number of turns that are tried
PATH_SPACING = 0.05  # maximum spacing of the smaller motions that are tried [m]
MIN_LESSER = 4  # minimum number of smaller motions that are tried
MAX_LESSER = 20  # maximum number of them
COMPARED_BEAMS = 200  # number of beams that suffice to compare motions
# A motion may replace odometry's if this fraction of the compared beams agrees with it,
# and more beams than with odometry's, by this fraction of the compared beams.
MIN_AGREEING = 0.3
MIN_GAIN = 0.05
# The beams that agree with that motion, but not with odometry's, must be in at least
# this many eighths of a circle, each with at least this many beams, so that a person
# who walks around the robot is not mistaken for its turn.
SECTORS = 8
MIN_SECTORS = 4
MIN_SECTOR_BEAMS = 2


def find_obstacles(
    config: GateConfig,
    ranges: Ranges,
    views: tuple[View, ...],
    ground: Ground | None = None,
) -> Array | None:
    """Returns the obstacles (P, 3) of a scan; None without a shield.

    Args:
        config: of the gate.
        ranges: (B,) of the scan [m].
        views: recent views, including this scan's as the newest; empty without
            odometry.
        ground: known ground; None if the lidar covers the full circle.
    """
    shield = config.shield
    if shield is None:
        return None
    is_mover = np.zeros(len(ranges), np.bool_)
    if views:
        is_mover = find_movers(config, shield, views)
    obstacles = [place(config, shield, ranges, is_mover) for place in EVIDENCE]
    if ground is not None:
        obstacles.append(make_static(ground.unseen))
    return np.concatenate(obstacles)


def find_movers(
    config: GateConfig, shield: ShieldConfig, views: tuple[View, ...]
) -> Flags:
    """Returns which beams (B,) of the newest view hit movers, together with a neighbour."""
    newest = views[-1]
    entered = np.zeros(len(newest.ranges), np.bool_)
    if shield.obstacle_speed == 0.0:
        return entered
    lidar = get_beams(config)
    constant, proportional = shield.range_noise
    tolerance = Tolerance(TOLERANCE + DEVIATIONS * constant, DEVIATIONS * proportional)
    for view in views[:-1]:
        evidence_kernels.mark_entered(
            entered,
            newest.ranges,
            view.ranges,
            lidar,
            estimate_motion(view, newest, lidar, tolerance),
            shield.range_max,
            tolerance,
        )
    before = np.roll(entered, 1)
    after = np.roll(entered, -1)
    is_full_circle = len(entered) >= round(FULL_CIRCLE / abs(lidar.step))
    if not is_full_circle:
        before[0] = False
        after[-1] = False
    return entered & (before | after)


def estimate_motion(
    old: View, new: View, lidar: MountedBeams, tolerance: Tolerance
) -> Array:
    """Returns the robot's motion (3,) between two views, by odometry and the scans.

    Among the motions that wheels may report by mistake, it is the one for which most
    beams of the new scan end where the old scan ended. Odometry's own motion is used
    unless clearly more beams agree with another one, in several directions.
    """
    by_odometry = between(old.pose, new.pose)
    path = math.hypot(by_odometry[0], by_odometry[1])
    if path <= MIN_CHECKED_PATH and abs(by_odometry[2]) <= MIN_CHECKED_TURN:
        return by_odometry
    stride = math.ceil(len(new.ranges) / COMPARED_BEAMS)
    is_return = np.isfinite(new.ranges[::stride])

    def find_agreeing(motions: Array) -> Flags:
        agreeing = np.empty((len(motions), len(is_return)), np.bool_)
        evidence_kernels.mark_agreeing(
            agreeing, new.ranges, old.ranges, lidar, motions, tolerance, stride
        )
        return agreeing

    usual = find_agreeing(by_odometry[None])[0]
    needed = max(
        np.count_nonzero(usual) + MIN_GAIN * len(usual), MIN_AGREEING * len(usual)
    )
    if np.count_nonzero(is_return) < needed:
        return by_odometry  # no motion can fit better
    motions = np.concatenate([_vary_turn(by_odometry), _lessen_motion(by_odometry)])
    agreeing_by_motion = find_agreeing(motions)
    # among equals, the turn closest to odometry's
    best = int(np.argmax(np.count_nonzero(agreeing_by_motion, axis=1)))
    agreeing = agreeing_by_motion[best]
    gained = np.flatnonzero(agreeing & ~usual) * stride
    is_better = np.count_nonzero(agreeing) >= needed
    if not is_better or _count_sectors(gained, lidar) < MIN_SECTORS:
        return by_odometry
    by_scans: Array = motions[best]
    return by_scans


def _vary_turn(motion: Array) -> Array:
    """Returns motions (n, 3) with other turns, sorted by the change of the turn."""
    span = MAX_TURN_FRACTION * abs(float(motion[2]))
    count = max(MIN_TURNS, math.ceil(span / TURN_SPACING) + 1)
    fractions = np.linspace(0.0, MAX_TURN_FRACTION, count)
    fractions = fractions[np.argsort(np.abs(fractions - 1.0), kind="stable")]
    arcs = np.tile(log(motion), (count, 1))
    arcs[:, 2] *= fractions
    return exp(arcs)


def _lessen_motion(motion: Array) -> Array:
    """Returns fractions (n, 3) of a motion from zero on, as if the wheels spin."""
    arc = log(motion)
    path = math.hypot(arc[0], arc[1])
    count = min(max(MIN_LESSER, math.ceil(path / PATH_SPACING)), MAX_LESSER)
    fractions = np.arange(count) / count
    return exp(fractions[:, None] * arc)


def _count_sectors(beams: NDArray[np.intp], lidar: MountedBeams) -> int:
    """Returns the number of sectors around the lidar that contain enough of the beams (n,)."""
    bearings = lidar.first + beams * lidar.step
    sectors = np.floor(bearings / FULL_CIRCLE * SECTORS).astype(np.intp) % SECTORS
    counts = np.bincount(sectors, minlength=SECTORS)
    return int(np.count_nonzero(counts >= MIN_SECTOR_BEAMS))


def place_returns(
    config: GateConfig, shield: ShieldConfig, ranges: Ranges, is_mover: Flags
) -> Array:
    """Returns an obstacle at the end of each beam with a return."""
    is_return = np.isfinite(ranges)
    angles = config.beam_angles[is_return]
    lengths = ranges[is_return].astype(np.float64)
    speeds = np.where(is_mover[is_return], shield.obstacle_speed, 0.0)
    return _place_at_ends(config, angles, lengths, speeds)


def place_too_close(
    config: GateConfig, shield: ShieldConfig, ranges: Ranges, is_mover: Flags
) -> Array:
    """Returns an obstacle at the minimum range of each beam too close to measure (`-inf`)."""
    is_near = np.isneginf(ranges)
    angles = config.beam_angles[is_near]
    lengths = np.full(len(angles), config.range_min)
    return _place_at_ends(config, angles, lengths, np.zeros(len(angles)))


def place_unknown(
    config: GateConfig, shield: ShieldConfig, ranges: Ranges, is_mover: Flags
) -> Array:
    """Returns a wall on the footprint wherever too many beams, or all, are unknown (NaN).

    The beams within `unknown_width` are counted together. At and beyond the edge of the
    field of view, fewer beams are expected.
    """
    bearings, points = sample_footprint(shield, config.mount, len(ranges))
    angles = config.beam_angles + config.mount[2]
    half_width = shield.unknown_width / 2.0
    known_count = _count_within(bearings, angles[~np.isnan(ranges)], half_width)
    count = _count_within(bearings, angles, half_width)
    full_count = shield.unknown_width / (angles[1] - angles[0])
    expected_count = np.where(count < int(full_count), count, full_count)
    is_unknown = known_count < (1.0 - shield.unknown_share) * expected_count
    return make_static(points[is_unknown])


EVIDENCE = (place_returns, place_too_close, place_unknown)
"""Functions that find obstacles (P, 3) in a scan."""


def _place_at_ends(
    config: GateConfig, angles: Array, lengths: Array, speeds: Array
) -> Array:
    """Returns obstacles (P, 3) at the ends of beams, by their angles in the lidar's frame [rad]."""
    x, y, heading = config.mount
    bearings = angles + heading
    xs = x + lengths * np.cos(bearings)
    ys = y + lengths * np.sin(bearings)
    return np.stack([xs, ys, speeds], axis=1)


def make_static(points: Array) -> Array:
    """Returns obstacles (P, 3) that do not approach, at points (P, 2)."""
    return np.pad(points, ((0, 0), (0, 1)))


def _count_within(
    bearings: Array, angles: Array, half_width: float
) -> NDArray[np.int64]:
    """Returns how many angles (B,) are within half a width of each bearing (M,) [rad]."""
    angles = np.sort(np.mod(angles + np.pi, 2.0 * np.pi) - np.pi)
    unrolled = np.concatenate([angles - 2.0 * np.pi, angles, angles + 2.0 * np.pi])
    begin = np.searchsorted(unrolled, bearings - half_width)
    return np.searchsorted(unrolled, bearings + half_width) - begin


def get_beams(config: GateConfig) -> MountedBeams:
    """Returns the beams of the lidar, and its mount."""
    angles = config.beam_angles
    step = float(angles[1] - angles[0])
    return MountedBeams(float(angles[0]), step, *config.mount)


def add_view(config: GateConfig, state: GateState, scan: Scan) -> tuple[View, ...]:
    """Returns the earlier views in use, oldest first, and the view of a new scan."""
    if config.shield is None or state.odometry is None:
        return ()
    pose = extrapolate_pose(state.odometry, scan.stamp_ns, MEMORY_S)
    kept: list[View] = []
    for view in state.views:
        age_s = (scan.stamp_ns - view.stamp_ns) * S_PER_NS
        # The stamps of the lidar may have jumped back since the view.
        if not 0.0 < age_s <= MEMORY_S:
            continue
        if not kept or (view.stamp_ns - kept[-1].stamp_ns) * S_PER_NS >= SPACING_S:
            kept.append(view)
    return (*kept, View(scan.stamp_ns, pose, scan.ranges))
