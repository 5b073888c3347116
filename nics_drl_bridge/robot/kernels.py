"""Compiled motion: the pruned model's rates, and the exact arc of a body twist.

A step of one robot is `rates` then `move`; `run` does the same for a batch, term by term, so that
vector instructions process several robots at a time. Both give the same bits for every batch size.
Shared arguments: `terms` are `Terms`; `x` contains state, command in effect and a last entry of 1;
`dq` are the rates; `series` is `SERIES` in the type of the other arrays.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.errors import ModelError
from nics_drl_bridge.geometry import Array
from nics_drl_bridge.kernels import kernel
from nics_drl_bridge.robot.taylor import TaylorModel

# Of sin(t) / t and (1 - cos(t)) / t: to 1e-14 for a turn below 0.1 rad, 1e-8 below WIDE_TURN.
SERIES: Array = np.array([1 / 6, 1 / 120, 1 / 5040, 1 / 2, 1 / 24, 1 / 720])
# For larger turns per step sine and cosine are used, not the series [rad]
WIDE_TURN = 0.5
GREATEST_ORDER = 4
# columns of `Terms.curves`, as in `InputCurve`
DEAD = 0
LEAST = 1
MOST = 2
BACK = 3


class Terms(NamedTuple):
    """The kept terms of a model, and what motors do around them."""

    dof: NDArray[np.int64]  # (T,) degree of freedom of each
    coefficient: Array  # (T,), or (T, n) of n robots
    factors: NDArray[
        np.int64
    ]  # (T, order) indices into `x`; unused ones of its last entry, 1
    degree: NDArray[np.int64]  # (T,) number of factors
    low: Array  # (S,) least and greatest state, at which it is held
    high: Array
    fall: Array  # (S,) greatest fall and rise of a state's rate
    rise: Array
    friction: Array  # (S,) by which a state is drawn to zero [unit / s]
    drag: Array  # (S,) times the square of a state, likewise [1 / (unit s)]
    curves: Array  # (C, 4) of the commands
    late: NDArray[
        np.int64
    ]  # (C,) delays of the commands after their common latency [steps]
    emf: Array  # (S, C) times a state and the size of a command in effect; (0, 0) if all are 0


class Bounds(NamedTuple):
    """Bounds of one state variable, as in `Terms`."""

    low: float
    high: float
    fall: float
    rise: float
    friction: float
    drag: float


def make_terms(model: TaylorModel) -> Terms:
    """Returns the kept terms of a model. Raises ModelError if the order of one is too high."""
    one = len(model.variables)
    order = max(1, int(model.powers.sum(axis=1).max(initial=1)))
    if order > GREATEST_ORDER:
        most = f"the greatest is {GREATEST_ORDER}: generate the model anew."
        raise ModelError(f"the kinematics have a term of order {order}; {most}")
    dofs, places = np.nonzero(model.coefficients)
    factors = np.full((len(dofs), order), one, dtype=np.int64)
    powers = model.powers[places]
    count = powers.sum(axis=1)
    factors[np.arange(order) < count[:, None]] = np.repeat(
        np.tile(np.arange(one), len(dofs)), powers.ravel()
    )
    coefficients = model.coefficients[dofs, places]
    fall, rise = np.ascontiguousarray(model.limits.T)
    return Terms(
        dofs.astype(np.int64),
        coefficients,
        factors,
        count,
        *model.state_box,
        fall,
        rise,
        np.asarray(model.friction, np.float64),
        np.asarray(model.drag, np.float64),
        _curve_rows(model),
        np.round(model.delays / model.dt).astype(np.int64),
        model.back_emf if model.back_emf.any() else np.zeros((0, 0)),
    )


def _curve_rows(model: TaylorModel) -> Array:
    commands = model.variables[model.state_size :]
    rows = np.tile([0.0, -np.inf, np.inf, 1.0], (len(commands), 1))
    for curve in model.inputs:
        row = curve.dead, min(curve.least, 0.0), max(curve.most, 0.0), curve.back
        rows[commands.index(curve.command)] = row
    return rows


def allocate_scratch(model: TaylorModel) -> tuple[Array, Array]:
    """Returns scratch memory for `x` and `dq` of one robot."""
    x = np.zeros(len(model.variables) + 1)
    x[-1] = 1.0
    return x, np.zeros(len(model.dofs))


@kernel
def apply_curve(command, curve):  # type: ignore[no-untyped-def]
    """Returns the effect of a command by its curve (4,); see `InputCurve`."""
    held = min(max(command, curve[LEAST]), curve[MOST])
    if held < -curve[DEAD] and held < 0.0:
        return curve[BACK] * (held + curve[DEAD])
    return 0.0 if held <= max(curve[DEAD], 0.0) else held - curve[DEAD]


@kernel
def put_command(x, command, terms):  # type: ignore[no-untyped-def]
    """Writes the effect of a command (C,) to `x`."""
    first = x.shape[0] - 1 - command.shape[0]
    for c in range(command.shape[0]):
        x[first + c] = apply_curve(command[c], terms.curves[c])


@kernel
def get_bounds(terms, i):  # type: ignore[no-untyped-def]
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
def advance_state(value, rate, dt, bounds):  # type: ignore[no-untyped-def]
    """Returns a state variable after dt [s]: rate limited, drag, dry friction, then held."""
    # Conditions on the bounds alone: a loop over robots is compiled once with them, once without.
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
def replace_coefficients(terms, coefficient):  # type: ignore[no-untyped-def]
    """Returns terms with other coefficients, those of a robot or of several."""
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
        terms.late,
        terms.emf,
    )


@kernel
def rates(dq, x, terms):  # type: ignore[no-untyped-def]
    """Computes dQ/dt (3 + S,) of one robot."""
    dq[:] = 0.0
    for k in range(terms.dof.shape[0]):
        product = terms.coefficient[k]
        for factor in range(terms.degree[k]):
            product *= x[terms.factors[k, factor]]
        dq[terms.dof[k]] += product
    for i in range(terms.emf.shape[0]):
        dq[3 + i] -= sum_back_emf(i, x, terms) * x[i]


@kernel
def sum_back_emf(i, x, terms):  # type: ignore[no-untyped-def]
    """Returns the rate [1/s] at which the commands in effect brake state variable i."""
    total = 0.0
    states = terms.emf.shape[0]
    for c in range(terms.emf.shape[1]):
        total += terms.emf[i, c] * abs(x[states + c])
    return total


@kernel
def move(x, y, c, s, vx, vy, turn, dt, series):  # type: ignore[no-untyped-def]
    """Returns x, y [m], cosine and sine of the heading after an arc of `turn` [rad] in dt [s]."""
    if abs(turn) > WIDE_TURN:
        one = series[3] + series[3]
        sine = math.sin(turn)
        versine = one - math.cos(turn)
        ahead, aside = _chord(vx, vy, sine / turn, versine / turn, dt)
        return _end(x, y, c, s, ahead, aside, sine, versine)
    return _move_little(x, y, c, s, vx, vy, turn, dt, series)


@kernel
def _move_little(x, y, c, s, vx, vy, turn, dt, series):  # type: ignore[no-untyped-def]
    t2 = turn * turn
    a = series[0] - t2 * (series[1] - t2 * series[2])
    a = (series[3] + series[3]) - t2 * a
    b = turn * (series[3] - t2 * (series[4] - t2 * series[5]))
    ahead, aside = _chord(vx, vy, a, b, dt)
    return _end(x, y, c, s, ahead, aside, turn * a, turn * b)


@kernel
def _chord(vx, vy, a, b, dt):  # type: ignore[no-untyped-def]
    """Returns the chord of an arc in the body's frame; a = sin(t) / t, b = (1 - cos(t)) / t."""
    return (a * vx - b * vy) * dt, (b * vx + a * vy) * dt


