"""Compiled model-predictive path integral control (Williams and others 2017).

Simulates K rollouts at a time in the robot's model, over H periods. Commands are actions in
[-1, 1] at `knots`, interpolated linearly. Shapes: N robots, S states, C commands, Q knots.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.geometry import Array
from nics_drl_bridge.kernels import kernel
from nics_drl_bridge.policy.planners import local_map_kernels as maps
from nics_drl_bridge.policy.planners.local_map_kernels import (
    Clearance,
    FootprintDiscs,
    MapScratch,
    ScanRays,
    Situation,
)
from nics_drl_bridge.random_kernels import PLANNER_STREAM, normal, uniform
from nics_drl_bridge.robot.kernels import Terms, advance, apply_curve, rates, run

HIT = 1e3  # cost of an immediate contact; later ones cost less
# multiple of the range from which proposals are drawn before clamping, so many lie at its ends
BEYOND = 1.3
# passes over the commands when fitting them to a twist
PASSES = 12
EASE = 1e-6


class Plant(NamedTuple):
    """The model of a robot, for K rollouts at a time."""

    terms: Terms  # with coefficients (T, K), one column per rollout
    single: Terms  # with coefficients (T,), for one robot
    series: Array
    dt: float  # [s]
    substeps: int  # integration steps per period
    latency: float  # delay before a command takes effect [s]
    settled: Array  # (S, C) steady state per unit of a held command
    low: Array  # (C,) minimum of each command
    high: Array


class Halt(NamedTuple):
    """A stop that ends a rollout."""

    # (C,) True for commands that are held while the robot stops
    holds: NDArray[np.bool_]
    rest: Array  # (C,) value of the other commands
    most: int  # maximum number of periods for the stop
    far: float  # distance along an axis beyond which the map is unknown [m]


class Sampling(NamedTuple):
    """The rollouts of a plan."""

    offers: Array  # (K, Q, C) proposed actions of the first round
    # (K, Q, C) standard normal noise, added to the best actions in later rounds
    noise: Array
    spreads: Array  # (R,) standard deviation of the noise in these rounds
    between: Array  # (H, Q) weights of the knots in the action of each period
    temperature: float  # temperature of the weights, in units of cost
    halt: Halt  # the stop at the end of each rollout


class Worth(NamedTuple):
    """Weights of the terms in the cost of a rollout."""

    near: float  # weight of driving a whole rollout at the margin [m]
    # weight of the mean path length to the goal; the final one has weight 1 - early
    early: float
    change: float  # weight of the squared change of actions between knots [m]
    astray: float  # weight of a final heading that leads away from the goal [m]


class RollOuts(NamedTuple):
    """Scratch memory of one robot's plan; a lane is one of the K rollouts."""

    pose: Array  # (6, K) see `robot.kernels.run`
    x: Array  # (S + C + 1, K)
    dq: Array  # (3 + S, K)
    actions: Array  # (K, Q, C)
    nominal: Array  # (Q, C)
    held: Array  # (C,) held command that explains the present twist
    x_single: Array  # (S + C + 1,) of one robot
    rate: Array  # (3 + S,)
    start: Array  # (3,)
    cost: Array  # (K,)
    way: Array  # (K,)
    # (K,) period of the contact or arrival; negative: neither
    ended: NDArray[np.int64]


@kernel(allocates=True)
def draw(offers: Array, noise: Array, rest: Array, seed: int) -> None:
    """Draws `Sampling.offers`, the first of them rest (C,), and `Sampling.noise`, by seed."""
    for k in range(offers.shape[0]):
        for q in range(offers.shape[1]):
            for c in range(offers.shape[2]):
                i = (k * offers.shape[1] + q) * offers.shape[2] + c
                drawn = BEYOND * (2.0 * uniform(seed, PLANNER_STREAM, 3 * i) - 1.0)
                # Half of the proposals hold one action.
                held = k < offers.shape[0] // 2 and q > 0
                offers[k, q, c] = (
                    offers[k, 0, c] if held else min(max(drawn, -1.0), 1.0)
                )
                if k == 0:
                    offers[k, q, c] = rest[c]
                noise[k, q, c] = normal(seed, PLANNER_STREAM, 3 * i + 1)


@kernel(allocates=True)
def plan_all(
    out: Array,
    scans: Array,
    goals: Array,
    twists: Array,
    sense: tuple[ScanRays, FootprintDiscs, Clearance, MapScratch],
    plant: Plant,
    sampling: Sampling,
    worth: Worth,
    lanes: RollOuts,
) -> None:
    """Writes the actions (N, C) of N robots from scans (N, P), goals (N, 2) and twists (N, 3)."""
    for n in range(out.shape[0]):
        around = maps.look(scans[n], goals[n], *sense)
        _plan(out[n], twists[n], around, plant, sampling, worth, lanes)


