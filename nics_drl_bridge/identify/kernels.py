"""Compiled rollouts over windows: poses at their ends, and derivatives by the coefficients.

`shoot` rolls out a model with its sensitivities, `roll_windows` a textbook. `follow_first_order`
serves states that follow commands, since `scipy.signal` takes a second to import.
"""

import math
from dataclasses import replace
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
    make_terms,
    sum_back_emf,
)
from nics_drl_bridge.robot.taylor import TaylorModel

# number of windows predicted at a time, for vector instructions
WIDTH = 16
# below this angle the series of sin(a)/a is exact to the last digits [rad]
SMALL_TURN = 0.3


def make_used_terms(
    model: TaylorModel, used: NDArray[np.bool_], free: NDArray[np.bool_]
) -> tuple[Terms, NDArray[np.int64]]:
    """Returns the used ones (D, K) of a model's terms, and the indices of the free among them.

    A term that is used may have a coefficient of 0.
    """
    terms = make_terms(replace(model, coefficients=used.astype(np.float64)))
    terms = terms._replace(coefficient=model.coefficients[used])
    return terms, np.flatnonzero(free[used]).astype(np.int64)


@kernel
def _sinc(half: float) -> float:
    if abs(half) > SMALL_TURN:
        return math.sin(half) / half
    square = half * half
    return 1.0 - square / 6.0 * (1.0 - square / 20.0 * (1.0 - square / 42.0))


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
    """Scratch memory of L windows: current values, and their derivatives by the free coefficients.

    There is space for a multiple of `WIDTH` coefficients.
    """

    x: Array  # (S + C + 1, L) X and a last entry of 1
    value: Array  # (K, L) of each term without its coefficient
    rate: Array  # (3 + S, L)
    jacobian: Array  # (3 + S, S, L) of the rates by the state
    rest: Array  # (L,)
    last: Array  # (L,) steps to the last horizon
    pose: Array  # (L, 3)
    state_slope: Array  # (L, S, P)
    pose_slope: Array  # (L, 3, P)
    before: Array  # (S, P) slope of a state a step earlier
    twist: Array  # (3, P) slope


