"""Corrects odometry's heading by a recorded gyro, and states what a model's errors refer to.

Odometry's heading is only as good as the grip of the wheels, and those of a skid-steer slip in
every turn. Its displacements along the gyro's heading are the better pose to learn from.
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from nics_drl_bridge.identify.verdict import Mistake
from nics_drl_bridge.recording.heading import (
    CLEARLY,
    WINDOW_S,
    Turning,
    compare_turning,
    turn_by_gyro,
)
from nics_drl_bridge.recording.recording import Recording

LEAST_COVERED = 0.9  # minimum fraction of a drive that the gyro must cover
# deviation from 1 of the ratio of turns, above which the gyro does not match a tracker
UNLIKE_TRACKER = 0.1


def correct_heading_by_gyro(recording: Recording) -> Recording:
    """Returns a recording whose odometry turns by the gyro, if one was recorded and the two differ.

    `gyro` then holds the comparison. Other poses are compared but not changed; `repairs` gets a
    sentence on the finding.
    """
    if recording.imu is None or recording.gyro is not None:
        return recording
    if recording.imu.clock != recording.pose.clock:
        sentence = "The gyro is on another clock than the pose, so it was not compared with it."
        return replace(recording, repairs=(*recording.repairs, sentence))
    pose = recording.pose
    gyro_t = recording.imu.t
    yaw_rate = recording.imu.values[:, 2]
    turning = compare_turning(pose.t, pose.values, gyro_t, yaw_rate)
    if turning is None or not turning.compared:
        return recording
    sentences = tuple(_describe_turning(recording, turning))
    if not _is_credible(recording, turning):
        return replace(recording, repairs=(*recording.repairs, *sentences))
    if recording.measured_by == "odometry" and turning.contradicts:
        turned, covered = turn_by_gyro(pose.t, pose.values, gyro_t, yaw_rate, turning)
        if covered < LEAST_COVERED:
            sentences = (
                f"The gyro covers only {covered:.0%} of the drive, so the heading is that of "
                "odometry, which it contradicts; record its topic without gaps.",
            )
            return replace(recording, repairs=(*recording.repairs, *sentences))
        pose = replace(pose, values=turned)
    return replace(
        recording, pose=pose, gyro=turning, repairs=(*recording.repairs, *sentences)
    )


def describe_reference(recording: Recording) -> str:
    """States what the errors of a model learnt from a recording are relative to."""
    by = recording.measured_by
    turning = recording.gyro
    if by == "truth":
        return ""
    if by == "tracker":
        return "That is relative to motion capture or a localiser."
    if by == "odometry" and turning is not None:
        if turning.contradicts:
            return (
                "That is relative to odometry with its heading from the gyro, which contradicts "
                f"odometry's own by {turning.apart:.2g} rad in {WINDOW_S:g} s; nothing here shows "
                "how far the path drifts."
            )
        return (
            "That is relative to odometry, whose heading the gyro confirms; nothing here shows "
            "how far the path drifts."
        )
    if by == "odometry":
        return "That is relative to odometry; nothing here shows how far that drifts."
    return (
        "That is relative to the recorded pose; nothing here shows whether it is odometry, which "
        "drifts."
    )


def _is_credible(recording: Recording, turning: Turning) -> bool:
    """True if the gyro is credible, given this pose."""
    if not turning.plausible:
        return False
    if recording.measured_by == "odometry":
        return True
    return abs(turning.scale - 1.0) < UNLIKE_TRACKER or not turning.contradicts


def _describe_turning(recording: Recording, turning: Turning) -> Iterator[str]:
    """Yields a sentence on how gyro and pose turn."""
    if turning.mirrored:
        yield Mistake(
            "The gyro turns against the heading: one of them is mirrored, and the gyro was not "
            "used. Counter-clockwise is positive; write `scale: -1` beside its `from:`, or fix "
            "its driver."
        )
        return
    if turning.in_degrees:
        yield Mistake(
            f"The gyro turns {1.0 / turning.scale:.3g} times as far as the heading, as degrees "
            "would, and was not used: write `unit: deg/s` beside its `from:`, or fix its driver."
        )
        return
    if not turning.plausible:
        yield (
            "The gyro does not turn as the heading does (correlation "
            f"{turning.alike:.2f}), and was not used: find out which of them is wrong."
        )
        return
    if turning.rest_s > 0.0:
        where = f"over {turning.rest_s:.1f} s at rest"
    else:
        where = "while driving"
    bias = (
        f"bias of {turning.bias:.4f} +- {turning.bias_std:.2g} rad/s was found {where}"
    )
    agrees = recording.measured_by == "tracker" and _is_credible(recording, turning)
    if agrees or not turning.contradicts:
        yield (
            f"The gyro confirms the heading: they differ by {turning.apart:.2g} rad in "
            f"{WINDOW_S:g} s; its {bias}."
        )
        return
    differ = f"by {turning.apart:.2g} rad in {WINDOW_S:g} s"
    if recording.measured_by == "odometry":
        slip = ""
        if abs(turning.scale - 1.0) > CLEARLY * turning.scale_std:
            slip = f": it turns {_format_factor(turning)} times as far, as wheels do that slip"
        yield (
            f"The gyro contradicts odometry {differ}{slip}. The model was learnt from the wheels' "
            f"displacements along the heading of the gyro, whose {bias}."
        )
        return
    times = f"{_format_factor(turning)} times as far"
    if recording.measured_by == "":
        yield (
            f"The gyro contradicts the pose {differ}: the pose turns {times}. If it is odometry, "
            "write `measured_by: odometry` below `pose:`, and the gyro will turn it."
        )
        return
    yield (
        f"The gyro contradicts the tracker {differ}: the tracker turns {times}; check the gyro's "
        "scale and mounting."
    )


def _format_factor(turning: Turning) -> str:
    digits = max(2, int(np.ceil(-np.log10(max(turning.scale_std, 1e-4)))))
    return f"{turning.scale:.{digits}f} +- {turning.scale_std:.1g}"
