"""Motion as state: the body twist derived from the pose, for robots whose state is part of it."""

from dataclasses import replace

import numpy as np

from nics_drl_bridge import geometry
from nics_drl_bridge.errors import RecordingError
from nics_drl_bridge.geometry import Array
from nics_drl_bridge.identify.calibration import (
    Calibration,
    resample_poses,
    select_outside_gaps,
)
from nics_drl_bridge.identify.drive import Drive
from nics_drl_bridge.identify.signals import (
    average_effect,
    infer_states,
    unwrap_headings,
)
from nics_drl_bridge.recording.recording import (
    Recording,
    Samples,
    Stream,
    samples_on_one_clock,
)
from nics_drl_bridge.robot.spec import (
    POSE_RATES,
    CommandVariable,
    RobotSpec,
    StateVariable,
)

WIDTHS_S = (0.07, 0.1, 0.15, 0.2)  # half-widths of the parabolas that give the twist
# fraction of the usual speed, and turn rate, that the noise of a twist may reach
NOISE = 0.02
SAMPLES = 2.5  # minimum number of samples in half a width
# steps of models, by the step of the poses
FINE_S = 0.01
COARSE_S = 0.02
COARSE_FROM_S = 0.015


def has_motion_as_state(spec: RobotSpec, recording: Recording) -> bool:
    """True if a state that is part of the body twist was not measured, or wheels are inputs."""
    if recording.state is not None:
        return False
    return any(v.twist for v in spec.state) or not (spec.state or spec.takes_cmd_vel)


def choose_half_width(drive: Drive) -> float:
    """Returns the half-width [s] for smoothing poses: the shortest that reduces noise enough."""
    t = drive.dated.t
    pose = unwrap_headings(drive.dated.values)
    span = float(t[-1] - t[0])
    every = span / max(len(t) - 1, 1)
    speed = np.hypot(*np.diff(pose[:, :2], axis=0).T).sum() / span
    turn = np.abs(np.diff(pose[:, 2])).sum() / span
    position, heading = drive.pose_noise or (0.0, 0.0)
    for width in WIDTHS_S:
        gain = np.sqrt(12.0 * every / (2.0 * width)) / (2.0 * width)
        if gain * position <= NOISE * speed and gain * heading <= NOISE * max(
            turn, speed
        ):
            break
    return float(max(width, SAMPLES * every))


def add_motion(
    drive: Drive, calibration: Calibration, grid: Array, width: float
) -> Drive:
    """Returns a drive with the state at uniform times (T,) on the commands' clock.

    Components of the twist of `base_link` are slopes of parabolas over twice the half-width [s];
    states that follow a command do so with the calibration's lags.
    """
    recording = drive.recording
    spec = drive.spec
    twist = measure_body_twists(drive, calibration, grid, width)
    columns = [
        twist[:, POSE_RATES.index(v.twist)]
        if v.twist
        else _infer_follower(v, drive, calibration, grid)
        for v in spec.state
    ]
    values = np.array(columns).reshape(len(columns), len(grid)).T
    return drive.part(
        replace(recording, state=Stream(grid, values, recording.command.clock))
    )


def measure_body_twists(
    drive: Drive, calibration: Calibration, grid: Array, width: float
) -> Array:
    """Returns the twists (T, 3) of `base_link` at uniform times (T,) on the commands' clock.

    They are slopes of parabolas through the poses within a half-width [s] on both sides.
    """
    step = float(grid[1] - grid[0])
    pose = unwrap_headings(resample_poses(drive, calibration, grid, 0.5 * width))
    rows = 2 * max(2, round(width / step)) + 1
    rates = find_slopes(pose, rows, step)
    forward = geometry.rotate(rates[:, :2], -pose[:, 2])
    return np.concatenate([forward, rates[:, 2:]], axis=1)


def smooth_commands(command: Array, step: float, width: float) -> Array:
    """Returns commands (T, C) at uniform times, smoothed like a twist derived by parabolas."""
    sums = np.cumsum(command, axis=0) * step
    rows = 2 * max(2, round(width / step)) + 1
    return find_slopes(sums, rows, step)


def find_slopes(values: Array, rows: int, step: float) -> Array:
    """Returns slopes of parabolas through an odd number of rows of `values` (T, C) around each.

    They are those of `scipy.signal.savgol_filter`, which takes most of a second to import.
    """
    half = rows // 2
    at = step * np.arange(-half, half + 1)
    slopes = np.empty_like(values)
    around = np.lib.stride_tricks.sliding_window_view(values, rows, axis=0)
    slopes[half : len(values) - half] = around @ (at / (at @ at))
    # No parabola is centred on the ends, which take those of the first and the last rows.
    for end, near in (
        (slice(None, rows), slice(None, half)),
        (slice(-rows, None), slice(-half, None)),
    ):
        curve = np.polynomial.polynomial.polyfit(at, values[end], 2)
        slopes[end][near] = curve[1] + 2.0 * np.outer(at[near], curve[2])
    return slopes


def _infer_follower(
    variable: StateVariable, drive: Drive, calibration: Calibration, t: Array
) -> Array:
    alone = drive.spec.model_copy(update={"state": (variable,)})
    lag = [r.lag_s for r in calibration.responses if r.state == variable.name]
    latency = calibration.command_latency_s
    command = drive.recording.command
    return infer_states(command, alone, np.array(lag), latency, t)[:, 0]


def resample_motion(drive: Drive, calibration: Calibration, width: float) -> Samples:
    """Resamples a drive from `add_motion` at the times of its state, with poses smoothed alike."""
    state = require_state(drive)
    spec = drive.spec
    grid = state.t
    step = round(float(grid[-1] - grid[0]) / (len(grid) - 1), 9)
    pose = resample_poses(drive, calibration, grid, 0.5 * width)
    begin = grid - calibration.command_latency_s
    command = average_effect(
        drive.recording.command, spec, calibration.inputs, begin, begin + step
    )
    samples = samples_on_one_clock(grid, pose, state.values, command)
    is_known = select_outside_gaps(
        samples.t, drive.sample_t + calibration.clock_offset_s, step
    )
    return replace(samples.rows(is_known), dt=step)


def require_state(drive: Drive) -> Stream:
    """Returns the state of a drive from `add_motion`."""
    if drive.recording.state is None:
        raise RecordingError(
            f"{drive.recording.source}: its motion has not been derived yet."
        )
    return drive.recording.state


def make_motion_grid(drive: Drive, calibration: Calibration, period: float) -> Array:
    """Returns uniform times (T,) of poses on the commands' clock; the step divides a period [s]."""
    pose = drive.recording.pose.t + calibration.clock_offset_s
    usual = float(np.median(np.diff(drive.dated.t)))
    step = period / max(
        1, round(period / (FINE_S if usual < COARSE_FROM_S else COARSE_S))
    )
    first = max(pose[0], drive.recording.command.t[0])
    return np.asarray(
        first + step * np.arange(int((pose[-1] - first) / step + 1e-6) + 1)
    )


def make_surrogate(spec: RobotSpec) -> RobotSpec:
    """Returns a robot whose state follows its commands one by one, to find delays and lags."""

    def follows(command: CommandVariable) -> StateVariable:
        limits = command.model_dump(include={"unit", "min", "max"})
        return StateVariable(
            name=f"{command.name}_state", follows=command.name, **limits
        )

    return spec.model_copy(update={"state": tuple(map(follows, spec.command))})
