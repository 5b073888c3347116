"""Calibration of a recording: clocks, latency, mounting, lags and noise, estimated from data."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.errors import RecordingError
from nics_drl_bridge.identify import repair
from nics_drl_bridge.identify.calibration import Calibration, Response
from nics_drl_bridge.identify.findings import Findings, sentences
from nics_drl_bridge.identify.mounting import (
    Mounting,
    jackknifed,
    lateral_lever,
    mounting_by_commands,
    mounting_without_lateral_motion,
    wheel_scales,
    wheels_swapped,
)
from nics_drl_bridge.identify.noise import TwistIntervals, motion, pose_noise
from nics_drl_bridge.identify.signals import held, interval_means
from nics_drl_bridge.identify.timing import (
    LONG_STEP,
    TimingEstimate,
    followed,
    fresh,
    if_certain,
    inferred_states,
    moved_commands,
    timing_of,
)
from nics_drl_bridge.recording.recording import Recording, check
from nics_drl_bridge.robot.spec import RobotSpec
from nics_drl_bridge.threads import one_blas_thread

Array = NDArray[np.float64]

MIN_LENGTH = 1e-4  # m, rad


@one_blas_thread
def calibrate(recording: Recording, spec: RobotSpec) -> Calibration:
    """Estimates the corrections that the streams of a recording need before a fit.

    Args:
        recording: of a drive in which the robot moved.
        spec: the robot. If the recording has no measured state, each state variable must
            follow a command.

    Returns:
        The calibration; the identity for a recording that needs no correction.

    Raises:
        RecordingError: the recording can't be used for this robot.
    """
    calibration, findings = examine(recording, spec)
    return replace(calibration, notes=sentences(calibration, findings, spec))


def examine(recording: Recording, spec: RobotSpec) -> tuple[Calibration, Findings]:
    """Does the same as `calibrate` without the notes, and returns the findings behind them."""
    check(recording, spec)
    _require_state(recording, spec)
    bursts = repair.find_bursts(recording.pose.t)
    noise = pose_noise(recording.pose.values, bursts, recording.pose.t)
    twists = tracked_twists(recording)
    if len(twists.start) < repair.MIN_STAMPS:
        raise RecordingError(
            f"{recording.source}: pose: only {len(twists.start)} usable intervals; record a drive "
            "of 20 s or more without long gaps."
        )
    timing = timing_of(recording, spec, twists)
    mounting = _mounting(recording, spec, twists, timing)
    calibration = Calibration(
        clock_offset_s=timing.offset,
        command_latency_s=timing.latency,
        burst_period_s=bursts.period_s if bursts else 0.0,
        position_noise_m=noise[0] if noise else 0.0,
        heading_noise_rad=noise[1] if noise else 0.0,
        uncertainty=timing.sigma,
        wheels_swapped=wheels_swapped(recording, twists, timing.offset),
    )
    calibration = _mounted(calibration, mounting)
    calibration = replace(
        calibration, responses=_responses(recording, spec, twists, calibration, timing)
    )
    calibration = wheel_scales(recording, twists, calibration)
    findings = Findings(
        bursts=bursts,
        noise_known=noise is not None,
        separated=timing.separated,
        clocks_differ=recording.pose.clock != recording.command.clock,
        lag_sigma=timing.lag_sigma,
        mounting=mounting,
        unmoved=_unmoved(recording, spec),
    )
    return calibration, findings


def tracked_twists(recording: Recording) -> TwistIntervals:
    """Returns twists of the tracked body over intervals as long as the pose noise requires."""
    t, pose = recording.pose.t, recording.pose.values
    bursts = repair.find_bursts(t)
    best = repair.newest(t, bursts)
    return motion(t[best], pose[best], bursts, pose_noise(pose, bursts, t) or (0.0, 0.0))


def _require_state(recording: Recording, spec: RobotSpec) -> None:
    missing = [v.name for v in spec.state if v.follows is None]
    if recording.state is None and missing:
        raise RecordingError(
            f"{recording.source}: has no measured state, and {missing[0]!r} of robot {spec.name!r} "
            "follows no command; record the state too, or add `follows:` to the robot's YAML file."
        )


def _unmoved(recording: Recording, spec: RobotSpec) -> tuple[str, ...]:
    moved = moved_commands(recording.command)
    return tuple(c.name for c, m in zip(spec.command, moved, strict=True) if not m)


def _expected(
    recording: Recording, spec: RobotSpec, twists: TwistIntervals, timing: TimingEstimate
) -> Array:
    """Returns the mean state (n, S) over the intervals of the twists; inferred ones at gain 1."""
    start, end = twists.start + timing.offset, twists.end + timing.offset
    if recording.state is not None:
        return interval_means(recording.state.t, recording.state.values, start, end)
    grid = np.arange(min(start[0], recording.command.t[0]) - 1.0, end[-1] + 0.01, 0.01)
    states = inferred_states(recording.command, spec, timing.lags, timing.latency, grid)
    return interval_means(grid, states, start, end)


def _mounting(
    recording: Recording, spec: RobotSpec, twists: TwistIntervals, timing: TimingEstimate
) -> Mounting | None:
    if spec.moves_sideways:
        return jackknifed(
            recording,
            twists,
            timing.offset,
            lambda drive, rows: _by_commands(drive, spec, rows, timing),
        )
    start, end = twists.start + timing.offset, twists.end + timing.offset
    command = held(recording.command, spec, start - timing.latency, end - timing.latency)
    found = mounting_without_lateral_motion(twists, spec.to_cmd_vel(command)[:, 0])
    speed = _speed_index(spec)
    if found is None or speed is None or np.isnan(found.lever_sigma[0]):
        return found
    expected = _expected(recording, spec, twists, timing)
    lever_y, sigma = lateral_lever(twists, found.rotation, expected[:, speed])
    return replace(
        found,
        lever=np.array([found.lever[0], lever_y]),
        lever_sigma=np.array([found.lever_sigma[0], sigma]),
    )


def _by_commands(
    recording: Recording, spec: RobotSpec, twists: TwistIntervals, timing: TimingEstimate
) -> Mounting | None:
    """Estimates the mounting on an omnidirectional robot."""
    if spec.state:
        expected = _expected(recording, spec, twists, timing)
        command = _as_commands(expected, recording, spec, timing.latency)
    else:
        begin = twists.start + timing.offset - timing.latency
        command = held(recording.command, spec, begin, begin + twists.end - twists.start)
    return mounting_by_commands(twists, spec.to_cmd_vel(command))


def _as_commands(states: Array, recording: Recording, spec: RobotSpec, latency: float) -> Array:
    """Converts states (n, S) to the commands (n, C) that would sustain them."""
    stream = recording.state
    if stream is None:
        return states[:, np.argsort(followed(spec))]
    span = np.diff(stream.t)
    keep = (span > 0.0) & (span < LONG_STEP * np.median(span))
    keep &= fresh(recording.command, stream.t[:-1] - latency)
    rates = np.diff(stream.values, axis=0)[keep] / span[keep, None]
    before = stream.values[:-1][keep]
    begin = stream.t - latency
    u = held(recording.command, spec, begin[:-1][keep], begin[1:][keep])
    # With more wheels than degrees of freedom, the rest of their speeds is slip, not commands.
    ways = np.linalg.svd(before, full_matrices=False)[2][: u.shape[1]].T
    chi = np.concatenate([before @ ways, u, np.ones((len(u), 1))], axis=1)
    beta = np.linalg.lstsq(chi, rates @ ways, rcond=1e-9)[0]
    size = ways.shape[1]
    steady = -np.linalg.pinv(beta[:size].T, rcond=1e-6) @ beta[size:-1].T
    return np.asarray(states @ ways @ np.linalg.pinv(steady).T)


def _speed_index(spec: RobotSpec) -> int | None:
    """Returns the index of the speed along the direction of travel; None if not unique."""
    speeds = [i for i, v in enumerate(spec.state) if v.unit == "m/s"]
    return speeds[0] if len(speeds) == 1 else None


def _mounted(calibration: Calibration, mounting: Mounting | None) -> Calibration:
    """Adds those parts of a mounting that are significant, and all uncertainties."""
    if mounting is None:
        return calibration
    rotation = if_certain(mounting.rotation, mounting.rotation_sigma, MIN_LENGTH)
    known = ~np.isnan(mounting.lever_sigma)
    x, y = (
        if_certain(float(value), float(sigma), MIN_LENGTH) if k else 0.0
        for value, sigma, k in zip(mounting.lever, mounting.lever_sigma, known, strict=True)
    )
    sigma = {"rotation_rad": mounting.rotation_sigma}
    sigma |= {
        f"lever_arm_{axis}_m": float(s)
        for axis, s, k in zip("xy", mounting.lever_sigma, known, strict=True)
        if k
    }
    return replace(
        calibration,
        rotation_rad=rotation,
        lever_arm_m=(x, y),
        uncertainty={**calibration.uncertainty, **sigma},
    )


def _responses(
    recording: Recording,
    spec: RobotSpec,
    twists: TwistIntervals,
    calibration: Calibration,
    timing: TimingEstimate,
) -> tuple[Response, ...]:
    """Returns the inferred states; a speed is scaled to the speed along the direction of travel."""
    if recording.state is not None:
        return ()
    gains = np.ones(len(spec.state))
    speed = _speed_index(spec)
    if speed is not None and moved_commands(recording.command)[followed(spec)[speed]]:
        x = _expected(recording, spec, twists, timing)[:, speed]
        c, s = np.cos(calibration.rotation_rad), np.sin(calibration.rotation_rad)
        along = c * twists.twist[:, 0] + s * twists.twist[:, 1]
        along = along + calibration.lever_arm_m[1] * twists.twist[:, 2]
        gains[speed] = float(x @ along / (x @ x))
    return tuple(
        Response(v.name, str(v.follows), float(lag), float(gain))
        for v, lag, gain in zip(spec.state, timing.lags, gains, strict=True)
    )
