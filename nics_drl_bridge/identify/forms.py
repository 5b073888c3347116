"""Forms: effects of motors, delays and tyres, which predictions of a drive confirm or refuse.

Input curves are those of Hammerstein models: dead zone, saturation, a separate reverse gain.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import product

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.geometry import Array
from nics_drl_bridge.identify import shooting
from nics_drl_bridge.identify.alignment import (
    average_effect,
    choose_half_width,
    find_speed_index,
    lag_behind,
    list_followed_commands,
    select_moved_commands,
    select_moved_inputs,
    smooth_commands,
)
from nics_drl_bridge.identify.calibration import Calibration
from nics_drl_bridge.identify.drive import Drive
from nics_drl_bridge.identify.open_loop import MIDDLE_OF_STEP, roll
from nics_drl_bridge.identify.statistics import compute_unexplained
from nics_drl_bridge.identify.terms import (
    Kind,
    Library,
    find_linear_term,
    select_motion_terms,
    tells_lever_from_wheels,
)
from nics_drl_bridge.identify.textbook import probe_structure
from nics_drl_bridge.recording.recording import Samples
from nics_drl_bridge.robot.curve import InputCurve
from nics_drl_bridge.robot.spec import POSE_RATES, RobotSpec
from nics_drl_bridge.robot.taylor import TaylorModel, evaluate, list_exponents

LAGS_S = (0.05, 0.15, 0.4, 1.0, 2.0)
# trial dead zones, as fractions of the command's maximum
DEAD = np.linspace(0.0, 0.45, 10)
FULL = np.linspace(0.15, 1.0, 18)
WORTH = 0.03  # minimum fraction of the residual variance that a curve must explain
# fraction from which it is beyond doubt; higher for the turn rate, where understeer looks alike
CLEAR = 0.25
STRIDE_S = 0.04
NOTHING = 1e-6  # [m/s, rad/s]
ENOUGH_ROWS = 1000  # to rank delays
# order of the model in the search for a delay
DELAY_ORDER = 2
DELAY_STEP_S = 0.02
LONGEST_S = 0.4  # a delay is sought this far around where its search starts
# step of their refinement
DELAY_SCALE_S = 0.05
CURVE_SCALE = 0.1
# step of a reverse gain
BACK_SCALE = 0.2
BACK_RANGE = (0.2, 5.0)
# fraction of a command's maximum at which the search for a dead zone starts
SMALL_DEAD = 0.05
# minimum fraction of the rows in which a command drives backwards, to determine its reverse gain
TWO_WAY = 0.05
# fraction of a command's maximum by which it must exceed the end of its curve
NEAR_END = 0.01
SELDOM = 1.0  # percentage of a drive that must exceed a rate limit for it to count
STRONG = 95.0  # percentile of the rates at which the search for limits starts
LEVER_SCALE_M = 0.05
TURN_SCALE = 0.1
LAG_SCALE_S = 0.02
# where limits of a state may start, relative to its command's range per second, and all delays
# and lags, which these limits may explain in part
RATES = (0.125, 0.25, 0.5, 1.0, 2.0, 4.0)
SHARES = (1.0, 0.5, 0.25)
START_SPACING_S = 1.0
LAG_RANGE_S = (0.002, 3.0)

Row = tuple[float, float, float, float]  # start, scale, and bounds of a parameter


@dataclass(frozen=True)
class FoundCurve:
    """A curve that explains a component of the twist better than a straight line."""

    curve: InputCurve
    gain: float  # fraction of the unexplained variance that it explains
    drives: bool  # True if it is of the speed


def find_input_curve(
    samples: Samples, spec: RobotSpec, place: int
) -> FoundCurve | None:
    """Returns the best curve of the command at an index; None if a straight line does as well."""
    structure = probe_structure(spec)
    # components of the twist that it drives
    acts = np.ones(3) if structure is None else structure[0][:, place]
    candidates = []
    for variable in spec.state:
        if variable.twist and acts[POSE_RATES.index(variable.twist)]:
            dof = POSE_RATES.index(variable.twist)
            candidates.append(_fit_curve(samples, spec, place, dof))
    found = [candidate for candidate in candidates if candidate is not None]
    if not found:
        return None
    best = max(found, key=lambda candidate: candidate.gain)
    needed = WORTH if best.drives else CLEAR
    return best if best.gain >= needed else None


def _fit_curve(
    samples: Samples, spec: RobotSpec, place: int, dof: int
) -> FoundCurve | None:
    """Returns the curve of a command that best explains a component of the twist, if one does."""
    sent = samples.x[:, len(spec.state) + place]
    reach = np.array([sent.min(), sent.max()])

    def measure_rest(dead: float, full: float) -> float:
        curve = _make_curve("", reach, dead, full)
        return _measure_rest(samples, spec, place, dof, curve)

    straight = measure_rest(0.0, 1.0)
    if straight < NOTHING**2 * len(sent):
        return None
    trials = [(measure_rest(0.0, full), 0.0, full) for full in FULL]
    full = min(trials)[2]
    trials += [(measure_rest(dead, full), dead, full) for dead in DEAD if dead < full]
    least, dead, full = min(trials)
    gain = 1.0 - least / straight
    if gain < WORTH:
        return None
    curve = _make_curve(spec.command[place].name, reach, dead, full)
    return FoundCurve(curve, gain, dof == 0)


def _measure_rest(
    samples: Samples, spec: RobotSpec, place: int, dof: int, curve: InputCurve
) -> float:
    """Returns the sum of squares that a curve of a command leaves unexplained, at the best lag."""
    effect = samples.x[:, len(spec.state) :].copy()
    effect[:, place] = curve.of(effect[:, place])
    stride = max(1, round(STRIDE_S / samples.dt))
    twist = _get_twist(samples, spec)
    speed = twist[:, 0]
    target = twist[::stride, dof]
    least = np.inf
    for lag in LAGS_S:
        lagged = [_lag_command(u, float(np.exp(-samples.dt / lag))) for u in effect.T]
        if dof:
            lagged += [low * speed for low in lagged]
        chi = np.stack([np.ones(len(speed)), *lagged], axis=1)[::stride]
        rest = target - chi @ np.linalg.lstsq(chi, target, rcond=None)[0]
        least = min(least, float(rest @ rest))
    return least


def _get_twist(samples: Samples, spec: RobotSpec) -> Array:
    """Returns the components (T, 3) of the twist that are states, and zeros for others."""
    twist = np.zeros((len(samples.t), 3))
    for i, variable in enumerate(spec.state):
        if variable.twist:
            twist[:, POSE_RATES.index(variable.twist)] = samples.x[:, i]
    return twist


def _lag_command(command: Array, kept: float) -> Array:
    """Returns a command (T,) behind a first-order lag."""
    return lag_behind(np.append(command, 0.0), 0.0, kept)[1:]


def _make_curve(name: str, reach: Array, dead: float, full: float) -> InputCurve:
    size = float(np.abs(reach).max())
    return InputCurve(
        command=name,
        dead=dead * size,
        least=max(float(reach[0]), -full * size),
        most=min(float(reach[1]), full * size),
    )


@dataclass(frozen=True)
class Form:
    """Effects in a model besides gains and lags."""

    curves: tuple[InputCurve, ...] = ()
    friction: tuple[str, ...] = ()  # states with dry friction
    limits: tuple[str, ...] = ()  # states with a maximum fall and rise
    back: tuple[str, ...] = ()  # commands whose curve has a separate reverse gain
    drag: tuple[str, ...] = ()  # states with a quadratic drag and a back-EMF
    # True if a car turns less at speed than its textbook, and slips sideways
    tyres: bool = False
    # initial delays of all commands [s]; empty if they share one
    delays: tuple[tuple[str, float], ...] = ()
    # (state, command) pairs of states that were not measured
    followed: tuple[tuple[str, str], ...] = ()
    # parts of the mounting that predictions adjust: `x`, `y` and `heading`
    mounted: tuple[str, ...] = ()
    is_timed: bool = False  # True if a measured state tells the latency

    def find_latency(self, at: shooting.Values) -> float:
        """Returns the common latency of the commands: their minimum delay [s]."""
        delays = [at[f"{name}.delay"] for name, _ in self.delays]
        return min(delays, default=at["latency"])

    def make_curves(self, at: shooting.Values) -> tuple[InputCurve, ...]:
        """Returns the input curves for values of the parameters."""
        latency = self.find_latency(at)
        curves = {curve.command: curve for curve in self.curves}
        for name, _ in self.delays:
            curves.setdefault(name, InputCurve(command=name))
        curves_now = (
            InputCurve(
                command=name,
                dead=at.get(f"{name}.dead", curve.dead),
                least=at.get(f"{name}.least", curve.least),
                most=at.get(f"{name}.most", curve.most),
                back=at.get(f"{name}.back", curve.back),
                delay=at.get(f"{name}.delay", latency) - latency,
            )
            for name, curve in curves.items()
        )
        return tuple(c for c in curves_now if c != InputCurve(command=c.command))

    def actuate(self, model: TaylorModel, at: shooting.Values) -> TaylorModel:
        """Returns a model with the lags, friction, drag and limits of its parameters."""
        states = model.variables[: model.state_size]
        commands = model.variables[model.state_size :]
        emf = [[at.get(f"{s}.back_emf.{c}", 0.0) for c in commands] for s in states]
        falls = [-at.get(f"{name}.fall", np.inf) for name in states]
        rises = [at.get(f"{name}.rise", np.inf) for name in states]
        model = replace(
            model,
            friction=np.array([at.get(f"{name}.friction", 0.0) for name in states]),
            drag=np.array([at.get(f"{name}.drag", 0.0) for name in states]),
            back_emf=np.array(emf).reshape(len(states), len(commands)),
            limits=np.stack([falls, rises], axis=1),
        )
        for state, command in self.followed:
            gain = at.get(f"{state}.gain", 1.0)
            model = set_lag(model, state, command, at[f"{state}.lag"], gain)
        return model


@dataclass(frozen=True)
class Evidence:
    """A drive on one time axis, as calibrated so far, and the terms that its model may have."""

    drive: Drive
    calibration: Calibration
    samples: Samples
    library: Library


def are_lags_measured(calibration: Calibration) -> bool:
    """True if both offset and latency are known: only the wheels' response separates them."""
    return {"clock_offset_s", "command_latency_s"} <= set(calibration.uncertainty)


