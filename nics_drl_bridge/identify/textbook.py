"""The textbook of a robot: fitted as a yardstick, written as a model, completing a model."""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import scipy  # its parts load slowly, when used
from numpy.typing import NDArray

from nics_drl_bridge import geometry
from nics_drl_bridge.errors import ConfigError, RecordingError
from nics_drl_bridge.geometry import Array
from nics_drl_bridge.identify.alignment import (
    average_held,
    choose_half_width,
    infer_states,
    lag_behind,
    list_followed_commands,
    measure_body_twists,
    require_state,
)
from nics_drl_bridge.identify.calibration import Calibration, Response
from nics_drl_bridge.identify.drive import Drive, Gap, unwrap_headings
from nics_drl_bridge.identify.kernels import STRAIGHT, BicycleGeometry, roll_windows
from nics_drl_bridge.identify.open_loop import Windows, select_windows
from nics_drl_bridge.identify.shooting import HEADING_ARM_M
from nics_drl_bridge.recording.recording import Samples, Stream
from nics_drl_bridge.robot.curve import InputCurve
from nics_drl_bridge.robot.kinds import (
    Textbook,
    compute_steady_twist,
    has_textbook,
    reach,
    textbook,
)
from nics_drl_bridge.robot.spec import POSE_RATES, CommandVariable, RobotSpec
from nics_drl_bridge.robot.taylor import TaylorModel, evaluate
from nics_drl_bridge.threads import one_blas_thread

Powers = NDArray[np.int64]

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
# ratio of an actuator's range to its maximum on a drive
MARGIN = 1.25
LEAST_COSINE = 0.1  # minimum cosine of a steering angle
WIDEST_ANGLE = 1.4  # maximum angle of a steered wheel in the expansion [rad]
NEGLIGIBLE = 1e-3  # fraction of a rate below which a term of the expansion is left out
# fraction of the widest searched range above which a limit counts as not found
UNLIMITED = 0.5
MIN_OPERATING_POINT = 1e-3
DIFFERENCE = 1e-4


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


def make_textbook_calibration(
    yardstick: Yardstick, calibration: Calibration, spec: RobotSpec
) -> Calibration:
    """Returns the calibration of a drive according to the fitted textbook."""
    response = yardstick.response
    x, y, heading = map(float, response.mounting)
    latency = max(response.delay_s, 0.0)
    # motion that precedes its commands has another clock
    early = max(-response.delay_s, 0.0)
    if not spec.state:  # a lag without a state acts as a delay
        used = response.gain.any(axis=1)
        latency += float(response.lag_s[used].mean())
    kept = ("clock_offset_s", "wheel_scale", "turn_scale")
    return replace(
        calibration,
        clock_offset_s=yardstick.clock_offset_s + early,
        command_latency_s=latency,
        rotation_rad=-heading,
        lever_arm_m=(x, y),
        responses=tuple(_update_responses(response, calibration, spec)),
        inputs=tuple(_find_dead_zones(response, spec)),
        uncertainty={k: v for k, v in calibration.uncertainty.items() if k in kept},
    )


def make_textbook_model(
    yardstick: Yardstick, model: TaylorModel, samples: Samples, spec: RobotSpec
) -> TaylorModel | None:
    """Returns the fitted textbook as terms, with the step and range of a model of the same drive.

    Trigonometric functions are expanded over the rows of the samples. None for a state that no
    textbook relates to the twist.
    """
    response = yardstick.response
    relation = _relate_variables(response, samples.x, spec)
    if relation is None:
        return None
    states = samples.x[:, : len(spec.state)]
    # A step of the model brings a state as close to its goal as the lag does.
    share = -np.expm1(-model.dt / relation.lag_s)
    rates = (relation.goal - states) * share / model.dt
    targets = np.concatenate([relation.twist, rates], axis=1)
    allowed = _list_terms(relation, samples.x.shape[1], len(targets.T))
    pairs = zip(targets.T, allowed, strict=True)
    powers, coefficients = _join_terms(
        [_expand(samples.x, target, powers) for target, powers in pairs]
    )
    limits = np.tile([-np.inf, np.inf], (len(spec.state), 1))
    limits[relation.is_speed] = _find_speed_limits(response)
    return TaylorModel(
        spec.variable_names,
        spec.dof_names,
        spec.dof_units,
        powers=powers,
        coefficients=coefficients,
        dt=model.dt,
        low=samples.x.min(axis=0),
        high=samples.x.max(axis=0),
        bounded=model.bounded,
        inputs=tuple(_find_dead_zones(response, spec)),
        limits=limits,
    )


