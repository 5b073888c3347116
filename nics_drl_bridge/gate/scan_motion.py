"""Detects a held body: odometry shows motion, but the scans show none.

A recent scan and the motion by odometry predict the newest scan. Where the prediction differs
clearly from the recent scan, the newest scan must have changed; if it has not, the wheels spin but
the body stands. A scene that looks the same after the motion, such as a long corridor, decides
nothing.
"""

import math
from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

import numpy as np

from nics_drl_bridge.gate import scan_motion_kernels as kernels
from nics_drl_bridge.gate.inputs import Odometry, Scan
from nics_drl_bridge.gate.scan_motion_kernels import Directions, Noise, Thresholds
from nics_drl_bridge.gate.state import (
    Cause,
    GateConfig,
    GateState,
    Ranges,
    ReducedScan,
    ScanMotion,
    replace,
)
from nics_drl_bridge.gate.stops import SCAN, make_cause
from nics_drl_bridge.geometry import between, compose, exp
from nics_drl_bridge.interface import S_PER_NS, Array

FULL_CIRCLE = 2.0 * np.pi


@dataclass(frozen=True)
class Settings:
    """When scans contradict odometry."""

    # Reduced scan: a direction is the median of the beams within `window` on each side of it.
    spacing: float = math.radians(2.0)
    window: float = math.radians(3.0)
    sector: float = math.radians(20.0)  # a person nearby fills one or two of them
    # Scans are kept `kept_every_s` apart; the newest one is compared with one that is at most
    # about `longest_s` older.
    longest_s: float = 0.56
    kept_every_s: float = 0.08
    # Minimum motion by odometry between the two scans [m], [rad], and its minimum fraction in
    # either half of that time. With less, a robot that has just started would look held if its
    # scans were up to a quarter of a second older than their stamps.
    min_path: float = 0.04
    min_turn: float = 0.05
    min_half: float = 0.25
    # If the robot turned by more than the first since a scan, a younger scan is preferred; if by
    # more than the second, the scan is never used, because a room may repeat itself.
    usual_turn: float = 0.6
    max_turn: float = 1.4
    # A sector is compared if the root mean square of the changes of its ranges must be this [m],
    # and this many standard deviations of the lidar's noise.
    min_change: float = 0.03
    deviations: float = 1.8
    # A range changed visibly if it did by this [m] and by so many of these deviations.
    visible_change: float = 0.05
    visible_deviations: float = 3.0
    # Neighbours whose ranges differ by more than this fraction are on two surfaces.
    gap: float = 0.25
    # A body is held if, of at least `min_sectors` compared sectors, the fraction `agreeing` shows
    # less than `sector_share` of the motion, the median shows less than `held_share`, and in the
    # median less than `max_changed` of a sector's ranges changed visibly. A skid-steer robot whose
    # odometry turns 30 % too far shows 0.77, and one on ice 0.5. One that begins to turn in DART
    # shows a tenth of the turn for half a second, but is not held: its ranges change because it
    # also drives.
    min_sectors: int = 5
    agreeing: float = 0.6
    sector_share: float = 0.45
    held_share: float = 0.2
    max_changed: float = 0.5
    # time for which scans must contradict odometry, without one that agrees
    confirmed_s: float = 0.15
    # time after which an unconfirmed contradiction is forgotten
    forgotten_s: float = 1.0


SETTINGS = Settings()


class Verdict(NamedTuple):
    """What two scans say about the motion in between."""

    sectors: int  # number of compared sectors
    share: (
        float  # median fraction of the motion that they show; NaN if there are too few
    )
    held: bool  # they contradict odometry
    reference: ReducedScan | None = (
        None  # the older of the two scans, if they were compared
    )


UNDECIDED = Verdict(0, math.nan, False)


def extrapolate_pose(odometry: Odometry, stamp_ns: int, longest_s: float) -> Array:
    """Returns the pose (3,) at a stamp near the newest odometry, extrapolated by its twist."""
    seconds = np.clip((stamp_ns - odometry.stamp_ns) * S_PER_NS, -longest_s, longest_s)
    return compose(odometry.pose, exp(seconds * odometry.twist))


