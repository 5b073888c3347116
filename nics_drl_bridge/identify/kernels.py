"""Compiled rollouts over windows: poses at their ends, and derivatives by the coefficients.

`shoot` rolls out a model with its sensitivities, `roll_windows` a textbook. `follow_first_order`
serves states that follow commands, since `scipy.signal` takes a second to import.
"""

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.geometry import Array
from nics_drl_bridge.kernels import kernel
from nics_drl_bridge.robot.kernels import (
    Bounds,
    Terms,
    advance_state,
    get_bounds,
)
from nics_drl_bridge.robot.taylor import TaylorModel

# most windows that are predicted at a time, and how many vector instructions take at once
LANES = 64
VECTOR = 16
# below this turn of a step the series of its sine and cosine are exact to the last digits [rad]
SMALL_TURN = 0.1


class TermIndex(NamedTuple):
    """The used terms of a model, without their coefficients, in the order of their dofs."""

    dof: NDArray[np.int64]  # (K,) degree of freedom of each term
    factors: NDArray[np.int64]  # (K, order) as in `Terms`
    degree: NDArray[np.int64]  # (K,)
    free: NDArray[np.int64]  # (P,) places of the free ones


@lru_cache(maxsize=16)  # searches change coefficients, not terms
def _index_terms(
    powers: bytes, used: bytes, free: bytes, shape: tuple[int, int]
) -> TermIndex:
    """Returns the index of the used ones (D, K) among terms, and the free ones (D, K) of these."""
    is_used = np.frombuffer(used, np.bool_).reshape(shape)
    is_free = np.frombuffer(free, np.bool_).reshape(shape)
    dofs, columns = np.nonzero(is_used)
    rows = np.frombuffer(powers, np.int64).reshape(shape[1], -1)[columns]
    degree = rows.sum(axis=1)
    variables = rows.shape[1]
    factors = np.full((len(rows), max(1, int(degree.max(initial=1)))), variables)
    for term, row in zip(factors, rows, strict=True):
        term[: row.sum()] = np.repeat(np.arange(variables), row)
    moving = np.flatnonzero(is_free[is_used])
    return TermIndex(dofs.astype(np.int64), factors, degree, moving.astype(np.int64))


def make_used_terms(
    model: TaylorModel, used: NDArray[np.bool_], free: NDArray[np.bool_]
) -> tuple[Terms, NDArray[np.int64]]:
    """Returns the used ones (D, K) of a model's terms, and the indices of the free among them.

    A term that is used may have a coefficient of 0. Commands are taken to be those in effect.
    """
    powers = model.powers.astype(np.int64).tobytes()
    index = _index_terms(powers, used.tobytes(), free.tobytes(), used.shape)
    low, high = model.state_box
    terms = Terms(
        dof=index.dof,
        coefficient=model.coefficients[used],
        factors=index.factors,
        degree=index.degree,
        low=low,
        high=high,
        fall=np.ascontiguousarray(model.limits[:, 0]),
        rise=np.ascontiguousarray(model.limits[:, 1]),
        friction=model.friction,
        drag=model.drag,
        curves=np.zeros((0, 4)),
        extra_delays=np.zeros(0, dtype=np.int64),
        emf=model.back_emf if model.back_emf.any() else np.zeros((0, 0)),
    )
    return terms, index.free


class Shot(NamedTuple):
    """Windows to predict from their first states: inputs and outputs of `shoot`."""

    state: Array  # (W, S) at the start
    first: NDArray[np.intp]  # (W,) rows of `command` (T, C) at the start
    command: Array
    stop: NDArray[np.intp]  # (W, H) steps after which poses are requested; 0: none
    # (W, H, 3) poses then, relative to those at the start; headings unwrapped
    end: Array
    slope: Array  # (W, H, 3, P) their derivatives by the free coefficients


