"""Pictures of a fit: its data, predictions, terms and input curves, as PNG."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator, NullLocator
from numpy.typing import NDArray

from nics_drl_bridge.files import write_bytes
from nics_drl_bridge.geometry import Array
from nics_drl_bridge.identify.alignment import average_held
from nics_drl_bridge.identify.identify import Identified
from nics_drl_bridge.identify.open_loop import (
    HORIZON_S,
    Windows,
    predict,
    select_windows,
)
from nics_drl_bridge.recording.recording import Samples
from nics_drl_bridge.robot import taylor
from nics_drl_bridge.robot.curve import InputCurve
from nics_drl_bridge.robot.curve import delays as delays_of
from nics_drl_bridge.robot.spec import RobotSpec
from nics_drl_bridge.style import (
    DARK,
    MARKERS,
    MEASURED,
    MEASURED_LINE,
    MODEL,
    MODEL_LINE,
    OTHER,
    POINTS,
    make_panels,
    render_png,
)

SHOWN_S = 8.0
PATHS = 6
PATH_POINTS = 40
SETTLED_S = 1.0
LEAST_ERROR = 1e-12
LEAST_RATE = 1e-6
MOST_POINTS = 3000
CURVE_POINTS = 400  # number of points at which an input curve is drawn
BAND: dict[str, Any] = {"color": DARK, "markersize": 14, "label": "95 % within"}
CAPTIONS = {
    "accuracy": "Error against the number of terms; circles mark how many are kept.",
    "residuals": "Rates on unseen data, those of the model, and the residuals.",
    "alignment": "Commands as stamped and as they take effect, and the response of the robot.",
    "inputs": "The effect of motors on commands, over the range of the drive, and on the "
    "rates of the terms.",
}


def write_pictures(
    spec: RobotSpec, identified: Identified, folder: str | Path
) -> tuple[Path, ...]:
    """Writes the pictures of a fit as PNG files, and returns their paths."""
    # The spec may be of a textbook robot with another state.
    spec = identified.drive.spec
    drawn = fit_pictures(spec, identified)
    files = {Path(folder) / f"{name}.png": picture for name, picture in drawn.items()}
    for file, picture in files.items():
        write_bytes(file, picture)
    return tuple(files)


def fit_pictures(
    spec: RobotSpec, identified: Identified, paths: bool = True
) -> dict[str, bytes]:
    """Returns the pictures of a fit that the recording allows, as PNG by name."""
    pictures = {}
    # There is no curve if the terms were chosen by predictions.
    if identified.findings.is_linear_fit:
        pictures["accuracy"] = draw_accuracy(identified)
    if paths and identified.held_out is not None:
        pictures["paths"] = draw_held_out_paths(identified.trial)
    if (
        identified.unseen is not None
        and np.abs(identified.unseen.dq).max() > LEAST_RATE
    ):
        pictures["residuals"] = draw_residuals(identified.trial, identified.unseen)
    if (np.ptp(identified.recording.command.values, axis=0) > 0.0).any():
        pictures["alignment"] = draw_alignment(spec, identified)
    inputs = draw_inputs(spec, identified)
    if inputs is not None:
        pictures["inputs"] = inputs
    return pictures


def draw_accuracy(identified: Identified) -> bytes:
    """Draws the cross-validated error over the number of terms, one line per degree of freedom."""
    figure, (axes,) = make_panels(1, 1, (7.5, 4.5))
    circle: dict[str, Any] = {"markersize": 10, "fillstyle": "none"}
    for n, curve in enumerate(identified.fit.curves):
        errors = np.maximum(curve.share, LEAST_ERROR)
        line = axes.plot(
            errors, marker=MARKERS[n % len(MARKERS)], markersize=4, label=curve.dof
        )[0]
        axes.plot(curve.kept, errors[curve.kept], "o", color=line.get_color(), **circle)
    axes.plot([], [], "o", color=DARK, label="kept", **circle)
    axes.set_yscale("log")
    longest = max((len(curve.error) for curve in identified.fit.curves), default=2)
    axes.set(
        xlabel="number of terms, largest standardised coefficient first (Eq. 2)",
        ylabel="cross-validated error / size of the rates",
        xlim=(-0.3, longest - 0.7),
    )
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.legend()
    return render_png(figure)


def draw_held_out_paths(identified: Identified) -> bytes:
    """Draws open-loop predictions on unseen data and the measured paths from the same starts."""
    drive = identified.drive
    pose = identified.recording.pose
    begin_s = identified.train_until_s
    free = max(drive.duration_s - begin_s - HORIZON_S, 0.0)
    span = (begin_s, drive.duration_s, HORIZON_S, free / PATHS)
    chosen = select_windows(drive, identified.calibration, *span)
    paths = _predict_paths(identified, chosen)[:PATHS]
    columns = min(len(paths), 3)
    rows = -(-len(paths) // 3)
    figure, grid = make_panels(rows, columns, (3.4 * columns, 3.4 * rows + 0.4))
    for n, (axes, path) in enumerate(zip(grid, paths, strict=False)):
        during = (pose.t >= chosen.start_t[n]) & (pose.t <= chosen.end_t[n])
        x, y, _ = pose.values[during].T
        axes.plot(x, y, label="measured", **MEASURED_LINE)
        axes.plot(*path[:, :2].T, "--", label="predicted", **MODEL_LINE)
        axes.plot(x[0], y[0], "o", color=DARK, markersize=5, label="start")
        axes.set_aspect("equal", adjustable="datalim")
        distance = float(np.hypot(*(path[-1] - chosen.end[n])[:2]))
        axes.set_title(f"{distance:.2g} m apart after {HORIZON_S:g} s")
        axes.set(xlabel="x [m]", ylabel="y [m]")
    return render_png(figure, grid[0])


def _predict_paths(identified: Identified, chosen: Windows) -> Array:
    """Returns predicted poses (N, T, 3) from the start to the end of each window."""
    poses = [chosen.start]
    for fraction in np.linspace(0.02, 1.0, PATH_POINTS):
        end_t = chosen.start_t + fraction * (chosen.end_t - chosen.start_t)
        window = replace(chosen, end_t=end_t)
        parts = (identified.model, identified.calibration, identified.drive)
        poses.append(predict(*parts, window))
    return np.stack(poses, axis=1)


def draw_yardsticks(identified: Identified) -> bytes:
    """Draws mean errors on unseen data over the horizon, for the model and the yardsticks."""
    figure, (axes,) = make_panels(1, 1, (5.0, 3.6))
    judgement = identified.judgement
    for name, label, colour, line in (
        ("model", "model", MODEL, "o-"),
        ("textbook", "fitted textbook", MEASURED, "s--"),
        ("kept_twist", "constant twist", OTHER, "^:"),
    ):
        points = [
            (at.horizon_s, max(getattr(at, name).position_m, LEAST_ERROR))
            for at in judgement
            if getattr(at, name)
        ]
        if points:
            axes.plot(*zip(*points, strict=True), line, color=colour, label=label)
    band = [(at.horizon_s, at.band_m) for at in judgement if at.band_m]
    if band:
        axes.plot(*zip(*band, strict=True), "_", **BAND)
    axes.set(
        xscale="log", yscale="log", xlabel="horizon [s]", ylabel="error of position [m]"
    )
    ticks = [at.horizon_s for at in judgement]
    axes.set_xticks(ticks, [f"{s:g}" for s in ticks])
    axes.xaxis.set_minor_locator(NullLocator())
    axes.yaxis.set_major_formatter("{x:g}")
    return render_png(figure, axes)


def draw_residuals(identified: Identified, unseen: Samples) -> bytes:
    """Draws measured rates, predicted rates and residuals on unseen data over time."""
    model = identified.model
    predicted = model.rates(unseen.x)
    t = unseen.t - unseen.t[0]
    shown = t < SHOWN_S
    moving = np.flatnonzero(np.abs(unseen.dq).max(axis=0) > LEAST_RATE)
    figure, grid = make_panels(
        len(moving), 1, (9.0, 1.7 * len(moving) + 0.6), sharex=True
    )
    for d, axes in zip(map(int, moving), grid, strict=True):
        rest = unseen.dq[:, d] - predicted[:, d]
        axes.plot(t[shown], unseen.dq[shown, d], label="measured", **MEASURED_LINE)
        axes.plot(t[shown], predicted[shown, d], "--", label="model", **MODEL_LINE)
        axes.plot(t[shown], rest[shown], color=OTHER, linewidth=0.8, label="residual")
        axes.set_ylabel(f"{model.dofs[d]} [{model.dof_units[d]}]")
    grid[-1].set_xlabel("time since the end of the training part [s]")
    return render_png(figure, grid[0])


def _draw_command(
    axes: Any, spec: RobotSpec, identified: Identified, c: int, t: Array, begin: float
) -> None:
    """Draws command c at times (T,) [s], as stamped and as it takes effect."""
    calibration = identified.calibration
    dt = identified.samples.dt
    command = identified.recording.command
    name = spec.command[c].name
    delay = float(delays_of([name], calibration.inputs)[0])
    for late, style, label in (
        (0.0, ":", "as stamped"),
        (calibration.command_latency_s + delay, "-", "as it takes effect"),
    ):
        value = average_held(command, spec, t - late, t - late + dt)[:, c]
        axes.plot(t - begin, value, style, label=label, **MODEL_LINE)
    axes.set_ylabel(f"{name} [{spec.command[c].unit}]", color=MODEL)


def draw_alignment(spec: RobotSpec, identified: Identified) -> bytes:
    """Draws each changing command, as stamped and as it takes effect, with the main response."""
    samples = identified.samples
    calibration = identified.calibration
    command = identified.recording.command
    moved = np.flatnonzero(np.ptp(command.values, axis=0) > 0.0)
    figure, grid = make_panels(
        len(moved), 1, (9.0, 2.5 * len(moved) + 0.6), sharex=True
    )
    begin = samples.t[0] + SETTLED_S
    shown = (samples.t >= begin) & (samples.t < begin + SHOWN_S)
    for axes, c in zip(grid, moved, strict=True):
        _draw_command(axes, spec, identified, int(c), samples.t[shown], begin)
        _draw_response(axes, samples, shown, len(spec.state) + int(c), identified)
    grid[-1].set_xlabel("time on the commands' clock [s]")
    grid[0].plot([], [], label="response", **MEASURED_LINE)
    offset = f"clock offset {calibration.clock_offset_s:.4g} s"
    latency = f"command latency {calibration.command_latency_s:.4g} s"
    grid[0].set_title(f"{offset}, {latency}")
    return render_png(figure, grid[0])


def _draw_response(
    axes: Axes,
    samples: Samples,
    shown: NDArray[np.bool_],
    variable: int,
    identified: Identified,
) -> None:
    twist = samples.dq[:, :3]
    wanted = samples.x[:, variable]
    with np.errstate(all="ignore"):
        correlations = [np.corrcoef(twist[:, d], wanted)[0, 1] for d in range(3)]
    d = int(np.argmax(np.nan_to_num(np.abs(correlations))))
    response_axes = axes.twinx()
    response_axes.grid(visible=False)
    t = samples.t[shown] - samples.t[0] - SETTLED_S
    response_axes.plot(t, twist[shown, d], **MEASURED_LINE)
    model = identified.model
    response_axes.set_ylabel(f"{model.dofs[d]} [{model.dof_units[d]}]", color=MEASURED)


def draw_inputs(spec: RobotSpec, identified: Identified) -> bytes | None:
    """Draws the input curves, and how limits, drag and friction change the rates of states."""
    model = identified.model
    curves = [curve for curve in model.inputs if curve.bends]
    restrained = [dof for dof in model.dofs if model.describe_limits(dof)]
    count = len(curves) + len(restrained)
    if not count:
        return None
    figure, grid = make_panels(1, count, (4.2 * count, 3.8))
    for axes, dof in zip(grid[len(curves) :], restrained, strict=True):
        _draw_restraint(axes, identified, dof)
    names = [command.name for command in spec.command]
    for axes, curve in zip(grid, curves, strict=False):
        _draw_curve(axes, spec, identified, curve, names.index(curve.command))
    return render_png(figure)


def _draw_curve(
    axes: Any, spec: RobotSpec, identified: Identified, curve: InputCurve, place: int
) -> None:
    """Draws an input curve over the commands that were sent."""
    sent = identified.recording.command.values[:, place]
    unit = spec.command[place].unit
    command = np.linspace(sent.min(), sent.max(), CURVE_POINTS)
    axes.plot(command, command, ":", color=OTHER, label="as commanded")
    axes.plot(command, curve.of(command), color=MODEL, label="in effect")
    sigma = identified.calibration.uncertainty.get(f"{curve.command}.dead", 0.0)
    for edge in (-curve.dead, curve.dead) if sigma else ():
        axes.axvspan(edge - 2.0 * sigma, edge + 2.0 * sigma, color=MODEL, alpha=0.25)
    rug: dict[str, Any] = {"transform": axes.get_xaxis_transform(), "alpha": 0.05}
    axes.plot(sent, np.full(len(sent), 0.03), "|", color=MEASURED, markersize=9, **rug)
    axes.set(xlabel=f"{curve.command} [{unit}]", ylabel=f"{curve.command}' [{unit}]")
    _finish(axes, curve.equation.replace("-+", "∓"))


def _draw_restraint(axes: Axes, identified: Identified, dof: str) -> None:
    """Draws the rates of a state as measured and as its limits, drag and friction allow them."""
    model = identified.model
    samples = identified.samples
    d = identified.model.dofs.index(dof)
    every = max(1, len(samples.t) // MOST_POINTS)
    x = samples.x[::every]
    measured = samples.dq[::every, d]
    unlimited = taylor.evaluate(x, model.powers) @ model.coefficients[d]
    axes.plot(unlimited, measured, color=MEASURED, label="measured", **POINTS)
    axes.plot(unlimited, model.rates(x)[:, d], color=MODEL, label="model", **POINTS)
    for word, edge in zip(("fall", "rise"), model.limits[d - 3].tolist(), strict=True):
        sigma = identified.calibration.uncertainty.get(
            f"{model.variables[d - 3]}.{word}", 0.0
        )
        if np.isfinite(edge):
            axes.axhline(edge, color=MODEL, linestyle="--")
            axes.axhspan(
                edge - 2.0 * sigma, edge + 2.0 * sigma, color=MODEL, alpha=0.25
            )
    unit = model.dof_units[d]
    axes.set(xlabel=f"{dof} by its terms [{unit}]", ylabel=f"{dof} [{unit}]")
    _finish(axes, dof + model.describe_limits(dof))


def _finish(axes: Axes, title: str) -> None:
    axes.set_title(title.replace("+-", "±"))
    axes.legend()
