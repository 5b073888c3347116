"""Effects of motors, delays, tyres and the mounting, as rows of parameters.

Which effects a model has is told by the names of its parameters: `throttle.dead` is a dead zone,
`vx.drag` a drag. Predictions of a drive confirm or refuse them. Input curves are those of
Hammerstein models: dead zone, saturation, a separate reverse gain.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from itertools import product

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.geometry import Array
from nics_drl_bridge.identify import shooting
from nics_drl_bridge.identify.calibration import Calibration, smooth_commands
from nics_drl_bridge.identify.drive import Drive
from nics_drl_bridge.identify.open_loop import MIDDLE_OF_STEP, roll
from nics_drl_bridge.identify.signals import (
    average_effect,
    find_speed_index,
    lag_behind,
    list_followed_commands,
    select_moved_commands,
    select_moved_inputs,
)
from nics_drl_bridge.identify.statistics import compute_unexplained
from nics_drl_bridge.identify.terms import (
    Kind,
    Library,
    find_linear_term,
    select_motion_terms,
    tells_lever_from_wheels,
)
from nics_drl_bridge.identify.yardstick import probe_structure
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
# start, step and bounds of a reverse gain
BACK = (1.0, 0.2, 0.2, 5.0)
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
Rows = dict[str, Row]
# True if a car turns less at speed than its textbook, and slips sideways
TYRES: Rows = {"tyres": (1.0, 1.0, 1.0, 1.0)}
# pose of the tracked body, by the names of its parts in a calibration
MOUNTING = {
    "x": "lever_arm_x_m",
    "y": "lever_arm_y_m",
    "heading": "rotation_rad",
}
CURVE_PARTS = ("dead", "least", "most", "back", "delay")


@dataclass(frozen=True)
class Evidence:
    """A drive on one time axis, as calibrated so far, and the terms that its model may have."""

    drive: Drive
    calibration: Calibration
    samples: Samples
    library: Library

    @property
    def followed(self) -> tuple[tuple[str, str], ...]:
        """Pairs (state, command) of unmeasured states whose command moved."""
        if self.library.kind is not Kind.FOLLOWER:
            return ()
        moved = select_moved_inputs(self.drive.recording.command, self.drive.spec)
        pairs = zip(self.drive.spec.state, moved.tolist(), strict=True)
        return tuple((v.name, str(v.follows)) for v, has_moved in pairs if has_moved)

    def find_column(self, name: str) -> Array:
        """Returns the samples (T,) of a variable of the robot."""
        return self.samples.x[:, self.drive.spec.variable_names.index(name)]

    def find_rates(self, state: str) -> Array:
        """Returns rates of a state; those that steps of its command ask for if it follows one."""
        for response in self.calibration.responses:
            if response.state == state and (state, response.command) in self.followed:
                moved = float(np.ptp(self.find_column(response.command)))
                return abs(response.gain) * np.array([-moved, moved])
        return self.samples.dq[:, 3 + self.drive.spec.variable_names.index(state)]


def list_plain_rows(evidence: Evidence, curves: tuple[InputCurve, ...] = ()) -> Rows:
    """Returns the parameters of the plainest model: delay, curves, lags, gains and mounting."""
    latency = _list_delay_row(evidence)
    if evidence.library.kind is Kind.MEASURED:  # the state tells it
        latency = _fix(latency)
    rows = {"latency": latency}
    for curve in curves:
        rows |= list_curve_rows(curve)
    return rows | _list_follower_rows(evidence) | _list_mounting_rows(evidence)


def _fix(row: Row) -> Row:
    """Returns the row of a parameter that is known."""
    start, scale, _, _ = row
    return start, scale, start, start


def _list_delay_row(evidence: Evidence) -> Row:
    """Returns the row of a delay, near the latency found so far [s]."""
    recording = evidence.drive.recording
    latency = evidence.calibration.command_latency_s
    low = latency - LONGEST_S
    if recording.pose.clock == recording.command.clock:
        low = min(latency, 0.0)
    return latency, DELAY_SCALE_S, low, latency + LONGEST_S


def list_delay_rows(evidence: Evidence) -> Rows:
    """Returns a delay of each command that moved, in place of one latency; none if only one did."""
    names = [command for _, command in evidence.followed]
    if evidence.library.kind is Kind.MOTION:
        moved = select_moved_commands(evidence.drive.recording.command).tolist()
        pairs = zip(evidence.drive.spec.command, moved, strict=True)
        names = [command.name for command, has_moved in pairs if has_moved]
    row = _list_delay_row(evidence)
    delays = {f"{name}.delay": row for name in names}
    return {"latency": _fix(row)} | delays if len(delays) > 1 else {}


def list_curve_rows(curve: InputCurve) -> Rows:
    """Returns the rows of a curve's ends and dead zone."""
    name = curve.command
    step = CURVE_SCALE * max(abs(curve.least), abs(curve.most))
    rows = {
        f"{name}.least": (curve.least, step, 1.5 * curve.least, 0.5 * curve.least),
        f"{name}.most": (curve.most, step, 0.5 * curve.most, 1.5 * curve.most),
    }
    if curve.dead:
        rows[f"{name}.dead"] = (curve.dead, step, 0.0, 5.0 * step)
    return rows