def list_followed(drive: Drive) -> tuple[tuple[str, str], ...]:
    """Returns (state, command) pairs of unmeasured states whose command moved."""
    if drive.recording.state is not None:
        return ()
    moved = select_moved_inputs(drive.recording.command, drive.spec)
    pairs = zip(drive.spec.state, moved.tolist(), strict=False)
    return tuple((v.name, str(v.follows)) for v, has_moved in pairs if has_moved)


def list_delays(evidence: Evidence) -> tuple[tuple[str, float], ...]:
    """Returns a delay [s] of each command that moved: at first, what all of them share."""
    drive = evidence.drive
    moved = select_moved_commands(drive.recording.command).tolist()
    latency = evidence.calibration.command_latency_s
    pairs = zip(drive.spec.command, moved, strict=True)
    return tuple((c.name, latency) for c, has_moved in pairs if has_moved)


def add_limits(form: Form, state: str) -> Form:
    """Returns a form in which a state has a maximum fall and rise."""
    return replace(form, limits=(*form.limits, state))


def make_form(evidence: Evidence) -> Form:
    """Returns the plainest form of a drive's model."""
    drive = evidence.drive
    library = evidence.library
    spec = drive.spec
    if spec.moves_sideways and (spec.state or spec.takes_cmd_vel):
        # The terms of the twist may be those of a body that is turned or moved.
        return Form(
            followed=list_followed(drive) if library.kind is Kind.FOLLOWER else (),
            is_timed=library.kind is Kind.MEASURED,
        )
    if not spec.state:
        if tells_lever_from_wheels(spec):
            return Form(mounted=("x", "y", "heading"))
        return Form(mounted=("x", "heading"))
    if library.kind is Kind.MOTION:
        return Form()
    known = evidence.calibration.uncertainty
    mounted = []
    if "lever_arm_x_m" in known:
        mounted.append("x")
    if "lever_arm_y_m" in known and tells_lever_from_wheels(spec):
        mounted.append("y")
    if "rotation_rad" in known:
        mounted.append("heading")
    return Form(
        followed=list_followed(drive),
        mounted=tuple(mounted),
        is_timed=library.kind is Kind.MEASURED,
    )