def _list_terms(relation: "_Relation", variables: int, dofs: int) -> list[Powers]:
    """Returns the terms (K, V) that each degree of freedom may have: linear, but for a bicycle."""
    linear = np.eye(variables, dtype=np.int64)
    allowed = [np.concatenate([0 * linear[:1], linear])] * dofs
    if relation.pair is not None:
        v, steer = (linear[place] for place in relation.pair)
        allowed[0] = np.array([v, v + 2 * steer])
        turns = [v, v + steer, v + 2 * steer, v + 3 * steer]
        allowed[2] = np.array([*turns, 2 * v, 2 * v + steer, 3 * v + steer])
    return allowed


def _expand(x: Array, target: Array, allowed: Powers) -> tuple[Powers, Array]:
    """Returns the terms (K, V), and their coefficients, that approximate a target (T,) on rows."""
    chi = evaluate(x, allowed)
    size = np.maximum(np.linalg.norm(chi, axis=0), 1e-12)
    beta = np.linalg.lstsq(chi / size, target, rcond=1e-9)[0]
    shown = np.abs(beta) > NEGLIGIBLE * max(float(np.linalg.norm(target)), 1e-12)
    beta = np.linalg.lstsq((chi / size)[:, shown], target, rcond=1e-9)[0]
    return allowed[shown], beta / size[shown]


def _join_terms(expansions: list[tuple[Powers, Array]]) -> tuple[Powers, Array]:
    """Returns the terms (K, V) of all degrees of freedom, and their coefficients (D, K)."""
    powers = np.unique(np.concatenate([rows for rows, _ in expansions]), axis=0)
    coefficients = np.zeros((len(expansions), len(powers)))
    for d, (rows, values) in enumerate(expansions):
        place = (powers == rows[:, None]).all(axis=2).argmax(axis=1)
        coefficients[d, place] = values
    return powers, coefficients


class _Relation(NamedTuple):
    """What a fitted textbook says of the variables of a robot, on the rows (T,) of a drive."""

    twist: Array  # (T, 3)
    goal: Array  # (T, S) to which commands lead the states
    lag_s: Array  # (S,)
    is_speed: NDArray[np.bool_]  # (S,) states whose acceleration is limited
    # indices in X of speed and steering, by which a bicycle moves
    pair: tuple[int, int] | None = None


def _relate_variables(
    response: TextbookResponse, x: Array, spec: RobotSpec
) -> _Relation | None:
    """Relates states and commands by a fitted textbook; None if it does not know the state."""
    count = len(spec.state)
    state = x[:, :count]
    command = x[:, count:]
    actuator = command @ response.gain.T
    actuator[:, 2] += response.bicycle.used * response.offset[2]
    if any(v.twist for v in spec.state):
        return _relate_twist(response, state, actuator, spec)
    if not count:
        nothing = np.zeros(0, dtype=np.bool_)
        pair = _find_bicycle_commands(response) if response.bicycle.used else None
        twist = _find_twist(response, actuator)
        return _Relation(twist, state, np.zeros(0), nothing, pair)
    if [v.name for v in spec.state] == ["wheel_speed", "wheel_angle"]:
        twist = _find_twist(response, np.insert(state, 1, 0.0, axis=1))
        used = [0, 2]
        is_speed = np.array([True, False])
        return _Relation(
            twist, actuator[:, used], response.lag_s[used], is_speed, (0, 1)
        )
    if all(v.follows for v in spec.state):
        return _relate_followers(response, state, command, spec)
    if has_textbook(spec) and not response.bicycle.used:
        return _relate_wheels(response, state, command, spec)
    return None


