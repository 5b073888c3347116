"""Braking: how far a robot moves after the command to stop, by simulation of its model.

The model is brought to the steady motion of many commands over their range: forwards, backwards,
sideways, turning, and mixtures. Each motion is then stopped. The stops yield a reaction time and a
deceleration that bound all of them from above. If a turn outlasts the speed, because the turn rate
lags more, it gets a separate bound, `TurnBraking`.
"""

import math
from collections import OrderedDict
from dataclasses import dataclass, replace
from itertools import combinations, product
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.geometry import Array
from nics_drl_bridge.robot.spec import RobotSpec
from nics_drl_bridge.robot.taylor import STATE_MARGIN, TaylorModel

MAX_STOP_S = 60.0  # a robot that still moves after this time does not stop
MAX_START_S = 30.0  # time in which a held command reaches its steady motion
# A robot is at rest if no point of its footprint moves faster [m/s].
CREEP = 0.05
# A bias of its fit may make a model creep at rest, up to this fraction of its maximum speed.
# Polynomials are less accurate with steered wheels.
BIAS = 0.05
BIAS_STEERED = 0.15
# A state has settled if it changes by less in a step, as a fraction of the largest state.
SETTLED = 1e-9
# Standard errors of the coefficients by which a model may respond more slowly
DEVIATIONS = 2.0
MIN_RESPONSE = 0.5  # lower bound on the factor by which they slow a model's response
# Added to stopping distances before the excess of a bound is divided by them
SLACK_M = 0.15
# A motion is straight if its turn moves the footprint by at most this fraction of its speed.
STRAIGHT = 0.1
MINOR = 0.1  # smaller fractions of the largest component of a twist do not count
ALIKE = 0.1  # components whose braking times differ by less stop together
# Candidates of `Braking.lever_m`, in footprint radii, and of `Braking.order`
LEVERS = (0.0, 0.25, 0.5, 0.75, 1.0, 1.25, 1.5, 2.0, 3.0, 4.0, 6.0, 9.0)
ORDERS = (2.0, math.inf, 1.0)
NEGLIGIBLE = 0.02  # a bound may exceed the tightest one by this slack
MIN_FRACTION = 0.05  # lower bound on `TurnBraking.least_turn` and `least_path`
MAX_MISSED_M = 0.01  # separate bounds may underestimate a creeping motion by this
MAX_MOTIONS = 2500
INSTANT = 1e-6  # 1/(2a) [s^2/m] below which the deceleration counts as infinite
# Fractions of each command's range whose mixtures are stopped, by the number of commands
LEVELS: dict[int, tuple[float, ...]] = {
    1: (0.5, 1.0),
    2: (0.1, 0.25, 0.5, 0.75, 1.0),
    3: (0.15, 0.4, 0.7, 1.0),
}
SINGLE_LEVELS = tuple(k / 20 for k in range(1, 21))  # likewise, for one command alone
CACHE_SIZE = 32
_CACHE: "OrderedDict[Any, Braking]" = OrderedDict()  # least recently used first


@dataclass(frozen=True)
class Drift:
    """Deviation of a braking robot from its arc, if parts of its motion end early.

    The components of a twist are compared as speeds, a turn as the speed of the footprint's edge.
    While the largest component is braked, a smaller one moves the robot by a factor times its
    motion along the arc.
    """

    least: float = 1.0  # minimum factor
    greatest: float = 1.0  # maximum factor
    # maximum ratio of a smaller component's motion to the largest one's, at least 1
    share: float = 1.0

    @property
    def is_none(self) -> bool:
        """True for a robot that stays on its arc."""
        return self.least == self.greatest


NO_DRIFT = Drift()


