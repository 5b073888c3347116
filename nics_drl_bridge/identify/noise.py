"""Noise of the sensors, and motion over a second that a model leaves unexplained."""

from typing import Any

import numpy as np

from nics_drl_bridge import geometry
from nics_drl_bridge.geometry import Array
from nics_drl_bridge.identify import open_loop
from nics_drl_bridge.identify.calibration import Calibration
from nics_drl_bridge.identify.drive import Drive, find_bursts, measure_pose_noise
from nics_drl_bridge.identify.statistics import measure_white_noise
from nics_drl_bridge.recording.recording import Samples
from nics_drl_bridge.robot.noise import (
    ASSUMED_STATE_DRIFT,
    MEASURED,
    Level,
    Noise,
    assume_level,
)
from nics_drl_bridge.robot.taylor import TaylorModel

HORIZON_S = 1.0
SPACING_S = 0.25
STATE_HORIZON_S = 0.1
MIN_WINDOWS = 20
OUTLYING = 10.0  # an error beyond this many medians is a jump of the pose
# a larger error of a prediction over a second is divergence, not drift
RUN_AWAY_M = 1e4
BLOCKS = 8
TINY = 1e-9
NEGLIGIBLE = 1e-4  # smaller levels are rounding: a tenth of a millimetre after a second
# percentage of a normal distribution within one standard deviation
WITHIN_SIGMA = 68.27
MIN_ROWS = 40


def measure_sensor_noise(drive: Drive) -> Noise:
    """Measures the noise of the pose sensor; its uncertainty comes from blocks of the drive."""
    pose = drive.recording.pose
    whole = drive.pose_noise
    if whole is None:
        return Noise()
    blocks = map(pose.rows, np.array_split(np.arange(len(pose.t)), BLOCKS))
    parts = [measure_pose_noise(block, find_bursts(block.t)) for block in blocks]
    measured = np.array([part for part in parts if part is not None])
    if len(measured) > 1:
        spread = measured.std(axis=0, ddof=1) / np.sqrt(len(measured))
    else:
        spread = [None, None]
    position, heading = (
        _make_level(std, unit, None if u is None else float(u))
        for std, unit, u in zip(whole, ("m", "rad"), spread, strict=True)
    )
    return Noise(pose_position=position, pose_heading=heading)


def add_motion_noise(
    sensor: Noise,
    drive: Drive,
    calibration: Calibration,
    model: TaylorModel,
    samples: Samples,
) -> Noise:
    """Adds drift, and odometry's noise from recorded or scaled wheel twists, to the sensor's."""
    measured: dict[str, Any] = {
        "state_drift": _measure_state_drift(drive, model, samples)
    }
    rest = measure_odometry_residual(drive, calibration, model, samples)
    if rest is not None:
        linear = (_measure_level(rest[:, i], "m/s") for i in (0, 1))
        measured["odom_linear"] = max(linear, key=lambda level: level.std)
        measured["odom_angular"] = _measure_level(rest[:, 2], "rad/s")
    measured |= _measure_pose_drift(sensor, drive, calibration, model)
    measured |= list_claimed_levels(sensor, drive.recording.pose.sigma)
    return sensor.model_copy(update=measured)


def list_claimed_levels(sensor: Noise, sigma: Array | None) -> dict[str, Level]:
    """Returns the pose's deviations according to its covariances, where these are larger."""
    # Differences do not show an error that persists for a while, and drift does not include it.
    if sigma is None:
        return {}
    usual = []
    for column in sigma.T:
        sigmas = column[np.isfinite(column) & (column > 0.0)]
        usual.append(float(np.median(sigmas)) if len(sigmas) else np.nan)
    across = [std for std in usual[:2] if std > 0.0]
    position = float(np.mean(across)) if across else 0.0
    larger = {}
    if position > sensor.pose_position.std:
        larger["pose_position"] = assume_level(position, sensor.pose_position.unit)
    if usual[2] > sensor.pose_heading.std:
        larger["pose_heading"] = assume_level(usual[2], sensor.pose_heading.unit)
    return larger


def _make_level(std: float, unit: str, uncertainty: float | None) -> Level:
    return Level(std=std, unit=unit, source=MEASURED, uncertainty=uncertainty)


def make_measured_level(variances: Array, unit: str) -> Level:
    """Returns a measured level from squares (n,) over time; its uncertainty comes from blocks."""
    std = float(np.sqrt(max(float(variances.mean()), 0.0)))
    means = np.array([part.mean() for part in np.array_split(variances, BLOCKS)])
    spread = float(means.std(ddof=1) / np.sqrt(BLOCKS))
    if std < NEGLIGIBLE:
        return _make_level(0.0, unit, 0.0)
    return _make_level(
        std, unit, spread / (2.0 * std) if std**2 > spread else float(np.sqrt(spread))
    )