def _relate_twist(
    response: TextbookResponse, state: Array, actuator: Array, spec: RobotSpec
) -> _Relation:
    """Relates states that are components of the body twist; others stay as they are."""
    parts = [POSE_RATES.index(v.twist) if v.twist else -1 for v in spec.state]
    twist = np.zeros((len(state), 3))
    goal = state.copy()
    for i, part in enumerate(parts):
        if part >= 0 and (part != 1 or spec.moves_sideways):
            twist[:, part] = state[:, i]
            goal[:, i] = actuator[:, part]
    return _Relation(twist, goal, response.lag_s[parts], np.array(parts) == 0)


def _relate_followers(
    response: TextbookResponse, state: Array, command: Array, spec: RobotSpec
) -> _Relation:
    """Relates states that follow commands one by one."""
    follow = list_followed_commands(spec).tolist()
    pairs = [_find_actuator(response, place) for place in follow]
    moved = [actuator for actuator, _ in pairs]
    goal = command[:, follow] * [gain for _, gain in pairs]
    actuator = np.zeros((len(state), 3))
    actuator[:, moved] = state
    pair = None
    if response.bicycle.used:  # the state is the commanded angle
        speed, steering = _find_bicycle_commands(response)
        pair = follow.index(speed), follow.index(steering)
        actuator[:, 2] *= response.gain[2, steering]
        actuator[:, 2] += response.offset[2]
    twist = _find_twist(response, actuator)
    return _Relation(twist, goal, response.lag_s[moved], np.array(moved) == 0, pair)


def _relate_wheels(
    response: TextbookResponse, state: Array, command: Array, spec: RobotSpec
) -> _Relation:
    """Relates wheels, which follow the commands as the textbook says, by its fitted gains."""
    book = textbook(spec)
    count = len(spec.state)
    per_command = book.target(np.eye(len(spec.command)))  # (C, S)
    per_wheel = book.twist(np.eye(count))  # (S, 3)
    steady = (per_command @ per_wheel).T  # (3, C)
    power = np.maximum((steady**2).sum(axis=1), 1e-12)
    times = (response.gain * steady).sum(axis=1) / power
    lag = float(response.lag_s[response.gain.any(axis=1)].mean())
    twist = state @ per_wheel * times
    unlimited = np.zeros(count, dtype=np.bool_)
    return _Relation(twist, command @ per_command, np.full(count, lag), unlimited)


def _find_twist(response: TextbookResponse, actuator: Array) -> Array:
    """Returns the body twist (T, 3) of actuators (T, 3): itself, or speed, 0 and angle."""
    bicycle = response.bicycle
    if not bicycle.used:
        return actuator
    speed = actuator[:, 0]
    angle = np.clip(actuator[:, 2], -WIDEST_ANGLE, WIDEST_ANGLE)
    length = bicycle.wheelbase * (1.0 + bicycle.understeer * speed**2)
    along = speed * np.cos(angle) if bicycle.front_drive else speed
    turn = along * np.tan(angle) / length
    return np.stack([along, 0.0 * speed, turn], axis=1)


def _find_speed_limits(response: TextbookResponse) -> tuple[float, float]:
    """Returns the maximum fall and rise of the speed, infinite where none was found."""
    rise, fall = map(float, response.limit)
    most = UNLIMITED * LIMIT_RANGE[1]
    return -fall if fall < most else -np.inf, rise if rise < most else np.inf