@dataclass(frozen=True)
class TurnBraking:
    """Braking of a turn that is independent of the speed's braking.

    The robot turns no further than if it kept its turn rate for the reaction time, and then braked
    with the constant deceleration. It may stop sooner, see `least_turn` and `least_path`.
    """

    reaction_s: float  # until the turn starts to brake, lags included
    # how fast the turn slows after that; inf for lags alone [rad/s^2]
    deceleration: float
    least_turn: float = 1.0  # minimum fraction of this bound that the robot turns
    least_path: float = 1.0  # minimum fraction of its path's bound that the robot moves

    def mean_time_s(self, rate: Array) -> Array:
        """Returns times (...) [s] in which constant rates (...) turn as far as the bound."""
        return np.asarray(self.reaction_s + np.abs(rate) / (2.0 * self.deceleration))


@dataclass(frozen=True)
class Braking:
    """An upper bound on the motion of a stopping robot.

    After the command to stop, a robot moves no further than if it kept its twist for the reaction
    time, and then braked its `pace` with the constant deceleration.
    """

    reaction_s: float  # from the command to stop until braking counts, lags included
    # how fast the robot slows after that; inf for lags alone [m/s^2]
    deceleration: float
    # Factor of the turn rate in the pace [m]; wheels that also turn the robot brake both motions
    lever_m: float = 0.0
    drift: Drift = NO_DRIFT  # off its arc while it brakes
    # Order of the norm of forward and sideways speed: infinite if they stop
    # independently, 1 if the brakes have to remove their sum, 2 otherwise
    order: float = 2.0
    turn: TurnBraking | None = None  # None if the turn brakes together with the speed

    def pace(self, twist: Array) -> Array:
        """Returns the speeds (...) that the brakes have to remove from twists (..., 3) [m/s]."""
        speed = np.linalg.norm(twist[..., :2], ord=self.order, axis=-1)
        return np.asarray(speed + self.lever_m * np.abs(twist[..., 2]))

    def time_s(self, twist: Array) -> Array:
        """Returns the times to rest (...) from twists (..., 3) [s]."""
        times = self.reaction_s + self.pace(twist) / self.deceleration
        if self.turn is None:
            return np.asarray(times)
        rate = np.abs(twist[..., 2])
        turn_times = self.turn.reaction_s + rate / self.turn.deceleration
        return np.asarray(np.maximum(times, np.where(rate == 0.0, 0.0, turn_times)))

    def mean_time_s(self, twist: Array) -> Array:
        """Returns times (...) [s] in which constant twists (..., 3) move as far as the bound."""
        times = self.reaction_s + self.pace(twist) / (2.0 * self.deceleration)
        if self.turn is None:
            return np.asarray(times)
        rate = twist[..., 2]
        turn_times = self.turn.mean_time_s(rate)
        return np.asarray(np.maximum(times, np.where(rate == 0.0, 0.0, turn_times)))

    def distance(self, speed: float) -> float:
        """Returns the length of the path to rest from a speed straight ahead [m]."""
        return speed * (self.reaction_s + speed / (2.0 * self.deceleration))


STOPS = np.dtype(
    [
        ("twist", "f8", 3),  # at the command to stop: vx, vy [m/s], wz [rad/s]
        ("path", "f8"),  # length of the path to rest [m]
        ("travel", "f8", 3),  # path of each component: |vx|, |vy| [m], |wz| [rad]
        ("last_twist", "f8", 3),  # at the end of the simulation
        ("holds_angle", "?"),  # True where steering angles were held
    ]
)
Stops = Any
"""Simulated stops: a record array (K,) of the type `STOPS`."""


