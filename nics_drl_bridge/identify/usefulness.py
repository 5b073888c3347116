"""Usefulness of a model: its predictions of unseen data against those of a standing robot."""

from __future__ import annotations

import numpy as np

from nics_drl_bridge.identify.fit import ORDER
from nics_drl_bridge.identify.identify import Identified
from nics_drl_bridge.identify.verdict import FAR_OFF
from nics_drl_bridge.recording.recording import Recording
from nics_drl_bridge.robot.spec import RobotSpec

MOST_LEFT = 0.5
"""Share of the error of standing still above which a model is hardly better."""
COARSE = 2.0 / 3.0
"""A state that changes by this share of its range between two rows is sampled too coarsely."""
ENDS = (1.0, 99.0)
"""Percentiles that bound the range of a state."""


def is_useless(error: float, standing: float, path: float, radius: float) -> bool:
    """True if predictions are hardly better than assuming that the robot stands still.

    Persistence is the usual baseline of a forecast (Murphy: Skill scores based on the mean square
    error, Monthly Weather Review, 1988). A robot that drives in circles or turns on the spot
    returns to its start: there the path and the robot's size set the scale.

    Args:
        error: median position error of the predictions [m]; NaN or inf if they diverge.
        standing: median position error on the same windows if the robot stood still [m].
        path: mean length of the measured path [m].
        radius: of the robot [m].
    """
    return not error <= max(MOST_LEFT * standing, FAR_OFF * path, radius)


def why_useless(identified: Identified, spec: RobotSpec, order: int = ORDER) -> str:
    """Returns one sentence on why a model is useless; empty if it is useful or untested.

    The median counts: a single permanent jump of the pose spoils only some of the predictions.
    """
    held_out, recording = identified.held_out, identified.recording
    if held_out is None:
        return ""
    error, standing = held_out.median_position_error_m, held_out.median_displacement_m
    if not np.isfinite(held_out.mean_position_error_m):
        error = np.inf
    if not is_useless(error, standing, held_out.mean_path_m, spec.footprint_radius):
        return ""
    return (
        f"{recording.source}: the fitted model is of no use: on unseen data its predictions "
        f"{_end(error)} after {held_out.horizon_s:g} s and a path of {held_out.mean_path_m:.2f} m, "
        f"where a robot that stood still would be {standing:.2f} m off; "
        f"{_suspicion(identified, spec, order)}."
    )


def _end(error: float) -> str:
    return f"end {error:.3g} m off" if np.isfinite(error) else "have run away"


def _suspicion(identified: Identified, spec: RobotSpec, order: int) -> str:
    """Returns the likely cause of a bad fit, and its remedy."""
    recording, unmoved = identified.recording, identified.fit.unmoved
    coarsest = max(_steps(recording, spec, unmoved), default=(0.0, ""))
    rows = recording.pose if recording.state is None else recording.state
    apart = f"{np.median(np.diff(rows.t)):.2g} s apart"
    if coarsest[0] > COARSE:
        return (
            f"{coarsest[1]} changes by {coarsest[0]:.0%} of its range between rows that are "
            f"{apart}, so record at a higher rate"
        )
    if unmoved:
        return (
            f"{', '.join(unmoved)} never moved in its first {identified.train_until_s:.0f} s, from "
            "which it is learnt, so change it from the beginning on"
        )
    if identified.alpha != "auto" or order < ORDER:
        return f"it may lack terms, so leave the order at {ORDER} and alpha at `auto`"
    return (
        "the recording does not show why, so make sure that nothing held the robot up, that it got "
        f"each command, that its pose did not jump and that rows {apart} show how it responds, and "
        "record anew"
    )


def _steps(
    recording: Recording, spec: RobotSpec, unmoved: tuple[str, ...]
) -> list[tuple[float, str]]:
    """Returns the step between rows and the name of each measured state that moved.

    The step is the 99th percentile, as a share of the state's range.
    """
    if recording.state is None:
        return []
    moved = [i for i, v in enumerate(spec.state) if v.name not in unmoved]
    values = recording.state.values[:, moved]
    spread = np.ptp(np.percentile(values, ENDS, axis=0), axis=0)
    steps = np.percentile(np.abs(np.diff(values, axis=0)), ENDS[1], axis=0)
    return [
        (float(step / size), spec.state[i].name)
        for i, step, size in zip(moved, steps, spread, strict=True)
        if size > 0.0
    ]
