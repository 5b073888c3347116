"""Alignment: the streams of a drive on one time axis, at `base_link`, by its calibration.

A command takes effect in this order:

1. `average_effect` bends the values of the commands by the input curves of the motors, and delays
   each one.
2. The stream of commands holds a value until the next stamp. `average_held` integrates it, so that
   any interval gets its exact mean.
3. `infer_states` lets unmeasured states follow the commands by first-order lags: over a step `dt`,
   a state keeps `exp(-dt / lag)` of its distance from the command.
"""

from dataclasses import replace

import numpy as np
import scipy  # its parts load slowly, when used
from numpy.typing import NDArray

from nics_drl_bridge import geometry
from nics_drl_bridge.errors import RecordingError
from nics_drl_bridge.geometry import Array
from nics_drl_bridge.identify.calibration import Calibration
from nics_drl_bridge.identify.drive import MAX_GAP_S, MIN_STAMPS, Drive, unwrap_headings
from nics_drl_bridge.identify.kernels import follow_first_order
from nics_drl_bridge.recording.recording import (
    Recording,
    Samples,
    Stream,
    samples_on_one_clock,
)
from nics_drl_bridge.robot import taylor
from nics_drl_bridge.robot.curve import InputCurve, apply_curves, delays
from nics_drl_bridge.robot.spec import (
    POSE_RATES,
    CommandVariable,
    RobotSpec,
    StateVariable,
)

MOST_SMOOTHED = 64  # maximum number of poses that a parabola is fitted to
FEWEST_SMOOTHED = 4
RIDGE = 1e-9  # keeps the normal equations of a parabola regular
DEFAULT_LAG_S = 0.1
SHORTEST_LAG_S = 1e-6
AT_REST_S = (
    2.0  # this long before the first command, states have the values of a robot at rest
)
STEP_S = 0.01  # step of the samples if the pose's own step is not usable
STEP_RANGE_S = (0.002, 0.02)
SMOOTHING_S = 0.1
SMOOTHING_BURSTS = 1.5
UNIFORM = 1e-6
WHOLE = 1e-6  # tolerance within which a period counts as a whole number of steps
SAME_STEP = 1e-3  # fraction of a step by which rounding of stamps may change it
# minimum fraction of rows with common stamps for which the other rows are dropped
SHARED = 0.5
# rates are unknown between states further apart than this many median steps
STATE_GAP = 2.5
WIDTHS_S = (0.07, 0.1, 0.15, 0.2)  # half-widths of the parabolas that give the twist
# fraction of the usual speed, and turn rate, that the noise of a twist may reach
NOISE = 0.02
SAMPLES = 2.5  # minimum number of samples in half a width
# steps of models, by the step of the poses
FINE_S = 0.01
COARSE_S = 0.02
COARSE_FROM_S = 0.015


def average_effect(
    command: Stream,
    spec: RobotSpec,
    curves: tuple[InputCurve, ...],
    start: Array,
    end: Array,
) -> Array:
    """Returns means (..., C) over intervals (...) [s] of commands after their curves and delays."""
    names = [c.name for c in spec.command]
    bent = replace(command, values=apply_curves(command.values, names, curves))
    delay_s = delays(names, curves)
    means = average_held(bent, spec, start, end)
    for c in np.flatnonzero(delay_s):
        delayed = average_held(bent, spec, start - delay_s[c], end - delay_s[c])
        means[..., c] = delayed[..., c]
    return means


def average_held(
    command: Stream,
    spec: RobotSpec,
    start: Array,
    end: Array,
    powers: NDArray[np.int64] | None = None,
) -> Array:
    """Returns means (..., C) of held commands over intervals (...) [s].

    With exponents `powers` (K, C), returns the means (..., K) of these products instead.
    """
    # Before its first command a robot is at rest, so commands that ever change are zero then.
    at_rest = np.clip(0.0, spec.command_low, spec.command_high)
    before = np.where(select_moved_commands(command), at_rest, command.values[0])
    values = np.concatenate([before[None], command.values])
    if powers is not None:
        values = taylor.evaluate(values, powers)
    # Row k of the values holds from edge k to edge k + 1.
    first = min(start.min(), command.t[0]) - 1.0
    last = max(end.max(), command.t[-1]) + 1.0
    edges = np.concatenate([[first], command.t, [last]])
    integrals = values * np.diff(edges)[:, None]
    return _average(edges, integrals, start, end)