def find_braking(
    robot: RobotSpec,
    model: TaylorModel,
    low: Array | None = None,
    high: Array | None = None,
    ramp: Array | None = None,
) -> Braking:
    """Returns the bound on all stops of a model; the last `CACHE_SIZE` results are cached.

    Args:
        robot: the robot of the model.
        model: its kinematics, including the effects of its motors.
        low: minimum commands (C,), by default the robot's.
        high: maximum commands (C,), likewise.
        ramp: (C,) maximum change of each command per second on the way to rest; infinite for
            commands that go to rest at once, which is the default for all.

    Raises ConfigError for a model that does not come to rest.
    """
    if low is None:
        low = robot.command_low
    if high is None:
        high = robot.command_high
    if ramp is None:
        ramp = np.full(len(low), np.inf)
    parts: list[Any] = [robot.model_dump_json(), low, high, ramp, *vars(model).values()]
    key = tuple(p.tobytes() if isinstance(p, np.ndarray) else repr(p) for p in parts)
    if key not in _CACHE:
        _CACHE[key] = _bound(robot, model, low, high, ramp)
    _CACHE.move_to_end(key)
    while len(_CACHE) > CACHE_SIZE:
        _CACHE.popitem(last=False)
    return _CACHE[key]


def _bound(
    robot: RobotSpec,
    model: TaylorModel,
    low: Array,
    high: Array,
    ramp: Array,
) -> Braking:
    commands = list_motions(low, high)
    models = [*filter(None, (model, derive_slowest_model(model)))]
    stops = []
    for limit in (ramp, np.full_like(ramp, np.inf)):
        parts = [simulate_stops(robot, each, commands, limit) for each in models]
        stops.append(_join_stops(parts))
        _require_rest(robot, stops[-1])
        if np.isinf(ramp).all():
            break
    ramped = stops[0]
    sudden = stops[-1]
    radius = robot.footprint_radius
    shared = fit_bound(ramped, radius, robot.footprint is not None)
    shared = replace(shared, drift=_find_drift(sudden, radius))
    if robot.steers or (shared.lever_m == 0.0 and shared.drift.is_none):
        return shared
    separate = fit_separate_bounds(_join_stops([ramped, sudden]), radius)
    if separate is None:
        return shared
    max_slack = _measure_slack(shared, ramped, radius) - NEGLIGIBLE
    if _measure_slack(separate, ramped, radius) > max_slack:
        return shared
    return separate


def list_motions(low: Array, high: Array) -> Array:
    """Returns commands (K, C) over the whole range of each, and mixtures of them."""
    count = len(low)
    fractions = LEVELS.get(count, (1.0,))
    levels = (*(-fraction for fraction in fractions), 0.0, *fractions)
    if len(levels) ** count <= MAX_MOTIONS:
        mixed = np.array(list(product(levels, repeat=count)))
    else:  # any two commands at the ends of their ranges
        mixed = np.array(
            [
                first * a + second * b
                for a, b in combinations(np.eye(count), 2)
                for first, second in product((-1.0, 1.0), repeat=2)
            ]
        )
    single = np.concatenate([level * np.eye(count) for level in SINGLE_LEVELS])
    chosen = np.concatenate([mixed, single, -single])
    return np.clip(np.where(chosen < 0.0, -chosen * low, chosen * high), low, high)


def derive_slowest_model(model: TaylorModel) -> TaylorModel | None:
    """Returns the model as slow as its standard errors allow; None if they do not matter.

    Each state responds more slowly by the relative error of the term that draws it to rest. The
    steady motion of a held command stays the same.
    """
    if not model.std_errors.size:
        return None
    factors = np.ones(len(model.dofs))
    for s in range(model.state_size):
        powers = np.zeros(len(model.variables), np.int64)
        powers[s] = 1
        for k in np.flatnonzero((model.powers == powers).all(axis=1)):
            size = abs(model.coefficients[3 + s, k])
            error = DEVIATIONS * float(np.nan_to_num(model.std_errors[3 + s, k]))
            if size > 0.0:
                factors[3 + s] = max(1.0 - error / size, MIN_RESPONSE)
    if factors.min() > 1.0 - 1e-3:
        return None
    return replace(model, coefficients=model.coefficients * factors[:, None])


