"""Braking: how far a robot still moves after it was told to stop, by a simulation of its model.

The model is brought to the steady motion of many commands over their range: forwards, backwards,
sideways, turning, and mixtures. Each motion is then stopped. From all stops follow a reaction time
and a deceleration that bound every one of them from above. A turn that ends apart from the speed,
as that of a robot whose turn rate lags more than its speed, has a bound of its own: `OwnTurn`.
"""

import math
from collections import OrderedDict
from dataclasses import dataclass, fields, replace
from itertools import combinations, product
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linprog

from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.geometry import Array
from nics_drl_bridge.robot.spec import RobotSpec
from nics_drl_bridge.robot.taylor import BEYOND, TaylorModel

# a robot that still moves after this time cannot be shown to stop [s]
LONGEST_STOP_S = 60.0
LONGEST_START_S = 30.0  # given to a held command to reach its steady motion [s]
# a robot that moves no faster than this stands [m/s, of its whole footprint]
CREEP = 0.05
BIAS = 0.05  # share of its greatest speed at which a model may creep at rest, by a bias of its fit
BIAS_STEERED = 0.15  # likewise with steered wheels: a polynomial is less exact there
FIXED = 1e-9  # a state that changes by less in a step has settled, as a share of the greatest
# standard errors of the model's coefficients by which it may respond slower
DEVIATIONS = 2.0
SLOWEST = 0.5  # least factor on the response of a model by its standard errors
# length beside which a stopping distance need not be bounded tightly [m]
SLACK_M = 0.15
STRAIGHT = 0.1  # a motion turns if its turn moves the footprint by more than this share
# a lesser component of a twist counts from this share of the greatest one on
MINOR = 0.1
ALIKE = 0.1  # components whose braking times differ by less stop together
LEVERS = (0.0, 0.25, 0.5, 0.75, 1.0, 1.25, 1.5, 2.0, 3.0, 4.0, 6.0, 9.0)
"""That are tried, in footprint radii."""
ORDERS = (2.0, math.inf, 1.0)  # that are tried, see `Braking.order`
NEGLIGIBLE = 0.02  # by which a lever may bound the stops less tightly than the best one
LEAST_SHARE = 0.05  # least share of its bound by which a component is said to move
MISSED_M = 0.01  # by which two bounds of their own may miss a motion whose speed is a creep [m]
MOST_MOTIONS = 2500
INSTANT = 1e-6  # 1/(2a) [s^2/m] below which the deceleration counts as infinite
LEVELS: dict[int, tuple[float, ...]] = {
    1: (0.5, 1.0),
    2: (0.1, 0.25, 0.5, 0.75, 1.0),
    3: (0.15, 0.4, 0.7, 1.0),
}
"""By the number of commands: shares of each range whose mixtures are stopped."""
ALONE = tuple(k / 20 for k in range(1, 21))  # shares of the range of one command alone
_KEPT: "OrderedDict[Any, Braking]" = OrderedDict()  # least recently used first
MOST_KEPT = 32


@dataclass(frozen=True)
class Drift:
    """How a robot leaves its arc while it brakes, as some of its motion ends before the rest.

    The components of a twist are compared as speeds, a turn as that of the whole footprint. While
    the greatest one is braked, a lesser one moves the robot by a factor more than along the arc.
    """

    least: float = 1.0  # factor
    greatest: float = 1.0  # factor
    # greatest share of the greatest component that a lesser one comes to
    share: float = 1.0

    @property
    def is_none(self) -> bool:
        """True for a robot that stays on its arc."""
        return self.least == self.greatest


NO_DRIFT = Drift()


@dataclass(frozen=True)
class TurnBraking:
    """How a turn ends that brakes apart from the speed.

    The robot turns no further than if it kept its turn rate for the reaction time, and then braked
    it evenly by the deceleration. It may stop sooner, but not by much: the least shares tell.
    """

    reaction_s: float  # until the braking of the turn counts, lags included
    deceleration: (
        float  # of the turn that follows; infinite if the lags are all [rad/s^2]
    )
    least_turn: float = 1.0  # share of this bound by which the robot turns at least
    # share of the bound of its path that the robot moves at least
    least_path: float = 1.0

    def mean_time_s(self, rate: Array) -> Array:
        """Returns the times (...) at full turn rates (...) in which the robot turns as far."""
        return np.asarray(self.reaction_s + np.abs(rate) / (2.0 * self.deceleration))