def average_between_stamps(t: Array, values: Array, start: Array, end: Array) -> Array:
    """Returns means (n, K) over intervals (n,) of values (T, K), linear between stamps (T,)."""
    trapezoids = np.diff(t)[:, None] * (values[1:] + values[:-1]) / 2.0
    return _average(t, trapezoids, start, end)


def _average(edges: Array, integrals: Array, start: Array, end: Array) -> Array:
    """Returns means (..., K) over intervals (...), from integrals (E, K) between edges (E + 1,)."""
    zero = np.zeros((1, integrals.shape[1]))
    area = np.concatenate([zero, np.cumsum(integrals, axis=0)])  # up to each edge
    means = np.empty((*start.shape, integrals.shape[1]))
    for k, column in enumerate(area.T):
        means[..., k] = np.interp(end, edges, column) - np.interp(start, edges, column)
    return means / (end - start)[..., None]


def select_moved_commands(command: Stream) -> NDArray[np.bool_]:
    """Returns a mask (C,) of the commands that ever changed."""
    return np.asarray(np.ptp(command.values, axis=0) > 0.0)


def select_moved_inputs(command: Stream, spec: RobotSpec) -> NDArray[np.bool_]:
    """Returns a mask (S,) of the states whose command changed, or (C,) without any state."""
    moved = select_moved_commands(command)
    return moved[list_followed_commands(spec)] if spec.state else moved


def list_followed_commands(spec: RobotSpec) -> NDArray[np.intp]:
    """Returns the index (S,) of the command that each state variable follows."""
    names = [c.name for c in spec.command]
    return np.array([names.index(str(v.follows)) for v in spec.state], dtype=np.intp)


def find_speed_index(spec: RobotSpec) -> int | None:
    """Returns the index of the speed along the direction of travel; None if not unique."""
    speeds = [i for i, v in enumerate(spec.state) if v.unit == "m/s"]
    return speeds[0] if len(speeds) == 1 else None


def get_nominal_lags(spec: RobotSpec) -> Array:
    """Returns the spec's time constants (S,) `NAME_lag` [s], or a typical one."""
    return np.array(
        [spec.parameters.get(f"{v.name}_lag", DEFAULT_LAG_S) for v in spec.state]
    )


def infer_states(
    command: Stream, spec: RobotSpec, lags: Array, latency: Array | float, grid: Array
) -> Array:
    """Infers states (T, S) at uniform times (T,) from commands, with a gain of one.

    Args:
        command: the commands.
        spec: the robot; each state follows one command.
        lags: (S,) time constants [s].
        latency: () or (S,) from a command's stamp to its effect [s].
        grid: (T,) uniform times [s].
    """
    dt = float(grid[1] - grid[0])
    follows = list_followed_commands(spec)
    targets = np.empty((len(grid), len(follows)))
    for late in np.unique(latency):
        means = average_held(command, spec, grid - late, grid + dt - late)
        delayed = np.broadcast_to(latency, len(follows)) == late
        targets[:, delayed] = means[:, follows[delayed]]
    at_rest = np.array([command.t[0] - AT_REST_S])
    initial = average_held(command, spec, at_rest, at_rest + 1.0)[0, follows]
    states = np.empty((len(grid), len(follows)))
    for i, kept in enumerate(np.exp(-dt / np.maximum(lags, SHORTEST_LAG_S))):
        states[:, i] = lag_behind(targets[:, i], float(initial[i]), float(kept))
    return states


def lag_behind(targets: Array, begin: float, kept: float) -> Array:
    """Returns states (T,), at first `begin`, that keep a share of their distance from targets."""
    states = np.empty(len(targets))
    states[0] = begin
    follow_first_order(states, np.ascontiguousarray(targets), kept)
    return states


def resample(
    t: Array, pose: Array, at: Array, half_width: float, weights: Array | None = None
) -> Array:
    """Resamples unwrapped poses (T, 3) at times (n,): smoothed if `half_width` [s] is not 0.

    Without smoothing, a cubic spline passes through all poses. With it, the value at a time is that
    of a parabola, fitted with weights (T, 3) to the poses within the half-width, at least four. Of
    more than `MOST_SMOOTHED` poses, only every second, third and so on is used.
    """
    distinct = np.concatenate([[True], np.diff(t) > 0.0])
    weights = np.ones_like(pose) if weights is None else weights
    t = t[distinct]
    pose = pose[distinct]
    weights = weights[distinct]
    if half_width == 0.0:
        return np.asarray(scipy.interpolate.make_interp_spline(t, pose, k=3)(at))
    row, is_used = _find_rows_around(t, at, half_width)
    weight = is_used[..., None] * weights[row]  # (n, m, 3)
    z = (t[row] - at[:, None]) / half_width
    change = pose[row] - pose[row[:, :1]]
    return np.asarray(_fit_parabolas(z, change, weight) + pose[row[:, 0]])