def simulate_stops(
    robot: RobotSpec,
    model: TaylorModel,
    commands: Array,
    ramp: Array,
) -> Stops:
    """Stops the steady motions of commands (K, C), with steering angles held and released."""
    # Models that diverge are refused later.
    with np.errstate(over="ignore", invalid="ignore"):
        state = _find_steady_states(robot, model, commands)
        rest = np.clip(0.0, robot.command_low, robot.command_high)
        is_angle = _select_angles(robot)
        held = np.where(is_angle, commands, rest)
        stops = [_simulate_stop(robot, model, state, commands, held, ramp)]
        if is_angle.any():
            released = np.broadcast_to(rest, commands.shape)
            stop = _simulate_stop(robot, model, state, commands, released, ramp)
            stops.append(stop)
    return _join_stops(stops)


def _join_stops(stops: list[Stops]) -> Stops:
    return np.concatenate(stops).view(np.recarray)


def _join_inputs(model: TaylorModel, state: Array, command: Array) -> Array:
    """Returns X (K, V) of states (K, S) and commands (K, C) before their curves."""
    return np.concatenate([state, model.apply_curves(command)], axis=-1)


def _find_steady_states(robot: RobotSpec, model: TaylorModel, commands: Array) -> Array:
    """Returns the states (K, S) to which held commands lead, within the robot's own range."""
    # Only the final state matters, which is reached sooner without rate limits.
    unlimited = replace(model, limits=np.zeros((0, 2)))
    low, high = _find_state_range(robot, model)
    state = np.zeros((len(commands), model.state_size))
    for _ in range(round(MAX_START_S / model.dt)):
        rates = unlimited.rates(_join_inputs(model, state, commands))
        after = np.clip(state + rates[:, 3:] * model.dt, low, high)
        settled = _is_settled(state, after)
        state = after
        if settled:
            break
    return state


def _find_state_range(robot: RobotSpec, model: TaylorModel) -> tuple[Array, Array]:
    """Returns the minimum and maximum states (S,) from which stops are simulated."""
    count = model.state_size
    recorded_low = model.low[:count]
    recorded_high = model.high[:count]
    low = np.array([variable.min for variable in robot.state])
    high = np.array([variable.max for variable in robot.state])
    if robot.takes_cmd_vel:  # the commands bound its speeds
        return np.minimum(low, recorded_low), np.maximum(high, recorded_high)
    # A held throttle may lead to speeds that the robot never had.
    margin = STATE_MARGIN * (recorded_high - recorded_low)
    low = np.maximum(low, recorded_low - margin)
    high = np.minimum(high, recorded_high + margin)
    return low, np.maximum(low, high)


def _is_settled(before: Array, after: Array) -> bool:
    if not before.size:
        return True
    scale = max(1.0, float(np.abs(after).max()))
    return bool(np.abs(after - before).max() <= SETTLED * scale)


def _simulate_stop(
    robot: RobotSpec,
    model: TaylorModel,
    state: Array,
    commands: Array,
    rest: Array,
    ramp: Array,
) -> Stops:
    """Simulates stops: each command goes to rest (K, C) by its ramp, after its delay."""
    dt = model.dt
    gap = rest - commands
    # A bias of its fit may make a model creep at rest.
    rest_state = _find_steady_states(robot, model, rest)
    creep = model.rates(_join_inputs(model, rest_state, rest))[:, :3]
    creep_speed = np.hypot(creep[:, 0], creep[:, 1])
    start = model.rates(_join_inputs(model, state, commands))[:, :3]
    is_held = (gap == 0.0) & _select_angles(robot) & (commands != 0.0)
    stops = np.recarray(len(start), STOPS)
    stops.twist = start
    stops.path = 0.0
    stops.travel = 0.0
    stops.holds_angle = is_held.any(axis=1)
    for step in range(round((MAX_STOP_S + model.delays.max(initial=0.0)) / dt)):
        passed = (step + 0.5) * dt - model.delays
        change = np.where(passed > 0.0, ramp * np.maximum(passed, dt / 2.0), 0.0)
        moved = np.sign(gap) * np.minimum(np.abs(gap), change)
        rates = model.rates(_join_inputs(model, state, commands + moved))
        twist = rates[:, :3]
        speed = np.hypot(twist[:, 0], twist[:, 1])
        stops.path += np.maximum(speed - creep_speed, 0.0) * dt
        stops.travel += np.maximum(np.abs(twist) - np.abs(creep), 0.0) * dt
        stops.last_twist = twist
        after = np.clip(state + rates[:, 3:] * dt, *model.state_box)
        settled = _is_settled(state, after) and bool((moved == gap).all())
        state = after
        if settled:
            break
    return stops