def list_dead_zone_rows(evidence: Evidence, command: str) -> Rows:
    """Returns the rows of a small dead zone of a command that never saturates."""
    sent = evidence.find_column(command)
    low = min(float(sent.min()), 0.0)
    high = max(float(sent.max()), 0.0)
    dead = SMALL_DEAD * max(-low, high)
    return list_curve_rows(InputCurve(command=command, dead=dead, least=low, most=high))


def list_reverse_rows(evidence: Evidence) -> Rows:
    """Returns a separate reverse gain of each command that drives the robot both ways."""
    rows: Rows = {}
    for name in list_driving_commands(evidence.drive.spec):
        sent = evidence.find_column(name)
        if min((sent < 0.0).mean(), (sent > 0.0).mean()) > TWO_WAY:
            ends = InputCurve(command=name, least=sent.min(), most=sent.max())
            rows |= list_curve_rows(ends) | {f"{name}.back": BACK}
    return rows


def list_limit_rows(evidence: Evidence, state: str) -> Rows:
    """Returns the rows of a state's maximum fall and rise, and of lags, which these explain."""
    rows = _list_lag_rows(evidence)
    for name, sign in (("fall", -1.0), ("rise", 1.0)):
        size = max(_find_strong(sign * evidence.find_rates(state)), 1e-3)
        rows[f"{state}.{name}"] = (size, 0.3 * size, 0.05 * size, 20.0 * size)
    return rows


def list_friction_rows(evidence: Evidence, state: str) -> Rows:
    """Returns the row of a state's dry friction."""
    strong = _find_strong(np.abs(evidence.find_rates(state)))
    return {f"{state}.friction": _start_small(strong)}


def list_drag_rows(evidence: Evidence, state: str) -> Rows:
    """Returns the rows of a state's drag, and of its back-EMF by each command that drives."""
    value = evidence.find_column(state)
    strong = _find_strong(np.abs(evidence.find_rates(state)))
    square = max(float(np.mean(value**2)), 1e-3)
    rows = {f"{state}.drag": _start_small(strong / square)}
    for command in list_driving_commands(evidence.drive.spec):
        effect = max(float(np.abs(evidence.find_column(command) * value).mean()), 1e-3)
        rows[f"{state}.back_emf.{command}"] = _start_small(strong / effect)
    return rows


def _find_strong(rates: Array) -> float:
    """Returns a strong rate of those of a drive (T,)."""
    return float(np.percentile(rates, STRONG))


def _start_small(size: float) -> Row:
    """Returns start, scale and bounds of a parameter between zero and a size."""
    return 0.1 * size, 0.1 * size, 0.0, size


def _list_lag_rows(evidence: Evidence) -> Rows:
    """Returns the rows of lags [s] of states that follow commands."""
    lags = {r.state: r.lag_s for r in evidence.calibration.responses}
    return {
        f"{state}.lag": (
            float(np.clip(lags[state], *LAG_RANGE_S)),
            LAG_SCALE_S,
            *LAG_RANGE_S,
        )
        for state, _ in evidence.followed
    }