def _find_rows_around(
    t: Array, at: Array, half_width: float
) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
    """Returns rows (n, m) of stamps around each time (n,), and which of these to use.

    Those not to be used pad the rows to one number m.
    """
    first = np.minimum(np.searchsorted(t, at - half_width), np.searchsorted(t, at) - 2)
    first = np.clip(first, 0, max(len(t) - FEWEST_SMOOTHED, 0))
    last = np.maximum(np.searchsorted(t, at + half_width), first + FEWEST_SMOOTHED)
    stride = -(-(last - first) // MOST_SMOOTHED)  # rounded up
    most = min(MOST_SMOOTHED, int((last - first).max()))
    row = first[:, None] + stride[:, None] * np.arange(most)
    is_used = (row < last[:, None]) & (row < len(t))
    return np.minimum(row, len(t) - 1), is_used


def _fit_parabolas(z: Array, change: Array, weight: Array) -> Array:
    """Returns the values (n, 3) at z = 0 of parabolas through changes (n, m, 3) at z (n, m)."""
    # The normal equations of  change = c0 + c1 z + c2 z^2,  z from -1 to 1, for each time n,
    # neighbour k, degree of freedom d, powers i and j. The value at the time is c0.
    basis = z[..., None] ** np.arange(3)
    normal = np.einsum("nki,nkd,nkj->ndij", basis, weight, basis) + RIDGE * np.eye(3)
    right = np.einsum("nki,nkd,nkd->ndi", basis, weight, change)
    coefficients = np.linalg.solve(normal, right[..., None])[..., 0]  # (n, 3, 3)
    return np.asarray(coefficients[..., 0])


def align(drive: Drive, calibration: Calibration) -> Samples:
    """Resamples a drive on one time axis, at `base_link`; RecordingError without an overlap."""
    # An exact drive is used bit for bit; noisy poses are smoothed by local parabolas.
    recording = drive.recording
    period = drive.settings.control_period_s
    shared = _find_shared_stamps(recording, period) if calibration.is_exact else None
    if shared is not None:
        samples = samples_on_one_clock(*shared)
        return replace(samples, dt=find_dividing_step(period, samples.dt))
    grid, step = _make_grid(recording, calibration, period)
    half_width = SMOOTHING_BURSTS * calibration.burst_period_s
    if not half_width and (
        calibration.position_noise_m or calibration.heading_noise_rad
    ):
        half_width = SMOOTHING_S
    return resample_drive(drive, calibration, grid, step, half_width)


def resample_drive(
    drive: Drive, calibration: Calibration, grid: Array, step: float, half_width: float
) -> Samples:
    """Resamples a drive at times (T,) on the commands' clock, without its gaps.

    Args:
        drive: the drive.
        calibration: of the drive.
        grid: (T,) times, a whole number of steps apart [s].
        step: [s].
        half_width: of the parabolas that smooth the poses [s]; 0 for none.
    """
    recording = drive.recording
    begin = grid - calibration.command_latency_s
    samples = samples_on_one_clock(
        grid,
        resample_poses(drive, calibration, grid, half_width),
        resample_states(drive, calibration, grid),
        average_effect(
            recording.command, drive.spec, calibration.inputs, begin, begin + step
        ),
    )
    is_known = select_outside_gaps(
        samples.t, drive.sample_t + calibration.clock_offset_s, step
    )
    if recording.state is not None:
        is_known &= select_outside_gaps(
            samples.t, recording.state.t, step, STATE_GAP, 0.0
        )
    return replace(samples.rows(is_known), dt=step)


def find_dividing_step(period: float, step: float) -> float:
    """Returns the step nearest to a given one that divides a period evenly, both in [s]."""
    count = period / step
    whole = max(1, round(count))
    return step if abs(count - whole) < WHOLE else period / whole


def resample_poses(
    drive: Drive, calibration: Calibration, grid: Array, half_width: float
) -> Array:
    """Returns poses (T, 3) of `base_link` at times on the commands' clock, by a half-width [s]."""
    t = drive.sample_t + calibration.clock_offset_s
    pose = drive.recording.pose
    return calibration.to_base(
        resample(t, unwrap_headings(pose.values), grid, half_width, pose.weights)
    )


def resample_states(drive: Drive, calibration: Calibration, grid: Array) -> Array:
    """Returns states (T, S), measured or inferred, at uniform times (T,) on the commands' clock."""
    recording = drive.recording
    if recording.state is not None:
        states = [
            np.interp(grid, recording.state.t, c) for c in recording.state.values.T
        ]
        return np.stack(states, axis=-1) if states else np.zeros((*grid.shape, 0))
    lags = np.array([r.lag_s for r in calibration.responses])
    gains = np.array([r.gain for r in calibration.responses])
    step = float(grid[1] - grid[0])
    lead = int(np.ceil(max(0.0, grid[0] - recording.command.t[0]) / step)) + 1
    longer = np.concatenate([grid[0] + step * np.arange(-lead, 0), grid])
    late = delays([r.command for r in calibration.responses], calibration.inputs)
    latency = calibration.command_latency_s + late
    inferred = infer_states(recording.command, drive.spec, lags, latency, longer)
    return np.asarray(gains * inferred[lead:])


def _find_shared_stamps(
    recording: Recording, period: float
) -> tuple[Array, Array, Array, Array] | None:
    """Returns stamps (T,), poses, states, commands of rows on a grid that divides a period."""
    pose = recording.pose
    state = recording.state
    command = recording.command
    if state is None:
        return None
    usual = float(np.median(np.diff(pose.t)))
    if not usual > 0.0:
        return None
    step = find_dividing_step(period, usual)
    if abs(step - usual) > SAME_STEP * usual:
        return None
    times = [stream.t - pose.t[0] for stream in (pose, state, command)]
    ticks = [np.round(t / step) for t in times]
    off = [np.abs(t - n * step).max() for t, n in zip(times, ticks, strict=True)]
    if max(off) > UNIFORM * max(1.0, float(pose.t[-1] - pose.t[0])):
        return None
    by_pose, by_state, by_command = _find_shared_rows(ticks)
    if len(by_pose) < SHARED * max(map(len, ticks)):
        return None
    return (
        pose.t[by_pose],
        pose.values[by_pose],
        state.values[by_state],
        command.values[by_command],
    )


def _find_shared_rows(ticks: list[Array]) -> tuple[NDArray[np.intp], ...]:
    """Returns the rows of three streams whose ticks (T,) are in all of them."""
    pose, state, command = ticks
    shared, first, second = np.intersect1d(pose, state, return_indices=True)
    _, both, third = np.intersect1d(shared, command, return_indices=True)
    return first[both], second[both], third


def _make_grid(
    recording: Recording, calibration: Calibration, period: float
) -> tuple[Array, float]:
    """Returns uniform times (T,) covered by pose, commands and state, on the commands' clock.

    Also returns their step [s], which divides a period [s].
    """
    pose = recording.pose.t + calibration.clock_offset_s
    step = float(np.median(np.diff(pose)))
    if (
        calibration.burst_period_s > 0.0
        or not STEP_RANGE_S[0] <= step <= STEP_RANGE_S[1]
    ):
        step = STEP_S
    step = find_dividing_step(period, step)
    first = max(pose[0], recording.command.t[0] + calibration.command_latency_s)
    last = pose[-1]
    if recording.state is not None:
        first = max(first, recording.state.t[0])
        last = min(last, recording.state.t[-1])
    count = int(np.floor((last - first) / step + 1e-6))
    if count < MIN_STAMPS:
        fault = f"commands and poses overlap for only {max(last - first, 0.0):.2f} s"
        raise RecordingError(
            f"{recording.source}: {fault}; check that they are from the same drive."
        )
    return np.asarray(first + step * np.arange(count + 1)), step


def select_outside_gaps(
    t: Array, samples: Array, step: float, usual: float = 3.0, least: float = MAX_GAP_S
) -> NDArray[np.bool_]:
    """Selects steps (T,) between samples within `least` [s] or `usual` median steps."""
    after = np.clip(np.searchsorted(samples, t + step / 2.0), 1, len(samples) - 1)
    gap = samples[after] - samples[after - 1]
    return np.asarray(gap < max(least, usual * float(np.median(np.diff(samples)))))


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
    speed = geometry.measure_path(pose)[-1] / span
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
    grid = require_state(drive).t
    step = round(float(grid[-1] - grid[0]) / (len(grid) - 1), 9)
    return resample_drive(drive, calibration, grid, step, 0.5 * width)


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