class Tangent(NamedTuple):
    """Scratch memory of L windows: current values, and their derivatives by P free coefficients."""

    x: Array  # (S + C + 1, L) X and a last entry of 1
    value: Array  # (K, L) of each term without its coefficient
    rate: Array  # (3 + S, L)
    # (3 + S, S, L) of the rates by the state; those of the state by a step, where no limit holds it
    jacobian: Array
    depends: NDArray[np.bool_]  # (3 + S, S) True if a rate depends on a state
    rest: Array  # (L,)
    pose: Array  # (5, L) x, y, heading, and its cosine and sine
    ahead: Array  # (3, L) way along x and y per vx, and along x per vy, in a step [s]
    moved: Array  # (3, L) way along x and y, and along x per turn of the start [m]
    by_turn: Array  # (2, L) way along x and y per turn rate [m s]
    moves: Array  # (S, L) dt where no limit holds the rate of a state, else 0
    kept: (
        Array  # (S, L) factor by which drag shrinks changes of a state; 0 if it sticks
    )
    pose_slope: Array  # (P, 3, L)
    state_slope: Array  # (P, S, L)
    after: Array  # (S, L) slope of the state a step later
    twist: Array  # (3, L) slope


def allocate_tangent(shot: Shot, terms: Terms, free: int) -> Tangent:
    """Allocates scratch memory for `shoot`."""
    windows, states = shot.state.shape
    blocks = max(1, -(-windows // LANES))
    lanes = VECTOR * max(1, -(-windows // (VECTOR * blocks)))
    depends = np.zeros((3 + states, states), dtype=np.bool_)
    for factors in terms.factors.T:
        by_state = factors < states
        depends[terms.dof[by_state], factors[by_state]] = True
    if terms.emf.size:
        depends[3:] |= np.eye(states, dtype=np.bool_)
    sizes: dict[str, tuple[int, ...]] = {
        "x": (states + shot.command.shape[1] + 1,),
        "value": (len(terms.dof),),
        "rate": (3 + states,),
        "jacobian": (3 + states, states),
        "rest": (),
        "pose": (5,),
        "ahead": (3,),
        "moved": (3,),
        "by_turn": (2,),
        "moves": (states,),
        "kept": (states,),
        "pose_slope": (free, 3),
        "state_slope": (free, states),
        "after": (states,),
        "twist": (3,),
    }
    memory = {name: np.zeros((*size, lanes)) for name, size in sizes.items()}
    return Tangent(depends=depends, **memory)


@kernel
def shoot(
    shot: Shot,
    terms: Terms,
    free: NDArray[np.int64],
    dt: float,
    scratch: Tangent,
) -> None:
    """Predicts windows in steps of dt [s], and the derivatives by the `free` (P,) of `terms`."""
    lanes = scratch.rest.shape[0]
    sloped = free.shape[0] > 0
    for begin in range(0, shot.state.shape[0], lanes):
        end = min(begin + lanes, shot.state.shape[0])
        for n in range(_begin(shot, begin, end, scratch)):
            _compute_rates(terms, scratch)
            if sloped:
                _linearise(terms, scratch)
            _move(scratch, dt)
            for i in range(shot.state.shape[1]):
                if sloped:
                    _hold_slopes(i, terms, scratch, dt)
                _advance(scratch.x[i], scratch.rate[3 + i], dt, get_bounds(terms, i))
            for p in range(free.shape[0]):
                dof = terms.dof[free[p]]
                value = scratch.value[free[p]]
                _follow_twist(scratch.state_slope[p], dof, value, scratch)
                _follow_pose(scratch.pose_slope[p], dt, scratch)
                _follow_state(scratch.state_slope[p], dof, value, scratch)
            for w in range(begin, end):
                _put(shot, w, n + 1, w - begin, scratch)


@kernel
def _begin(shot: Shot, begin: int, end: int, scratch: Tangent) -> int:
    """Initialises windows at their starts, and returns the number of steps to the last horizon."""
    scratch.x[:] = 0.0
    scratch.x[-1] = 1.0
    scratch.pose[:] = 0.0
    scratch.pose[3] = 1.0
    scratch.state_slope[:] = 0.0
    scratch.pose_slope[:] = 0.0
    last = 0
    for w in range(begin, end):
        for i in range(shot.state.shape[1]):
            scratch.x[i, w - begin] = shot.state[w, i]
        _put(shot, w, 0, w - begin, scratch)
        for h in range(shot.stop.shape[1]):
            last = max(last, shot.stop[w, h])
    return last


@kernel(inline=True)
def _put(shot: Shot, w: int, n: int, lane: int, scratch: Tangent) -> None:
    """Writes the requested outputs after n steps, and the command of the next step."""
    row = min(shot.first[w] + n, shot.command.shape[0] - 1)
    for i in range(shot.command.shape[1]):
        scratch.x[shot.state.shape[1] + i, lane] = shot.command[row, i]
    for h in range(shot.stop.shape[1]):
        if n > 0 and shot.stop[w, h] == n:
            for d in range(3):
                shot.end[w, h, d] = scratch.pose[d, lane]
                for p in range(shot.slope.shape[3]):
                    shot.slope[w, h, d, p] = scratch.pose_slope[p, d, lane]


# The following loops are over lanes and short, so that they become vector instructions.


@kernel
def _add(total: Array, factor: float, by: Array) -> None:
    for lane in range(total.shape[0]):
        total[lane] += factor * by[lane]


@kernel
def _add_product(total: Array, a: Array, b: Array) -> None:
    for lane in range(total.shape[0]):
        total[lane] += a[lane] * b[lane]


@kernel
def _put_product(product: Array, a: Array, b: Array) -> None:
    for lane in range(product.shape[0]):
        product[lane] = a[lane] * b[lane]


@kernel
def _multiply(product: Array, by: Array) -> None:
    for lane in range(product.shape[0]):
        product[lane] *= by[lane]


@kernel
def _compute_rates(terms: Terms, scratch: Tangent) -> None:
    """Computes the terms and the rates."""
    scratch.rate[:] = 0.0
    for k in range(terms.dof.shape[0]):
        value = scratch.value[k]
        first = scratch.x[terms.factors[k, 0]]
        if terms.degree[k] < 2:
            for lane in range(value.shape[0]):
                value[lane] = first[lane]
        else:
            _put_product(value, first, scratch.x[terms.factors[k, 1]])
        for f in range(2, terms.degree[k]):
            _multiply(value, scratch.x[terms.factors[k, f]])
        _add(scratch.rate[terms.dof[k]], terms.coefficient[k], value)
    states = terms.emf.shape[0]
    for i in range(states):
        for c in range(terms.emf.shape[1]):
            _brake(
                scratch.rate[3 + i],
                terms.emf[i, c],
                scratch.x[states + c],
                scratch.x[i],
            )


@kernel
def _brake(rate: Array, emf: float, command: Array, state: Array) -> None:
    """Subtracts the back-EMF of a command from the rate of a state."""
    for lane in range(rate.shape[0]):
        rate[lane] -= emf * abs(command[lane]) * state[lane]


@kernel
def _linearise(terms: Terms, scratch: Tangent) -> None:
    """Computes the derivatives of the rates by the state."""
    states = scratch.after.shape[0]
    scratch.jacobian[:] = 0.0
    for k in range(terms.dof.shape[0]):
        factors = terms.factors[k]
        degree = terms.degree[k]
        for f in range(degree):
            if factors[f] < states:
                slope = scratch.jacobian[terms.dof[k], factors[f]]
                _multiply_others(scratch.rest, factors, degree, f, scratch.x)
                _add(slope, terms.coefficient[k], scratch.rest)
    ones = scratch.x[-1]
    for i in range(terms.emf.shape[0]):
        for c in range(terms.emf.shape[1]):
            slope = scratch.jacobian[3 + i, i]
            _brake(slope, terms.emf[i, c], scratch.x[states + c], ones)


@kernel
def _multiply_others(
    product: Array, factors: NDArray[np.int64], degree: int, without: int, x: Array
) -> None:
    """Writes products (L,) of all factors except one."""
    product[:] = 1.0
    for f in range(degree):
        if f != without:
            _multiply(product, x[factors[f]])


@kernel
def _move(scratch: Tangent, dt: float) -> None:
    """Moves the poses along arcs; keeps how their ways depend on the twists and headings."""
    _aim(scratch.ahead, scratch.pose, scratch.rate[2], dt)
    ahead = scratch.ahead
    moved = scratch.moved
    twist = scratch.rate
    for lane in range(moved.shape[1]):
        ahead[2, lane] = -ahead[1, lane]
    for lane in range(moved.shape[1]):
        moved[0, lane] = (
            ahead[0, lane] * twist[0, lane] + ahead[2, lane] * twist[1, lane]
        )
    for lane in range(moved.shape[1]):
        moved[1, lane] = (
            ahead[1, lane] * twist[0, lane] + ahead[0, lane] * twist[1, lane]
        )
    for lane in range(moved.shape[1]):
        moved[2, lane] = -moved[1, lane]
    _add(scratch.pose[0], 1.0, moved[0])
    _add(scratch.pose[1], 1.0, moved[1])
    _add(scratch.pose[2], dt, twist[2])
    _lean(scratch.by_turn[0], moved[2], moved[0], twist[2], dt)
    _lean(scratch.by_turn[1], moved[0], moved[1], twist[2], dt)


@kernel
def _aim(ahead: Array, pose: Array, turn_rate: Array, dt: float) -> None:
    """Computes the way in a step per vx, and the cosine and sine of the next heading."""
    cosine = pose[3]
    sine = pose[4]
    along = ahead[0]
    aside = ahead[1]
    largest = 0.0
    for lane in range(turn_rate.shape[0]):
        largest = max(largest, abs(turn_rate[lane]))
    for lane in range(turn_rate.shape[0]):
        turn = turn_rate[lane] * dt
        square = turn * turn
        sinc = 1.0 - square * (1.0 / 6.0 - square * (1.0 / 120.0 - square / 5040.0))
        cosc = turn * (0.5 - square * (1.0 / 24.0 - square / 720.0))
        along[lane] = dt * (sinc * cosine[lane] - cosc * sine[lane])
        aside[lane] = dt * (sinc * sine[lane] + cosc * cosine[lane])
    for lane in range(turn_rate.shape[0]):
        cosine[lane] -= turn_rate[lane] * aside[lane]
        sine[lane] += turn_rate[lane] * along[lane]
    for lane in range(turn_rate.shape[0] if largest * dt > SMALL_TURN else 0):
        turn = turn_rate[lane] * dt
        if abs(turn) > SMALL_TURN:
            before = pose[2, lane]
            cosine[lane] = math.cos(before + turn)
            sine[lane] = math.sin(before + turn)
            along[lane] = (sine[lane] - math.sin(before)) / turn_rate[lane]
            aside[lane] = (math.cos(before) - cosine[lane]) / turn_rate[lane]


@kernel
def _lean(
    by_turn: Array, across: Array, along: Array, turn_rate: Array, dt: float
) -> None:
    """Computes the way per turn rate: half of it is across, and the chord gets shorter."""
    for lane in range(by_turn.shape[0]):
        shorter = dt * dt / 12.0 * turn_rate[lane]
        by_turn[lane] = 0.5 * dt * across[lane] - shorter * along[lane]


@kernel
def _advance(state: Array, rate: Array, dt: float, bounds: Bounds) -> None:
    for lane in range(state.shape[0]):
        state[lane] = advance_state(state[lane], rate[lane], dt, bounds)


@kernel
def _hold_slopes(i: int, terms: Terms, scratch: Tangent, dt: float) -> None:
    """Computes how limits and drag of a state hold its changes."""
    bounds = get_bounds(terms, i)
    rate = scratch.rate[3 + i]
    moves = scratch.moves[i]
    for lane in range(rate.shape[0]):
        moves[lane] = dt if bounds.fall <= rate[lane] <= bounds.rise else 0.0
    for lane in range(rate.shape[0]):
        scratch.kept[i, lane] = _keep(scratch.x[i, lane], rate[lane], dt, bounds)
    for j in range(scratch.after.shape[0]):
        if scratch.depends[3 + i, j]:
            slope = scratch.jacobian[3 + i, j]
            _multiply(slope, moves)


@kernel
def _keep(value: float, rate: float, dt: float, bounds: Bounds) -> float:
    """Returns the factor by which drag shrinks changes of a state; 0 if it sticks or is limited."""
    moved = advance_state(value, rate, dt, bounds)
    unheld = value + dt * min(max(rate, bounds.fall), bounds.rise)
    slower = 1.0 + dt * bounds.drag * abs(unheld)
    if slower > 1.0:
        unheld /= slower
    unheld -= math.copysign(dt * bounds.friction, unheld)
    return 1.0 / (slower * slower) if moved == unheld else 0.0


@kernel
def _follow_twist(slopes: Array, dof: int, value: Array, scratch: Tangent) -> None:
    """Computes the slopes of the twist by a coefficient of a term of a dof."""
    for d in range(3):
        twist = scratch.twist[d]
        twist[:] = 0.0
        for j in range(slopes.shape[0]):
            if scratch.depends[d, j]:
                _add_product(twist, scratch.jacobian[d, j], slopes[j])
    if dof < 3:
        _add(scratch.twist[dof], 1.0, value)


@kernel
def _follow_pose(slope: Array, dt: float, scratch: Tangent) -> None:
    """Propagates the slopes (3, L) of poses along arcs, from those of the twist."""
    ahead = scratch.ahead
    moved = scratch.moved
    by_turn = scratch.by_turn
    heading = slope[2]
    _shift(slope[0], ahead[0], ahead[2], moved[2], by_turn[0], scratch.twist, heading)
    _shift(slope[1], ahead[1], ahead[0], moved[0], by_turn[1], scratch.twist, heading)
    _add(heading, dt, scratch.twist[2])


@kernel
def _shift(
    place: Array,
    per_vx: Array,
    per_vy: Array,
    per_heading: Array,
    per_turn_rate: Array,
    twist: Array,
    heading: Array,
) -> None:
    """Adds the ways by slopes of the twist (3, L) and of the heading."""
    vx = twist[0]
    vy = twist[1]
    wz = twist[2]
    for lane in range(place.shape[0]):
        place[lane] += (
            per_vx[lane] * vx[lane]
            + per_vy[lane] * vy[lane]
            + per_heading[lane] * heading[lane]
            + per_turn_rate[lane] * wz[lane]
        )


@kernel
def _follow_state(slopes: Array, dof: int, value: Array, scratch: Tangent) -> None:
    """Propagates the slopes (S, L) of states by a coefficient of a term of a dof."""
    states = slopes.shape[0]
    for i in range(states):
        after = scratch.after[i]
        for lane in range(after.shape[0]):
            after[lane] = slopes[i, lane]
        for j in range(states):
            if scratch.depends[3 + i, j]:
                _add_product(after, scratch.jacobian[3 + i, j], slopes[j])
        if dof == 3 + i:
            _add_product(after, scratch.moves[i], value)
    for i in range(states):
        _put_product(slopes[i], scratch.after[i], scratch.kept[i])


@kernel
def follow_first_order(states: Array, targets: Array, kept: float) -> None:
    """Writes states (T,) after the first: each keeps a share of its distance from the target."""
    for k in range(len(states) - 1):
        states[k + 1] = targets[k] + kept * (states[k] - targets[k])


class BicycleGeometry(NamedTuple):
    """Geometry of a robot that steers."""

    used: bool
    front_drive: bool
    wheelbase: float  # [m]
    understeer: float  # turn rates are divided by 1 + understeer * speed^2 [s^2/m^2]


STRAIGHT = BicycleGeometry(False, False, 1.0, 0.0)


@kernel
def _limited(value: float, target: float, lag: float, limit: Array) -> float:
    """Returns a target close enough that a first-order lag towards it stays within `limit` (2,)."""
    gap = target - value
    most: float = lag * (limit[0] if gap * value >= 0.0 else limit[1])
    return value + most * math.tanh(gap / most)


@kernel
def _twist(state: Array, bicycle: BicycleGeometry) -> tuple[float, float, float]:
    if not bicycle.used:
        return state[0], state[1], state[2]
    speed = state[0]
    angle = state[2]
    if bicycle.front_drive:
        return speed * math.cos(angle), 0.0, speed * math.sin(angle) / bicycle.wheelbase
    length = bicycle.wheelbase * (1.0 + bicycle.understeer * speed * speed)
    return speed, 0.0, speed * math.tan(angle) / length


@kernel
def _keep_lags(share: float, dt: float, lag: Array) -> tuple[float, float, float]:
    """Returns the shares of their distances from the targets that actuators keep in a step."""
    span = share * dt
    return (
        1.0 / (1.0 + span / lag[0]),
        1.0 / (1.0 + span / lag[1]),
        1.0 / (1.0 + span / lag[2]),
    )


@kernel
def _advance_actuator(
    state: Array,
    target: Array,
    place: float,
    kept: tuple[float, float, float],
    lag: Array,
    limit: Array,
) -> None:
    """Moves an actuator (3,) towards its target (G, 3) at a place between rows."""
    held = min(max(place, 0.0), len(target) - 2.0)
    k = int(held)
    for i in range(3):
        aim = target[k, i] + (held - k) * (target[k + 1, i] - target[k, i])
        if i == 0:
            aim = _limited(state[0], aim, lag[0], limit)
        state[i] = aim + (state[i] - aim) * kept[i]


@kernel
def _rotate_half(half: float) -> tuple[float, float]:
    """Returns cosine and sine of half the turn of a step."""
    if abs(half) > SMALL_TURN:
        return math.cos(half), math.sin(half)
    square = half * half
    cosine = 1.0 - square / 30.0 * (1.0 - square / 56.0)
    sine = 1.0 - square / 42.0 * (1.0 - square / 72.0)
    return (
        1.0 - square / 2.0 * (1.0 - square / 12.0 * cosine),
        half * (1.0 - square / 6.0 * (1.0 - square / 20.0 * sine)),
    )


@kernel
def roll_windows(
    ends: Array,
    actuator: Array,
    begin: Array,
    stops: Array,
    target: Array,
    lag: Array,
    limit: Array,
    bicycle: BicycleGeometry,
    dt: float,
) -> None:
    """Writes relative poses (W, H, 3) at ascending `stops` (W, H), in steps of `dt` after `begin`.

    `actuator` (W, 3) holds the initial states and is overwritten: a body twist, or speed, 0 and
    angle of a steered robot; `target` (G, 3) their targets on a grid, `begin` (W,) indices in it;
    `lag` (3,) [s]; `limit` (2,) of the speed's acceleration and deceleration [m/s^2].
    """
    kept_by_step = _keep_lags(1.0, dt, lag)
    for w in range(len(begin)):
        x = 0.0
        y = 0.0
        heading = 0.0
        c = 1.0
        s = 0.0
        done = 0.0
        for h in range(stops.shape[1]):
            while done < stops[w, h] - 1e-9:
                share = min(1.0, stops[w, h] - done)
                kept = kept_by_step if share == 1.0 else _keep_lags(share, dt, lag)
                place = begin[w] + done
                _advance_actuator(actuator[w], target, place, kept, lag, limit)
                vx, vy, turn_rate = _twist(actuator[w], bicycle)
                span = share * dt
                cosine, sine = _rotate_half(0.5 * turn_rate * span)
                c, s = c * cosine - s * sine, s * cosine + c * sine  # half-way
                x += span * (c * vx - s * vy)
                y += span * (s * vx + c * vy)
                c, s = c * cosine - s * sine, s * cosine + c * sine
                heading += turn_rate * span
                done += share
            ends[w, h, 0] = x
            ends[w, h, 1] = y
            ends[w, h, 2] = heading
