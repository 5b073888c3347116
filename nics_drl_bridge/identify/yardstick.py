"""Yardsticks for a model: a robot that keeps its twist, and the fitted textbook kinematics."""

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import scipy  # its parts load slowly, when used
from numpy.typing import NDArray

from nics_drl_bridge import geometry
from nics_drl_bridge.errors import ConfigError, RecordingError
from nics_drl_bridge.geometry import Array
from nics_drl_bridge.identify.alignment import choose_half_width, measure_body_twists
from nics_drl_bridge.identify.calibration import Calibration
from nics_drl_bridge.identify.drive import Drive
from nics_drl_bridge.identify.kernels import STRAIGHT, BicycleGeometry, roll_windows
from nics_drl_bridge.identify.open_loop import Windows, select_windows
from nics_drl_bridge.identify.shooting import HEADING_ARM_M
from nics_drl_bridge.identify.signals import average_held, lag_behind, unwrap_headings
from nics_drl_bridge.robot.kinds import compute_steady_twist
from nics_drl_bridge.robot.spec import RobotSpec
from nics_drl_bridge.threads import one_blas_thread

HORIZONS_S = (1.0, 2.5, 5.0)  # horizons at which the fit compares predictions
STEP_S = 0.02
SPACING_S = 0.1
MOST_WINDOWS = 200
MIN_GRID = 40  # minimum number of steps over which twists are measured
LOSS_SCALE = 0.2  # scale of the soft L1 loss [m/s]
MOST_EVALUATIONS = 60
TOLERANCE = 1e-4
GUESS_S = 0.5  # gains and lags are first guessed from motions over this time,
# at each of these delays for streams on one clock
DELAYS_S = np.arange(-0.1, 0.51, 0.05)
FAR_DELAYS_S = np.arange(-1.0, 1.01, 0.05)  # and at these for streams on two
LAG_S = 0.15
LAG_RANGE_S = (0.005, 5.0)
# limit of accelerations [m/s^2]
LIMIT = 10.0
LIMIT_RANGE = (0.05, 1e3)
NOTHING = 1e-9
# fraction of the range of a command at which the textbook is probed for its structure
PROBE = 0.5


@dataclass(frozen=True)
class TextbookResponse:
    """Actuators that follow gain * command + offset, with lags, after a delay.

    Actuators are the body twist (vx, vy, wz), or speed, 0, steering angle of a bicycle.
    """

    delay_s: float
    gain: Array  # (3, C) actuator per unit of command
    offset: Array  # (3,)
    lag_s: Array  # (3,)
    # (2,) maximum acceleration and deceleration of the first actuator [m/s^2]
    limit: Array
    bicycle: BicycleGeometry
    mounting: Array  # (3,) pose of the tracked body in `base_link`


@dataclass(frozen=True)
class Yardstick:
    """A fitted textbook robot to compare a model with."""

    response: TextbookResponse
    clock_offset_s: float  # added to the pose's stamps to give the commands' clock

    def predict(
        self, drive: Drive, chosen: Windows, twist: Array | None = None
    ) -> Array:
        """Predicts poses (W, 3) at windows' ends from twists (W, 3) at their starts, if known."""
        duration = (chosen.end_t - chosen.start_t)[:, None]
        course = _sample_commands(drive, chosen.start_t + self.clock_offset_s, duration)
        twist = estimate_twists_at(drive, chosen.start_t) if twist is None else twist
        return geometry.compose(
            chosen.start, _predict_ends(self.response, course, twist)[:, 0]
        )


def predict_kept_twist(
    drive: Drive, chosen: Windows, twist: Array | None = None
) -> Array:
    """Predicts poses (W, 3) at windows' ends for a robot that keeps the twist at their starts."""
    twist = estimate_twists_at(drive, chosen.start_t) if twist is None else twist
    moved = twist * (chosen.end_t - chosen.start_t)[:, None]
    return geometry.compose(chosen.start, geometry.exp(moved))


