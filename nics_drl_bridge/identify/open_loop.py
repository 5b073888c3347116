"""Open-loop prediction: windows of a drive, and the poses that a model predicts at their ends."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge import geometry
from nics_drl_bridge.errors import RecordingError
from nics_drl_bridge.geometry import Array
from nics_drl_bridge.identify.calibration import Calibration, resample_states
from nics_drl_bridge.identify.drive import Drive
from nics_drl_bridge.identify.kernels import Shot, make_used_terms, shoot, tangent
from nics_drl_bridge.identify.signals import average_effect, list_followed_commands
from nics_drl_bridge.robot.kernels import SERIES, make_terms, simulate_rollouts
from nics_drl_bridge.robot.taylor import TaylorModel

HORIZON_S = 5.0
SPACING_S = 0.1
# windows start at least this long after the first command if the state is inferred
SETTLE_S = 1.0
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
    chosen: list[int] = []
    for k in begin:
        if not chosen or t[k] - t[chosen[-1]] > 0.9 * spacing:
            chosen.append(int(k))
    begin = np.array(chosen, dtype=np.intp)
    after = np.clip(np.searchsorted(t, t[begin] + horizon), 1, len(t) - 1)
    before_is_nearer = t[begin] + horizon - t[after - 1] < t[after] - t[begin] - horizon
    end = after - before_is_nearer
    good = np.abs(t[end] - t[begin] - horizon) <= END_TOLERANCE * period
    good &= t[end] <= origin + stop
    episode = drive.recording.episode_at(t)
    good &= episode[begin] == episode[end]
    begin = begin[good]
    end = end[good]
    length = np.append(0.0, np.cumsum(np.hypot(*np.diff(pose[:, :2], axis=0).T)))
    return Windows(
        t[begin], t[end], pose[begin], pose[end], length[end] - length[begin]
    )


def predict(
    model: TaylorModel, calibration: Calibration, drive: Drive, chosen: Windows
) -> Array:
    """Predicts poses (W, 3) at windows' ends from commands and measured or inferred states."""
    if drive.recording.state is None:
        relative = _by_one_rollout(model, calibration, drive, chosen)
    else:
        course = trace_states(model, calibration, drive, chosen)
        relative, _ = predict_ends(course, model)
    return convert_to_tracked(chosen, calibration, relative)


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
    recording = drive.recording
    spec = drive.spec
    start, end = (
        t + calibration.clock_offset_s for t in (chosen.start_t, chosen.end_t)
    )
    lead = np.ceil((max(0.0, start.min() - recording.command.t[0]) + 1.0) / model.dt)
    # Whole steps before the first window, so that windows of regular poses lie on the grid.
    grid = start.min() + model.dt * np.arange(
        -lead, (end.max() - start.min()) / model.dt + 2.0
    )
    begin = grid - calibration.command_latency_s
    command = average_effect(
        recording.command, spec, model.inputs, begin, begin + model.dt
    )
    state = (
        np.array([r.gain for r in calibration.responses])
        * command[0, list_followed_commands(spec)]
    )
    poses, _ = _roll(model, state[None], command[None])
    path = poses[0, :-1]
    starts = np.zeros((len(start), 3))
    ends = np.zeros((len(end), 3))
    for i, column in enumerate(path.T):
        starts[:, i] = np.interp(start, grid, column)
        ends[:, i] = np.interp(end, grid, column)
    return geometry.between(starts, ends)


def _roll(model: TaylorModel, state: Array, command: Array) -> tuple[Array, Array]:
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


@dataclass(frozen=True)
class Course:
    """X over windows, step by step, of a drive whose state was measured."""

    chosen: Windows  # the windows
    x: Array  # (W, T, V) X during each step
    steps: NDArray[np.intp]  # (W,) whole steps to the end of each window
    share: Array  # (W,) remaining fraction of one more step


def trace_states(
    model: TaylorModel, calibration: Calibration, drive: Drive, chosen: Windows
) -> Course:
    """Returns the course of X over windows, each started from its measured state."""
    start = chosen.start_t + calibration.clock_offset_s
    exact = (chosen.end_t - chosen.start_t) / model.dt
    count = int(np.ceil(float(exact.max()) - 1e-6)) + 1
    begin = start[:, None] + model.dt * np.arange(count) - calibration.command_latency_s
    command = average_effect(
        drive.recording.command, drive.spec, model.inputs, begin, begin + model.dt
    )
    _, states = _roll(model, resample_states(drive, calibration, start), command)
    steps = np.floor(exact + 1e-6).astype(np.intp)
    share = np.clip(exact - steps, 0.0, 1.0)
    x = np.concatenate([states[:, :-1], command], axis=2)
    return Course(chosen, np.ascontiguousarray(x), steps, share)


def predict_ends(
    course: Course, model: TaylorModel, free: NDArray[np.bool_] | None = None
) -> tuple[Array, Array]:
    """Returns relative ends (W, 3), unwrapped, their slopes (W, 3, P) by `free` coefficients."""
    if free is None:
        free = np.zeros(model.coefficients.shape, dtype=np.bool_)
    used = (model.coefficients != 0.0) | free
    used[3:] = False
    terms, moving = make_used_terms(model, used, free)
    # X is known, so it takes the place of the commands of a robot without a state
    terms = terms._replace(emf=terms.emf[:0])
    count, length, variables = course.x.shape
    shot = Shot(
        state=np.zeros((count, 0)),
        first=length * np.arange(count),
        command=course.x.reshape(count * length, variables),
        stop=np.stack([course.steps, course.steps + 1], axis=1),
        end=np.zeros((count, 2, 3)),
        slope=np.zeros((count, 2, 3, len(moving))),
    )
    scratch = tangent(0, variables, len(terms.dof), len(moving))
    shoot(shot, terms, moving, model.dt, scratch)
    share = course.share[:, None]
    ends = (1.0 - share) * shot.end[:, 0] + share * shot.end[:, 1]
    share = share[..., None]
    return ends, (1.0 - share) * shot.slope[:, 0] + share * shot.slope[:, 1]


def differentiate_ends(
    course: Course, calibration: Calibration, ends: Array, moved: Array
) -> Array:
    """Returns derivatives (W, 3, P) of `convert_to_tracked`, from those of the relative poses."""
    heading = calibration.to_base(course.chosen.start)[:, 2]
    arm = geometry.rotate(
        np.broadcast_to(calibration.mounting[:2], (len(ends), 2)), ends[:, 2]
    )
    inside = (
        moved[:, :2]
        + np.stack([-arm[:, 1], arm[:, 0]], axis=1)[:, :, None] * moved[:, 2:]
    )
    c = np.cos(heading)[:, None]
    s = np.sin(heading)[:, None]
    x = inside[:, 0]
    y = inside[:, 1]
    return np.stack([c * x - s * y, s * x + c * y, moved[:, 2]], axis=1)
