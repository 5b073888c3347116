"""Bands of predictions: how far they end from what happened, on data that a fit did not see."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri, stdtrit

from nics_drl_bridge.geometry import Array
from nics_drl_bridge.identify import motion, shooting
from nics_drl_bridge.identify.calibration import Calibration
from nics_drl_bridge.identify.drive import Drive
from nics_drl_bridge.identify.open_loop import SPACING_S, predict, windows
from nics_drl_bridge.identify.refine import readjusted
from nics_drl_bridge.recording.recording import Samples
from nics_drl_bridge.robot.taylor import TaylorModel

HORIZONS_S = (0.5, 1.0, 2.0, 5.0)
FOLDS = 5
EVALUATIONS = 8  # of the fit to all but one part, which starts at the fit to all
WITHIN, FEWEST = 95.0, 20  # percentage of the ends within a band, of so many at least

Known = tuple[TaylorModel, Calibration]


def bands_of(
    model: TaylorModel, calibration: Calibration, training: Drive, samples: Samples | None
) -> dict[float, float]:
    """Returns the distances [m] within which 95 % of predictions are expected to end, by horizon.

    Parts of the training part are predicted by the model, adjusted to the others. `samples` are
    those of a motion that was taken from the poses.
    """
    pose = training.recording.pose
    errors: dict[float, list[Array]] = {h: [] for h in HORIZONS_S}
    for block in np.array_split(np.arange(len(pose.t)), FOLDS):
        others = np.ones(len(pose.t), dtype=np.bool_)
        others[block] = False
        if samples is None:
            rest = training.part(replace(training.recording, pose=pose.rows(others)))
            found = readjusted(model, calibration, rest)
        else:
            at = pose.t[block[[0, -1]]] + calibration.clock_offset_s
            kept = (samples.t < at[0]) | (samples.t > at[1])
            found = _with_motion(model, calibration, training, samples, kept)
        if found is None:
            return {}
        part = training.part(replace(training.recording, pose=pose.rows(block)))
        for horizon, told in errors.items():
            chosen = windows(part, found[1], 0.0, part.duration_s, horizon, SPACING_S)
            if len(chosen.start_t):
                told.append(np.hypot(*(predict(*found, part, chosen) - chosen.end)[:, :2].T))
    every = {h: np.concatenate(told) for h, told in errors.items() if told}
    return {
        h: float(np.percentile(e, WITHIN)) * widened(training.duration_s / h)
        for h, e in every.items()
        if len(e) >= FEWEST
    }


def widened(count: float) -> float:
    """Returns by how much a band of so many independent predictions is to be wider (Student)."""
    count, tail = max(count, 3.0), 0.5 + WITHIN / 200.0
    return float(stdtrit(count - 1.0, tail) / ndtri(tail) * np.sqrt(1.0 + 1.0 / count))


def _with_motion(
    model: TaylorModel, calibration: Calibration, training: Drive, samples: Samples,
    kept: NDArray[np.bool_],
) -> Known:  # fmt: skip
    """Adjusts a model with a motion as state, and its inputs, to the rows that are kept (T,)."""
    problem = replace(
        motion.problem_of(training, calibration, samples), spacing_s=motion.CV_SPACING_S
    )
    _, defined = motion.by_definition(model, training.spec)
    free = (model.coefficients != 0.0) & ~defined
    inputs = motion.inputs_of(training, calibration)
    found = shooting.fitted(problem, model, free, inputs, kept, EVALUATIONS)
    count = 1 + 3 * len(calibration.inputs)
    calibration = replace(
        calibration, command_latency_s=float(found.values[0]),
        inputs=motion.curves_at(calibration.inputs, found.values[1:count]),
    )  # fmt: skip
    return found.model, motion.remounted(calibration, found) if problem.mounted else calibration