def estimate_twists_at(drive: Drive, at: Array) -> Array:
    """Estimates twists (W, 3) of the tracked body at times (W,) of poses.

    A yardstick starts from the same information as a model whose state is its motion: parabolas
    through the poses on both sides.
    """
    grid, twist = _measure_twists(drive)
    return np.stack([np.interp(at, grid, column) for column in twist.T], axis=-1)


@lru_cache(maxsize=4)
def _measure_twists(drive: Drive) -> tuple[Array, Array]:
    """Returns uniform times (T,) on the pose's clock, and twists (T, 3) of the tracked body."""
    t = drive.dated.t
    width = choose_half_width(drive)
    count = max(int((t[-1] - t[0]) / STEP_S), MIN_GRID)
    grid = np.linspace(t[0], t[-1], count + 1)
    return grid, measure_body_twists(drive, Calibration(), grid, width)


class _Course(NamedTuple):
    start_t: Array  # (W,) starts of windows, on the commands' clock [s]
    duration: Array  # (W, H) durations of predictions [s]
    grid_t: Array  # (G,) [s]
    command: Array  # (G, C) means over steps of the grid


def _sample_commands(drive: Drive, start_t: Array, duration: Array) -> _Course:
    command = drive.recording.command
    grid = np.arange(command.t[0] - 1.0, command.t[-1] + 1.0, STEP_S)
    return _Course(
        start_t, duration, grid, average_held(command, drive.spec, grid, grid + STEP_S)
    )


def _predict_ends(response: TextbookResponse, course: _Course, twist: Array) -> Array:
    """Returns poses (W, H, 3) of the tracked body relative to its start, given the twist there."""
    bicycle = response.bicycle
    mounting = response.mounting
    target = course.command @ response.gain.T
    begin = course.start_t - response.delay_s - course.grid_t[0]
    arm = np.array([mounting[1], -mounting[0], 0.0]) * twist[:, 2:]
    actuator = _rotate_twists(twist, mounting[2]) + arm
    if bicycle.used:  # a command of zero means stop, whatever the offset
        more = np.maximum(np.abs(target[:, 0]) + response.offset[0], 0.0)
        target = np.stack(
            [np.sign(target[:, 0]) * more, 0.0 * more, target[:, 2]], axis=1
        )
        target[:, 2] += response.offset[2]
        kept = float(np.exp(-STEP_S / response.lag_s[2]))
        angle = lag_behind(target[:, 2], float(target[0, 2]), kept)
        actuator[:, 1] = 0.0
        actuator[:, 2] = np.interp(begin / STEP_S, np.arange(len(angle)), angle)
        if bicycle.front_drive:
            actuator[:, 0] /= np.maximum(np.cos(actuator[:, 2]), 0.1)
    else:
        target = target + response.offset
    ends = np.empty((*course.duration.shape, 3))
    roll_windows(
        ends,
        actuator,
        begin / STEP_S,
        course.duration / STEP_S,
        target,
        response.lag_s,
        response.limit,
        bicycle,
        STEP_S,
    )
    back = geometry.between(mounting, np.zeros(3))
    return geometry.compose(back, geometry.compose(ends, mounting))


def _rotate_twists(twist: Array, angle: float) -> Array:
    return np.concatenate([geometry.rotate(twist[:, :2], angle), twist[:, 2:]], axis=1)