@kernel(allocates=True)
def _plan(
    out: Array,
    twist: Array,
    around: Situation,
    plant: Plant,
    sampling: Sampling,
    worth: Worth,
    lanes: RollOuts,
) -> None:
    """Writes the first action (C,) of the plan.

    Instead of warm-starting from the previous plan, the first round proposes actions from the whole
    range. The planner therefore has no memory: its actions depend only on the observation.
    """
    _wait(twist, plant, lanes)
    lanes.actions[:] = sampling.offers
    best = _roll(around, plant, sampling, worth, lanes)
    lanes.nominal[:] = lanes.actions[best]
    for spread in sampling.spreads:
        for k in range(lanes.actions.shape[0]):
            for q in range(lanes.nominal.shape[0]):
                for c in range(lanes.nominal.shape[1]):
                    action = lanes.nominal[q, c]
                    if k > 0:
                        action += spread * sampling.noise[k, q, c]
                    lanes.actions[k, q, c] = min(max(action, -1.0), 1.0)
        best = _roll(around, plant, sampling, worth, lanes)
        _average(best, sampling.temperature, lanes)
    out[:] = lanes.nominal[0]


@kernel
def _wait(twist: Array, plant: Plant, lanes: RollOuts) -> None:
    """Writes pose and state, when commands take effect, of a robot that has a twist (3,) now."""
    follow(twist, plant, lanes)
    lanes.start[:] = 0.0
    if plant.latency > 0.0:
        advance(lanes.start, twist, plant.latency, plant.series)


@kernel
def _average(best: int, temperature: float, lanes: RollOuts) -> None:
    """Replaces the nominal actions by the cost-weighted mean of the sampled ones."""
    lanes.nominal[:] = 0.0
    total = 0.0
    for k in range(lanes.cost.shape[0]):
        weight = math.exp((lanes.cost[best] - lanes.cost[k]) / temperature)
        total += weight
        for q in range(lanes.nominal.shape[0]):
            for c in range(lanes.nominal.shape[1]):
                lanes.nominal[q, c] += weight * lanes.actions[k, q, c]
    for q in range(lanes.nominal.shape[0]):
        for c in range(lanes.nominal.shape[1]):
            lanes.nominal[q, c] /= total


@kernel
def follow(twist: Array, plant: Plant, lanes: RollOuts) -> None:
    """Writes the held command whose steady twist is nearest to a twist (3,), and its state.

    Coordinate descent on the squared difference.
    """
    held = lanes.held
    x = lanes.x_single
    dq = lanes.rate
    terms = plant.single
    count = plant.settled.shape[1]
    for c in range(count):
        held[c] = min(max(0.0, plant.low[c]), plant.high[c])
    for _ in range(PASSES):
        for c in range(count):
            _settle(held, plant, lanes)
            rates(dq, x, terms)
            r0 = twist[0] - dq[0]
            r1 = twist[1] - dq[1]
            r2 = twist[2] - dq[2]
            b0 = dq[0]
            b1 = dq[1]
            b2 = dq[2]
            step = 1e-3 * (plant.high[c] - plant.low[c])
            held[c] += step
            _settle(held, plant, lanes)
            rates(dq, x, terms)
            held[c] -= step
            g0 = (dq[0] - b0) / step
            g1 = (dq[1] - b1) / step
            g2 = (dq[2] - b2) / step
            size = g0 * g0 + g1 * g1 + g2 * g2 + EASE
            value = held[c] + (g0 * r0 + g1 * r1 + g2 * r2) / size
            held[c] = min(max(value, plant.low[c]), plant.high[c])
    _settle(held, plant, lanes)


@kernel
def _settle(command: Array, plant: Plant, lanes: RollOuts) -> None:
    """Writes the steady state of a command (C,) and its effect into `one`."""
    states, count = plant.settled.shape
    x = lanes.x_single
    for s in range(states):
        x[s] = 0.0
        for c in range(count):
            x[s] += plant.settled[s, c] * command[c]
    for c in range(count):
        x[states + c] = apply_curve(command[c], plant.single.curves[c])
    x[states + count] = 1.0