def choose_start(
    problem: shooting.Shooting, model: TaylorModel, known: tuple[str, ...]
) -> shooting.Shooting:
    """Starts limits of states that are not `known` where predictions are best, with the lags."""
    names = problem.parameters.names
    for name in names:
        state = name.removesuffix(".rise")
        if state == name or name in known or f"{state}.lag" not in names:
            continue
        coarse = replace(problem, spacing_s=START_SPACING_S)
        starts = _list_starts(problem.parameters, state)
        errors = [coarse.measure_mean_error(model, start) for start in starts]
        best = starts[int(np.argmin(errors))]
        problem = replace(problem, parameters=replace(problem.parameters, start=best))
    return problem


def _list_starts(parameters: shooting.Parameters, state: str) -> list[Array]:
    """Returns starts (I,) of the limits of a state, with delays and lags that fit to these."""
    names = parameters.names
    limits = np.isin(names, [f"{state}.rise", f"{state}.fall"])
    times = [n == "latency" or n.endswith((".lag", ".delay")) for n in names]
    starts = []
    for rate, share in product(RATES, SHARES):
        start = parameters.start.copy()
        start[limits] *= rate
        start[times] *= share
        starts.append(np.clip(start, parameters.low, parameters.high))
    return starts


def set_lag(
    model: TaylorModel, state: str, command: str, lag_s: float, gain: float
) -> TaylorModel:
    """Returns a model in which a state follows a command with a lag [s] and a gain."""
    names = np.array(model.variables)
    row = 3 + int(np.flatnonzero(names == state)[0])
    rate = -np.expm1(-model.dt / lag_s) / model.dt
    coefficients = model.coefficients.copy()
    coefficients[row] = 0.0
    coefficients[row, find_linear_term(model, state)] = -rate
    coefficients[row, find_linear_term(model, command)] = rate * gain
    return replace(model, coefficients=coefficients)


