"""Courses of X over windows that no coefficient of the body twist changes.

Where the state was measured, state and commands of a window are known before the twist is: the
model of the state's rates stays as it was fitted. Then one pass through a window gives the pose
at its end and the derivative by every coefficient of the twist.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge import geometry
from nics_drl_bridge.calibration.calibration import Calibration
from nics_drl_bridge.calibration.kernels import follow
from nics_drl_bridge.calibration.open_loop import Windows, from_measured_states
from nics_drl_bridge.kinematics.kernels import term_arrays
from nics_drl_bridge.kinematics.model import TaylorModel
from nics_drl_bridge.kinematics.recording import Recording
from nics_drl_bridge.kinematics.spec import RobotSpec

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Course:
    """X over windows, step by step.

    Attributes:
        chosen: the windows.
        x: (W, T, V + 1) X during each step, and a last entry of 1.
        steps: (W,) whole steps to the end of each window.
        share: (W,) of one more step.
    """

    chosen: Windows
    x: Array
    steps: NDArray[np.intp]
    share: Array


def course_of(
    model: TaylorModel,
    calibration: Calibration,
    recording: Recording,
    spec: RobotSpec,
    chosen: Windows,
) -> Course:
    """The course over windows, each from its own measured state."""
    states, command, steps, share = from_measured_states(
        model, calibration, recording, spec, chosen
    )[1:]
    ones = np.ones((*command.shape[:2], 1))
    x = np.concatenate([states[:, :-1], command, ones], axis=2)
    return Course(chosen, np.ascontiguousarray(x), steps, share)


def relative_ends(
    course: Course, model: TaylorModel, free: NDArray[np.bool_] | None = None
) -> tuple[Array, Array]:
    """Poses at the ends relative to the starts, and how coefficients move them.

    Args:
        course: of the windows.
        model: its body twist is followed.
        free: (D, K) coefficients to differentiate by, even where they are zero.

    Returns:
        (W, 3) with unwrapped headings, and (W, 3, P).
    """
    asked = np.zeros(model.coefficients.shape, dtype=np.bool_) if free is None else free
    used = (model.coefficients != 0.0) | asked
    used[3:] = False
    dofs, places = np.nonzero(used)
    _, _, factors, count = term_arrays(replace(model, coefficients=used.astype(np.float64)))
    terms = dofs.astype(np.int64), model.coefficients[dofs, places], factors, count
    moving = np.flatnonzero(asked[dofs, places]).astype(np.int64)
    ends = np.zeros((len(course.steps), 3))
    moved = np.zeros((len(course.steps), 3, len(moving)))
    follow(ends, moved, course.x, course.steps, course.share, terms, moving, model.dt)
    return ends, moved


def tracked_ends(course: Course, calibration: Calibration, ends: Array) -> Array:
    """Poses (W, 3) of the tracked body where `base_link` has moved by relative poses (W, 3)."""
    base = calibration.to_base(course.chosen.start)
    return calibration.to_tracked(geometry.compose(base, ends))


def tracked_slopes(course: Course, calibration: Calibration, ends: Array, moved: Array) -> Array:
    """Derivatives (W, 3, P) of `tracked_ends`, from those of the relative poses."""
    heading = calibration.to_base(course.chosen.start)[:, 2]
    arm = geometry.rotate(np.broadcast_to(calibration.mounting[:2], (len(ends), 2)), ends[:, 2])
    across = np.stack([-arm[:, 1], arm[:, 0]], axis=1)[:, :, None]
    inside = moved[:, :2] + across * moved[:, 2:]
    c, s = np.cos(heading)[:, None], np.sin(heading)[:, None]
    x, y = inside[:, 0], inside[:, 1]
    return np.stack([c * x - s * y, s * x + c * y, moved[:, 2]], axis=1)