@kernel
def _end(x, y, c, s, ahead, aside, sine, versine):  # type: ignore[no-untyped-def]
    x = x + (c * ahead - s * aside)
    y = y + (s * ahead + c * aside)
    return x, y, c - (c * versine + s * sine), s - (s * versine - c * sine)


@kernel
def wrap(heading):  # type: ignore[no-untyped-def]
    """Wraps a heading [rad] to [-pi, pi)."""
    return heading - 2.0 * math.pi * math.floor((heading + math.pi) / (2.0 * math.pi))


@kernel
def advance(pose, twist, dt, series):  # type: ignore[no-untyped-def]
    """Moves a pose (3,) in place along the exact arc of a body twist (3,)."""
    turn = twist[2] * dt
    c = math.cos(pose[2])
    s = math.sin(pose[2])
    pose[0], pose[1], _, _ = move(
        pose[0], pose[1], c, s, twist[0], twist[1], turn, dt, series
    )
    pose[2] = wrap(pose[2] + turn)


@kernel
def run(pose, x, dq, terms, series, dt, steps):  # type: ignore[no-untyped-def]
    """Moves n robots in place by the same number of steps of dt [s], commands in effect constant.

    `pose` (6, n) is x, y [m], cosine, sine, unwrapped heading, and an upper bound of the path
    length [m]; `x` is (S + C + 1, n), `dq` (3 + S, n) the last step's rates, coefficients (T, n).
    """
    for _ in range(steps):
        _rates_of_all(dq, x, terms)
        _move_all(pose, dq, dt, series)
        for d in range(3, dq.shape[0]):
            state = x[d - 3]
            rate = dq[d]
            bounds = get_bounds(terms, d - 3)
            for i in range(state.shape[0]):
                state[i] = advance_state(state[i], rate[i], dt, bounds)


