"""Detects a held body: odometry shows motion, but the scans show none.

`watch_scan` judges each new scan while the robot is commanded to move:

1. Reduce it to the median ranges in a few directions.
2. Choose an earlier scan as the reference: the oldest one since which the robot has not
   turned far. If odometry shows too little motion since then, or nearly all of it in
   one half of the time, there is no decision.
3. Predict the new scan from the reference and that motion.
4. Compare it sector by sector, wherever the prediction differs clearly from the
   reference. The share of a sector is the fraction of the predicted change that the new
   scan shows: 1 if odometry is right, 0 if the body does not move. A scene that looks
   the same after the motion, such as a long corridor, allows no decision.
5. The scans contradict odometry if most sectors show a small share, their median hardly any, and in
   the median sector few ranges changed visibly.
6. Report a held body (rule `body_held`) once scans have contradicted odometry for some time.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from nics_drl_bridge.gate import scan_motion_kernels as kernels
from nics_drl_bridge.gate.inputs import Odometry, Scan
from nics_drl_bridge.gate.scan_motion_kernels import Directions, Noise
from nics_drl_bridge.gate.state import (
    GateConfig,
    GateState,
    Ranges,
    ScanMotion,
    View,
    replace,
)
from nics_drl_bridge.geometry import between, compose, exp
from nics_drl_bridge.interface import S_PER_NS, Array

FULL_CIRCLE = 2.0 * np.pi
BEAM_COUNT_TOLERANCE = 1e-6  # tolerance of a number of beams
# standard deviation of the median of n normal numbers, times sqrt(n): about sqrt(pi / 2)
MEDIAN_FACTOR = 1.25


@dataclass(frozen=True)
class Settings:
    """Settings that define when scans contradict odometry.

    Usual shares: 0.77 for a skid-steer robot whose odometry turns 30 % too far, 0.5 on
        ice. Tyres that lose grip may show a share of 0.1 in a turn of half a second;
        such a robot does not count as held, because it also drives and its ranges
        change.

    Attributes:
        spacing: angle between the directions of a reduced scan [rad].
        window: angle on each side of a direction over which the median is taken [rad].
        sector: angle of a sector [rad]. A person nearby fills one or two of them.
        longest_s: time for which scans are kept as references, and the longest over which odometry
            is extrapolated to a scan's stamp [s].
        slow_periods: periods of a slow lidar that should fit into that time.
        slow_factor: maximum factor by which the time is extended for them.
        min_periods: periods that must fit, regardless of the factor.
        kept_every_s: minimum time between scans that are kept [s].
        min_path: minimum path by odometry since the reference [m], unless the turn suffices.
        min_turn: minimum turn by odometry since the reference [rad], unless the path suffices.
        min_half: minimum fraction of the motion in each half of the time since the reference. Scans
            stamped up to 0.25 s too late miss about the second half: of a robot that has just
            started they show only the first, and it would look held.
        usual_half: with less than this fraction in one half, the limits of the shares below shrink
            in proportion. It must be greater than `held_share`: scans of a free robot stamped too
            late, which moved 3 cm and then 17 cm, show a share of 0.15, and the limit is 0.12.
        min_half_motion: in that case, each half must also have this motion, in multiples of the
            minimum motion: noise would hide a smaller one.
        usual_turn: a younger reference is preferred if the robot turned further than this [rad].
        max_turn: no reference is used if it turned further: a room may repeat itself [rad].
        min_sectors: minimum number of compared sectors.
        min_contradicting: minimum fraction of them that show less than `sector_share`.
        sector_share: magnitude of a share below which a sector contradicts odometry.
        held_share: magnitude below which the median share of the sectors does so.
        max_changed: in the median sector, less than this fraction of the ranges changed visibly.
        confirmed_s: time for which scans must contradict odometry, without one that agrees [s].
        forgotten_s: time after which the first contradiction is forgotten [s].
    """

    spacing: float = math.radians(2.0)
    window: float = math.radians(3.0)
    sector: float = math.radians(20.0)
    longest_s: float = 0.56
    slow_periods: float = 3.1
    slow_factor: float = 1.15
    min_periods: float = 2.2
    kept_every_s: float = 0.08
    min_path: float = 0.04
    min_turn: float = 0.05
    min_half: float = 0.1
    usual_half: float = 0.25
    min_half_motion: float = 0.5
    usual_turn: float = 0.6
    max_turn: float = 1.4
    min_sectors: int = 5
    min_contradicting: float = 0.6
    sector_share: float = 0.45
    held_share: float = 0.2
    max_changed: float = 0.5
    confirmed_s: float = 0.15
    forgotten_s: float = 1.0


SETTINGS = Settings()


class Verdict(NamedTuple):
    """What two scans show about the motion between them.

    Attributes:
        share: median fraction of the motion that they show; NaN if nothing is decided.
        held: they contradict odometry.
        reference: the older of the two scans; None if they were not compared.
    """

    share: float
    held: bool
    reference: View | None = None


UNDECIDED = Verdict(math.nan, False)


def watch_scan(config: GateConfig, state: GateState, scan: Scan) -> ScanMotion:
    """Returns what recent scans show of the motion, after a new scan."""
    before = state.scan_motion
    is_judged = config.stop_when_held and len(config.beam_angles) >= 2
    if not is_judged or state.odometry is None:
        return ScanMotion()
    newest = View(
        scan.stamp_ns,
        extrapolate_pose(state.odometry, scan.stamp_ns, SETTINGS.longest_s),
        _reduce_scan(config, scan.ranges),
    )
    oldest_ns = scan.stamp_ns - round(_compute_memory_s(config) / S_PER_NS)
    kept = tuple(
        view for view in before.views if oldest_ns <= view.stamp_ns < scan.stamp_ns
    )
    verdict = UNDECIDED
    held_since_ns = None
    push_s = None
    # Only a robot that is commanded to move can be held. Each push (motion commanded
    # without a pause) is judged separately: tyres that slip at each start do not matter
    # for the time in between.
    if state.push is not None:
        push_s = state.push.since_s
        verdict = judge_motion(config, kept, newest)
        before_ns = before.held_since_ns if before.push_s == push_s else None
        held_since_ns = _update_held_since(before_ns, verdict, scan.stamp_ns)
    held = _explain_contradiction(newest, verdict, held_since_ns)
    spacing_ns = round(SETTINGS.kept_every_s / S_PER_NS)
    if not kept or newest.stamp_ns - kept[-1].stamp_ns >= spacing_ns:
        kept = (*kept, newest)
    return ScanMotion(
        views=kept,
        held_since_ns=held_since_ns,
        held=held,
        share=verdict.share,
        push_s=push_s,
    )


def extrapolate_pose(odometry: Odometry, stamp_ns: int, longest_s: float) -> Array:
    """Returns the pose (3,) at a stamp near the newest odometry, extrapolated by its twist."""
    seconds = np.clip((stamp_ns - odometry.stamp_ns) * S_PER_NS, -longest_s, longest_s)
    return compose(odometry.pose, exp(seconds * odometry.twist))


def _compute_memory_s(config: GateConfig) -> float:
    """Returns how long scans are kept [s], which is longer for a slow lidar."""
    slow_s = min(
        SETTINGS.slow_periods / config.scan_rate,
        SETTINGS.slow_factor * SETTINGS.longest_s,
    )
    return max(SETTINGS.longest_s, slow_s, SETTINGS.min_periods / config.scan_rate)


def _update_held_since(
    before_ns: int | None, verdict: Verdict, now_ns: int
) -> int | None:
    """Returns the stamp since which scans have contradicted odometry; None if they do not."""
    if before_ns is not None and (now_ns - before_ns) * S_PER_NS > SETTINGS.forgotten_s:
        before_ns = None
    if math.isnan(verdict.share):
        return before_ns
    if not verdict.held:
        return None
    return now_ns if before_ns is None else before_ns


def _explain_contradiction(
    newest: View, verdict: Verdict, held_since_ns: int | None
) -> str:
    """Returns a sentence once scans have contradicted odometry for long enough, else nothing."""
    reference = verdict.reference
    if held_since_ns is None or reference is None:
        return ""
    if (newest.stamp_ns - held_since_ns) * S_PER_NS < SETTINGS.confirmed_s:
        return ""
    x, y, turn = between(reference.pose, newest.pose).tolist()
    seconds = (newest.stamp_ns - reference.stamp_ns) * S_PER_NS
    motion = f"{math.hypot(x, y):.2f} m and {abs(turn):.2f} rad in {seconds:.2f} s"
    fault = "the scans show none of it: the body is held, or the wheels slip"
    return f"odometry shows {motion}, {fault}"


def judge_motion(config: GateConfig, kept: tuple[View, ...], newest: View) -> Verdict:
    """Judges whether the newest scan shows the motion that odometry shows since an earlier one."""
    selected = _select_reference(kept, newest)
    if selected is None:
        return UNDECIDED
    reference, lesser_fraction = selected
    # Scans stamped too late show at least this fraction of a free robot's motion; see `usual_half`.
    share_scale = min(1.0, lesser_fraction / SETTINGS.usual_half)
    observed, changed = _compare_scans(config, reference, newest)
    is_compared = ~np.isnan(observed)
    sectors = np.count_nonzero(is_compared)
    if sectors < SETTINGS.min_sectors:
        return UNDECIDED
    share = float(np.median(observed[is_compared]))
    contradicting = np.count_nonzero(
        np.abs(observed[is_compared]) < share_scale * SETTINGS.sector_share
    )
    held = (
        contradicting >= SETTINGS.min_contradicting * sectors
        and abs(share) < share_scale * SETTINGS.held_share
        and np.median(changed[is_compared]) < SETTINGS.max_changed
    )
    return Verdict(share, bool(held), reference)


def _compare_scans(
    config: GateConfig, reference: View, newest: View
) -> tuple[Array, Array]:
    """Returns, per sector, what the newest scan shows of the motion since the reference.

    See `scan_motion_kernels.compare_sectors`.
    """
    mount = np.array(config.mount)
    moved = between(compose(reference.pose, mount), compose(newest.pose, mount))
    directions = get_directions(config)
    # The change of a range is the difference of two medians, each of n ranges with normal noise:
    # its standard deviation is sqrt(2) * sqrt(pi / 2) / sqrt(n) times theirs, and at most sqrt(2)
    # times.
    count = 2 * directions.half_window + 1
    factor = math.sqrt(2.0) * min(1.0, MEDIAN_FACTOR / math.sqrt(count))
    predicted = np.empty_like(reference.ranges)
    kernels.predict_scan(reference.ranges, directions, moved, predicted)
    compared: tuple[Array, Array] = kernels.compare_sectors(
        reference.ranges,
        newest.ranges,
        predicted,
        round(SETTINGS.sector / directions.step) or 1,
        Noise(*(factor * std for std in config.range_noise)),
    )
    return compared


def _select_reference(
    kept: tuple[View, ...], newest: View
) -> tuple[View, float] | None:
    """Returns the scan to compare the newest one with; None if odometry shows too little motion.

    Also returns the fraction of the motion in the half of the time with less motion.
    """
    # The oldest scan since which the robot has not turned further than usual; otherwise
    # the youngest usable one. The last scan is excluded, because another scan has to be
    # in between.
    chosen = None
    for index, scan in enumerate(kept[:-1]):
        turn = abs(_measure_turn(scan, newest))
        if turn > SETTINGS.max_turn:
            continue
        chosen = index
        if turn <= SETTINGS.usual_turn:
            break
    if chosen is None:
        return None
    reference = kept[chosen]
    middle_ns = (reference.stamp_ns + newest.stamp_ns) // 2
    middle = min(kept[chosen + 1 :], key=lambda scan: abs(scan.stamp_ns - middle_ns))
    motion = _measure_motion(reference, newest)
    lesser_motion = min(
        _measure_motion(reference, middle),
        _measure_motion(middle, newest),
    )
    is_usual = lesser_motion >= SETTINGS.usual_half * motion
    is_enough = (
        lesser_motion >= SETTINGS.min_half * motion
        and lesser_motion >= SETTINGS.min_half_motion
    )
    if motion < 1.0 or not (is_usual or is_enough):
        return None
    return reference, lesser_motion / motion


def _measure_motion(old: View, new: View) -> float:
    """Returns the motion that odometry shows between two scans, in multiples of the minimum."""
    path = math.hypot(*(new.pose[:2] - old.pose[:2]).tolist())
    turn = abs(_measure_turn(old, new))
    return max(path / SETTINGS.min_path, turn / SETTINGS.min_turn)


def _measure_turn(old: View, new: View) -> float:
    """Returns the turn that odometry shows between two scans, of at most half a circle."""
    return math.remainder(float(new.pose[2] - old.pose[2]), FULL_CIRCLE)


def _reduce_scan(config: GateConfig, ranges: Ranges) -> Ranges:
    """Returns the median ranges (K,) of a scan (B,) around its directions."""
    directions = get_directions(config)
    reduced = np.empty(directions.size, np.float32)
    kernels.reduce_scan(ranges, directions, reduced)
    return reduced


def get_directions(config: GateConfig) -> Directions:
    """Returns the directions of a lidar's reduced scans."""
    beams = len(config.beam_angles)
    step = float(config.beam_angles[1] - config.beam_angles[0])
    size = min(beams, max(1, round(beams * step / SETTINGS.spacing)))
    half_window = min(
        int(SETTINGS.window / step + BEAM_COUNT_TOLERANCE),
        (kernels.LARGEST_WINDOW - 1) // 2,
        (beams - 1) // 2,
    )
    return make_directions(config, size, half_window)


def make_directions(config: GateConfig, size: int, half_window: int) -> Directions:
    """Returns a number of directions, evenly spaced over the beams of a lidar."""
    beams = len(config.beam_angles)
    step = float(config.beam_angles[1] - config.beam_angles[0])
    beams_per_direction = beams / size
    return Directions(
        size=size,
        first=float(config.beam_angles[0]) + int(0.5 * beams_per_direction) * step,
        step=beams_per_direction * step,
        beams_per_direction=beams_per_direction,
        half_window=half_window,
        full_circle=beams * step > FULL_CIRCLE - 0.5 * step,
    )


def warm_up(config: GateConfig) -> None:
    """Compiles the kernels for a scan, which takes seconds that a moving robot does not have."""
    if len(config.beam_angles) < 2:
        return
    ranges = np.ones(len(config.beam_angles), np.float32)
    view = View(0, np.zeros(3), _reduce_scan(config, ranges))
    views = tuple(
        replace(view, stamp_ns=k, pose=np.array([0.1 * k, 0.0, 0.0])) for k in range(3)
    )
    judge_motion(config, views[:2], views[2])