def _predict_errors(
    drive: Drive, calibration: Calibration, model: TaylorModel, horizon: float
) -> tuple[open_loop.Windows, Array] | None:
    chosen = open_loop.select_windows(
        drive, calibration, 0.0, drive.duration_s, horizon, SPACING_S
    )
    if len(chosen.start_t) < MIN_WINDOWS:
        return None
    if drive.recording.state is None:
        ends = open_loop.predict(model, calibration, drive, chosen)
    else:  # restart from the measured state, so that its drift is not counted twice
        ends = open_loop.predict_along_states(model, calibration, drive, chosen)
    return chosen, geometry.between(ends, chosen.end)


def _measure_pose_drift(
    sensor: Noise, drive: Drive, calibration: Calibration, model: TaylorModel
) -> dict[str, Level]:
    """Returns the drift of position and heading; none if too short or the model diverges."""
    predicted = _predict_errors(drive, calibration, model, HORIZON_S)
    if predicted is None:
        return {}
    chosen, error = predicted
    size = np.hypot(error[:, 0], error[:, 1])
    if not (size < RUN_AWAY_M).all():
        return {}
    inside = size <= OUTLYING * max(float(np.median(size)), TINY)
    position, _, heading = sensor.pose
    away = np.sum((chosen.end - chosen.start)[inside, :2] ** 2, axis=1)
    turn = error[inside, 2] ** 2 - 2.0 * heading**2
    grown = max(float(turn.mean()), 0.0)
    # Errors of the initial heading, and heading drift along the path, cause lateral errors.
    aside = 0.5 * away * (heading**2 + grown / 3.0)
    shift = 0.5 * size[inside] ** 2 - 2.0 * position**2 - aside
    return {
        "position_drift": make_measured_level(shift / HORIZON_S, "m/sqrt(s)"),
        "heading_drift": make_measured_level(turn / HORIZON_S, "rad/sqrt(s)"),
    }


def _measure_state_drift(
    drive: Drive, model: TaylorModel, samples: Samples
) -> dict[str, Level]:
    """Returns the drift of a measured state; assumed levels for an unmeasured one."""
    state = drive.recording.state
    nominal = {
        v.name: assume_level(ASSUMED_STATE_DRIFT * (v.max - v.min), f"{v.unit}/sqrt(s)")
        for v in drive.spec.state
    }
    if state is None:
        return nominal
    rest = (samples.dq - model.rates(samples.x))[:, 3:] * samples.dt
    steps = max(1, round(STATE_HORIZON_S / samples.dt))
    count = len(rest) // steps
    next_to = np.append(np.diff(samples.t) < 1.5 * samples.dt, True)[: count * steps]
    whole = next_to.reshape(count, steps)[:, :-1].all(axis=1)
    sums = rest[: count * steps].reshape(count, steps, -1)[whole].sum(axis=1)
    if len(sums) < MIN_WINDOWS:
        return nominal
    drift = {}
    sensor = measure_white_noise(state.values)
    for i, variable in enumerate(drive.spec.state):
        usual = OUTLYING * max(float(np.median(np.abs(sums[:, i]))), TINY)
        kept = sums[np.abs(sums[:, i]) <= usual, i]
        drift[variable.name] = make_measured_level(
            (kept**2 - 2.0 * float(sensor[i]) ** 2) / (steps * samples.dt),
            f"{variable.unit}/sqrt(s)",
        )
    return drift


def measure_odometry_residual(
    drive: Drive, calibration: Calibration, model: TaylorModel, samples: Samples
) -> Array | None:
    """Returns reported minus modelled twist (n, 3); None if there is nothing to compare."""
    recording = drive.recording
    stream = drive.recording.odometry
    if stream is not None:
        t = stream.t
        twist = stream.values
        if stream.clock == recording.pose.clock:
            t = t + calibration.clock_offset_s
    elif recording.wheels is not None and calibration.wheel_scale is not None:
        t = recording.wheels.t
        wheels = recording.wheels.values
        twist = np.zeros((len(t), 3))
        twist[:, 0] = calibration.wheel_scale * wheels.mean(axis=1)
        twist[:, 2] = (calibration.turn_scale or 0.0) * (wheels[:, 1] - wheels[:, 0])
    else:
        return None
    inside = (t >= samples.t[0]) & (t <= samples.t[-1])
    if inside.sum() < MIN_ROWS:
        return None
    rates = model.rates(samples.x)[:, :3]
    # The rates are means from each sample to the next, so they belong to the middle of the step.
    middle = samples.t + samples.dt / 2.0
    expected = np.stack(
        [np.interp(t[inside], middle, column) for column in rates.T], axis=1
    )
    return np.asarray(twist[inside] - expected)


def _measure_level(rest: Array, unit: str) -> Level:
    """Returns a level that is robust against single outliers."""
    std, *parts = (
        float(np.percentile(np.abs(part - np.median(part)), WITHIN_SIGMA))
        for part in (rest, *np.array_split(rest, BLOCKS))
    )
    return _make_level(std, unit, float(np.std(parts, ddof=1) / np.sqrt(BLOCKS)))