class _InEffect:
    """Commands in effect at the rows of a drive, and states that follow these."""

    def __init__(self, evidence: Evidence, form: Form) -> None:
        self.drive = evidence.drive
        self.form = form
        self.dt = evidence.samples.dt
        self.t = evidence.samples.t
        self.rows: slice | NDArray[np.intp] = slice(None)
        if form.followed:
            self._begin_at_first_command()
        self.commands = {c.name for c in self.drive.spec.command}
        self.follower = _make_follower(self.drive.spec, self.dt)
        # Most parameters affect neither commands nor states.
        self._average = lru_cache(maxsize=8)(self._average_commands)
        self._roll = lru_cache(maxsize=8)(self._roll_states)

    def _begin_at_first_command(self) -> None:
        """Extends the times back to the first command, from which on states follow."""
        first = self.t[0]
        sent = self.drive.recording.command.t[0]
        lead = int(np.ceil(max(0.0, first - sent) / self.dt)) + 1
        rows = np.round((self.t - first) / self.dt).astype(np.intp) + lead
        steps = np.arange(-lead, rows[-1] - lead + 1) + MIDDLE_OF_STEP
        self.t = first + self.dt * steps
        self.rows = rows

    def find_commands(self, at: shooting.Values) -> Array:
        """Returns the commands (T, C) in effect for values of the parameters."""
        return np.asarray(self._find_all_commands(at)[self.rows])

    def find_states(self, at: shooting.Values) -> Array:
        """Returns the states (T, S) that follow them."""
        # A mounting, whose names have no dot, does not affect a state.
        return self._roll(
            tuple(item for item in at.items() if "." in item[0] or item[0] == "latency")
        )

    def _find_all_commands(self, at: shooting.Values) -> Array:
        names = {"latency"} | self.commands
        return self._average(
            tuple(item for item in at.items() if item[0].partition(".")[0] in names)
        )

    def _average_commands(self, items: tuple[tuple[str, float], ...]) -> Array:
        at = dict(items)
        begin = self.t - self.form.find_latency(at)
        command = self.drive.recording.command
        curves = self.form.make_curves(at)
        return average_effect(command, self.drive.spec, curves, begin, begin + self.dt)

    def _roll_states(self, items: tuple[tuple[str, float], ...]) -> Array:
        at = dict(items)
        sent = self._find_all_commands(at)
        spec = self.drive.spec
        gains = [at.get(f"{v.name}.gain", 1.0) for v in spec.state]
        begin = np.array(gains) * sent[0, list_followed_commands(spec)]
        model = self.form.actuate(self.follower, at)
        _, states = roll(model, begin[None], sent[None])
        return np.asarray(states[0][self.rows])