def needs_actuators(yardstick: Yardstick, spec: RobotSpec) -> bool:
    """True for a steered robot whose state is its twist: its steering lags, not its turn rate."""
    return yardstick.response.bicycle.used and any(v.twist for v in spec.state)


def make_actuated_spec(yardstick: Yardstick, drive: Drive) -> RobotSpec:
    """Returns a steered robot whose state is its speed and its steering angle."""
    response = yardstick.response
    spec = drive.spec
    speed, steering = _find_bicycle_commands(response)
    speed_gain = abs(float(response.gain[0, speed]))
    angle_gain = abs(float(response.gain[2, steering]))
    forward = [v.twist for v in spec.state].index("vx")
    driven = np.abs(require_state(drive).values[:, forward]).max()
    sent = np.abs(drive.recording.command.values[:, steering]).max()
    turned = angle_gain * sent + abs(response.offset[2])
    states = [
        _make_actuator("wheel_speed", spec.command[speed], speed_gain, driven),
        _make_actuator("wheel_angle", spec.command[steering], angle_gain, turned),
    ]
    parameters = {
        "speed_lag": float(response.lag_s[0]),
        "steering_lag": float(response.lag_s[2]),
    }
    # a car commanded by fractions of throttle and steering
    if "speed_gain" in spec.parameters:
        parameters |= {"speed_gain": speed_gain, "greatest_steering": angle_gain}
    parameters = spec.parameters | parameters
    data = spec.model_dump() | {"state": states, "parameters": parameters}
    return RobotSpec.model_validate(data)


def _make_actuator(
    name: str, command: CommandVariable, gain: float, farthest: float
) -> dict[str, object]:
    """Returns a state that follows a command by a gain, and went as far as this on a drive."""
    unit = "m/s" if name == "wheel_speed" else "rad"
    largest = max(command.max, -command.min)
    reach = max(farthest, gain * largest)
    if command.unit == unit:
        reach = max(reach, largest)
    reach = MARGIN * float(reach)
    limits = {"min": -reach, "max": reach}
    return {"name": name, "unit": unit, "follows": command.name, **limits}


def add_actuator_state(
    drive: Drive, spec: RobotSpec, yardstick: Yardstick, calibration: Calibration
) -> Drive:
    """Returns a drive, with known motion, of a robot whose state is speed and steering angle.

    The speed is that of the motion, the angle that of the textbook for the commands.
    """
    response = yardstick.response
    state = require_state(drive)
    forward = [v.twist for v in drive.spec.state].index("vx")
    _, steering = _find_bicycle_commands(response)
    alone = spec.model_copy(update={"state": spec.state[1:]})
    command = drive.recording.command
    lag = response.lag_s[2:]
    latency = calibration.command_latency_s
    angle = infer_states(command, alone, lag, latency, state.t)[:, 0]
    angle = response.gain[2, steering] * angle + response.offset[2]
    speed = state.values[:, forward]
    if response.bicycle.front_drive:
        speed = speed / np.maximum(np.cos(angle), LEAST_COSINE)
    values = np.stack([speed, angle], axis=1)
    recording = replace(drive.recording, state=Stream(state.t, values, state.clock))
    return replace(drive.part(recording), spec=spec)


def _find_bicycle_commands(response: TextbookResponse) -> tuple[int, int]:
    """Returns the indices of speed and steering among the commands of a bicycle."""
    speed = int(np.argmax(np.abs(response.gain[0])))
    return speed, 1 - speed


def _find_actuator(response: TextbookResponse, command: int) -> tuple[int, float]:
    """Returns the row of the actuator that a command moves most, and its gain."""
    actuator = int(np.argmax(np.abs(response.gain[:, command])))
    if response.bicycle.used and actuator == 2:  # the state is the commanded angle
        return actuator, 1.0
    return actuator, float(response.gain[actuator, command])


