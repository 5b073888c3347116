"""Compiled motion: the pruned model's rates, and the exact arc of a body twist.

A step of one robot is `rates`, then `move`; `run` does the same for a batch, term by term, so that
vector instructions process several robots at a time. Results are bit-identical for all batch sizes.
Shared arguments: `x` (S + C + 1,) holds the state, the commands in effect, and a last entry of 1;
`dq` (3 + S,) are the rates; `series` is `SERIES` in the type of the other arrays, which may be
float32 or float64.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.errors import ModelError
from nics_drl_bridge.geometry import Array
from nics_drl_bridge.kernels import kernel
from nics_drl_bridge.robot.taylor import TaylorModel

# Series coefficients of sin(t) / t and (1 - cos(t)) / t, accurate to 1e-14 for turns below 0.1 rad
# and to 1e-8 below WIDE_TURN
SERIES: Array = np.array([1 / 6, 1 / 120, 1 / 5040, 1 / 2, 1 / 24, 1 / 720])
WIDE_TURN = 0.5  # larger turns per step use sine and cosine, not the series [rad]
MAX_ORDER = 4  # maximum order of a term
# Columns of `Terms.curves`, as in `InputCurve`
DEAD = 0
LOW = 1
HIGH = 2
BACK = 3
Moved = tuple[float, float, float, float]  # x, y [m], cosine and sine of the heading


class Terms(NamedTuple):
    """The kept terms of a model, and the effects of motors around them."""

    dof: NDArray[np.int64]  # (T,) degree of freedom of each term
    coefficient: Array  # (T,), or (T, n) for n robots
    # (T, order) indices into `x`; unused ones point to its last entry
    factors: NDArray[np.int64]
    degree: NDArray[np.int64]  # (T,) number of factors
    low: Array  # (S,) minimum state, to which it is clipped
    high: Array  # (S,) maximum state, likewise
    fall: Array  # (S,) minimum rate of a state
    rise: Array  # (S,) maximum rate of a state
    friction: Array  # (S,) dry friction, which draws a state to zero [unit / s]
    drag: Array  # (S,) drag, which slows a state by its square [1 / (unit s)]
    curves: Array  # (C, 4) input curves of the commands
    # (C,) delays of commands beyond their common latency [steps]
    extra_delays: NDArray[np.int64]
    emf: Array  # (S, C) back-EMF per state and size of a command; (0, 0) if all are 0


class Bounds(NamedTuple):
    """Bounds of one state variable, as in `Terms`."""

    low: float
    high: float
    fall: float
    rise: float
    friction: float
    drag: float


def make_terms(model: TaylorModel) -> Terms:
    """Returns the kept terms of a model. Raises ModelError if a term's order is too high."""
    order = max(1, int(model.powers.sum(axis=1).max(initial=1)))
    if order > MAX_ORDER:
        raise ModelError(
            f"the kinematics have a term of order {order}; the maximum is {MAX_ORDER}: "
            "generate the model again."
        )
    dofs, columns = np.nonzero(model.coefficients)
    powers = model.powers[columns]
    degree = powers.sum(axis=1)
    variables = len(model.variables)
    factors = np.full((len(dofs), order), variables, dtype=np.int64)
    factors[np.arange(order) < degree[:, None]] = np.repeat(
        np.tile(np.arange(variables), len(dofs)), powers.ravel()
    )
    low, high = model.state_box
    return Terms(
        dof=dofs.astype(np.int64),
        coefficient=model.coefficients[dofs, columns],
        factors=factors,
        degree=degree,
        low=low,
        high=high,
        fall=np.ascontiguousarray(model.limits[:, 0]),
        rise=np.ascontiguousarray(model.limits[:, 1]),
        friction=np.asarray(model.friction, np.float64),
        drag=np.asarray(model.drag, np.float64),
        curves=_make_curves(model),
        extra_delays=np.round(model.delays / model.dt).astype(np.int64),
        emf=model.back_emf if model.back_emf.any() else np.zeros((0, 0)),
    )


