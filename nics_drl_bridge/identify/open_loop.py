"""Open-loop prediction: windows of a drive, and the poses that a model predicts at their ends."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge import geometry
from nics_drl_bridge.errors import RecordingError
from nics_drl_bridge.geometry import Array
from nics_drl_bridge.identify.alignment import (
    average_effect,
    list_followed_commands,
    resample_states,
)
from nics_drl_bridge.identify.calibration import Calibration
from nics_drl_bridge.identify.drive import Drive
from nics_drl_bridge.recording.recording import Samples
from nics_drl_bridge.robot.kernels import SERIES, make_terms, simulate_rollouts
from nics_drl_bridge.robot.taylor import TaylorModel

HORIZON_S = 5.0
SPACING_S = 0.1
# windows start at least this long after the first command if the state is inferred
SETTLE_S = 1.0
# A robot moves through a step by the state at its start. So that a latency is not shorter by half
# a step than it is, commands act on an inferred state half a step earlier.
MIDDLE_OF_STEP = 0.5
GAP = 1.5  # rows further apart than this many steps are not consecutive
# maximum distance from a window's end to the nearest sample, as a fraction of the period
END_TOLERANCE = 0.6


@dataclass(frozen=True)
class OpenLoop:
    """Errors of predictions from a measured pose, by the commands, to another measured pose."""

    horizon_s: float  # length of each prediction
    windows: int  # number of predictions
    mean_position_error_m: float
    median_position_error_m: float
    max_position_error_m: float
    mean_heading_error_rad: float  # absolute
    mean_path_m: float  # length of the measured path over the horizon
    # from start to end, which is the error of predicting a standstill
    median_displacement_m: float


@dataclass(frozen=True)
class Windows:
    """Pairs of measured poses, one `horizon` apart."""

    start_t: Array  # (W,) on the pose's clock [s]
    end_t: Array  # (W,)
    start: Array  # (W, 3) poses of the tracked body
    end: Array  # (W, 3)
    path: Array  # (W,) length of the measured path between them [m]

    def rows(self, keep: NDArray[np.bool_]) -> "Windows":
        """Returns the windows selected by a mask (W,)."""
        return Windows(*(values[keep] for values in vars(self).values()))


def select_windows(
    drive: Drive,
    calibration: Calibration,
    start: float,
    stop: float,
    horizon: float,
    spacing: float,
) -> Windows:
    """Selects windows of a `horizon` from `start` to `stop`, starts `spacing` apart, all in [s]."""
    t = drive.dated.t
    pose = drive.dated.values
    origin = drive.recording.pose.t[0]
    period = float(np.median(np.diff(t)))
    first = origin + start
    if calibration.responses:
        first = max(
            first, drive.recording.command.t[0] - calibration.clock_offset_s + SETTLE_S
        )
    begin = np.flatnonzero((t >= first) & (t + horizon <= origin + stop + period / 2.0))
    begin = begin[_select_apart(t[begin], 0.9 * spacing)]
    after = np.clip(np.searchsorted(t, t[begin] + horizon), 1, len(t) - 1)
    before_is_nearer = t[begin] + horizon - t[after - 1] < t[after] - t[begin] - horizon
    end = after - before_is_nearer
    good = np.abs(t[end] - t[begin] - horizon) <= END_TOLERANCE * period
    good &= t[end] <= origin + stop
    episode = drive.recording.episode_at(t)
    good &= episode[begin] == episode[end]
    begin = begin[good]
    end = end[good]
    length = geometry.measure_path(pose)
    return Windows(
        t[begin], t[end], pose[begin], pose[end], length[end] - length[begin]
    )


def _select_apart(t: Array, least: float) -> list[int]:
    """Returns the rows of times (T,) that are more than the least time apart [s]."""
    chosen: list[int] = []
    for row, time in enumerate(t.tolist()):
        if not chosen or time - t[chosen[-1]] > least:
            chosen.append(row)
    return chosen


def predict(
    model: TaylorModel, calibration: Calibration, drive: Drive, chosen: Windows
) -> Array:
    """Predicts poses (W, 3) at windows' ends from commands and measured or inferred states."""
    if drive.recording.state is None:
        relative = _by_one_rollout(model, calibration, drive, chosen)
    else:
        relative = _by_windows(model, calibration, drive, chosen)
    return convert_to_tracked(chosen, calibration, relative)


def predict_along_states(
    model: TaylorModel, calibration: Calibration, drive: Drive, chosen: Windows
) -> Array:
    """Predicts poses (W, 3) at windows' ends from the states that were measured on the way."""
    relative = _by_windows(model, calibration, drive, chosen, states_known=True)
    return convert_to_tracked(chosen, calibration, relative)


def _by_windows(
    model: TaylorModel,
    calibration: Calibration,
    drive: Drive,
    chosen: Windows,
    states_known: bool = False,
) -> Array:
    """Returns relative poses (W, 3) from rollouts, each from the state measured at its start.

    With `states_known`, the states are those measured all along a window.
    """
    begin = chosen.start_t + calibration.clock_offset_s
    length = (chosen.end_t - chosen.start_t) / model.dt
    count = int(np.ceil(float(length.max()) - 1e-6)) + 1
    t = begin[:, None] + model.dt * np.arange(count)
    sent_t = t - calibration.command_latency_s
    command = average_effect(
        drive.recording.command, drive.spec, model.inputs, sent_t, sent_t + model.dt
    )
    if states_known:
        states = resample_states(drive, calibration, t)
        rates = model.rates(np.concatenate([states, command], axis=2))
        poses = _integrate_twists(rates[..., :3], model.dt)
    else:
        states = resample_states(drive, calibration, begin)
        poses = roll(model, states, command)[0]
    steps = np.floor(length + 1e-6).astype(np.intp)
    share = np.clip(length - steps, 0.0, 1.0)[:, None]
    window = np.arange(len(begin))
    return (1.0 - share) * poses[window, steps] + share * poses[window, steps + 1]


