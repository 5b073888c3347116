"""Errors of a model on each of the recordings that it was jointly fitted to."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from nics_drl_bridge.identify import open_loop
from nics_drl_bridge.identify.calibration import Calibration
from nics_drl_bridge.identify.drive import Drive
from nics_drl_bridge.robot.taylor import TaylorModel

HORIZONS_S = (5.0, 2.0, 1.0, 0.5)
FEWEST = 5  # minimum number of windows per recording
SPACING_S = 0.5
# ratio to the errors of the other recordings from which one is reported as off
ALONE = 2.5
LEAST_SHARE = 0.02  # fraction of the path below which errors are ignored


class Alone(str):
    """A sentence on a single recording with large errors."""

    __slots__ = ()


class ErrorOfRecording(NamedTuple):
    """Mean errors of predictions within one recording."""

    source: str
    horizon_s: float
    position_m: float
    path_m: float  # mean length of the measured path

    @property
    def share(self) -> float:
        """Error as a fraction of the path."""
        return self.position_m / max(self.path_m, 1e-9)


def errors_by_recording(
    model: TaylorModel, calibration: Calibration, drive: Drive
) -> list[ErrorOfRecording]:
    """Predicts each recording of a drive over the longest horizon that fits into all of them."""
    sources = [episode.source for episode in drive.recording.episodes]
    for horizon in HORIZONS_S:
        chosen = open_loop.windows(
            drive, calibration, 0.0, drive.duration_s, horizon, SPACING_S
        )
        if not len(chosen.start_t):
            continue
        sources_of_windows = np.array(sources)[
            drive.recording.episode_at(chosen.start_t)
        ]
        if any((sources_of_windows == source).sum() < FEWEST for source in sources):
            continue
        ends = open_loop.predict(model, calibration, drive, chosen)
        error = np.hypot(*(ends - chosen.end)[:, :2].T)
        return [
            ErrorOfRecording(
                source,
                horizon,
                float(error[sources_of_windows == source].mean()),
                float(chosen.path[sources_of_windows == source].mean()),
            )
            for source in dict.fromkeys(sources)
        ]
    return []


def about_recordings(
    model: TaylorModel, calibration: Calibration, drive: Drive
) -> Iterator[str]:
    """Yields a sentence on the errors by recording, and one per recording that alone is off."""
    if not drive.recording.episodes:
        return
    errors = errors_by_recording(model, calibration, drive)
    if len(errors) < 2:
        return
    for error in errors:
        others = [another for another in errors if another is not error]
        usual = float(np.median([another.share for another in others]))
        if error.share > max(ALONE * usual, LEAST_SHARE) and np.isfinite(usual):
            ends = f"end {error.position_m:.3g} m off after {error.horizon_s:g} s"
            shares = f"{error.share:.1%} of the path, those of the others {usual:.1%}"
            finding = f"{error.source} alone is off: its predictions {ends} ({shares})"
            causes = "its clocks, its mounting and the floor it was driven on"
            yield Alone(f"{finding}; check {causes}, or leave it out.")
    listed = ", ".join(f"{error.source} {error.share:.1%}" for error in errors)
    yield f"By recording, errors after {errors[0].horizon_s:g} s as shares of the path: {listed}."