@dataclass(frozen=True)
class Braking:
    """An upper bound of a robot's stops.

    A robot that moves with a pace p when it is told to stop moves no further than if it kept its
    twist for the reaction time, and then braked evenly by the deceleration.
    """

    reaction_s: (
        float  # from the command to stop until the braking counts, lags included
    )
    deceleration: (
        float  # of the braking that follows; infinite if the lags are all [m/s^2]
    )
    # by which a turn rate adds to the speed in the pace [m]: wheels that turn the robot brake both
    lever_m: float = 0.0
    drift: Drift = NO_DRIFT  # off its arc while it brakes
    # of the norm of ahead and sideways: infinite if the slower of both stops as if it were alone,
    # 1 if the brakes have to take away the sum, 2 otherwise
    order: float = 2.0
    turn: TurnBraking | None = None  # None if the turn brakes as the speed does

    def pace(self, twist: Array) -> Array:
        """Returns the speed that the brakes take away (...) from twists (..., 3) [m/s]."""
        across = np.linalg.norm(twist[..., :2], ord=self.order, axis=-1)
        return np.asarray(across + self.lever_m * np.abs(twist[..., 2]))

    def time_s(self, twist: Array) -> Array:
        """Returns the times to rest (...) from twists (..., 3)."""
        times = self.reaction_s + self.pace(twist) / self.deceleration
        if self.turn is not None:
            turning = (
                self.turn.reaction_s + np.abs(twist[..., 2]) / self.turn.deceleration
            )
            times = np.maximum(times, np.where(twist[..., 2] == 0.0, 0.0, turning))
        return np.asarray(times)

    def mean_time_s(self, twist: Array) -> Array:
        """Returns the times (...) at full twists (..., 3) in which the robot moves as far."""
        times = self.reaction_s + self.pace(twist) / (2.0 * self.deceleration)
        if self.turn is not None:
            turning = self.turn.mean_time_s(twist[..., 2])
            times = np.maximum(times, np.where(twist[..., 2] == 0.0, 0.0, turning))
        return np.asarray(times)

    def distance(self, speed: float) -> float:
        """Returns the length of the path to rest from a speed straight ahead [m]."""
        return speed * (self.reaction_s + speed / (2.0 * self.deceleration))


class Stops(NamedTuple):
    """Simulated stops of K motions."""

    twist: Array  # (K, 3) at the command to stop: vx, vy [m/s], wz [rad/s]
    path: Array  # (K,) length of the path to rest [m]
    travel: Array  # (K, 3) the same of each component: |vx|, |vy| [m], |wz| [rad]
    left: Array  # (K, 3) twist that is left at the end
    holds: NDArray[np.bool_]  # (K,) True where steering angles were held meanwhile


def find_braking(
    robot: RobotSpec,
    model: TaylorModel,
    low: Array | None = None,
    high: Array | None = None,
    ramp: Array | None = None,
) -> Braking:
    """Returns the bound of all stops of a model; the last `MOST_KEPT` results are cached.

    Args:
        robot: whose model it is.
        model: its kinematics, with all that its motors do.
        low: least commands (C,), those of the robot if not given.
        high: greatest commands (C,), likewise.
        ramp: (C,) greatest change of each command per second on the way to rest; infinite for
            those that go to rest at once, as all do if it is not given.

    Raises ConfigError for a model that does not come to rest.
    """
    low = robot.command_low if low is None else low
    high = robot.command_high if high is None else high
    ramp = np.full(len(low), np.inf) if ramp is None else ramp
    key = _key(robot, model, low, high, ramp)
    if key not in _KEPT:
        _KEPT[key] = _bound(robot, model, low, high, ramp)
    _KEPT.move_to_end(key)
    while len(_KEPT) > MOST_KEPT:
        _KEPT.popitem(last=False)
    return _KEPT[key]


def _key(robot: RobotSpec, model: TaylorModel, *arrays: Array) -> tuple[Any, ...]:
    values = (getattr(model, each.name) for each in fields(model))
    content = (v.tobytes() if isinstance(v, np.ndarray) else repr(v) for v in values)
    return (robot.model_dump_json(), *content, *(each.tobytes() for each in arrays))


