"""Checks the estimate of the robot's pose: it must not jump or quickly become uncertain.

Without a localiser the covariance of a pose in `map` grows forever, by noise and by
heading uncertainty times the distance from the origin. This does not matter for the
next few metres, where goal and scan are. Therefore only the covariance added since a
recent estimate, or since arming, counts.
"""

import math

import numpy as np

from nics_drl_bridge.gate.frozen import measure_motion
from nics_drl_bridge.gate.inputs import ESTIMATE, Estimate
from nics_drl_bridge.gate.limits import get_maximum_speeds
from nics_drl_bridge.gate.state import (
    EstimateMark,
    EstimateTrack,
    GateConfig,
    GateState,
)
from nics_drl_bridge.geometry import between

WINDOW_S = 10.0  # window over which uncertainty is counted, but only since arming [s]
ESTIMATE_MARK_S = 1.0  # time between two marks [s]
SLIP = 2.0  # factor by which a robot may exceed its maximum speeds
REMEDY = (
    "give the pose by `initialpose` or by the localiser, or call `middleware_node/~/reset`, then "
    "`~/reset` and `~/arm`"
)


def compute_growth(mark: EstimateMark, estimate: Estimate) -> tuple[float, float]:
    """Returns the uncertainty of an estimate's pose relative to an earlier one.

    It is the standard deviation of position [m] and heading [rad].
    """
    # An old heading error shifts the pose at right angles to the path since then.
    x, y = (estimate.pose[:2] - mark.pose[:2]).tolist()
    carried = np.array([[1.0, 0.0, -y], [0.0, 1.0, x], [0.0, 0.0, 1.0]])
    gained = np.diag(estimate.covariance - carried @ mark.covariance @ carried.T)
    position = math.sqrt(max(0.0, float(gained[:2].max())))
    return position, math.sqrt(max(0.0, float(gained[2])))


def track_estimate(
    config: GateConfig, state: GateState, estimate: Estimate, now: float
) -> EstimateTrack:
    """Returns the track with a new estimate and its fault, if any."""
    track = state.estimates
    newest = EstimateMark(now, estimate.pose, estimate.covariance)
    marks = tuple(mark for mark in track.marks if now - mark.time_s <= WINDOW_S)
    if state.estimate is None or not marks:  # nothing to compare it with
        return EstimateTrack((newest,), "", track.last_fault)
    fault = _find_jump(config, state.estimate, estimate, now - state.estimate_s)
    position, heading = compute_growth(marks[0], estimate)
    is_certain = position <= config.estimate_position
    if not fault and not (is_certain and heading <= config.estimate_heading):
        fault = (
            f"it became uncertain by {position:.3g} m and {heading:.3g} rad in "
            f"{now - marks[0].time_s:.1f} s, the limits are {config.estimate_position:g} m and "
            f"{config.estimate_heading:g} rad"
        )
    if fault:
        return EstimateTrack((newest,), fault, fault)
    if now - marks[-1].time_s >= ESTIMATE_MARK_S:
        marks = (*marks, newest)
    return EstimateTrack(marks, "", track.last_fault)


def _find_jump(
    config: GateConfig, before: Estimate, after: Estimate, passed_s: float
) -> str:
    """Returns the fault of a pose that the robot can't have reached, or ""."""
    moved = measure_motion(between(before.pose, after.pose))
    fastest = np.full(2, np.inf)
    if config.limits is not None:
        fastest = np.array(get_maximum_speeds(config.limits))
    allowed = np.array([config.estimate_position, config.estimate_heading])
    if (moved <= allowed + SLIP * fastest * passed_s).all():
        return ""
    path, turn = moved
    return f"it jumped by {path:.3g} m and {turn:.3g} rad in {passed_s:.2f} s"


def restart_track(state: GateState) -> EstimateTrack:
    """Returns a track that begins at the newest estimate, as at arming."""
    if state.estimate is None:
        return EstimateTrack()
    newest = EstimateMark(
        state.estimate_s, state.estimate.pose, state.estimate.covariance
    )
    return EstimateTrack((newest,))


def explain_unsteadiness(config: GateConfig, state: GateState, now: float) -> str:
    """Returns why the gate can't be armed yet if the estimate was recently faulty."""
    track = state.estimates
    if not track.last_fault or now - track.marks[0].time_s >= config.settle_s:
        return ""
    return (
        f"{ESTIMATE}: {track.last_fault}; wait for {config.settle_s:g} s, or {REMEDY}"
    )