def _update_responses(
    response: TextbookResponse, calibration: Calibration, spec: RobotSpec
) -> Iterator[Response]:
    names = [c.name for c in spec.command]
    for follower in calibration.responses:
        actuator, gain = _find_actuator(response, names.index(follower.command))
        yield replace(follower, lag_s=float(response.lag_s[actuator]), gain=gain)


def _find_dead_zones(
    response: TextbookResponse, spec: RobotSpec
) -> Iterator[InputCurve]:
    """Yields the dead zone of a speed command whose effect is below, or above, proportional."""
    if not response.bicycle.used or response.offset[0] == 0.0:
        return
    place = int(np.argmax(np.abs(response.gain[0])))
    dead = float(-response.offset[0] / max(abs(response.gain[0, place]), 1e-9))
    yield InputCurve(command=spec.command[place].name, dead=dead)


def assume_textbook(
    model: TaylorModel, spec: RobotSpec, unmoved: tuple[str, ...]
) -> tuple[TaylorModel, tuple[str, ...]]:
    """Adds textbook terms for inputs that never moved; ConfigError if the spec has no textbook."""
    # A fit at a constant input is a section through the full model: `wz = c speed`, measured at
    # the steering angle s0, becomes `wz = (c/s0) speed*steering`; at s0 = 0, the textbook's
    # parameters are used.
    named = model.named
    rows = {dof: dict(terms) for dof, terms in named.terms.items()}
    point = dict(zip(model.variables, (model.low + model.high) / 2.0, strict=True))
    completion = _Completion(
        model.dt, spec, textbook(spec), unmoved, point, rows, list(model.assumed)
    )
    for i, variable in enumerate(spec.state):
        if variable.twist:  # by definition
            rows[variable.twist] = {variable.name: 1.0}
        elif variable.name in unmoved:
            completion.restore_twist(i)
    for i in range(len(spec.state)):
        completion.restore_rate(i)
    update = {
        "terms": rows,
        "assumed": tuple(completion.assumed),
        "valid": completion.widened(named.valid),
    }
    return named.model_copy(update=update).model(), tuple(completion.notes)