def _make_curves(model: TaylorModel) -> Array:
    commands = model.variables[model.state_size :]
    rows = np.tile([0.0, -np.inf, np.inf, 1.0], (len(commands), 1))
    for curve in model.inputs:
        row = rows[commands.index(curve.command)]
        row[DEAD] = curve.dead
        row[LOW] = min(curve.least, 0.0)
        row[HIGH] = max(curve.most, 0.0)
        row[BACK] = curve.back
    return rows


def allocate_scratch(model: TaylorModel) -> tuple[Array, Array]:
    """Returns memory for `x` and `dq` of one robot."""
    x = np.zeros(len(model.variables) + 1)
    x[-1] = 1.0
    return x, np.zeros(len(model.dofs))


@kernel
def apply_curve(command: float, curve: Array) -> float:
    """Returns the effect of a command through its curve (4,); see `InputCurve`."""
    held: float = min(max(command, curve[LOW]), curve[HIGH])
    dead: float = curve[DEAD]
    back: float = curve[BACK]
    if held < -dead and held < 0.0:
        return back * (held + dead)
    if held <= max(dead, 0.0):
        return 0.0
    return held - dead


@kernel
def put_command(x: Array, command: Array, terms: Terms) -> None:
    """Writes the effect of a command (C,) to `x`."""
    first = x.shape[0] - 1 - command.shape[0]
    for c in range(command.shape[0]):
        x[first + c] = apply_curve(command[c], terms.curves[c])


@kernel
def get_bounds(terms: Terms, i: int) -> Bounds:
    """Returns the bounds of state variable i."""
    return Bounds(
        terms.low[i],
        terms.high[i],
        terms.fall[i],
        terms.rise[i],
        terms.friction[i],
        terms.drag[i],
    )


@kernel
def advance_state(value: float, rate: float, dt: float, bounds: Bounds) -> float:
    """Returns a state variable after dt [s] of limited rate, drag and dry friction, clipped."""
    # These conditions depend only on the bounds, so the compiler can move them out of a loop over
    # robots.
    if bounds.fall > -math.inf or bounds.rise < math.inf:
        rate = min(max(rate, bounds.fall), bounds.rise)
    value += dt * rate
    if bounds.drag > 0.0:
        value /= 1.0 + dt * bounds.drag * abs(value)
    if bounds.friction > 0.0:
        stick = dt * bounds.friction
        value = max(value - stick, min(value + stick, 0.0))
    return min(max(value, bounds.low), bounds.high)


@kernel
def replace_coefficients(terms: Terms, coefficient: Array) -> Terms:
    """Returns terms with other coefficients, (T,) for one robot or (T, n) for several."""
    return Terms(
        terms.dof,
        coefficient,
        terms.factors,
        terms.degree,
        terms.low,
        terms.high,
        terms.fall,
        terms.rise,
        terms.friction,
        terms.drag,
        terms.curves,
        terms.extra_delays,
        terms.emf,
    )


@kernel
def rates(dq: Array, x: Array, terms: Terms) -> None:
    """Computes dQ/dt (3 + S,) of one robot (Eq. 1)."""
    dq[:] = 0.0
    for k in range(terms.dof.shape[0]):
        product = terms.coefficient[k]
        for factor in range(terms.degree[k]):
            product *= x[terms.factors[k, factor]]
        dq[terms.dof[k]] += product
    for i in range(terms.emf.shape[0]):
        dq[3 + i] -= sum_back_emf(i, x, terms) * x[i]


@kernel
def sum_back_emf(i: int, x: Array, terms: Terms) -> float:
    """Returns the rate at which the commands in effect brake state variable i [1/s]."""
    total = 0.0
    states = terms.emf.shape[0]
    for c in range(terms.emf.shape[1]):
        total += terms.emf[i, c] * abs(x[states + c])
    return total