def make_prediction_problem(
    evidence: Evidence, form: Form, parameters: shooting.Parameters
) -> shooting.Shooting:
    """Returns the prediction problem of a drive, to find the parameters of a form."""
    drive = evidence.drive
    in_effect = _InEffect(evidence, form)
    noise, _ = drive.pose_noise or (0.0, 0.0)

    def trust(start: Array, end: Array) -> Array:
        offset = evidence.calibration.clock_offset_s
        return drive.trust(start - offset, end - offset)

    return shooting.Shooting(
        evidence.samples,
        parameters,
        commands=in_effect.find_commands,
        shape=form.actuate,
        trust=trust,
        inferred=in_effect.find_states if form.followed else None,
        noise_m=noise,
    )


def _make_follower(spec: RobotSpec, dt: float) -> TaylorModel:
    """Returns a model without motion, with a term of each variable alone."""
    count = len(spec.variable_names)
    return TaylorModel(
        spec.variable_names,
        spec.dof_names,
        spec.dof_units,
        powers=np.eye(count, dtype=np.int64),
        coefficients=np.zeros((len(spec.dof_names), count)),
        dt=dt,
        low=np.full(count, -np.inf),
        high=np.full(count, np.inf),
    )


def list_parameters(evidence: Evidence, form: Form) -> shooting.Parameters:
    """Returns the parameters of a form besides coefficients: start, scale and bounds by name."""
    rows = _list_command_values(evidence, form)
    rows |= _list_follower_values(evidence, form)
    rows |= _list_motor_values(evidence, form)
    if form.mounted:
        rows |= _list_mounting_values(evidence.drive.spec, form)
    return shooting.Parameters(tuple(rows), *np.array(list(rows.values())).T)


def _list_motor_values(evidence: Evidence, form: Form) -> dict[str, Row]:
    """Returns the rows of friction, drag and limits of states."""
    spec = evidence.drive.spec
    samples = evidence.samples
    rates = {v.name: samples.dq[:, 3 + i] for i, v in enumerate(spec.state)}
    variables = dict(zip(spec.variable_names, samples.x.T, strict=True))
    for response in evidence.calibration.responses:
        if (response.state, response.command) in form.followed:
            size = abs(response.gain) * float(np.ptp(variables[response.command]))
            rates[response.state] = np.array([-size, size])
    rows: dict[str, Row] = {}
    for name in form.friction:
        rows[f"{name}.friction"] = _start_small(_find_strong(np.abs(rates[name])))
    for name in form.drag:
        rows |= _list_drag_values(name, rates[name], variables, spec)
    for name in form.limits:
        rows[f"{name}.fall"] = _start_at_strong(-rates[name])
        rows[f"{name}.rise"] = _start_at_strong(rates[name])
    return rows


def _list_mounting_values(spec: RobotSpec, form: Form) -> dict[str, Row]:
    """Returns the rows of what remains of the error of the mounting."""
    reach = 2.0 * spec.footprint_radius
    mounting = {"x": (LEVER_SCALE_M, reach), "y": (LEVER_SCALE_M, reach)}
    mounting["heading"] = (TURN_SCALE, np.pi)
    rows = {}
    for name, (scale, most) in mounting.items():
        most = most if name in form.mounted else 0.0
        rows[name] = (0.0, scale, -most, most)
    return rows


def _start_at_strong(rates: Array) -> Row:
    """Returns start, scale and bounds of a limit, near the strong rates of a drive (T,)."""
    size = max(_find_strong(rates), 1e-3)
    return size, 0.3 * size, 0.05 * size, 20.0 * size


def _find_strong(rates: Array) -> float:
    """Returns a strong rate of those of a drive (T,)."""
    return float(np.percentile(rates, STRONG))


def _list_drag_values(
    name: str, rate: Array, variables: dict[str, Array], spec: RobotSpec
) -> dict[str, Row]:
    """Returns the rows of a state's drag, and of its back-EMF by each command that drives."""
    value = variables[name]
    strong = _find_strong(np.abs(rate))
    square = max(float(np.mean(value**2)), 1e-3)
    rows = {f"{name}.drag": _start_small(strong / square)}
    for command in list_driving_commands(spec):
        effect = max(float(np.abs(variables[command] * value).mean()), 1e-3)
        rows[f"{name}.back_emf.{command}"] = _start_small(strong / effect)
    return rows


