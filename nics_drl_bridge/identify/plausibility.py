"""Plausibility: detects wrong axes and units, which no calibration can repair."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge import geometry
from nics_drl_bridge.errors import RecordingError
from nics_drl_bridge.identify import repair
from nics_drl_bridge.identify.least_squares import unexplained
from nics_drl_bridge.identify.signals import interval_means
from nics_drl_bridge.recording.recording import Recording, Samples, Stream
from nics_drl_bridge.robot.spec import RobotSpec, Variable

Array = NDArray[np.float64]

WRONG_UNIT = 5.0
"""Values this many times the limit are in another unit: degrees are 57, rpm 9.5 times larger."""
UNIT_PERCENTILE = 75.0
TRAVEL_SHARE = 0.1
"""Directions of travel are measured over at least this share of the footprint's radius."""
MIN_DIRECTIONS = 30
MIN_TURN = 1.0
"""A reversed axis does not show in a drive that turned by less than this [rad]."""
CONSISTENT, INCONSISTENT = 0.9, 0.6
"""Consistency of the direction of travel in the body frame; 1 is perfect."""
MIRRORED = -0.5
"""Correlation of yaw rate and steering below which the robot turns the wrong way."""


def check_units(recording: Recording, spec: RobotSpec) -> None:
    """Refuses states and commands that only another unit can explain.

    Raises:
        RecordingError: a variable is too large; with its value and its limit.
    """
    streams: list[tuple[Stream, tuple[Variable, ...]]] = [(recording.command, spec.command)]
    if recording.state is not None:
        streams.append((recording.state, spec.state))
    for stream, variables in streams:
        sizes = np.percentile(np.abs(stream.values), UNIT_PERCENTILE, axis=0)
        for variable, size in zip(variables, sizes, strict=True):
            limit = max(abs(variable.min), abs(variable.max))
            if size > WRONG_UNIT * limit:
                raise RecordingError(
                    f"{recording.source}: {variable.name} is {size:.4g} and more where its limit "
                    f"is {limit:g} {variable.unit}; it must be in {variable.unit} (degrees, "
                    "millimetres or revolutions per minute look like this)."
                )


def check_axes(recording: Recording, spec: RobotSpec) -> None:
    """Refuses poses whose heading turns against the direction of travel.

    In its own frame, a robot without sideways motion always travels in the same direction; that
    of an omnidirectional robot depends on its state. If this is true only with the heading
    mirrored, then x, y or heading is reversed.

    Raises:
        RecordingError: one axis of the pose is reversed.
    """
    t, pose = _far_apart(recording.pose, TRAVEL_SHARE * spec.footprint_radius)
    if len(t) < MIN_DIRECTIONS or np.ptp(np.unwrap(pose[:, 2])) < MIN_TURN:
        return
    other = pose * np.array([1.0, 1.0, -1.0])
    if not spec.moves_sideways:
        as_given, mirrored = _steadiness(pose), _steadiness(other)
    elif recording.state is not None and recording.state.clock == recording.pose.clock:
        as_given, mirrored = (_explained(t, p, recording.state) for p in (pose, other))
    else:
        return
    if as_given < INCONSISTENT and mirrored > CONSISTENT:
        raise RecordingError(
            f"{recording.source}: pose: the heading turns one way and the path the other; one of "
            "x, y and heading is reversed: they must be x forward, y left, heading "
            "counter-clockwise (REP-103)."
        )


def _far_apart(pose: Stream, distance: float) -> tuple[Array, Array]:
    """Returns stamps (n,) and poses (n, 3) of a stream, about `distance` [m] apart."""
    best = repair.newest(pose.t, repair.find_bursts(pose.t))
    t, values = pose.t[best], pose.values[best]
    path = np.append(0.0, np.cumsum(np.hypot(*np.diff(values[:, :2], axis=0).T)))
    marks = np.arange(0.0, path[-1], max(distance, 1e-3))
    chosen = np.unique(np.searchsorted(path, marks))
    return t[chosen], values[chosen]


def _steadiness(pose: Array) -> float:
    """Returns the constancy (0 to 1) of the body-frame axis of travel, forward or backward."""
    moved = geometry.log(geometry.between(pose[:-1], pose[1:]))[:, :2]
    size = np.hypot(*moved.T)
    course = np.exp(2j * np.arctan2(moved[:, 1], moved[:, 0]))
    return float(np.abs((size * course).sum()) / max(float(size.sum()), 1e-12))


def _explained(t: Array, pose: Array, state: Stream) -> float:
    """Returns the share (0 to 1) of the velocity between poses (n, 3) that the state explains.

    The body velocity is linear in the state.
    """
    span = np.diff(t)
    keep = span > 0.0
    velocity = geometry.log(geometry.between(pose[:-1], pose[1:]))[keep, :2] / span[keep, None]
    means = interval_means(state.t, state.values, t[:-1][keep], t[1:][keep])
    return 1.0 - float((unexplained(means, velocity) ** 2).mean())


def mirror_note(samples: Samples, spec: RobotSpec) -> tuple[str, ...]:
    """Returns a sentence if the robot turns right when commanded to turn left."""
    for i, command in enumerate(spec.command, start=len(spec.state)):
        if not command.turns:
            continue
        turn, wanted = samples.dq[:, 2], samples.x[:, i]
        if command.steers:
            wanted = wanted * np.sign(samples.dq[:, 0])
        if min(turn.std(), wanted.std()) > 1e-3 and np.corrcoef(turn, wanted)[0, 1] < MIRRORED:
            return (
                f"The robot turns right where {command.name} is positive: the recording is a "
                "mirror image (y and heading reversed), or the sign of the command is; the model "
                "moves as recorded.",
            )
    return ()