@kernel
def move(
    x: float,
    y: float,
    c: float,
    s: float,
    vx: float,
    vy: float,
    turn: float,
    dt: float,
    series: Array,
) -> Moved:
    """Moves x, y [m], cosine and sine of the heading along an arc of `turn` [rad] in dt [s]."""
    if abs(turn) > WIDE_TURN:
        unit = series[3] + series[3]
        sine = math.sin(turn)
        versine = unit - math.cos(turn)
        ahead, left = _compute_chord(vx, vy, sine / turn, versine / turn, dt)
        moved: Moved = _turn_and_shift(x, y, c, s, ahead, left, sine, versine)
    else:
        moved = _move_by_series(x, y, c, s, vx, vy, turn, dt, series)
    return moved


@kernel
def _move_by_series(
    x: float,
    y: float,
    c: float,
    s: float,
    vx: float,
    vy: float,
    turn: float,
    dt: float,
    series: Array,
) -> Moved:
    """Does the same as `move`, for turns up to WIDE_TURN."""
    square = turn * turn
    sinc = series[0] - square * (series[1] - square * series[2])
    sinc = (series[3] + series[3]) - square * sinc
    cosc = turn * (series[3] - square * (series[4] - square * series[5]))
    ahead, left = _compute_chord(vx, vy, sinc, cosc, dt)
    moved: Moved = _turn_and_shift(x, y, c, s, ahead, left, turn * sinc, turn * cosc)
    return moved


@kernel
def _compute_chord(
    vx: float,
    vy: float,
    sinc: float,
    cosc: float,
    dt: float,
) -> tuple[float, float]:
    """Returns the chord of an arc, forward and left [m], from sin(t) / t and (1 - cos(t)) / t."""
    return (sinc * vx - cosc * vy) * dt, (cosc * vx + sinc * vy) * dt


@kernel
def _turn_and_shift(
    x: float,
    y: float,
    c: float,
    s: float,
    ahead: float,
    left: float,
    sine: float,
    versine: float,
) -> Moved:
    """Shifts a pose and rotates its heading by an angle, given its sine and 1 - cosine."""
    x = x + (c * ahead - s * left)
    y = y + (s * ahead + c * left)
    return x, y, c - (c * versine + s * sine), s - (s * versine - c * sine)


@kernel
def wrap(heading: float) -> float:
    """Wraps a heading [rad] to [-pi, pi)."""
    return heading - 2.0 * math.pi * math.floor((heading + math.pi) / (2.0 * math.pi))


@kernel
def advance(pose: Array, twist: Array, dt: float, series: Array) -> None:
    """Moves a pose (3,) in place along the exact arc of a body twist (3,)."""
    turn = twist[2] * dt
    c = math.cos(pose[2])
    s = math.sin(pose[2])
    pose[0], pose[1], _, _ = move(
        pose[0], pose[1], c, s, twist[0], twist[1], turn, dt, series
    )
    pose[2] = wrap(pose[2] + turn)


@kernel
def run(
    pose: Array,
    x: Array,
    dq: Array,
    terms: Terms,
    series: Array,
    dt: float,
    steps: int,
) -> None:
    """Moves n robots in place by the same number of steps of dt [s] under constant commands.

    `pose` (6, n) is x, y [m], cosine, sine, unwrapped heading, and an upper bound on the path
    length [m]. `x` is (S + C + 1, n). `dq` (3 + S, n) receives the last step's rates. Coefficients
    are (T, n).
    """
    for _ in range(steps):
        _compute_all_rates(dq, x, terms)
        _move_all(pose, dq, dt, series)
        for d in range(3, dq.shape[0]):
            state = x[d - 3]
            rate = dq[d]
            bounds = get_bounds(terms, d - 3)
            for i in range(state.shape[0]):
                state[i] = advance_state(state[i], rate[i], dt, bounds)