def tangent(states: int, commands: int, terms: int, free: int) -> Tangent:
    """Allocates scratch memory for `shoot`."""
    lanes = WIDTH
    free = -(-free // WIDTH) * WIDTH
    shapes = (
        (states + commands + 1, lanes),
        (terms, lanes),
        (3 + states, lanes),
        (3 + states, states, lanes),
        (lanes,),
        (lanes,),
        (lanes, 3),
        (lanes, states, free),
        (lanes, 3, free),
        (states, free),
        (3, free),
    )
    return Tangent(*map(np.zeros, shapes))


@kernel
def shoot(
    shot: Shot,
    terms: Terms,
    free: NDArray[np.int64],
    dt: float,
    scratch: Tangent,
) -> None:
    """Predicts windows in steps of dt [s], and the derivatives by the `free` (P,) of `terms`.

    The indices of free terms, and the degrees of freedom of the terms, must ascend.
    """
    for begin in range(0, shot.state.shape[0], WIDTH):
        end = min(begin + WIDTH, shot.state.shape[0])
        for n in range(_begin(shot, begin, end, scratch)):
            _linearise(terms, free, scratch)
            for w in range(begin, end):
                if n < scratch.last[w - begin]:
                    _step(w - begin, terms, free, scratch, dt)
                    _put(shot, w, n + 1, w - begin, scratch)


@kernel
def _begin(shot: Shot, begin: int, end: int, scratch: Tangent) -> int:
    """Initialises windows at their starts, and returns the number of steps to the last horizon."""
    scratch.x[-1] = 1.0
    last = 0
    scratch.pose[:] = 0.0
    scratch.state_slope[:] = 0.0
    scratch.pose_slope[:] = 0.0
    for w in range(begin, end):
        for i in range(shot.state.shape[1]):
            scratch.x[i, w - begin] = shot.state[w, i]
        _put(shot, w, 0, w - begin, scratch)
        scratch.last[w - begin] = 0.0
        for h in range(shot.stop.shape[1]):
            scratch.last[w - begin] = max(scratch.last[w - begin], shot.stop[w, h])
        last = max(last, int(scratch.last[w - begin]))
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
                shot.end[w, h, d] = scratch.pose[lane, d]
                for p in range(shot.slope.shape[3]):
                    shot.slope[w, h, d, p] = scratch.pose_slope[lane, d, p]


@kernel
def _linearise(terms: Terms, free: NDArray[np.int64], scratch: Tangent) -> None:
    """Computes the terms and the rates, and their derivatives by the state if any are needed."""
    states = scratch.state_slope.shape[1]
    sloped = free.shape[0] > 0
    scratch.rate[:] = 0.0
    scratch.jacobian[:] = 0.0
    for k in range(terms.dof.shape[0]):
        d = terms.dof[k]
        coefficient = terms.coefficient[k]
        factors = terms.factors[k]
        degree = terms.degree[k]
        value = scratch.value[k if sloped else 0]
        rate = scratch.rate[d]
        _multiply(value, 1.0, factors, degree, -1, scratch.x)
        for lane in range(rate.shape[0]):
            rate[lane] += coefficient * value[lane]
        for f in range(degree if sloped else 0):
            if factors[f] < states:
                _multiply(scratch.rest, coefficient, factors, degree, f, scratch.x)
                slope = scratch.jacobian[d, factors[f]]
                for lane in range(slope.shape[0]):
                    slope[lane] += scratch.rest[lane]
    for i in range(terms.emf.shape[0]):
        rate = scratch.rate[3 + i]
        slope = scratch.jacobian[3 + i, i]
        state = scratch.x[i]
        for lane in range(rate.shape[0]):
            braking = sum_back_emf(i, scratch.x[:, lane], terms)
            rate[lane] -= braking * state[lane]
            slope[lane] -= braking


@kernel
def _multiply(
    product: Array,
    first: float,
    factors: NDArray[np.int64],
    degree: int,
    without: int,
    x: Array,
) -> None:
    """Writes products (L,) of a number and all factors except one."""
    for lane in range(product.shape[0]):
        product[lane] = first
    for f in range(degree):
        if f != without:
            factor = x[factors[f]]
            for lane in range(product.shape[0]):
                product[lane] *= factor[lane]


@kernel(inline=True)
def _step(
    lane: int, terms: Terms, free: NDArray[np.int64], scratch: Tangent, dt: float
) -> None:
    """Advances a window and its derivatives by a step."""
    rate = scratch.rate[:, lane]
    pose = scratch.pose[lane]
    sloped = free.shape[0] > 0
    first = _follow_twist(lane, terms, free, scratch) if sloped else 0
    turn = rate[2] * dt
    along = dt * _sinc(rate[2] * dt / 2.0)
    c = math.cos(pose[2] + turn / 2.0)
    s = math.sin(pose[2] + turn / 2.0)
    dx = along * (c * rate[0] - s * rate[1])
    dy = along * (s * rate[0] + c * rate[1])
    if sloped:
        shorter = -turn / 12.0 * dt
        _follow_pose(
            scratch.pose_slope[lane],
            scratch.twist,
            (dx, dy),
            (along * c, along * s),
            shorter,
            dt,
        )
    pose[0] += dx
    pose[1] += dy
    pose[2] += turn
    _follow_state(lane, terms, free, first, scratch, dt)


@kernel
def _follow_twist(
    lane: int, terms: Terms, free: NDArray[np.int64], scratch: Tangent
) -> int:
    state = scratch.state_slope[lane]
    for d in range(3):
        scratch.twist[d] = 0.0
        for j in range(state.shape[0]):
            _add(scratch.twist[d], scratch.jacobian[d, j, lane], state[j])
    p = 0
    while p < free.shape[0] and terms.dof[free[p]] < 3:
        scratch.twist[terms.dof[free[p]], p] += scratch.value[free[p], lane]
        p += 1
    return p


@kernel
def _add(total: Array, factor: float, by: Array) -> None:
    if factor != 0.0:
        for p in range(total.shape[0]):
            total[p] += factor * by[p]


@kernel
def _follow_pose(
    pose: Array,
    twist: Array,
    moved: tuple[float, float],
    along: tuple[float, float],
    shorter: float,
    dt: float,
) -> None:
    """Propagates the derivatives (3, P) of a pose along an arc, from those of its twist (3, P)."""
    x = pose[0]
    y = pose[1]
    heading = pose[2]
    vx = twist[0]
    vy = twist[1]
    wz = twist[2]
    dx, dy = moved
    ax, ay = along
    for p in range(x.shape[0]):
        lean = heading[p] + 0.5 * dt * wz[p]
        x[p] += ax * vx[p] - ay * vy[p] - lean * dy + shorter * wz[p] * dx
    for p in range(x.shape[0]):
        lean = heading[p] + 0.5 * dt * wz[p]
        y[p] += ay * vx[p] + ax * vy[p] + lean * dx + shorter * wz[p] * dy
    for p in range(x.shape[0]):
        heading[p] += dt * wz[p]


@kernel(inline=True)
def _follow_state(
    lane: int,
    terms: Terms,
    free: NDArray[np.int64],
    k: int,
    scratch: Tangent,
    dt: float,
) -> None:
    state = scratch.state_slope[lane]
    before = scratch.before
    rate = scratch.rate[:, lane]
    states, count = state.shape
    for i in range(states):
        for p in range(count):
            before[i, p] = state[i, p]
    for i in range(states):
        moves = terms.fall[i] <= rate[3 + i] <= terms.rise[i]
        now = state[i]
        for j in range(states if moves and count > 0 else 0):
            _add(now, dt * scratch.jacobian[3 + i, j, lane], before[j])
        while k < free.shape[0] and terms.dof[free[k]] == 3 + i:
            if moves:
                now[k] += dt * scratch.value[free[k], lane]
            k += 1
        bounds = get_bounds(terms, i)
        x = scratch.x[i]
        moved = advance_state(x[lane], rate[3 + i], dt, bounds)
        if count > 0:
            _hold(now, x[lane], moved, rate[3 + i], dt, bounds)
        x[lane] = moved


@kernel
def _hold(
    slope: Array,
    value: float,
    moved: float,
    rate: float,
    dt: float,
    bounds: Bounds,
) -> None:
    """Scales derivatives (P,) of a state by its drag; zeroes them if it sticks or is limited."""
    unheld = value + dt * min(max(rate, bounds.fall), bounds.rise)
    slower = 1.0 + dt * bounds.drag * abs(unheld)
    if slower > 1.0:
        unheld /= slower
        for p in range(slope.shape[0]):
            slope[p] /= slower * slower
    unheld -= math.copysign(dt * bounds.friction, unheld)
    if moved != unheld:
        slope[:] = 0.0


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
    for w in range(len(begin)):
        x = 0.0
        y = 0.0
        heading = 0.0
        done = 0.0
        state = actuator[w]
        for h in range(stops.shape[1]):
            while done < stops[w, h] - 1e-9:
                share = min(1.0, stops[w, h] - done)
                place = min(max(begin[w] + done, 0.0), len(target) - 2.0)
                k = int(place)
                for i in range(3):
                    aim = target[k, i] + (place - k) * (target[k + 1, i] - target[k, i])
                    if i == 0:
                        aim = _limited(state[0], aim, lag[0], limit)
                    state[i] = aim + (state[i] - aim) / (1.0 + share * dt / lag[i])
                vx, vy, turn = _twist(state, bicycle)
                span = share * dt
                middle = heading + 0.5 * turn * span
                c = math.cos(middle)
                s = math.sin(middle)
                x += span * (c * vx - s * vy)
                y += span * (s * vx + c * vy)
                heading += turn * span
                done += share
            ends[w, h, 0] = x
            ends[w, h, 1] = y
            ends[w, h, 2] = heading