@dataclass(frozen=True)
class _Form:
    """An initial response, and which of its values are free."""

    start: TextbookResponse
    moves: NDArray[np.bool_]  # (3, C) commands that an actuator follows
    mounted: NDArray[np.bool_]  # (3,) free values of the mounting
    # True if acceleration and deceleration have the same limit
    one_limit: bool = False

    def list_free(self) -> tuple[NDArray[np.bool_], ...]:
        """Returns masks of the free values, in the order of `_flatten`."""
        bicycle = self.start.bicycle
        follows = np.asarray(self.moves.any(axis=1))
        return (
            np.array([True]),
            self.moves,
            follows,
            follows,
            np.array([True, not self.one_limit]),
            np.array([bicycle.used and not bicycle.front_drive]),
            self.mounted,
        )

    def pack(self) -> Array:
        """Returns the free values of the start (P,)."""
        pairs = zip(_flatten(self.start), self.list_free(), strict=True)
        return np.concatenate([values[free] for values, free in pairs])

    def unpack(self, theta: Array) -> TextbookResponse:
        """Returns the response for free values (P,)."""
        values = _flatten(self.start)
        begin = 0
        for value, free in zip(values, self.list_free(), strict=True):
            end = begin + int(free.sum())
            value[free] = theta[begin:end]
            begin = end
        delay, gain, offset, log_lag, log_limit, understeer, mounting = values
        limit = np.exp(np.clip(log_limit, *np.log(LIMIT_RANGE)))
        return TextbookResponse(
            float(delay[0]),
            gain,
            offset,
            np.exp(np.clip(log_lag, *np.log(LAG_RANGE_S))),
            np.full(2, limit[0]) if self.one_limit else limit,
            self.start.bicycle._replace(understeer=float(understeer[0])),
            mounting,
        )


def _flatten(response: TextbookResponse) -> tuple[Array, ...]:
    """Returns copies of the values of a response; positive ones as logarithms."""
    return (
        np.array([response.delay_s]),
        response.gain.copy(),
        response.offset.copy(),
        np.log(response.lag_s),
        np.log(response.limit),
        np.array([response.bicycle.understeer]),
        response.mounting.copy(),
    )


def probe_structure(spec: RobotSpec) -> tuple[Array, BicycleGeometry] | None:
    """Asks the textbook what each command moves (3, C), and for a bicycle; None without one."""
    half = PROBE * np.maximum(spec.command_high, -spec.command_low)
    try:
        alone = compute_steady_twist(spec, np.diag(half))
        together = compute_steady_twist(spec, half)
        # A bicycle turns by neither command alone, but by both together.
        turns_alone = np.abs(alone[:, 2]).max() > NOTHING
        if len(half) != 2 or turns_alone or abs(together[2]) < NOTHING:
            per_unit = np.where(np.abs(alone) > NOTHING, alone / half[:, None], 0.0)
            return per_unit.T, STRAIGHT
        speed = int(np.argmax(np.abs(alone[:, 0])))
        less = np.where(np.arange(2) == speed, half, 0.5 * half)
        slower = compute_steady_twist(spec, less)
    except ConfigError:
        return None
    forward = alone[speed, 0]
    angle, bicycle = _find_bicycle(forward, together, slower)
    moves = np.zeros((3, 2))
    moves[0, speed] = forward / half[speed]
    moves[2, 1 - speed] = angle / half[1 - speed]
    return moves, bicycle


def _find_bicycle(
    forward: float, turning: Array, less: Array
) -> tuple[float, BicycleGeometry]:
    """Returns the steering angle of a bicycle that turns, and its geometry.

    Args:
        forward: its speed straight ahead [m/s].
        turning: (3,) its twist at the same speed command and the angle.
        less: (3,) likewise, at half the angle.
    """
    cosine = float(turning[0] / forward)
    if cosine < 1.0 - 1e-6:
        angle = float(np.arccos(cosine))
        length = abs(forward * np.sin(angle) / turning[2])
        return angle, BicycleGeometry(True, True, float(length), 0.0)
    # the tangent of half an angle, from that of the angle
    share = 1.0 - 2.0 * float(less[2] / turning[2])
    angle = 2.0 * float(np.arctan(np.sqrt(max(share, 1e-6))))
    length = abs(forward * np.tan(angle) / turning[2])
    return angle, BicycleGeometry(True, False, float(length), 0.0)