def watch_scan(
    config: GateConfig, state: GateState, scan: Scan, settings: Settings = SETTINGS
) -> ScanMotion:
    """Returns what recent scans show of the motion, after a new scan."""
    before = state.scan_motion
    if not _can_judge(config) or state.odometry is None:
        return ScanMotion()
    newest = ReducedScan(
        scan.stamp_ns,
        extrapolate_pose(state.odometry, scan.stamp_ns, settings.longest_s),
        _reduce(config, scan.ranges, settings),
    )
    oldest_ns = scan.stamp_ns - round(_compute_memory_s(config, settings) / S_PER_NS)
    kept = tuple(
        view for view in before.views if oldest_ns <= view.stamp_ns < scan.stamp_ns
    )
    verdict = UNDECIDED
    since_ns = None
    push_s = None
    # Only a robot that is commanded to move can be held. Each push is judged alone: tyres that
    # slip whenever the robot starts say nothing about the time in between.
    if state.push is not None:
        push_s = state.push.since_s
        verdict = judge_motion(config, kept, newest, settings)
        before_ns = before.held_since_ns if before.push_s == push_s else None
        since_ns = _update_held_since(before_ns, verdict, scan.stamp_ns, settings)
    held = _explain_contradiction(newest, verdict, since_ns, settings)
    spacing_ns = round(settings.kept_every_s / S_PER_NS)
    if not kept or newest.stamp_ns - kept[-1].stamp_ns >= spacing_ns:
        kept = (*kept, newest)
    return ScanMotion(kept, since_ns, held, verdict.share, push_s)


def _can_judge(config: GateConfig) -> bool:
    """True if the rule is on, and the lidar has the two beams at least that give directions."""
    return config.stop_when_held and len(config.beam_angles) >= 2


def _compute_memory_s(config: GateConfig, settings: Settings) -> float:
    """Returns for how long scans are kept [s].

    At least `longest_s`; up to 15 % longer to hold three periods of a slow lidar, and always two.
    """
    three_periods = min(3.1 / config.scan_rate, 1.15 * settings.longest_s)
    return max(settings.longest_s, three_periods, 2.2 / config.scan_rate)


def _update_held_since(
    before_ns: int | None, verdict: Verdict, now_ns: int, settings: Settings
) -> int | None:
    """Returns the stamp of the first contradiction that is neither outdated nor refuted."""
    if before_ns is not None and (now_ns - before_ns) * S_PER_NS > settings.forgotten_s:
        before_ns = None
    if math.isnan(verdict.share):
        return before_ns
    if not verdict.held:
        return None
    return now_ns if before_ns is None else before_ns


def _explain_contradiction(
    newest: ReducedScan,
    verdict: Verdict,
    held_since_ns: int | None,
    settings: Settings,
) -> str:
    """Returns a sentence once scans have contradicted odometry for long enough, else nothing."""
    reference = verdict.reference
    if not verdict.held or held_since_ns is None or reference is None:
        return ""
    if (newest.stamp_ns - held_since_ns) * S_PER_NS < settings.confirmed_s:
        return ""
    x, y, turn = between(reference.pose, newest.pose).tolist()
    seconds = (newest.stamp_ns - reference.stamp_ns) * S_PER_NS
    motion = f"{math.hypot(x, y):.2f} m and {abs(turn):.2f} rad in {seconds:.2f} s"
    fault = "the scans show none of it: the body is held, or the wheels slip"
    return f"odometry shows {motion}, {fault}"


def judge_motion(
    config: GateConfig,
    kept: tuple[ReducedScan, ...],
    newest: ReducedScan,
    settings: Settings,
) -> Verdict:
    """Judges whether the newest scan shows the motion that odometry shows since an earlier one."""
    reference = _select_reference(kept, newest, settings)
    if reference is None:
        return UNDECIDED
    mount = np.array(config.mount)
    moved = between(compose(reference.pose, mount), compose(newest.pose, mount))
    directions = get_directions(config, settings)
    predicted = np.empty_like(reference.ranges)
    kernels.predict_scan(reference.ranges, directions, moved, settings.gap, predicted)
    sector = round(settings.sector / directions.step) or 1
    thresholds = Thresholds(
        settings.min_change,
        settings.deviations,
        settings.visible_change,
        settings.visible_deviations,
    )
    noise = compute_noise(config, directions)
    observed, changed = kernels.compare_sectors(
        reference.ranges, newest.ranges, predicted, sector, noise, thresholds
    )
    is_compared = ~np.isnan(observed)
    sectors = int(np.count_nonzero(is_compared))
    if sectors < max(settings.min_sectors, 1):
        return UNDECIDED._replace(sectors=sectors)
    share = float(np.median(observed[is_compared]))
    unmoved = np.count_nonzero(np.abs(observed[is_compared]) < settings.sector_share)
    held = (
        unmoved >= settings.agreeing * sectors
        and abs(share) < settings.held_share
        and np.median(changed[is_compared]) < settings.max_changed
    )
    return Verdict(sectors, share, bool(held), reference)