def _bound(
    robot: RobotSpec, model: TaylorModel, low: Array, high: Array, ramp: Array
) -> Braking:
    commands = motions(low, high)
    slower = derive_slowest_model(model)
    variants = (model,) if slower is None else (model, slower)
    ramped = _together(
        [simulate_stops(robot, each, commands, ramp) for each in variants]
    )
    at_once = np.full_like(ramp, np.inf)
    sudden = ramped
    if np.isfinite(ramp).any():
        sudden = _together(
            [simulate_stops(robot, each, commands, at_once) for each in variants]
        )
    for stops in (ramped, sudden):
        _require_rest(robot, stops)
    radius = robot.footprint_radius
    shared = fit_bound(ramped, radius, robot.footprint is not None)
    shared = replace(shared, drift=_drift(sudden, radius))
    if robot.steers or (shared.lever_m == 0.0 and shared.drift.is_none):
        return shared
    apart = fit_apart(_together([ramped, sudden]), radius)
    if (
        apart is None
        or _slack(apart, ramped, radius) > _slack(shared, ramped, radius) - NEGLIGIBLE
    ):
        return shared
    return apart


def motions(low: Array, high: Array) -> Array:
    """Returns commands (K, C) over the whole range of each, and all mixtures of them."""
    count = len(low)
    shares = LEVELS.get(count, (1.0,))
    levels = (*(-share for share in shares), 0.0, *shares)
    if len(levels) ** count <= MOST_MOTIONS:
        mixed = np.array(list(product(levels, repeat=count)))
    else:
        mixed = _pairs(count)
    alone = [
        sign * share * row
        for row in np.eye(count)
        for share in ALONE
        for sign in (-1, 1)
    ]
    chosen = np.concatenate([mixed, alone])
    return np.clip(np.where(chosen < 0.0, -chosen * low, chosen * high), low, high)


def _pairs(count: int) -> Array:
    """Returns the shares (K, C) of any two of many commands."""
    rows = []
    for i, j in combinations(range(count), 2):
        for first, second in product((-1.0, 1.0), repeat=2):
            row = np.zeros(count)
            row[i] = first
            row[j] = second
            rows.append(row)
    return np.array(rows)


def derive_slowest_model(model: TaylorModel) -> TaylorModel | None:
    """Returns the model as slow as its standard errors allow; None if they tell nothing.

    Each state responds slower by the relative error of the term that draws it to rest; where a
    held command leads is as before.
    """
    if not model.std_errors.size:
        return None
    factors = np.ones(len(model.dofs))
    for s in range(model.state_size):
        own = np.zeros(len(model.variables), np.int64)
        own[s] = 1
        for k in np.flatnonzero((model.powers == own).all(axis=1)):
            size = abs(model.coefficients[3 + s, k])
            error = DEVIATIONS * float(np.nan_to_num(model.std_errors[3 + s, k]))
            if size > 0.0:
                factors[3 + s] = max(1.0 - error / size, SLOWEST)
    if factors.min() > 1.0 - 1e-3:
        return None
    return replace(model, coefficients=model.coefficients * factors[:, None])


def simulate_stops(
    robot: RobotSpec, model: TaylorModel, commands: Array, ramp: Array
) -> Stops:
    """Stops the steady motions of commands (K, C), with steering angles held and released."""
    with np.errstate(
        over="ignore", invalid="ignore"
    ):  # a model that diverges is refused later
        state = _steady(robot, model, commands)
        rest = np.clip(0.0, robot.command_low, robot.command_high)
        angles = np.array([each.unit == "rad" for each in robot.command])
        stops = [
            _stop(robot, model, state, commands, np.where(angles, commands, rest), ramp)
        ]
        if angles.any():
            released = np.broadcast_to(rest, commands.shape)
            stops.append(_stop(robot, model, state, commands, released, ramp))
    return _together(stops)


def _together(stops: list[Stops]) -> Stops:
    return Stops(*(np.concatenate(parts) for parts in zip(*stops, strict=True)))


def _steady(robot: RobotSpec, model: TaylorModel, commands: Array) -> Array:
    """Returns the states (K, S) to which held commands lead, within those that the robot has."""
    # How fast it gets there is of no interest: without limits of rates it is soon.
    quick = replace(model, limits=np.zeros((0, 2)))
    count = model.state_size
    least, most = _range_of_states(robot, model)
    effect = model.apply_curves(commands)
    state = np.zeros((len(commands), count))
    for _ in range(round(LONGEST_START_S / model.dt)):
        rates = quick.rates(np.concatenate([state, effect], axis=-1))
        after = np.clip(state + rates[:, 3:] * model.dt, least, most)
        settled = _is_settled(state, after)
        state = after
        if settled:
            break
    return state