def _guess_response(
    drive: Drive, until_s: float, clock_offset: float, offsets: bool
) -> _Form:
    """Fits gains, lags, maybe offsets linearly to motions over `GUESS_S` at the best delay."""
    structure = probe_structure(drive.spec)
    book, bicycle = structure or (np.ones((3, len(drive.spec.command))), STRAIGHT)
    seen = select_windows(drive, Calibration(), 0.0, until_s, GUESS_S, SPACING_S)
    motion = _MeanMotion.over(drive, seen)
    guesses = []
    for delay in _list_delays(drive):
        start = seen.start_t + (clock_offset - delay)
        end = seen.end_t + (clock_offset - delay)
        u = average_held(drive.recording.command, drive.spec, start, end)
        rotation = 0.0
        if structure is not None:
            rotation = _find_rotation(u @ book.T, motion.twist)
        place = np.array([0.0, 0.0, -rotation])
        seen_so = motion.turn(-rotation)
        guess = _regress_twists(u, seen_so, book != 0.0, bicycle, offsets)
        guesses.append((*guess, delay, place))
    _, gain, offset, lag, delay, place = min(guesses, key=lambda guess: guess[0])
    limit = np.full(2, LIMIT)
    response = TextbookResponse(delay, gain, offset, lag, limit, bicycle, place)
    # Unequal wheels look like a lateral lever arm; without a textbook, any gain may be one.
    mounted = np.array([True, np.count_nonzero(book[0]) < 2, True])
    return _Form(response, book != 0.0, mounted & (structure is not None))


def _list_delays(drive: Drive) -> list[float]:
    """Returns the delays [s] at which gains and lags are guessed."""
    recording = drive.recording
    one_clock = recording.command.clock == recording.pose.clock
    delays: list[float] = (DELAYS_S if one_clock else FAR_DELAYS_S).tolist()
    return delays


class _MeanMotion(NamedTuple):
    """Mean motions over windows."""

    twist: Array  # (W, 3)
    change: Array  # (W, 3) rate of the twist

    @classmethod
    def over(cls, drive: Drive, seen: Windows) -> "_MeanMotion":
        """Measures the motions of the tracked body over windows of a drive."""
        span = (seen.end_t - seen.start_t)[:, None]
        twist = geometry.log(geometry.between(seen.start, seen.end)) / span
        before = estimate_twists_at(drive, seen.start_t)
        after = estimate_twists_at(drive, seen.end_t)
        return cls(twist, (after - before) / span)

    def turn(self, angle: float) -> "_MeanMotion":
        """Returns the motions as seen by a body that is turned by an angle."""
        return _MeanMotion(*(_rotate_twists(part, angle) for part in self))


def _find_rotation(expected: Array, twist: Array) -> float:
    """Returns the angle by which measured velocities are turned from the expected ones [rad]."""
    a, b = (v[:, 0] + 1j * v[:, 1] for v in (expected, twist))
    return float(np.angle((a.conj() * b).sum()))


def _regress_twists(
    u: Array,
    motion: _MeanMotion,
    moves: NDArray[np.bool_],
    bicycle: BicycleGeometry,
    offsets: bool,
) -> tuple[float, Array, Array, Array]:
    """Regresses twist + lag * change on commands; returns residual, gains, offsets, lags."""
    left = 0.0
    gain = np.zeros(moves.shape)
    offset = np.zeros(3)
    lag = np.full(3, LAG_S)
    for i in np.flatnonzero(moves.any(axis=1)):
        target = motion.twist[:, i]
        chi = np.column_stack([u[:, moves[i]], np.full(len(u), float(offsets))])
        if (
            bicycle.used and i == 2
        ):  # an angle: it turns the robot in proportion to its speed
            chi = chi * motion.twist[:, :1] / bicycle.wheelbase
            beta = np.linalg.lstsq(chi, target, rcond=None)[0]
        else:
            lagged = np.column_stack([chi, -motion.change[:, i]])
            beta = np.linalg.lstsq(lagged, target, rcond=None)[0]
            if beta[-1] > LAG_RANGE_S[0]:
                lag[i] = min(beta[-1], LAG_RANGE_S[1])
                chi = lagged
            else:
                beta = np.linalg.lstsq(chi, target, rcond=None)[0]
        count = int(moves[i].sum())
        gain[i, moves[i]] = beta[:count]
        offset[i] = beta[count]
        rest = chi @ beta - target
        left += float((rest**2).mean() / max((target**2).mean(), 1e-12))
    return left, gain, offset, lag