def _start_small(size: float) -> Row:
    """Returns start, scale and bounds of a parameter between zero and a size."""
    return 0.1 * size, 0.1 * size, 0.0, size


def _list_follower_values(evidence: Evidence, form: Form) -> dict[str, Row]:
    """Returns the rows of lags [s] and gains of states that follow commands."""
    spec = evidence.drive.spec
    rows = {}
    speed = find_speed_index(spec)
    scaled = None if speed is None else spec.state[speed].name
    is_known = are_lags_measured(evidence.calibration) and not form.limits
    for response in evidence.calibration.responses:
        state = response.state
        if (state, response.command) not in form.followed:
            continue
        lag = float(np.clip(response.lag_s, *LAG_RANGE_S))
        bounds = (lag, lag) if is_known else LAG_RANGE_S
        rows[f"{state}.lag"] = (lag, LAG_SCALE_S, *bounds)
        if state == scaled:
            gain = response.gain
            low, high = sorted((0.2 * gain, 5.0 * gain))
            rows[f"{state}.gain"] = (gain, 0.1 * abs(gain), low, high)
    return rows


def _list_command_values(evidence: Evidence, form: Form) -> dict[str, Row]:
    """Returns the rows of latency and delays [s], and of input curves."""
    recording = evidence.drive.recording
    latency = evidence.calibration.command_latency_s
    one_clock = recording.pose.clock == recording.command.clock
    bounds = (
        min(latency, 0.0) if one_clock else latency - LONGEST_S,
        latency + LONGEST_S,
    )
    is_known = form.is_timed or form.delays
    shared = (latency, latency) if is_known else bounds
    rows = {"latency": (latency, DELAY_SCALE_S, *shared)}
    rows |= {f"{name}.delay": (at, DELAY_SCALE_S, *bounds) for name, at in form.delays}
    for curve in form.curves:
        rows |= _list_curve_values(curve)
        if curve.command in form.back:
            rows[f"{curve.command}.back"] = (curve.back, BACK_SCALE, *BACK_RANGE)
    return rows


def _list_curve_values(curve: InputCurve) -> dict[str, Row]:
    """Returns the rows of a curve's dead zone and ends; none for a curve without ends."""
    size = max(abs(curve.least), abs(curve.most))
    if not np.isfinite(size):
        return {}
    name = curve.command
    step = CURVE_SCALE * size
    widest = 0.5 * size if curve.dead else 0.0
    least = curve.least
    most = curve.most
    return {
        f"{name}.dead": (curve.dead, step, 0.0, widest),
        f"{name}.least": (least, step, 1.5 * least, 0.5 * least),
        f"{name}.most": (most, step, 0.5 * most, 1.5 * most),
    }


def find_two_way_curves(evidence: Evidence) -> tuple[InputCurve, ...]:
    """Returns neutral curves of commands that drive the robot both ways."""
    spec = evidence.drive.spec
    curves = []
    for name in list_driving_commands(spec):
        sent = evidence.samples.x[:, spec.variable_names.index(name)]
        if min((sent < 0.0).mean(), (sent > 0.0).mean()) > TWO_WAY:
            least = float(sent.min())
            most = float(sent.max())
            curves.append(InputCurve(command=name, least=least, most=most))
    return tuple(curves)


def list_driving_commands(spec: RobotSpec) -> tuple[str, ...]:
    """Names the commands that drive a robot ahead, according to its textbook."""
    structure = probe_structure(spec)
    if structure is None:
        return ()
    moves, _ = structure
    return tuple(spec.command[k].name for k in np.flatnonzero(moves[0]))


def add_dead_zones(
    form: Form, evidence: Evidence, commands: tuple[str, ...] | None = None
) -> Form:
    """Returns a form in which commands, by default those that drive ahead, have a dead zone."""
    spec = evidence.drive.spec
    if commands is None:
        commands = list_driving_commands(spec)
    bent = {c.command: c for c in form.curves}
    for name in commands:
        sent = evidence.samples.x[:, spec.variable_names.index(name)]
        low = min(float(sent.min()), 0.0)
        high = max(float(sent.max()), 0.0)
        curve = bent.get(name, InputCurve(command=name, least=low, most=high))
        if not curve.dead:
            bent[name] = curve.model_copy(update={"dead": SMALL_DEAD * max(-low, high)})
    return replace(form, curves=tuple(bent.values()))