def _range_of_states(robot: RobotSpec, model: TaylorModel) -> tuple[Array, Array]:
    """Returns the least and the greatest state (S,) from which stops are simulated."""
    count = model.state_size
    least = np.array([variable.min for variable in robot.state])
    most = np.array([variable.max for variable in robot.state])
    if robot.takes_cmd_vel:  # the commands bound its speeds
        return np.minimum(least, model.low[:count]), np.maximum(
            most, model.high[:count]
        )
    # A throttle that is held may lead to speeds that the robot never had.
    margin = BEYOND * (model.high[:count] - model.low[:count])
    low = np.maximum(least, model.low[:count] - margin)
    high = np.minimum(most, model.high[:count] + margin)
    return low, np.maximum(low, high)


def _is_settled(before: Array, after: Array) -> bool:
    if not before.size:
        return True
    scale = max(1.0, float(np.abs(after).max()))
    return bool(np.abs(after - before).max() <= FIXED * scale)


def _stop(
    robot: RobotSpec,
    model: TaylorModel,
    state: Array,
    commands: Array,
    rest: Array,
    ramp: Array,
) -> Stops:
    """Simulates stops: each command goes to rest (K, C) by its ramp, after its own delay."""
    dt = model.dt
    count = len(commands)
    delays = model.delays
    gap = rest - commands
    low, high = model.state_box
    idle = _idle_twist(robot, model, rest)
    idle_speed = np.hypot(idle[:, 0], idle[:, 1])
    holds = (rest == commands) & np.array(
        [each.unit == "rad" for each in robot.command]
    )
    path = np.zeros(count)
    travel = np.zeros((count, 3))
    first = np.zeros((count, 3))
    twist = first
    for step in range(round((LONGEST_STOP_S + delays.max(initial=0.0)) / dt)):
        since_told = (step + 0.5) * dt - delays  # in the middle of this step
        changed = np.where(
            since_told > 0.0, ramp * np.maximum(since_told, dt / 2.0), 0.0
        )
        moved = np.sign(gap) * np.minimum(np.abs(gap), changed)
        x = np.concatenate([state, model.apply_curves(commands + moved)], axis=-1)
        rates = model.rates(x)
        twist = rates[:, :3]
        if step == 0:
            held = np.concatenate([state, model.apply_curves(commands)], axis=-1)
            first = model.rates(held)[:, :3]
        path += np.maximum(np.hypot(twist[:, 0], twist[:, 1]) - idle_speed, 0.0) * dt
        travel += np.maximum(np.abs(twist) - np.abs(idle), 0.0) * dt
        after = np.clip(state + rates[:, 3:] * dt, low, high)
        settled = _is_settled(state, after) and bool((moved == gap).all())
        state = after
        if settled:
            break
    return Stops(first, path, travel, twist, (holds & (commands != 0.0)).any(axis=1))


def _idle_twist(robot: RobotSpec, model: TaylorModel, rest: Array) -> Array:
    """Returns the twists (K, 3) by which a model at rest still drifts, by a bias of its fit."""
    state = _steady(robot, model, rest)
    return model.rates(np.concatenate([state, model.apply_curves(rest)], axis=-1))[
        :, :3
    ]


def _require_rest(robot: RobotSpec, stops: Stops) -> None:
    """Raises ConfigError if a motion did not end."""
    left = np.hypot(stops.left[:, 0], stops.left[:, 1])
    left = left + robot.footprint_radius * np.abs(stops.left[:, 2])
    finite = np.isfinite(stops.path) & np.isfinite(left)
    left = np.where(finite, left, np.inf)
    speeds = np.hypot(stops.twist[:, 0], stops.twist[:, 1])
    fastest = float(speeds[finite].max(initial=0.0))
    creep = np.maximum(np.where(stops.holds, BIAS_STEERED, BIAS) * fastest, CREEP)
    if (left <= creep).all():
        return
    worst = float(left.max())
    k = int(np.argmax(left))
    raise ConfigError(
        f"robot {robot.name!r}: by its model it does not stop: {LONGEST_STOP_S:g} s after the "
        f"command to stop from {speeds[k]:.3g} m/s and {abs(stops.twist[k, 2]):.3g} rad/s it moves "
        f"at {worst:.3g} m/s; generate the model from a drive that stops several times, or correct "
        "what brakes it (its terms, `friction`, `drag` or `limits`)."
    )