def _integrate_twists(twist: Array, dt: float) -> Array:
    """Returns poses (W, T + 1, 3) of bodies that move along arcs by twists (W, T, 3)."""
    turn = dt * twist[..., 2]
    heading = np.cumsum(turn, axis=1)
    chord = dt * np.sinc(turn / (2.0 * np.pi))[..., None]
    moved = geometry.rotate(chord * twist[..., :2], heading - turn / 2.0)
    poses = np.zeros((twist.shape[0], twist.shape[1] + 1, 3))
    poses[:, 1:, :2] = np.cumsum(moved, axis=1)
    poses[:, 1:, 2] = heading
    return poses


def convert_to_tracked(
    chosen: Windows, calibration: Calibration, relative: Array
) -> Array:
    """Returns poses (W, 3) of the tracked body after `base_link` moved by relative poses."""
    return calibration.to_tracked(
        geometry.compose(calibration.to_base(chosen.start), relative)
    )


def _by_one_rollout(
    model: TaylorModel, calibration: Calibration, drive: Drive, chosen: Windows
) -> Array:
    """Returns relative poses (W, 3) from one rollout: an inferred state needs only commands."""
    start, end = (
        t + calibration.clock_offset_s for t in (chosen.start_t, chosen.end_t)
    )
    grid, path, _ = _roll_drive(model, calibration, drive, start.min(), end.max())
    starts = np.zeros((len(start), 3))
    ends = np.zeros((len(end), 3))
    for i, column in enumerate(path.T):
        starts[:, i] = np.interp(start, grid, column)
        ends[:, i] = np.interp(end, grid, column)
    return geometry.between(starts, ends)


def infer_samples(
    model: TaylorModel, calibration: Calibration, drive: Drive, samples: Samples
) -> Samples:
    """Returns samples with states that follow the commands as a model says."""
    t = samples.t
    grid, _, rolled = _roll_drive(model, calibration, drive, t[0], t[-1])
    state = np.stack([np.interp(t, grid, column) for column in rolled.T], axis=-1)
    return put_states(samples, state)


def put_states(samples: Samples, state: Array) -> Samples:
    """Returns samples with other states (T, S), and their rates; a gap keeps the rate before it."""
    count = state.shape[1]
    step = np.diff(samples.t)
    rates = np.diff(state, axis=0) / samples.dt
    is_next = step < GAP * samples.dt
    before = np.maximum.accumulate(np.where(is_next, np.arange(len(step)), 0))
    dq = samples.dq.copy()
    dq[:-1, 3:] = rates[before]
    dq[-1, 3:] = dq[-2, 3:]
    return replace(
        samples,
        x=np.concatenate([state, samples.x[:, count:]], axis=1),
        q=np.concatenate([samples.q[:, :3], state], axis=1),
        dq=dq,
    )


def _roll_drive(
    model: TaylorModel,
    calibration: Calibration,
    drive: Drive,
    first: float,
    last: float,
) -> tuple[Array, Array, Array]:
    """Rolls a model out over the commands of a drive, from the first one on.

    Returns times (T,) on the commands' clock, which are whole steps from `first` and reach to
    `last` [s], and poses (T, 3) and states (T, S) at them.
    """
    recording = drive.recording
    spec = drive.spec
    lead = np.ceil((max(0.0, first - recording.command.t[0]) + 1.0) / model.dt)
    grid = first + model.dt * np.arange(-lead, (last - first) / model.dt + 2.0)
    middle = MIDDLE_OF_STEP * model.dt if spec.state else 0.0
    begin = grid - calibration.command_latency_s + middle
    command = average_effect(
        recording.command, spec, model.inputs, begin, begin + model.dt
    )
    state = (
        np.array([r.gain for r in calibration.responses])
        * command[0, list_followed_commands(spec)]
    )
    poses, states = roll(model, state[None], command[None])
    return grid, poses[0, :-1], states[0, :-1]


def roll(model: TaylorModel, state: Array, command: Array) -> tuple[Array, Array]:
    """Rolls commands (W, T, C) out to unwrapped poses (W, T + 1, 3) from the origin, and states."""
    count, steps = command.shape[:2]
    poses = np.zeros((count, steps + 1, 3))
    states = np.empty((count, steps + 1, state.shape[1]))
    states[:, 0] = state
    simulate_rollouts(
        poses,
        states,
        np.ascontiguousarray(command),
        make_terms(model),
        SERIES,
        model.dt,
    )
    return poses, states


def measure_open_loop_error(
    model: TaylorModel,
    calibration: Calibration,
    drive: Drive,
    start: float,
    stop: float,
) -> OpenLoop:
    """Predicts part of a drive [s] open-loop, every 0.1 s; RecordingError if it is too short."""
    chosen = select_windows(drive, calibration, start, stop, HORIZON_S, SPACING_S)
    if len(chosen.start_t) == 0:
        fault = f"the {stop - start:.1f} s from {start:.1f} s on hold no window of {HORIZON_S:g} s"
        source = drive.recording.source
        raise RecordingError(f"{source}: {fault}; record a longer drive.")
    error = predict(model, calibration, drive, chosen) - chosen.end
    position = np.hypot(error[:, 0], error[:, 1])
    moved = chosen.end - chosen.start
    return OpenLoop(
        HORIZON_S,
        len(position),
        float(position.mean()),
        float(np.median(position)),
        float(position.max()),
        float(np.abs(geometry.wrap_angle(error[:, 2])).mean()),
        float(chosen.path.mean()),
        float(np.median(np.hypot(moved[:, 0], moved[:, 1]))),
    )
