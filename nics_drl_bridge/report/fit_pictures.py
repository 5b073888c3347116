"""Pictures of a fit: its data, its predictions, and the value of each term."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from nics_drl_bridge.files import write_bytes
from nics_drl_bridge.identify.identify import Identified
from nics_drl_bridge.identify.open_loop import HORIZON_S, Windows, predict, windows
from nics_drl_bridge.identify.signals import held
from nics_drl_bridge.recording.recording import Samples
from nics_drl_bridge.report.calibration_pictures import calibration_pictures
from nics_drl_bridge.report.page import DARK, MEASURED, MODEL, OTHER, png
from nics_drl_bridge.robot.spec import RobotSpec

Array = NDArray[np.float64]

SHOWN_S = 8.0
PATHS, POINTS = 6, 40
SETTLED_S = 1.0
LEAST_SHARE = 1e-12
LEAST_RATE = 1e-6


def write_pictures(spec: RobotSpec, identified: Identified, folder: str | Path) -> tuple[Path, ...]:
    """Writes the pictures of a fit and of its calibration as PNG files, and returns these."""
    drawn = {**fit_pictures(spec, identified), **calibration_pictures(spec, identified)}
    files = {Path(folder) / f"{name}.png": picture for name, picture in drawn.items()}
    for file, picture in files.items():
        write_bytes(file, picture)
    return tuple(files)


def fit_pictures(spec: RobotSpec, identified: Identified) -> dict[str, bytes]:
    """The pictures of a fit by name, each a PNG.

    `accuracy` is always included; `paths` and `residuals` if data was held out from the fit,
    `alignment` if a command changed.
    """
    pictures = {"accuracy": accuracy(identified)}
    if identified.held_out is not None:
        pictures["paths"] = held_out_paths(identified)
    if identified.unseen is not None and np.abs(identified.unseen.dq).max() > LEAST_RATE:
        pictures["residuals"] = residuals(identified, identified.unseen)
    if (np.ptp(identified.recording.command.values, axis=0) > 0.0).any():
        pictures["alignment"] = alignment(spec, identified)
    return pictures


def accuracy(identified: Identified) -> bytes:
    """Draws the cross-validated error over the number of terms, a line per degree of freedom."""
    figure = Figure(figsize=(7.5, 4.5), layout="constrained")
    axes = figure.subplots()
    circle: dict[str, Any] = {"markersize": 10, "fillstyle": "none"}
    for n, curve in enumerate(identified.fit.curves):
        share = np.maximum(curve.share, LEAST_SHARE)
        line = axes.plot(share, marker=".", color=f"C{n}", label=curve.dof)[0]
        axes.plot(curve.kept, share[curve.kept], "o", color=line.get_color(), **circle)
    axes.plot([], [], "o", color=DARK, label="kept", **circle)
    axes.set_yscale("log")
    axes.set_xlabel("number of terms, largest standardised coefficient first (Eq. 2)")
    axes.set_ylabel("cross-validated error / size of the rates")
    longest = max((len(curve.error) for curve in identified.fit.curves), default=2)
    axes.set_xlim(-0.3, longest - 0.7)
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.grid(alpha=0.3)
    axes.legend(frameon=False, fontsize=9)
    return png(figure)


def held_out_paths(identified: Identified) -> bytes:
    """Draws open-loop predictions on unseen data and the measured paths, from the same start."""
    drive, calibration, pose = identified.drive, identified.calibration, identified.recording.pose
    free = max(drive.duration_s - identified.train_until_s - HORIZON_S, 0.0)
    chosen = windows(
        drive, calibration, identified.train_until_s, drive.duration_s, HORIZON_S, free / PATHS
    )
    predicted = _predicted(identified, chosen)
    count = min(len(predicted), PATHS)
    figure = Figure(figsize=(3.4 * min(count, 3), 3.4 * -(-count // 3) + 0.4), layout="constrained")
    grid = figure.subplots(-(-count // 3), min(count, 3), squeeze=False).ravel()
    for n, (axes, path) in enumerate(zip(grid, predicted, strict=False)):
        during = (pose.t >= chosen.start_t[n]) & (pose.t <= chosen.end_t[n])
        truth = pose.values[during]
        axes.plot(*truth[:, :2].T, color=MEASURED, linewidth=3.5, alpha=0.55, label="measured")
        axes.plot(*path[:, :2].T, color=MODEL, linestyle="--", label="predicted")
        axes.plot(*truth[0, :2], "o", color=DARK, markersize=5, label="start")
        axes.set_aspect("equal", adjustable="datalim")
        apart = float(np.hypot(*(path[-1] - chosen.end[n])[:2]))
        axes.set_title(f"{apart:.3f} m apart after {HORIZON_S:g} s", fontsize=10)
        axes.set(xlabel="x [m]", ylabel="y [m]")
    for axes in grid[count:]:
        axes.set_axis_off()
    return png(figure, grid[0])


def residuals(identified: Identified, unseen: Samples) -> bytes:
    """Draws rates on unseen data, those of the model, and the residuals, over time."""
    model = identified.model
    predicted, t = model.rates(unseen.x), unseen.t - unseen.t[0]
    shown = t < SHOWN_S
    moving = np.flatnonzero(np.abs(unseen.dq).max(axis=0) > LEAST_RATE)
    figure = Figure(figsize=(9.0, 1.7 * len(moving) + 0.6), layout="constrained")
    grid = figure.subplots(len(moving), 1, sharex=True, squeeze=False).ravel()
    for d, axes in zip(map(int, moving), grid, strict=True):
        rest = unseen.dq[:, d] - predicted[:, d]
        axes.plot(t[shown], unseen.dq[shown, d], color=MEASURED, linewidth=2.5, alpha=0.55)
        axes.plot(t[shown], predicted[shown, d], color=MODEL, linestyle="--", linewidth=1.2)
        axes.plot(t[shown], rest[shown], color=OTHER, linewidth=0.8)
        axes.set_ylabel(f"{model.dofs[d]} [{model.dof_units[d]}]", fontsize=8)
        axes.grid(alpha=0.3)
    grid[-1].set_xlabel("time since the end of the training part [s]")
    for color, label in ((MEASURED, "measured"), (MODEL, "model"), (OTHER, "residual")):
        grid[0].plot([], [], color=color, label=label)
    return png(figure, grid[0])


def alignment(spec: RobotSpec, identified: Identified) -> bytes:
    """Draws each changing command, as stamped and as it takes effect, with its main response."""
    samples, calibration = identified.samples, identified.calibration
    command = identified.recording.command
    moved = np.flatnonzero(np.ptp(command.values, axis=0) > 0.0)
    figure = Figure(figsize=(9.0, 2.5 * len(moved) + 0.6), layout="constrained")
    grid = figure.subplots(len(moved), 1, sharex=True, squeeze=False).ravel()
    begin = samples.t[0] + SETTLED_S
    shown = (samples.t >= begin) & (samples.t < begin + SHOWN_S)
    t = samples.t[shown]
    for axes, c in zip(grid, moved, strict=True):
        name, unit = spec.command[c].name, spec.command[c].unit
        latency = calibration.command_latency_s
        for late, style, label in ((0.0, ":", "as stamped"), (latency, "-", "as it takes effect")):
            value = held(command, spec, t - late, t - late + samples.dt)[:, c]
            axes.plot(t - begin, value, style, color=MODEL, linewidth=1.4, label=label)
        axes.set_ylabel(f"{name} [{unit}]", fontsize=9, color=MODEL)
        _response(axes, samples, shown, len(spec.state) + int(c), identified)
    grid[-1].set_xlabel("time on the commands' clock [s]")
    grid[0].plot([], [], color=MEASURED, linewidth=2.5, alpha=0.55, label="response")
    title = f"clock offset {calibration.clock_offset_s:.4g} s, command latency {latency:.4g} s"
    grid[0].set_title(title, fontsize=10)
    return png(figure, grid[0])


def _response(
    axes: Axes, samples: Samples, shown: NDArray[np.bool_], variable: int, identified: Identified
) -> None:
    """Draws the component of the body twist that correlates most with a variable of X."""
    twist, wanted = samples.dq[:, :3], samples.x[:, variable]
    with np.errstate(all="ignore"):
        alike = np.abs([np.corrcoef(twist[:, d], wanted)[0, 1] for d in range(3)])
    d = int(np.argmax(np.nan_to_num(alike)))
    other = axes.twinx()
    other.plot(
        samples.t[shown] - samples.t[0] - SETTLED_S, twist[shown, d],
        color=MEASURED, linewidth=2.5, alpha=0.55,
    )  # fmt: skip
    model = identified.model
    other.set_ylabel(f"{model.dofs[d]} [{model.dof_units[d]}]", fontsize=9, color=MEASURED)


def _predicted(identified: Identified, chosen: Windows) -> Array:
    """Open-loop paths (W, n, 3) over windows."""
    shares = np.linspace(0.02, 1.0, POINTS)
    ends = [chosen.start_t + share * (chosen.end_t - chosen.start_t) for share in shares]
    model, calibration, drive = identified.model, identified.calibration, identified.drive
    poses = [predict(model, calibration, drive, replace(chosen, end_t=end)) for end in ends]
    return np.stack([chosen.start, *poses], axis=1)