def _list_follower_rows(evidence: Evidence) -> Rows:
    """Returns the rows of lags of states that follow commands, and of the gain of a speed."""
    spec = evidence.drive.spec
    rows = _list_lag_rows(evidence)
    if {"clock_offset_s", "command_latency_s"} <= set(evidence.calibration.uncertainty):
        # only the wheels' response separates these, and it tells the lags
        rows = {name: _fix(row) for name, row in rows.items()}
    speed = find_speed_index(spec)
    for i, response in enumerate(evidence.calibration.responses):
        if i == speed and f"{response.state}.lag" in rows:
            gain = response.gain
            low, high = sorted((0.2 * gain, 5.0 * gain))
            rows[f"{response.state}.gain"] = (gain, 0.1 * abs(gain), low, high)
    return rows


def _list_mounting_rows(evidence: Evidence) -> Rows:
    """Returns the rows of what remains of the error of the mounting, if predictions show it."""
    spec = evidence.drive.spec
    if spec.state and evidence.library.kind is Kind.MOTION:
        return {}  # the motion was derived for one mounting
    # The terms of the twist may be those of a body that is turned or moved.
    if spec.moves_sideways and (spec.state or spec.takes_cmd_vel):
        return {}
    shown = set(evidence.calibration.uncertainty if spec.state else MOUNTING.values())
    if not tells_lever_from_wheels(spec):
        shown -= {"lever_arm_y_m"}
    if not shown & set(MOUNTING.values()):
        return {}
    reach = 2.0 * spec.footprint_radius
    lever = (0.0, LEVER_SCALE_M, -reach, reach)
    free = {"x": lever, "y": lever, "heading": (0.0, TURN_SCALE, -np.pi, np.pi)}
    return {
        part: row if MOUNTING[part] in shown else _fix(row)
        for part, row in free.items()
    }


def make_parameters(rows: Rows) -> shooting.Parameters:
    """Returns the parameters of rows."""
    return shooting.Parameters(tuple(rows), *np.array(list(rows.values())).T)


def find_latency(at: shooting.Values) -> float:
    """Returns the common latency of the commands: their minimum delay [s]."""
    delays = [value for name, value in at.items() if name.endswith(".delay")]
    return min(delays, default=at["latency"])


def make_curves(spec: RobotSpec, at: shooting.Values) -> tuple[InputCurve, ...]:
    """Returns the input curves for values of the parameters."""
    curves = []
    for command in spec.command:
        name = command.name
        parts = {p: at[f"{name}.{p}"] for p in CURVE_PARTS if f"{name}.{p}" in at}
        if "delay" in parts:
            parts["delay"] -= find_latency(at)
        curve = InputCurve(command=name, **parts)
        if curve != InputCurve(command=name):
            curves.append(curve)
    return tuple(curves)


def actuate(spec: RobotSpec, model: TaylorModel, at: shooting.Values) -> TaylorModel:
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
    for variable in spec.state:
        name = variable.name
        if f"{name}.lag" in at:
            gain = at.get(f"{name}.gain", 1.0)
            lag = at[f"{name}.lag"]
            model = set_lag(model, name, str(variable.follows), lag, gain)
    return model


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

    def __init__(self, evidence: Evidence) -> None:
        self.drive = evidence.drive
        self.spec = evidence.drive.spec
        self.dt = evidence.samples.dt
        self.t = evidence.samples.t
        self.rows: slice | NDArray[np.intp] = slice(None)
        if evidence.followed:
            self._begin_at_first_command()
        self.follower = _make_follower(self.spec, self.dt)
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
        names = {"latency"} | {c.name for c in self.spec.command}
        return self._average(
            tuple(item for item in at.items() if item[0].partition(".")[0] in names)
        )

    def _average_commands(self, items: tuple[tuple[str, float], ...]) -> Array:
        at = dict(items)
        begin = self.t - find_latency(at)
        command = self.drive.recording.command
        curves = make_curves(self.spec, at)
        return average_effect(command, self.spec, curves, begin, begin + self.dt)

    def _roll_states(self, items: tuple[tuple[str, float], ...]) -> Array:
        at = dict(items)
        sent = self._find_all_commands(at)
        gains = [at.get(f"{v.name}.gain", 1.0) for v in self.spec.state]
        begin = np.array(gains) * sent[0, list_followed_commands(self.spec)]
        model = actuate(self.spec, self.follower, at)
        _, states = roll(model, begin[None], sent[None])
        return np.asarray(states[0][self.rows])