def _select_angles(robot: RobotSpec) -> NDArray[np.bool_]:
    """Selects the commands (C,) that are steering angles."""
    return np.array([command.unit == "rad" for command in robot.command])


def _require_rest(robot: RobotSpec, stops: Stops) -> None:
    """Raises ConfigError if a motion did not end."""
    last = stops.last_twist
    left = np.hypot(last[:, 0], last[:, 1])
    left = left + robot.footprint_radius * np.abs(last[:, 2])
    finite = np.isfinite(stops.path) & np.isfinite(left)
    left = np.where(finite, left, np.inf)
    speeds = np.hypot(stops.twist[:, 0], stops.twist[:, 1])
    max_speed = float(speeds[finite].max(initial=0.0))
    bias = np.where(stops.holds_angle, BIAS_STEERED, BIAS)
    if (left <= np.maximum(bias * max_speed, CREEP)).all():
        return
    k = int(np.argmax(left))
    raise ConfigError(
        f"robot {robot.name!r}: its model does not stop: {MAX_STOP_S:g} s after the "
        f"command to stop from {speeds[k]:.3g} m/s and {abs(stops.twist[k, 2]):.3g} "
        f"rad/s it moves at {left[k]:.3g} m/s; generate the model from a drive with "
        "several stops, or correct the parts that brake it (its terms, `friction`, "
        "`drag` or `limits`)."
    )


def fit_bound(stops: Stops, radius: float, turns_count: bool) -> Braking:
    """Returns the tightest reaction time and deceleration that bound all stops.

    Args:
        stops: motions of all kinds.
        radius: of the circle around the footprint [m].
        turns_count: True if a turn alone sweeps new ground, because the footprint has corners.
    """
    is_moving = _measure_speed(stops) + radius * np.abs(stops.twist[:, 2]) > CREEP
    stops = stops[is_moving]
    if not len(stops):
        return Braking(0.0, math.inf)
    # Path of the footprint's fastest point. Only straight motions determine the slack.
    speed = _measure_speed(stops)
    turn_speed = radius * np.abs(stops.twist[:, 2])
    swept = stops.path + radius * stops.travel[:, 2]
    is_straight = turn_speed <= STRAIGHT * speed
    if not is_straight.any():
        is_straight[:] = True
    bounds = []
    for lever, order in product(LEVERS, _list_orders(stops)):
        bound = Braking(0.0, 1.0, lever * radius, order=order)
        pace = bound.pace(stops.twist)
        if turns_count:
            pace = np.maximum(pace, turn_speed)
        fit = _fit_tightest(speed + turn_speed, pace, swept, is_straight)
        bounds.append((bound, fit))
    return _choose_bound(bounds, NEGLIGIBLE)


def _measure_speed(stops: Stops) -> Array:
    """Returns the speeds (K,) at the command to stop [m/s]."""
    return np.asarray(np.hypot(stops.twist[:, 0], stops.twist[:, 1]))


def _list_orders(stops: Stops) -> tuple[float, ...]:
    """Returns the candidates of `Braking.order`; they do not matter if nothing moves diagonally."""
    slower_component = np.abs(stops.twist[:, :2]).min(axis=1)
    if (slower_component > MINOR * _measure_speed(stops)).any():
        return ORDERS
    return (2.0,)