@one_blas_thread
def fit_yardstick(
    drive: Drive, until_s: float, clock_offset_s: float = 0.0, one_limit: bool = False
) -> Yardstick:
    """Fits the textbook of a drive's robot up to `until_s` [s], as a fair hand-made model of it.

    Minimises open-loop errors after `HORIZONS_S`. With `one_limit`, acceleration and deceleration
    have the same limit. Raises RecordingError if the part is too short for these horizons.
    """
    longest = HORIZONS_S[-1]
    spacing = max(SPACING_S, (until_s - longest) / MOST_WINDOWS)
    chosen = select_windows(drive, Calibration(), 0.0, until_s, longest, spacing)
    if not len(chosen.start_t):
        fault = f"the first {until_s:.1f} s contain no window of {longest:g} s"
        raise RecordingError(
            f"{drive.recording.source}: {fault}; record a longer drive."
        )
    motions = _Motions.of(drive, chosen, clock_offset_s)
    guesses = [
        _guess_response(drive, until_s, clock_offset_s, offsets)
        for offsets in (True, False)
    ]
    fits = [_search(replace(guess, one_limit=one_limit), motions) for guess in guesses]
    _, response = min(fits, key=lambda fit: fit[0])
    return Yardstick(response, clock_offset_s)


class _Motions(NamedTuple):
    """What a textbook is to predict."""

    course: _Course
    twist: Array  # (W, 3) at the starts of windows
    measured: Array  # (W, H, 3) poses at the horizons, relative to the starts

    @classmethod
    def of(cls, drive: Drive, chosen: Windows, clock_offset_s: float) -> "_Motions":
        """Returns the motions over `HORIZONS_S` from the starts of windows."""
        duration = np.tile(HORIZONS_S, (len(chosen.start_t), 1))
        at = chosen.start_t[:, None] + duration
        pose = unwrap_headings(drive.dated.values)
        ends = [np.interp(at, drive.dated.t, column) for column in pose.T]
        return cls(
            _sample_commands(drive, chosen.start_t + clock_offset_s, duration),
            estimate_twists_at(drive, chosen.start_t),
            geometry.between(chosen.start[:, None], np.stack(ends, axis=-1)),
        )


def _search(form: _Form, motions: _Motions) -> tuple[float, TextbookResponse]:
    """Returns the least loss of predictions by a form, and the response that has it."""

    def residuals(theta: Array) -> Array:
        response = form.unpack(theta)
        error = _predict_ends(response, motions.course, motions.twist)
        error -= motions.measured
        error[..., 2] = HEADING_ARM_M * geometry.wrap_angle(error[..., 2])
        rates = np.clip(error / motions.course.duration[..., None], -100.0, 100.0)
        return np.asarray(np.nan_to_num(rates)).ravel()

    theta = form.pack()
    solution = scipy.optimize.least_squares(
        residuals,
        theta,
        x_scale=np.maximum(np.abs(theta), 0.05),
        loss="soft_l1",
        diff_step=1e-4,
        f_scale=LOSS_SCALE,
        max_nfev=MOST_EVALUATIONS,
        ftol=TOLERANCE,
        xtol=TOLERANCE,
    )
    return float(solution.cost), form.unpack(solution.x)
