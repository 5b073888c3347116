"""Compiled model-predictive path integral control (Williams and others 2017).

Simulates K rollouts at a time in the robot's model, over H periods and the stop after them.
Commands are actions in [-1, 1] at knots, interpolated linearly. Shapes: N robots, S states, C
commands, Q knots.
"""

import math
from typing import NamedTuple

from nics_drl_bridge.geometry import Array
from nics_drl_bridge.kernels import kernel
from nics_drl_bridge.lidar.arrays import Integers, Mask
from nics_drl_bridge.policy.planners import local_map_kernels as maps
from nics_drl_bridge.random_kernels import PLANNER_STREAM, normal, uniform
from nics_drl_bridge.robot.kernels import Terms, advance, apply_curve, rates, run

SPREADS = (0.4, 0.2)  # standard deviation of the noise in the rounds after the first
TEMPERATURE = 0.05  # of the weights of rollouts, as a path length [m]
# Weights in the cost of a rollout: driving all of it at the margin [m]; the mean path
# length to the goal (the final one has the complementary weight); squared changes of
# actions between knots [m]; and a final heading away from the goal [m]
NEAR = 4.0
EARLY = 0.3
CHANGE = 0.02
ASTRAY = 0.2
HIT = 1e3  # cost of an immediate contact; later ones cost less
# proposals are drawn from this multiple of the range and clamped, so that many are
# extreme
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


class Sampling(NamedTuple):
    """The rollouts of a plan, each of which ends with a stop."""

    offers: Array  # (K, Q, C) proposed actions of the first round
    # (K, Q, C) standard normal noise, added to the best actions in later rounds
    noise: Array
    between: Array  # (H, Q) weights of the knots in the action of each period
    # (C,) True for commands that are held while the robot stops
    holds: Mask
    rest: Array  # (C,) value of the other commands
    # maximum number of periods for the stop; 0 if the robot can stop within half a rollout
    stop: int
    far: float  # distance along an axis beyond which the map is unknown [m]


class RollOuts(NamedTuple):
    """Scratch memory of one robot's plan; a lane is one of the K rollouts."""

    pose: Array  # (6, K) see `robot.kernels.run`
    x: Array  # (S + C + 1, K)
    dq: Array  # (3 + S, K)
    actions: Array  # (K, Q, C)
    nominal: Array  # (Q, C)
    held: Array  # (C,) held command that explains the current twist
    x_single: Array  # (S + C + 1,) of one robot
    rate: Array  # (3 + S,)
    start: Array  # (3,)
    reached: Array  # (3,) twist of the held command
    cost: Array  # (K,)
    way: Array  # (K,)
    # (K,) period of the contact or arrival; negative: neither
    ended: Integers


@kernel
def draw(offers: Array, noise: Array, rest: Array, seed: int) -> None:
    """Draws `Sampling.offers`, the first of them rest (C,), and `Sampling.noise`, by seed."""
    for k in range(len(offers)):
        for q in range(offers.shape[1]):
            for c in range(offers.shape[2]):
                i = (k * offers.shape[1] + q) * offers.shape[2] + c
                drawn = BEYOND * (2.0 * uniform(seed, PLANNER_STREAM, 3 * i) - 1.0)
                # Half of the proposals hold one action.
                held = k < len(offers) // 2 and q > 0
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
    around: maps.Situation,
    plant: Plant,
    sampling: Sampling,
    lanes: RollOuts,
) -> None:
    """Writes the first actions (N, C) of the plans of N robots.

    Scans are (N, P), goals (N, 2), twists (N, 3). Instead of warm-starting from the previous plan,
    the first round proposes actions from the whole range. The planner therefore has no memory: its
    actions depend only on the observation.
    """
    for n in range(len(out)):
        maps.map_scan(scans[n], goals[n], around)
        # pose and state when the first command takes effect
        fit_command(twists[n], plant, lanes)
        lanes.start[:] = 0.0
        if plant.latency > 0.0:
            advance(lanes.start, twists[n], plant.latency, plant.series)
        lanes.actions[:] = sampling.offers
        best = _roll_out(around, plant, sampling, lanes)
        nominal = lanes.nominal
        nominal[:] = lanes.actions[best]
        for spread in SPREADS:
            for k in range(len(lanes.actions)):
                for q in range(len(nominal)):
                    for c in range(nominal.shape[1]):
                        action = nominal[q, c]
                        if k > 0:
                            action += spread * sampling.noise[k, q, c]
                        lanes.actions[k, q, c] = min(max(action, -1.0), 1.0)
            best = _roll_out(around, plant, sampling, lanes)
            # The nominal actions become the mean of the sampled ones, weighted by their costs.
            nominal[:] = 0.0
            total = 0.0
            for k in range(len(lanes.cost)):
                weight = math.exp((lanes.cost[best] - lanes.cost[k]) / TEMPERATURE)
                total += weight
                nominal += weight * lanes.actions[k]
            nominal /= total
        out[n] = nominal[0]