@kernel
def _roll(
    around: Situation, plant: Plant, sampling: Sampling, worth: Worth, lanes: RollOuts
) -> int:
    """Rolls out the actions of all lanes; writes their costs and returns the cheapest lane."""
    _begin(around, plant, worth, lanes)
    states = plant.settled.shape[0]
    periods = sampling.between.shape[0]
    limit = maps.touching(around)
    for t in range(periods):
        for c in range(plant.low.shape[0]):
            middle = 0.5 * (plant.low[c] + plant.high[c])
            half = 0.5 * (plant.high[c] - plant.low[c])
            row = lanes.x[states + c]
            curve = plant.single.curves[c]
            for k in range(row.shape[0]):
                action = 0.0
                for q in range(lanes.nominal.shape[0]):
                    action += sampling.between[t, q] * lanes.actions[k, q, c]
                row[k] = apply_curve(middle + half * action, curve)
        run(
            lanes.pose,
            lanes.x,
            lanes.dq,
            plant.terms,
            plant.series,
            plant.dt,
            plant.substeps,
        )
        for k in range(lanes.cost.shape[0]):
            if lanes.ended[k] < 0:
                _judge(k, t, periods, limit, around, worth, lanes)
    _halt(around, plant, sampling.halt, limit, lanes)
    best = 0
    for k in range(lanes.cost.shape[0]):
        lanes.cost[k] += (1.0 - worth.early) * lanes.way[k]
        if lanes.cost[k] < lanes.cost[best]:
            best = k
    return best


@kernel
def _halt(
    around: Situation, plant: Plant, halt: Halt, limit: float, lanes: RollOuts
) -> None:
    """Stops all lanes at the end of their rollouts; adds the cost of contacts while stopping."""
    states = plant.settled.shape[0]
    for t in range(halt.most):
        for c in range(plant.low.shape[0]):
            if not halt.holds[c]:
                lanes.x[states + c, :] = apply_curve(
                    halt.rest[c], plant.single.curves[c]
                )
        run(
            lanes.pose,
            lanes.x,
            lanes.dq,
            plant.terms,
            plant.series,
            plant.dt,
            plant.substeps,
        )
        pose = lanes.pose
        for k in range(lanes.cost.shape[0]):
            if lanes.ended[k] >= 0:
                continue
            room = maps.room_at(pose[0, k], pose[1, k], pose[2, k], pose[3, k], around)
            if room < limit or max(abs(pose[0, k]), abs(pose[1, k])) > halt.far:
                lanes.cost[k] += HIT * (1.0 - t / halt.most)
                lanes.ended[k] = t


@kernel
def _begin(around: Situation, plant: Plant, worth: Worth, lanes: RollOuts) -> None:
    """Puts all lanes at the start; begins their costs with the changes of action between knots."""
    states, count = plant.settled.shape
    x = lanes.start[0]
    y = lanes.start[1]
    heading = lanes.start[2]
    for k in range(lanes.cost.shape[0]):
        lanes.pose[0, k] = x
        lanes.pose[1, k] = y
        lanes.pose[2, k], lanes.pose[3, k] = math.cos(heading), math.sin(heading)
        lanes.pose[4, k] = heading
        lanes.pose[5, k] = 0.0
        for s in range(states):
            lanes.x[s, k] = lanes.x_single[s]
        change = 0.0
        for c in range(count):
            before = (
                2.0 * (lanes.held[c] - plant.low[c]) / (plant.high[c] - plant.low[c])
                - 1.0
            )
            for q in range(lanes.nominal.shape[0]):
                change += (lanes.actions[k, q, c] - before) ** 2
                before = lanes.actions[k, q, c]
        lanes.cost[k] = worth.change * change
        lanes.way[k] = 0.0
        lanes.ended[k] = -1


@kernel
def _judge(
    k: int,
    t: int,
    periods: int,
    limit: float,
    around: Situation,
    worth: Worth,
    lanes: RollOuts,
) -> None:
    """Adds the cost of period t in lane k."""
    x = lanes.pose[0, k]
    y = lanes.pose[1, k]
    c = lanes.pose[2, k]
    s = lanes.pose[3, k]
    room = maps.room_at(x, y, c, s, around)
    way = maps.way_at(x, y, around)
    lanes.way[k] = way
    lanes.cost[k] += worth.early * way / periods
    if room < limit:
        lanes.cost[k] += HIT * (2.0 - t / periods)
        lanes.ended[k] = t
        return
    keep = around.clearance
    near = max(keep.margin + keep.soft - room, 0.0) / keep.soft
    lanes.cost[k] += worth.near * near * near / periods
    if math.hypot(around.goal[0] - x, around.goal[1] - y) < maps.ARRIVED_M:
        lanes.ended[k] = t
        lanes.way[k] = 0.0
    elif t == periods - 1:
        lanes.cost[k] += (
            worth.astray * maps.astray(x, y, c, s, way, around) * min(way, 1.0)
        )
