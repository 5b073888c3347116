"""Judgement of a model: its predictions of unseen data, beside those of yardsticks."""

from collections.abc import Iterator

import numpy as np

from nics_drl_bridge import geometry
from nics_drl_bridge.errors import RecordingError
from nics_drl_bridge.geometry import Array
from nics_drl_bridge.identify.calibration import Calibration
from nics_drl_bridge.identify.drive import Drive
from nics_drl_bridge.identify.open_loop import HORIZON_S, SPACING_S, Windows, predict, windows
from nics_drl_bridge.identify.yardstick import (
    Yardstick,
    fit_yardstick,
    kept_twist,
    twists_before,
)  # fmt: skip
from nics_drl_bridge.robot.taylor import EndErrors, HorizonErrors, TaylorModel

HORIZONS_S = (0.5, 1.0, 2.0, HORIZON_S, 10.0)


def judged(
    model: TaylorModel, calibration: Calibration, drive: Drive, bands: dict[float, float]
) -> tuple[HorizonErrors, ...]:
    """Compares predictions of the held-out part, by the horizons that fit into it.

    `bands` are distances within which 95 % of the ends are expected [m], by horizon [s].
    """
    begin, told = drive.settings.train_until_s, []
    textbook = None if calibration.is_exact else textbook_of(drive, calibration)
    for horizon in HORIZONS_S:
        chosen = windows(drive, calibration, begin, drive.duration_s, horizon, SPACING_S)
        if not len(chosen.start_t):
            break
        ends = predict(model, calibration, drive, chosen)
        twist = twists_before(drive, chosen.start_t)
        band, far = bands.get(horizon), np.hypot(*(ends - chosen.end)[:, :2].T)
        told.append(HorizonErrors(
            horizon, len(far), float(chosen.path.mean()), errors_of_ends(ends, chosen),
            errors_of_ends(kept_twist(drive, chosen, twist), chosen),
            None if textbook is None
            else errors_of_ends(textbook.predict(drive, chosen, twist), chosen),
            band, None if band is None else float((far <= band).mean()),
        ))  # fmt: skip
    return tuple(told)


def textbook_of(drive: Drive, calibration: Calibration) -> Yardstick | None:
    """Fits the textbook to the training part; None if that is too short."""
    try:
        return fit_yardstick(drive, drive.settings.train_until_s, calibration.clock_offset_s)
    except RecordingError:
        return None


def errors_of_ends(ends: Array, chosen: Windows) -> EndErrors:
    """Returns the mean errors of predicted ends (W, 3)."""
    apart = ends - chosen.end
    heading = np.abs(geometry.wrap_angle(apart[:, 2])).mean()
    return EndErrors(float(np.hypot(*apart[:, :2].T).mean()), float(heading))


def shortfall(judgement: tuple[HorizonErrors, ...]) -> Iterator[str]:
    """Says which yardsticks a model does not beat after 5 s."""
    for at in (each for each in judgement if each.horizon_s == HORIZON_S):
        named = {"the fitted textbook": at.textbook, "a robot that keeps its twist": at.kept_twist}
        better = {name: errors.position_m for name, errors in named.items() if errors is not None}
        better = {name: m for name, m in better.items() if not at.model.position_m < m}
        if better:
            off = f"end {at.model.position_m:.3g} m off after {at.horizon_s:g} s"
            those = " and ".join(f"those of {name} {error:.3g} m" for name, error in better.items())
            finding = f"The model does not beat {' and '.join(better)}"
            yield f"{finding}: on unseen data its predictions {off}, {those}."
