"""Alignment of a calibrated drive: all streams on one time axis, at `base_link`."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.errors import RecordingError
from nics_drl_bridge.identify.calibration import Calibration
from nics_drl_bridge.identify.drive import MAX_GAP_S, MIN_STAMPS, Drive
from nics_drl_bridge.identify.signals import held, inferred_states, resample, unwrapped
from nics_drl_bridge.recording.recording import Recording, Samples, samples_on_one_clock

Array = NDArray[np.float64]

STEP_S = 0.01
"""Step of the samples where the pose's own step is not usable."""
STEP_RANGE_S = (0.002, 0.02)
SMOOTHING_S = 0.1
SMOOTHING_BURSTS = 1.5
UNIFORM = 1e-6
SHARED = 0.5
"""Minimum share of rows with common stamps; only then are the other rows dropped."""
STATE_GAP = 2.5
"""Rates are unknown between states that are this many median steps apart."""


def align(drive: Drive, calibration: Calibration) -> Samples:
    """Puts a drive on one time axis, on the clock of the commands.

    A recording that needs no correction is used bit for bit. Otherwise the pose is smoothed by
    local parabolas as far as its noise requires, and rows in gaps of the pose are dropped.

    Raises:
        RecordingError: the streams do not overlap in time.
    """
    recording = drive.recording
    if calibration.is_identity and (shared := _shared_stamps(recording)) is not None:
        return samples_on_one_clock(*shared)
    grid = _grid(recording, calibration)
    t = drive.sample_t + calibration.clock_offset_s
    tracked = resample(t, unwrapped(recording.pose.values), grid, _half_width(calibration))
    step = float(grid[1] - grid[0])
    begin = grid - calibration.command_latency_s
    samples = samples_on_one_clock(
        grid,
        calibration.to_base(tracked),
        states_at(drive, calibration, grid),
        held(recording.command, drive.spec, begin, begin + step),
    )
    known = _outside_gaps(samples.t, t, step)
    if recording.state is not None:
        known &= _outside_gaps(samples.t, recording.state.t, step, STATE_GAP, 0.0)
    return samples.rows(known)


def states_at(drive: Drive, calibration: Calibration, grid: Array) -> Array:
    """Returns states (T, S), measured or inferred, at uniform times (T,) on the commands' clock."""
    recording = drive.recording
    if recording.state is not None:
        columns = recording.state.values.T
        return np.stack([np.interp(grid, recording.state.t, c) for c in columns], axis=1)
    lags = np.array([r.lag_s for r in calibration.responses])
    gains = np.array([r.gain for r in calibration.responses])
    step = float(grid[1] - grid[0])
    lead = int(np.ceil(max(0.0, grid[0] - recording.command.t[0]) / step)) + 1
    longer = np.concatenate([grid[0] + step * np.arange(-lead, 0), grid])
    latency = calibration.command_latency_s
    return gains * inferred_states(recording.command, drive.spec, lags, latency, longer)[lead:]


def _shared_stamps(recording: Recording) -> tuple[Array, Array, Array, Array] | None:
    """Returns stamps (T,), poses, states and commands of the rows with common stamps.

    None if the state was not measured, or if the stamps do not lie on one uniform grid; rows may
    be missing from the grid.
    """
    pose, state, command = recording.pose, recording.state, recording.command
    if state is None:
        return None
    step = np.median(np.diff(pose.t))
    if not step > 0.0:
        return None
    tick = [np.round((s.t - pose.t[0]) / step) for s in (pose, state, command)]
    off = max(
        float(np.abs(s.t - pose.t[0] - n * step).max())
        for s, n in zip((pose, state, command), tick, strict=True)
    )
    if off > UNIFORM * max(1.0, float(pose.t[-1] - pose.t[0])):
        return None
    ticks, at_pose, at_state = np.intersect1d(tick[0], tick[1], return_indices=True)
    ticks, both, at_command = np.intersect1d(ticks, tick[2], return_indices=True)
    if len(ticks) < SHARED * max(map(len, tick)):
        return None
    at_pose, at_state = at_pose[both], at_state[both]
    return (
        pose.t[at_pose],
        pose.values[at_pose],
        state.values[at_state],
        command.values[at_command],
    )


def _grid(recording: Recording, calibration: Calibration) -> Array:
    """Returns uniform times (T,) covered by pose, commands and state, on the commands' clock."""
    pose = recording.pose.t + calibration.clock_offset_s
    step = float(np.median(np.diff(pose)))
    if calibration.burst_period_s > 0.0 or not STEP_RANGE_S[0] <= step <= STEP_RANGE_S[1]:
        step = STEP_S
    first = max(pose[0], recording.command.t[0] + calibration.command_latency_s)
    last = pose[-1]
    if recording.state is not None:
        first, last = max(first, recording.state.t[0]), min(last, recording.state.t[-1])
    count = int(np.floor((last - first) / step + 1e-6))
    if count < MIN_STAMPS:
        raise RecordingError(
            f"{recording.source}: commands and poses overlap for {max(last - first, 0.0):.2f} s "
            "only; check that they are of one drive."
        )
    return np.asarray(first + step * np.arange(count + 1))


def _half_width(calibration: Calibration) -> float:
    if calibration.burst_period_s > 0.0:
        return SMOOTHING_BURSTS * calibration.burst_period_s
    noisy = calibration.position_noise_m > 0.0 or calibration.heading_noise_rad > 0.0
    return SMOOTHING_S if noisy else 0.0


def _outside_gaps(
    t: Array, samples: Array, step: float, usual: float = 3.0, least: float = MAX_GAP_S
) -> NDArray[np.bool_]:
    """Selects the steps (T,) whose neighbouring samples are close together.

    Close means less than the larger of `least` [s] and `usual` times the median sample interval.
    """
    after = np.clip(np.searchsorted(samples, t + step / 2.0), 1, len(samples) - 1)
    gap = samples[after] - samples[after - 1]
    return np.asarray(gap < max(least, usual * float(np.median(np.diff(samples)))))