@kernel
def _compute_all_rates(dq: Array, x: Array, terms: Terms) -> None:
    factors = terms.factors
    n = x.shape[1]
    for d in range(dq.shape[0]):
        rate = dq[d]
        for i in range(n):
            rate[i] = 0.0
    for k in range(terms.dof.shape[0]):
        rate = dq[terms.dof[k]]
        value = terms.coefficient[k]
        first = x[factors[k, 0]]
        if terms.degree[k] == 1:
            for i in range(n):
                rate[i] += value[i] * first[i]
        elif terms.degree[k] == 2:
            second = x[factors[k, 1]]
            for i in range(n):
                rate[i] += value[i] * first[i] * second[i]
        elif terms.degree[k] == 3:
            second = x[factors[k, 1]]
            third = x[factors[k, 2]]
            for i in range(n):
                rate[i] += value[i] * first[i] * second[i] * third[i]
        elif terms.degree[k] == 4:
            second = x[factors[k, 1]]
            third = x[factors[k, 2]]
            fourth = x[factors[k, 3]]
            for i in range(n):
                rate[i] += value[i] * first[i] * second[i] * third[i] * fourth[i]
        else:  # the constant
            for i in range(n):
                rate[i] += value[i]
    _subtract_back_emf(dq, x, terms)


@kernel
def _subtract_back_emf(dq: Array, x: Array, terms: Terms) -> None:
    states = terms.emf.shape[0]
    for d in range(states):
        rate = dq[3 + d]
        state = x[d]
        for c in range(terms.emf.shape[1]):
            emf = terms.emf[d, c]
            command = x[states + c]
            for i in range(x.shape[1]):
                rate[i] -= emf * abs(command[i]) * state[i]


@kernel
def _move_all(pose: Array, dq: Array, dt: float, series: Array) -> None:
    px = pose[0]
    py = pose[1]
    pc = pose[2]
    ps = pose[3]
    heading = pose[4]
    length = pose[5]
    vx = dq[0]
    vy = dq[1]
    wz = dq[2]
    n = px.shape[0]
    wide = np.int32(0)
    for i in range(n):
        wide |= np.int32(abs(wz[i] * dt) > WIDE_TURN)
    # There are two loops because the one with sine and cosine is slower.
    if wide:
        for i in range(n):
            turn = wz[i] * dt
            px[i], py[i], pc[i], ps[i] = move(
                px[i], py[i], pc[i], ps[i], vx[i], vy[i], turn, dt, series
            )
    else:
        for i in range(n):
            turn = wz[i] * dt
            px[i], py[i], pc[i], ps[i] = _move_by_series(
                px[i], py[i], pc[i], ps[i], vx[i], vy[i], turn, dt, series
            )
    for i in range(n):
        heading[i] += wz[i] * dt
        length[i] += (abs(vx[i]) + abs(vy[i])) * dt


@kernel(allocates=True)
def simulate_rollouts(
    poses: Array,
    states: Array,
    commands: Array,
    terms: Terms,
    series: Array,
    dt: float,
) -> None:
    """Simulates W robots from their first poses and states, and fills in the following ones.

    `poses` is (W, T + 1, 3), `states` is (W, T + 1, S). `commands` (W, T, C) are those in effect.
    """
    size = states.shape[2]
    width = commands.shape[2]
    x = np.ones(size + width + 1)
    dq = np.zeros(3 + size)
    for w in range(poses.shape[0]):
        px, py, heading = poses[w, 0]
        c = math.cos(heading)
        s = math.sin(heading)
        for i in range(size):
            x[i] = states[w, 0, i]
        for n in range(commands.shape[1]):
            for i in range(width):
                x[size + i] = commands[w, n, i]
            rates(dq, x, terms)
            turn = dq[2] * dt
            px, py, c, s = move(px, py, c, s, dq[0], dq[1], turn, dt, series)
            heading += turn
            for i in range(size):
                x[i] = advance_state(x[i], dq[3 + i], dt, get_bounds(terms, i))
                states[w, n + 1, i] = x[i]
            poses[w, n + 1, 0] = px
            poses[w, n + 1, 1] = py
            poses[w, n + 1, 2] = heading


@kernel
def find_delayed_command(substep: int, delay: int, substeps: int, periods: int) -> int:
    """Returns which of the last `periods` commands is in effect at a substep, newest first.

    A period has `substeps`; `delay` is in substeps.
    """
    if delay <= substep:
        return 0
    return min((delay - substep + substeps - 1) // substeps, periods - 1)