class _Fit(NamedTuple):
    """Tightest bound for one candidate of order and lever."""

    slack: float
    reaction_s: float
    inverse: float  # half the inverse of the deceleration [s^2/m]


def _choose_bound(bounds: list[tuple[Braking, _Fit]], slack: float = 0.0) -> Braking:
    """Returns the first bound that has at most some slack more than the tightest one.

    It is rounded to whole milliseconds and three digits of the deceleration.
    """
    max_slack = min(fit.slack for _, fit in bounds) + slack
    bound, fit = next(pair for pair in bounds if pair[1].slack <= max_slack)
    reaction_s = math.ceil(1e3 * fit.reaction_s - 1e-3) / 1e3
    deceleration = math.inf
    if fit.inverse >= INSTANT:
        deceleration = 0.5 / fit.inverse
        digit = 10.0 ** (math.floor(math.log10(deceleration)) - 2)
        deceleration = math.floor(deceleration / digit + 1e-3) * digit
        deceleration = float(f"{deceleration:.3g}")
    return replace(bound, reaction_s=reaction_s, deceleration=deceleration)


def _compute_envelope(speed: Array, distance: Array) -> Array:
    """Returns, for each motion, the maximum distance (K,) of all motions that are no faster."""
    order = np.argsort(speed, kind="stable")
    envelope = np.empty_like(distance)
    envelope[order] = np.maximum.accumulate(distance[order])
    return envelope


def _fit_tightest(
    speed: Array,
    pace: Array,
    distance: Array,
    counts: NDArray[np.bool_] | None = None,
) -> _Fit:
    """Fits distance <= speed * (reaction + pace * inverse) for all stops, with minimum slack.

    The slack is the mean excess of the bound, as a fraction of the distances. With `counts` (K,),
    only those stops count, each with the longest distance of any that is no faster.
    """
    worst = distance
    counted_speed = speed
    counted_pace = pace
    if counts is not None:
        counted_speed = speed[counts]
        counted_pace = pace[counts]
        worst = _compute_envelope(counted_speed, distance[counts])
    weight = 1.0 / (worst + SLACK_M)
    ahead = counted_speed * weight
    cost = ahead.mean()
    cost_of_pace = (ahead * counted_pace).mean()
    times = distance / speed
    if not np.isfinite(times).all():
        return _Fit(slack=math.inf, reaction_s=float(times.max()), inverse=0.0)
    reaction, inverse = find_lowest_line(pace, times, cost_of_pace / cost)
    slack = cost * reaction + cost_of_pace * inverse - (worst * weight).mean()
    # A rounding error must not lower the bound.
    reaction += max(float((times - reaction - pace * inverse).max()), 0.0)
    return _Fit(float(slack), reaction, inverse)


def find_lowest_line(x: Array, y: Array, at: float) -> tuple[float, float]:
    """Returns the line above all points (x, y), each (K,), that is lowest at an x >= 0.

    Returns its intercept and its slope, of which neither is negative. No x is negative.
    """
    x = np.append(x, 0.0)  # above the origin, the intercept is not negative
    y = np.append(y, 0.0)
    # The search begins with a level line through the highest point. While the line touches a point
    # right of `at`, it is lower at `at` if it is tilted about that point until it touches the next.
    touched = int(np.argmax(y))
    slope = 0.0
    while x[touched] > at:
        left = np.flatnonzero(x < x[touched])
        slopes = (y[touched] - y[left]) / (x[touched] - x[left])
        nearest = int(np.argmin(slopes))
        slope = float(slopes[nearest])
        touched = int(left[nearest])
    return float(y[touched] - slope * x[touched]), slope