def fit_bound(stops: Stops, radius: float, turns_count: bool) -> Braking:
    """Returns the tightest reaction time and deceleration that bound all stops.

    Args:
        stops: of motions of all kinds.
        radius: of the circle around the footprint [m].
        turns_count: True if a turn alone sweeps ground, as that of a footprint with corners.
    """
    speed = np.hypot(stops.twist[:, 0], stops.twist[:, 1])
    turn = np.abs(stops.twist[:, 2])
    whole = speed + radius * turn
    distance = stops.path + radius * stops.travel[:, 2]
    counts = whole > CREEP
    if not counts.any():
        return Braking(0.0, math.inf)
    twist = stops.twist[counts]
    speed, turn, whole, distance = (
        each[counts] for each in (speed, turn, whole, distance)
    )
    straight = radius * turn <= STRAIGHT * speed
    if not straight.any():
        straight = np.ones_like(straight)
    worst = _envelope(whole[straight], distance[straight])
    sideways = np.abs(twist[:, :2]).min(axis=1) > MINOR * speed
    orders = ORDERS if sideways.any() else (2.0,)
    tried = [
        Braking(0.0, 1.0, share * radius, order=order)
        for share in LEVERS
        for order in orders
    ]
    found = []
    for each in tried:
        pace = each.pace(twist)
        if turns_count:
            pace = np.maximum(pace, radius * turn)
        found.append(_tightest(whole, pace, distance, straight, worst))
    least = min(slack for slack, _, _ in found)
    chosen = next(i for i, row in enumerate(found) if row[0] <= least + NEGLIGIBLE)
    _, reaction, inverse = found[chosen]
    return _rounded(tried[chosen], reaction, inverse)


def _rounded(bound: Braking, reaction: float, inverse: float) -> Braking:
    """Returns a bound in whole milliseconds and three digits of the deceleration."""
    reaction = math.ceil(1e3 * reaction - 1e-3) / 1e3
    if inverse < INSTANT:
        return replace(bound, reaction_s=reaction, deceleration=math.inf)
    deceleration = 0.5 / inverse
    digit = 10.0 ** (math.floor(math.log10(deceleration)) - 2)
    deceleration = math.floor(deceleration / digit + 1e-3) * digit
    return replace(
        bound, reaction_s=reaction, deceleration=float(f"{deceleration:.3g}")
    )


def _envelope(speed: Array, distance: Array) -> Array:
    """Returns the greatest distance (K,) of any motion that is no faster than each."""
    order = np.argsort(speed, kind="stable")
    greatest = np.empty_like(distance)
    greatest[order] = np.maximum.accumulate(distance[order])
    return greatest


def _tightest(
    whole: Array,
    pace: Array,
    distance: Array,
    straight: NDArray[np.bool_],
    worst: Array,
) -> tuple[float, float, float]:
    """Returns slack, reaction time [s] and half the inverse of the deceleration [s^2/m].

    They bound the distance of every motion, distance <= whole (reaction + pace inverse), and have
    the least slack: the mean of how far they are above the worst of the straight ones, as a share.
    """
    weight = 1.0 / (worst + SLACK_M)
    ahead = whole[straight] * weight
    cost = np.array([ahead.mean(), (ahead * pace[straight]).mean()])
    result = linprog(
        cost, np.stack([-whole, -whole * pace], axis=-1), -distance, bounds=(0.0, None)
    )
    if not result.success:
        return math.inf, float((distance / whole).max()), 0.0
    reaction, inverse = result.x
    slack = float(cost @ result.x - (worst * weight).mean())
    # The solver meets each bound up to its tolerance.
    missing = float((distance / whole - reaction - pace * inverse).max())
    return slack, float(reaction) + max(missing, 0.0), float(inverse)