@kernel
def fit_command(twist: Array, plant: Plant, lanes: RollOuts) -> None:
    """Writes the held command whose steady twist is nearest to a twist (3,), and its state.

    Coordinate descent on the squared difference.
    """
    held = lanes.held
    rate = lanes.rate
    count = len(held)
    for c in range(count):
        held[c] = min(max(0.0, plant.low[c]), plant.high[c])
    for _ in range(PASSES):
        for c in range(count):
            _settle(plant, lanes)
            for i in range(3):
                lanes.reached[i] = rate[i]
            step = 1e-3 * (plant.high[c] - plant.low[c])
            held[c] += step
            _settle(plant, lanes)
            held[c] -= step
            size = 0.0
            gain = 0.0
            for i in range(3):
                slope = (rate[i] - lanes.reached[i]) / step
                size += slope * slope
                gain += slope * (twist[i] - lanes.reached[i])
            value = held[c] + gain / (size + EASE)
            held[c] = min(max(value, plant.low[c]), plant.high[c])
    _settle(plant, lanes)


@kernel
def _settle(plant: Plant, lanes: RollOuts) -> None:
    """Writes the steady state of the held command, the command's effect, and the rates."""
    states, count = plant.settled.shape
    x = lanes.x_single
    for s in range(states):
        x[s] = 0.0
        for c in range(count):
            x[s] += plant.settled[s, c] * lanes.held[c]
    for c in range(count):
        x[states + c] = apply_curve(lanes.held[c], plant.single.curves[c])
    x[states + count] = 1.0
    rates(lanes.rate, x, plant.single)


@kernel
def _roll_out(
    around: maps.Situation, plant: Plant, sampling: Sampling, lanes: RollOuts
) -> int:
    """Rolls out the actions of all lanes; writes their costs and returns the cheapest lane."""
    _begin(plant, lanes)
    limit = maps.find_contact_limit(around)
    for t in range(len(sampling.between) + sampling.stop):
        _give_commands(t, plant, sampling, lanes)
        run(
            lanes.pose,
            lanes.x,
            lanes.dq,
            plant.terms,
            plant.series,
            plant.dt,
            plant.substeps,
        )
        for k in range(len(lanes.cost)):
            if lanes.ended[k] < 0:
                _add_cost(k, t, limit, around, sampling, lanes)
    best = 0
    for k in range(len(lanes.cost)):
        lanes.cost[k] += (1.0 - EARLY) * lanes.way[k]
        if lanes.cost[k] < lanes.cost[best]:
            best = k
    return best


@kernel
def _give_commands(t: int, plant: Plant, sampling: Sampling, lanes: RollOuts) -> None:
    """Writes the effect of each lane's commands in period t, or of those that stop the robot."""
    for c in range(len(plant.low)):
        row = lanes.x[len(plant.settled) + c]
        curve = plant.single.curves[c]
        if t < len(sampling.between):
            middle = 0.5 * (plant.low[c] + plant.high[c])
            half = 0.5 * (plant.high[c] - plant.low[c])
            for k in range(len(row)):
                action = 0.0
                for q in range(len(lanes.nominal)):
                    action += sampling.between[t, q] * lanes.actions[k, q, c]
                row[k] = apply_curve(middle + half * action, curve)
        elif not sampling.holds[c]:
            row[:] = apply_curve(sampling.rest[c], curve)


@kernel
def _begin(plant: Plant, lanes: RollOuts) -> None:
    """Puts all lanes at the start; initialises their costs with the changes between knots."""
    states, count = plant.settled.shape
    x = lanes.start[0]
    y = lanes.start[1]
    heading = lanes.start[2]
    for k in range(len(lanes.cost)):
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
            for q in range(len(lanes.nominal)):
                change += (lanes.actions[k, q, c] - before) ** 2
                before = lanes.actions[k, q, c]
        lanes.cost[k] = CHANGE * change
        lanes.way[k] = 0.0
        lanes.ended[k] = -1


@kernel
def _add_cost(
    k: int,
    t: int,
    limit: float,
    around: maps.Situation,
    sampling: Sampling,
    lanes: RollOuts,
) -> None:
    """Adds the cost of period t in lane k: path length and contacts, or contacts while stopping."""
    periods = len(sampling.between)
    x = lanes.pose[0, k]
    y = lanes.pose[1, k]
    c = lanes.pose[2, k]
    s = lanes.pose[3, k]
    room = maps.find_room(x, y, c, s, around)
    if t >= periods:
        if room < limit or max(abs(x), abs(y)) > sampling.far:
            lanes.cost[k] += HIT * (1.0 - (t - periods) / sampling.stop)
            lanes.ended[k] = t
        return
    way = maps.find_way(x, y, around)
    lanes.way[k] = way
    lanes.cost[k] += EARLY * way / periods
    if room < limit:
        lanes.cost[k] += HIT * (2.0 - t / periods)
        lanes.ended[k] = t
        return
    keep = around.clearance
    near = max(keep.margin + keep.soft - room, 0.0) / keep.soft
    lanes.cost[k] += NEAR * near * near / periods
    if math.hypot(around.goal[0] - x, around.goal[1] - y) < maps.ARRIVED_M:
        lanes.ended[k] = t
        lanes.way[k] = 0.0
    elif t == periods - 1:
        astray = maps.score_heading(x, y, c, s, way, around)
        lanes.cost[k] += ASTRAY * astray * min(way, 1.0)