def fit_separate_bounds(stops: Stops, radius: float) -> Braking | None:
    """Returns the tightest separate bounds on path and turn; None if there are no such bounds.

    Args:
        stops: motions of all kinds.
        radius: of the circle around the footprint [m].
    """
    rate = np.abs(stops.twist[:, 2])
    moves = _measure_speed(stops) > CREEP
    turns = radius * rate > CREEP
    if not (moves.any() and turns.any()):
        return None
    moving = stops[moves]
    bounds = []
    for order in _list_orders(moving):
        bound = Braking(0.0, 1.0, order=order)
        pace = bound.pace(moving.twist)
        bounds.append((bound, _fit_tightest(_measure_speed(moving), pace, moving.path)))
    bound = _choose_bound(bounds)
    turning = rate[turns]
    fit = _fit_tightest(turning, turning, stops.travel[turns, 2])
    of_turn = _choose_bound([(Braking(0.0, 1.0), fit)])
    turn = TurnBraking(of_turn.reaction_s, of_turn.deceleration)
    turned = stops.travel[:, 2]
    max_path = _bound_path(bound, stops.twist)
    max_turn = rate * turn.mean_time_s(rate)
    missed = np.maximum(stops.path - max_path, radius * (turned - max_turn))
    if float(missed.max()) > MAX_MISSED_M:
        return None
    mixed = moves & turns
    if mixed.any():
        turn = replace(
            turn,
            least_turn=_find_min_fraction(turned[mixed], max_turn[mixed]),
            least_path=_find_min_fraction(stops.path[mixed], max_path[mixed]),
        )
    return replace(bound, turn=turn)


def _find_min_fraction(distance: Array, bound: Array) -> float:
    """Returns the minimum ratio of distances (K,) to their bounds (K,).

    It is at least `MIN_FRACTION`, and 1 if all bounds are 0.
    """
    fractions = np.divide(
        distance, bound, out=np.ones_like(distance), where=bound > 0.0
    )
    return float(np.clip(fractions.min(), MIN_FRACTION, 1.0))


def _bound_path(bound: Braking, twist: Array) -> Array:
    """Returns the bounds (K,) on the paths of twists (K, 3) while the speed brakes [m]."""
    speed = np.hypot(twist[:, 0], twist[:, 1])
    return speed * (bound.reaction_s + bound.pace(twist) / (2.0 * bound.deceleration))


def _measure_slack(bound: Braking, stops: Stops, radius: float) -> float:
    """Returns the mean excess of a bound over all motions, as a fraction."""
    rate = np.abs(stops.twist[:, 2])
    if bound.turn is None:
        pace = bound.pace(stops.twist)
        turn_time = bound.reaction_s + pace / (2.0 * bound.deceleration)
    else:
        turn_time = bound.turn.mean_time_s(rate)
    assumed = _bound_path(bound, stops.twist) + radius * rate * turn_time
    needed = stops.path + radius * stops.travel[:, 2]
    return float(((assumed - needed) / (needed + SLACK_M)).mean())


def _find_drift(stops: Stops, radius: float) -> Drift:
    """Returns how much longer or shorter smaller components of a twist last than the largest."""
    scale = np.array([1.0, 1.0, radius])
    sizes = np.abs(stops.twist) * scale
    largest = sizes.max(axis=1)
    rows = np.arange(len(sizes))
    main = sizes.argmax(axis=1)
    times = stops.travel * scale / np.maximum(sizes, 1e-12)
    ratios = times / np.maximum(times[rows, main], 1e-12)[:, None]
    fractions = sizes / np.maximum(largest, 1e-12)[:, None]
    counts = (fractions > MINOR) & (largest > CREEP)[:, None]
    counts[rows, main] = False
    if not counts.any():
        return NO_DRIFT
    low = float(ratios[counts].min())
    high = float(ratios[counts].max())
    if low > 1.0 - ALIKE and high < 1.0 + ALIKE:
        return NO_DRIFT
    fraction = float((ratios * fractions)[counts].max())
    return Drift(least=min(low, 1.0), greatest=max(high, 1.0), share=max(fraction, 1.0))