@dataclass(frozen=True)
class _Completion:
    dt: float  # step of the model [s]
    spec: RobotSpec
    book: Textbook
    unmoved: tuple[str, ...]
    point: dict[str, float]  # middle of each variable's range
    rows: dict[str, dict[str, float]]  # coefficients by dof and term, to be completed
    assumed: list[tuple[str, str]]  # (dof, term) pairs
    notes: list[str] = field(default_factory=list)

    def restore_twist(self, i: int) -> None:
        """Restores the products with state variable `i` in the body twist."""
        name = self.spec.state[i].name
        for d, dof in enumerate(("vx", "vy", "wz")):
            for product in self.book.structure[dof]:
                factors = product.split("*")
                if name not in factors:
                    continue
                factors.remove(name)
                learnt = self.rows[dof].pop("*".join(factors) or "1", None)
                value = self.point[name]
                if learnt is not None and abs(value) > MIN_OPERATING_POINT:
                    coefficient = learnt / value
                    source = f"measured at {name} = {value:g}"
                else:
                    coefficient = self._slope(d, product)
                    source = self.source
                if coefficient == 0.0:
                    continue
                self.rows[dof][product] = coefficient
                self.assumed.append((dof, product))
                term = f"{dof} = {coefficient:.4g}*{product} ({source})"
                finding = f"{term}, since {name} never moved"
                advice = f"to learn it, drive with {name} over its whole range"
                self.notes.append(Gap(f"Assumed, not learnt: {finding}; {advice}."))

    def _slope(self, d: int, product: str) -> float:
        """Returns the coefficient of a product of state variables in the textbook twist, at 0."""
        index = [
            i for i, v in enumerate(self.spec.state) if v.name in product.split("*")
        ]
        value = 0.0
        for signs in 1.0 - 2.0 * np.array(list(np.ndindex(*(2,) * len(index)))):
            state = np.zeros(len(self.spec.state))
            state[index] = DIFFERENCE * signs
            value += float(np.prod(signs) * self.book.twist(state)[d])
        return value / (2.0 * DIFFERENCE) ** len(index)

    def widened(
        self, valid: dict[str, tuple[float, float]]
    ) -> dict[str, tuple[float, float]]:
        """Returns the ranges, widened to what commands can reach for assumed parts of the twist."""
        assumed = {dof for dof, _ in self.assumed}
        for variable in self.spec.state:
            if variable.twist and f"d_{variable.name}" in assumed:
                far = float(reach(self.spec)[POSE_RATES.index(variable.twist)])
                low, high = valid[variable.name]
                valid = valid | {variable.name: (min(low, -far), max(high, far))}
        return valid

    @property
    def source(self) -> str:
        """States where the textbook's parameters come from."""
        assumed = ", ".join(self.spec.assumed)
        if not assumed:
            return "from the parameters in the robot's YAML file"
        return f"by default, because the robot's YAML file gives no {assumed}"

    def restore_rate(self, i: int) -> None:
        """Makes a state follow the commands that never moved, with its lag (learnt or nominal)."""
        name = self.spec.state[i].name
        row = self.rows[f"d_{self.spec.state[i].name}"]
        lag = float(self.book.lag[i])
        source = f" ({self.source})"
        rate = float(-np.expm1(-self.dt / lag)) / self.dt
        if name in row:
            rate = -row[name]
            lag = -1.0 / row[name]
            source = ""
        added = self._turning(i, row, rate)
        if added is None:
            added = self._following(i, row, rate)
        if not added:
            return
        if name not in row:
            added[name] = -rate
        row.update(added)
        self.assumed.extend((f"d_{name}", term) for term in added)
        follows = ", ".join(term for term in added if term != name)
        self.notes.append(
            Gap(
                f"Assumed, not learnt: {name} follows {follows} with a lag of {lag:.3g} s{source}."
            )
        )

    def _following(
        self, i: int, row: dict[str, float], rate: float
    ) -> dict[str, float]:
        """Returns the terms by which a state follows commands, one per command."""
        commands = self.spec.command
        target = self.book.target
        here = np.array([self.point[c.name] for c in commands])
        added = {}
        constant = 0.0
        for j, command in enumerate(commands):
            step = np.where(np.arange(len(commands)) == j, DIFFERENCE, 0.0)
            slope = (target(here + step)[i] - target(here - step)[i]) / (
                2.0 * DIFFERENCE
            )
            if command.name in self.unmoved and not abs(slope) < 1e-9:
                added[command.name] = rate * float(slope)
                constant -= added[command.name] * here[j]
        if added:
            constant += row.pop("1", 0.0)
            if self.spec.state[i].name in row and abs(constant) > 1e-9 * rate:
                row["1"] = constant
        return added

    def _turning(
        self, i: int, row: dict[str, float], rate: float
    ) -> dict[str, float] | None:
        """Returns the term by which a car turns whose state is its twist; None for other rates.

        It is the product of speed and steering, measured at a constant if there is one.
        """
        structure = probe_structure(self.spec)
        state = {v.twist: v.name for v in self.spec.state}
        turned = self.spec.state[i].twist == "wz" and "vx" in state
        if structure is None or not structure[1].used or not turned:
            return None
        k = int(np.argmax(np.abs(structure[0][2])))
        names = state["vx"], self.spec.command[k].name
        still = [name for name in names if name in self.unmoved]
        if not still:
            return {}
        learnt = row.pop(
            "*".join(name for name in names if name not in still) or "1", None
        )
        value = float(np.prod([self.point[name] for name in still]))
        if learnt is not None and abs(value) > MIN_OPERATING_POINT:
            return {"*".join(names): learnt / value}
        return {
            "*".join(names): rate * float(structure[0][2, k]) / structure[1].wheelbase
        }