def _select_reference(
    kept: tuple[ReducedScan, ...], newest: ReducedScan, settings: Settings
) -> ReducedScan | None:
    """Returns the scan to compare the newest one with; None if odometry shows too little motion."""
    chosen = None
    for index, scan in enumerate(kept[:-1]):
        turn = abs(_measure_turn(scan, newest))
        if turn > settings.max_turn:
            continue
        chosen = index
        if turn <= settings.usual_turn:
            break
    if chosen is None:
        return None
    reference = kept[chosen]
    half_ns = (reference.stamp_ns + newest.stamp_ns) // 2
    middle = min(kept[chosen + 1 :], key=lambda scan: abs(scan.stamp_ns - half_ns))
    motion = _measure_motion(reference, newest, settings)
    lesser_half = min(
        _measure_motion(reference, middle, settings),
        _measure_motion(middle, newest, settings),
    )
    is_enough = motion >= 1.0 and lesser_half >= settings.min_half * motion
    return reference if is_enough else None


def _measure_motion(old: ReducedScan, new: ReducedScan, settings: Settings) -> float:
    """Returns the motion that odometry shows between two scans, in multiples of the minimum."""
    path = math.hypot(*(new.pose[:2] - old.pose[:2]).tolist())
    turn = abs(_measure_turn(old, new))
    tiny = 1e-9  # the minimum may be set to zero
    return max(path / max(settings.min_path, tiny), turn / max(settings.min_turn, tiny))


def _measure_turn(old: ReducedScan, new: ReducedScan) -> float:
    """Returns the turn that odometry shows between two scans, of at most half a circle."""
    return math.remainder(float(new.pose[2] - old.pose[2]), FULL_CIRCLE)


def _reduce(config: GateConfig, ranges: Ranges, settings: Settings) -> Ranges:
    directions = get_directions(config, settings)
    reduced = np.empty(round(len(ranges) / directions.beams), np.float32)
    kernels.reduce_scan(ranges, directions, reduced)
    return reduced


def get_directions(config: GateConfig, settings: Settings = SETTINGS) -> Directions:
    """Returns the directions of a lidar's reduced scans."""
    angles = config.beam_angles
    return _make_directions(
        len(angles),
        float(angles[0]),
        float(angles[1] - angles[0]),
        settings.spacing,
        settings.window,
    )


@cache
def _make_directions(
    beams: int, first: float, step: float, spacing: float, window: float
) -> Directions:
    count = min(beams, max(1, round(beams * step / spacing)))
    beams_per_direction = beams / count
    reach = min(
        int(window / step + 1e-6), (kernels.LARGEST_WINDOW - 1) // 2, (beams - 1) // 2
    )
    full_circle = beams * step > FULL_CIRCLE - 0.5 * step
    return Directions(
        first=first + int(0.5 * beams_per_direction) * step,
        step=beams_per_direction * step,
        beams=beams_per_direction,
        reach=reach,
        full_circle=full_circle,
    )


def compute_noise(config: GateConfig, directions: Directions) -> Noise:
    """Returns the standard deviation of the change of a reduced range."""
    # That of the difference of two medians, each of `count` normal numbers.
    count = 2 * directions.reach + 1
    factor = math.sqrt(2.0) * min(1.0, 1.25 / math.sqrt(count))
    constant, proportional = config.range_noise
    return Noise(factor * constant, factor * proportional)


def body_held(config: GateConfig, state: GateState, now: float) -> Cause | None:
    """The scans show none of the motion that odometry shows: the body is held, its wheels spin."""
    return make_cause("body_held", SCAN, state.scan_motion.held)


def warm_up(config: GateConfig) -> None:
    """Compiles the kernels for a scan; that takes seconds, which a moving robot does not have."""
    if not _can_judge(config):
        return
    view = ReducedScan(
        0,
        np.zeros(3),
        _reduce(config, np.ones(len(config.beam_angles), np.float32), SETTINGS),
    )
    views = tuple(
        replace(view, stamp_ns=k, pose=np.array([0.1 * k, 0.0, 0.0])) for k in range(3)
    )
    judge_motion(config, views[:2], views[2], SETTINGS)
