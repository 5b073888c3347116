"""The picture of the noise: of each sensor, and how far the robot drifts from its model."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from nics_drl_bridge.calibration.identify import Identified
from nics_drl_bridge.calibration.noise import pose_residual
from nics_drl_bridge.calibration.noise_model import Level
from nics_drl_bridge.calibration.odometry import odometry_residual
from nics_drl_bridge.calibration.unexplained import drift_growth
from nics_drl_bridge.kinematics.spec import RobotSpec
from nics_drl_bridge.report.drawing import DARK, MEASURED, MODEL, png

Array = NDArray[np.float64]

BINS = 60
REACH = 5.0
"""Histograms end at this many standard deviations."""


def noise(spec: RobotSpec, identified: Identified) -> bytes | None:
    """Histograms of what was measured beside the normal curve, and the growth of the drift.

    None if the recording is exact to the last digit.
    """
    levels, panels = identified.noise, []
    pose = pose_residual(identified.recording.pose)
    if pose is not None:
        panels += [("pose position", levels.pose_position, pose[:, :2].ravel())]
        panels += [("pose heading", levels.pose_heading, pose[:, 2])]
    odometry = odometry_residual(
        identified.recording, identified.calibration, identified.model, identified.samples
    )
    if odometry is not None:
        panels += [("odometry, linear", levels.odom_linear, odometry[:, 0])]
        panels += [("odometry, angular", levels.odom_angular, odometry[:, 2])]
    panels = [p for p in panels if p[1].measured and p[1].std > 0.0]
    grown = drift_growth(identified.recording, identified.calibration, identified.model, spec)
    drifts = grown is not None and levels.position_drift.measured and bool(grown[1].max() > 1e-9)
    if not panels and not drifts:
        return None
    count = len(panels) + 2 * drifts
    columns = 2 if count == 4 else min(count, 3)
    rows = -(-count // columns)
    figure = Figure(figsize=(4.3 * columns, 3.4 * rows), layout="constrained")
    grid = list(figure.subplots(rows, columns, squeeze=False).ravel())
    for axes, (name, level, rest) in zip(grid, panels, strict=False):
        _histogram(axes, name, level, rest)
    if drifts and grown is not None:
        horizon, position, heading = grown
        rows_ = (
            ("position", levels.position_drift, position, "m"),
            ("heading", levels.heading_drift, heading, "rad"),
        )
        for axes, row in zip(grid[len(panels) :], rows_, strict=False):
            _growth(axes, horizon, *row)
    for axes in grid[count:]:
        axes.set_axis_off()
    return png(figure)


def _histogram(axes: Axes, name: str, level: Level, rest: Array) -> None:
    edges = np.linspace(-REACH * level.std, REACH * level.std, BINS + 1)
    axes.hist(rest - np.median(rest), list(edges), density=True, color=MEASURED, alpha=0.55)
    normal = np.exp(-0.5 * (edges / level.std) ** 2) / (level.std * np.sqrt(2.0 * np.pi))
    axes.plot(edges, normal, "--", color=MODEL)
    axes.xaxis.set_major_locator(MaxNLocator(5))
    axes.set_xlabel(f"residual [{level.unit}]")
    axes.set_ylabel("density")
    axes.set_title(f"noise of the {name}\n{_value(level)}", fontsize=10, color=DARK)


def _growth(axes: Axes, horizon: Array, name: str, level: Level, error: Array, unit: str) -> None:
    axes.plot(horizon, error, "o-", color=MEASURED, markersize=4, label="error of the prediction")
    axes.plot(horizon, level.std * np.sqrt(horizon), "--", color=MODEL, label="the drift alone")
    axes.set_xlabel("horizon [s]")
    axes.set_ylabel(f"root mean square [{unit}]")
    axes.set_title(f"drift of the {name}\n{_value(level)}", fontsize=10, color=DARK)
    axes.grid(alpha=0.3)
    axes.legend(frameon=False, fontsize=9)


def _value(level: Level) -> str:
    spread = "" if level.uncertainty is None else f" ± {level.uncertainty:.1g}"
    return f"{level.std:.3g}{spread} {level.unit}"