@kernel
def _rates_of_all(dq, x, terms):  # type: ignore[no-untyped-def]
    factors = terms.factors
    n = x.shape[1]
    for d in range(dq.shape[0]):
        rate = dq[d]
        for i in range(n):
            rate[i] = 0.0
    for k in range(terms.dof.shape[0]):
        rate = dq[terms.dof[k]]
        value = terms.coefficient[k]
        one = x[factors[k, 0]]
        if terms.degree[k] == 1:
            for i in range(n):
                rate[i] += value[i] * one[i]
        elif terms.degree[k] == 2:
            other = x[factors[k, 1]]
            for i in range(n):
                rate[i] += value[i] * one[i] * other[i]
        elif terms.degree[k] == 3:
            other = x[factors[k, 1]]
            third = x[factors[k, 2]]
            for i in range(n):
                rate[i] += value[i] * one[i] * other[i] * third[i]
        elif terms.degree[k] == 4:
            other = x[factors[k, 1]]
            third = x[factors[k, 2]]
            last = x[factors[k, 3]]
            for i in range(n):
                rate[i] += value[i] * one[i] * other[i] * third[i] * last[i]
        else:  # the constant
            for i in range(n):
                rate[i] += value[i]
    states = terms.emf.shape[0]
    for d in range(states):
        rate = dq[3 + d]
        state = x[d]
        for c in range(terms.emf.shape[1]):
            emf = terms.emf[d, c]
            command = x[states + c]
            for i in range(n):
                rate[i] -= emf * abs(command[i]) * state[i]


@kernel
def _move_all(pose, dq, dt, series):  # type: ignore[no-untyped-def]
    px = pose[0]
    py = pose[1]
    pc = pose[2]
    ps = pose[3]
    heading = pose[4]
    length = pose[5]
    vx = dq[0]
    vy = dq[1]
    wz = dq[2]
    wide = np.int32(0)
    for i in range(px.shape[0]):
        wide |= np.int32(abs(wz[i] * dt) > WIDE_TURN)
    if wide:  # in a separate loop, as it is slower
        _move_widely(pose, dq, dt, series)
        return
    for i in range(px.shape[0]):
        turn = wz[i] * dt
        px[i], py[i], pc[i], ps[i] = _move_little(
            px[i], py[i], pc[i], ps[i], vx[i], vy[i], turn, dt, series
        )
        heading[i] += turn
        length[i] += (abs(vx[i]) + abs(vy[i])) * dt


@kernel
def _move_widely(pose, dq, dt, series):  # type: ignore[no-untyped-def]
    px = pose[0]
    py = pose[1]
    pc = pose[2]
    ps = pose[3]
    heading = pose[4]
    length = pose[5]
    vx = dq[0]
    vy = dq[1]
    wz = dq[2]
    for i in range(px.shape[0]):
        turn = wz[i] * dt
        px[i], py[i], pc[i], ps[i] = move(
            px[i], py[i], pc[i], ps[i], vx[i], vy[i], turn, dt, series
        )
        heading[i] += turn
        length[i] += (abs(vx[i]) + abs(vy[i])) * dt


@kernel(allocates=True)
def simulate_rollouts(poses, states, commands, terms, series, dt):  # type: ignore[no-untyped-def]
    """Rolls out robots from the first of poses (W, T + 1, 3), commands in effect (W, T, C)."""
    size = states.shape[2]
    width = commands.shape[2]
    x = np.ones(size + width + 1)
    dq = np.zeros(3 + size)
    for w in range(poses.shape[0]):
        px, py, heading = poses[w, 0]
        c = math.cos(heading)
        s = math.sin(heading)
        x[:size] = states[w, 0]
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
def find_delayed_command(substep, delay, substeps, periods):  # type: ignore[no-untyped-def]
    """Returns the index, newest first, of the one of the last `periods` commands in effect."""
    if delay <= substep:
        return 0
    return min((delay - substep + substeps - 1) // substeps, periods - 1)