def make_prediction_problem(
    evidence: Evidence, parameters: shooting.Parameters
) -> shooting.Shooting:
    """Returns the prediction problem of a drive, to find the parameters of a model."""
    drive = evidence.drive
    in_effect = _InEffect(evidence)
    noise, _ = drive.pose_noise or (0.0, 0.0)

    def trust(start: Array, end: Array) -> Array:
        offset = evidence.calibration.clock_offset_s
        return drive.trust(start - offset, end - offset)

    return shooting.Shooting(
        evidence.samples,
        parameters,
        commands=in_effect.find_commands,
        shape=partial(actuate, drive.spec),
        trust=trust,
        inferred=in_effect.find_states if evidence.followed else None,
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


def list_driving_commands(spec: RobotSpec) -> tuple[str, ...]:
    """Names the commands that drive a robot ahead, according to its textbook."""
    structure = probe_structure(spec)
    if structure is None:
        return ()
    moves, _ = structure
    return tuple(spec.command[k].name for k in np.flatnonzero(moves[0]))


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
    best = None
    for state, variable in enumerate(spec.state):
        if variable.twist and acts[POSE_RATES.index(variable.twist)]:
            found = _fit_curve(samples, spec, place, state)
            if best is None or found.gain > best.gain:
                best = found
    if best is None:
        return None
    needed = WORTH if best.drives else CLEAR
    return best if best.gain >= needed else None


def _fit_curve(samples: Samples, spec: RobotSpec, place: int, state: int) -> FoundCurve:
    """Returns the curve of a command that best explains a component of the twist."""
    twist = [variable.twist for variable in spec.state]
    drives = twist[state] == "vx"
    target = samples.x[:, state]
    speed = None if drives or "vx" not in twist else samples.x[:, twist.index("vx")]
    command = samples.x[:, len(spec.state) :]
    sent = command[:, place]
    reach = np.array([sent.min(), sent.max()])
    name = spec.command[place].name

    def measure_rest(dead: float, full: float) -> float:
        effect = command.copy()
        effect[:, place] = _make_curve(name, reach, dead, full).of(sent)
        return _measure_rest(effect, target, speed, samples.dt)

    straight = measure_rest(0.0, 1.0)
    if straight < NOTHING**2 * len(sent):
        return FoundCurve(_make_curve(name, reach, 0.0, 1.0), 0.0, drives)
    trials = [(measure_rest(0.0, full), 0.0, full) for full in FULL]
    full = min(trials)[2]
    trials += [(measure_rest(dead, full), dead, full) for dead in DEAD if dead < full]
    least, dead, full = min(trials)
    curve = _make_curve(name, reach, dead, full)
    return FoundCurve(curve, 1.0 - least / straight, drives)


def _measure_rest(
    effect: Array, target: Array, speed: Array | None, dt: float
) -> float:
    """Returns the squares of a target (T,) that commands (T, C) do not explain, at the best lag.

    They act in proportion to a speed (T,), too, if it is given.
    """
    stride = max(1, round(STRIDE_S / dt))
    least = np.inf
    for lag in LAGS_S:
        kept = float(np.exp(-dt / lag))
        lagged = [lag_behind(np.append(u, 0.0), 0.0, kept)[1:] for u in effect.T]
        if speed is not None:
            lagged += [low * speed for low in lagged]
        chi = np.stack([np.ones(len(target)), *lagged], axis=1)[::stride]
        rest = target[::stride] - chi @ np.linalg.lstsq(chi, target[::stride])[0]
        least = min(least, float(rest @ rest))
    return least


def _make_curve(name: str, reach: Array, dead: float, full: float) -> InputCurve:
    size = float(np.abs(reach).max())
    return InputCurve(
        command=name,
        dead=dead * size,
        least=max(float(reach[0]), -full * size),
        most=min(float(reach[1]), full * size),
    )


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
    width = drive.half_width_s
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