def add_reverse_gains(form: Form, curves: tuple[InputCurve, ...]) -> Form:
    """Returns a form in which the commands of curves have separate reverse gains."""
    curved = {curve.command for curve in form.curves}
    more = tuple(curve for curve in curves if curve.command not in curved)
    back = tuple(curve.command for curve in curves)
    return replace(form, curves=form.curves + more, back=back)


def drop_unreached_ends(
    model: TaylorModel, drive: Drive, samples: Samples, errors: Mapping[str, float]
) -> TaylorModel:
    """Returns a model without curve ends that were never reached, and limits that hardly were.

    Limits below their errors (by name) are removed as well. The range of a command in effect
    becomes that of the commands sent.
    """
    low = model.low.copy()
    high = model.high.copy()
    curves = []
    for curve in model.inputs:
        place = [c.name for c in drive.spec.command].index(curve.command)
        sent = drive.recording.command.values[:, place]
        reach = np.array([min(sent.min(), 0.0), max(sent.max(), 0.0)])
        curve = _drop_curve_ends(curve, reach)
        row = model.state_size + place
        low[row], high[row] = curve.of([sent.min(), sent.max()])
        if curve != InputCurve(command=curve.command):
            curves.append(curve)
    limits = _drop_limits(model, samples, errors)
    return replace(model, inputs=tuple(curves), low=low, high=high, limits=limits)


def _drop_curve_ends(curve: InputCurve, reach: Array) -> InputCurve:
    """Returns a curve without the ends that a command within its reach (2,) did not pass."""
    beyond = NEAR_END * float(np.abs(reach).max())
    ends = {}
    if not reach[0] < curve.least - beyond:
        ends["least"] = -np.inf
    if not reach[1] > curve.most + beyond:
        ends["most"] = np.inf
    return curve.model_copy(update=ends)


def _drop_limits(
    model: TaylorModel, samples: Samples, errors: Mapping[str, float]
) -> Array:
    """Returns the limits (S, 2) of a model, infinite where the drive hardly reached them."""
    limits = model.limits.copy()
    nothing = np.zeros(0)
    free = replace(model, limits=np.zeros((0, 2)), drag=nothing, friction=nothing)
    asked = free.rates(samples.x)[:, 3:]
    for i, name in enumerate(model.variables[: model.state_size]):
        lowest, highest = np.percentile(asked[:, i], (SELDOM, 100.0 - SELDOM))
        if not lowest < limits[i, 0] < -errors.get(f"{name}.fall", 0.0):
            limits[i, 0] = -np.inf
        if not highest > limits[i, 1] > errors.get(f"{name}.rise", 0.0):
            limits[i, 1] = np.inf
    return limits


def find_likely_delay(
    drive: Drive, calibration: Calibration, samples: Samples
) -> float:
    """Returns the delay [s] of the commands that best explains the rates of the state."""
    recording = drive.recording
    trials = np.arange(0.0, LONGEST_S, DELAY_STEP_S)
    if recording.pose.clock != recording.command.clock:
        trials = trials - LONGEST_S / 2.0
    width = choose_half_width(drive)
    left = []
    for delay in trials:
        begin = samples.t - delay
        command = average_effect(
            recording.command,
            drive.spec,
            calibration.inputs,
            begin,
            begin + samples.dt,
        )
        smooth = smooth_commands(command, samples.dt, width)
        left.append(_measure_unexplained(drive.spec, samples, smooth))
    if np.isfinite(left).all():
        return float(trials[int(np.argmin(left))])
    return calibration.command_latency_s


def _measure_unexplained(spec: RobotSpec, samples: Samples, command: Array) -> float:
    """Returns the part of the state's rates that commands in effect (T, C) leave unexplained."""
    states = len(spec.state)
    free = [3 + i for i, v in enumerate(spec.state) if v.twist] or [0, 2]
    # rows in between hardly differ
    stride = max(1, min(round(STRIDE_S / samples.dt), len(command) // ENOUGH_ROWS))
    x = np.concatenate([samples.x[:, :states], command], axis=1)[::stride]
    rates = samples.dq[::stride]
    powers = list_exponents(x.shape[1], DELAY_ORDER)
    allowed = select_motion_terms(powers, spec)
    left = 0.0
    for d in free:
        chi = evaluate(x, powers[allowed[d]])
        left += float((compute_unexplained(chi, rates[:, [d]]) ** 2).mean())
    return left