def fit_apart(stops: Stops, radius: float) -> Braking | None:
    """Returns the tightest bound of the path and of the turn, each by itself; None if none holds.

    Args:
        stops: of motions of all kinds.
        radius: of the circle around the footprint [m].
    """
    rate = np.abs(stops.twist[:, 2])
    speeds = stops.twist[:, :2]
    moves = np.hypot(speeds[:, 0], speeds[:, 1]) > CREEP
    turns = radius * rate > CREEP
    if not (moves.any() and turns.any()):
        return None
    sideways = np.abs(speeds).min(axis=1) > MINOR * np.abs(speeds).max(axis=1)
    found = []
    for order in ORDERS if sideways[moves].any() else (2.0,):
        speed = np.hypot(speeds[:, 0], speeds[:, 1])
        pace = Braking(0.0, 1.0, order=order).pace(stops.twist)
        found.append(
            (order, *_bound_alone(speed[moves], pace[moves], stops.path[moves]))
        )
    order, _, reaction, inverse = min(found, key=lambda row: row[1])
    bound = _rounded(Braking(0.0, 1.0, order=order), reaction, inverse)
    turned = stops.travel[:, 2]
    _, reaction, inverse = _bound_alone(rate[turns], rate[turns], turned[turns])
    turn = _rounded(Braking(0.0, 1.0), reaction, inverse)
    own = TurnBraking(turn.reaction_s, turn.deceleration)
    most_path = _path_bound(bound, stops.twist)
    most_turn = rate * own.mean_time_s(rate)
    missed = np.maximum(stops.path - most_path, radius * (turned - most_turn))
    if float(missed.max()) > MISSED_M:
        return None
    mixed = moves & turns
    if mixed.any():
        least_path = _least_share(stops.path[mixed], most_path[mixed])
        least_turn = _least_share(turned[mixed], most_turn[mixed])
        least_path, least_turn = np.clip(
            [least_path, least_turn], LEAST_SHARE, 1.0
        ).tolist()
        own = replace(own, least_turn=least_turn, least_path=least_path)
    return replace(bound, turn=own)


def _least_share(distance: Array, most: Array) -> float:
    """Returns the least share of its bound that a distance (K,) comes to; 1 if all bounds are 0."""
    shares = np.divide(distance, most, out=np.ones_like(distance), where=most > 0.0)
    return float(shares.min())


def _bound_alone(
    speed: Array, pace: Array, distance: Array
) -> tuple[float, float, float]:
    """Returns what `_tightest` does of a component by itself, which counts at all speeds."""
    return _tightest(speed, pace, distance, np.ones(len(speed), np.bool_), distance)


def _path_bound(bound: Braking, twist: Array) -> Array:
    """Returns the bound of the paths (K,) of twists (K, 3), as far as the speed brakes [m]."""
    speed = np.hypot(twist[:, 0], twist[:, 1])
    return speed * (bound.reaction_s + bound.pace(twist) / (2.0 * bound.deceleration))


def _slack(bound: Braking, stops: Stops, radius: float) -> float:
    """Returns the mean, over all motions, of how far a bound is above them, as a share."""
    rate = np.abs(stops.twist[:, 2])
    turn_time = bound.reaction_s + bound.pace(stops.twist) / (2.0 * bound.deceleration)
    if bound.turn is not None:
        turn_time = bound.turn.mean_time_s(rate)
    assumed = _path_bound(bound, stops.twist) + radius * rate * turn_time
    needed = stops.path + radius * stops.travel[:, 2]
    return float(((assumed - needed) / (needed + SLACK_M)).mean())


def _drift(stops: Stops, radius: float) -> Drift:
    """Returns how lesser components of a twist outlast the greatest, or end before it."""
    scale = np.array([1.0, 1.0, radius])
    sizes = np.abs(stops.twist) * scale
    greatest = sizes.max(axis=1)
    rows = np.arange(len(sizes))
    main = sizes.argmax(axis=1)
    times = stops.travel * scale / np.maximum(sizes, 1e-12)
    ratios = times / np.maximum(times[rows, main], 1e-12)[:, None]
    shares = sizes / np.maximum(greatest, 1e-12)[:, None]
    counts = (shares > MINOR) & (greatest > CREEP)[:, None]
    counts[rows, main] = False
    if not counts.any():
        return NO_DRIFT
    least = float(ratios[counts].min())
    most = float(ratios[counts].max())
    if least > 1.0 - ALIKE and most < 1.0 + ALIKE:
        return NO_DRIFT
    share = float((ratios * shares)[counts].max())
    return Drift(min(least, 1.0), max(most, 1.0), max(share, 1.0))
