"""What may move when a model is refined, and what is fixed by definition or by measurement."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.calibration.calibration import Calibration
from nics_drl_bridge.kinematics.model import TaylorModel
from nics_drl_bridge.kinematics.spec import RobotSpec


def free_coefficients(
    model: TaylorModel, calibration: Calibration, spec: RobotSpec
) -> NDArray[np.bool_]:
    """Which coefficients (D, K) may move: kept, and not fixed by what a state is.

    An inferred speed is by definition the speed along the travel, so that vx = 1 speed; its
    lag stays where the wheels showed it.
    """
    free = model.coefficients != 0.0
    if not calibration.responses:
        free[3:] = False  # the rates of a measured state were fitted to that state itself
    for i, response in enumerate(calibration.responses):
        alone = linear_term(model, spec, response.state)
        if alone is None:
            continue
        if model.coefficients[0, alone] == 1.0:
            free[0, alone] = False
        else:  # another scale of this state would serve as well: its gain stays
            free[3 + i, linear_term(model, spec, response.command)] = False
        if lag_is_measured(calibration):
            free[3 + i, alone] = False
    return np.asarray(free)


def lag_is_measured(calibration: Calibration) -> bool:
    """Offset and latency are both known only where the wheels showed the response."""
    return {"clock_offset_s", "command_latency_s"} <= set(calibration.uncertainty)


def linear_term(model: TaylorModel, spec: RobotSpec, name: str) -> int | None:
    """Column of the term that is one variable alone."""
    wanted = np.array([v == name for v in spec.variable_names], dtype=np.int64)
    hits = np.flatnonzero((model.powers == wanted).all(axis=1))
    return int(hits[0]) if len(hits) else None


def may_turn(calibration: Calibration, spec: RobotSpec) -> bool:
    """Whether the rotation may move.

    It is known by the direction in which a robot can't move. One that moves in every direction
    would be described as well in any other frame, with other coefficients.
    """
    everywhere = any(command.cmd_vel == "linear.y" for command in spec.command)
    return "rotation_rad" in calibration.uncertainty and not calibration.is_exact and not everywhere


def free_time(calibration: Calibration) -> str | None:
    """The time that may move: the clock offset, else the latency; none that the state showed."""
    if not calibration.responses:
        return None
    if "clock_offset_s" in calibration.uncertainty:
        return "clock_offset_s"
    if calibration.command_latency_s > 0.0:
        return "command_latency_s"
    return None
