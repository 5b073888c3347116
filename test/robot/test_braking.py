"""The bound on a robot's stops, beside stops that are simulated apart from it."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from skid_rover import kinematics as skid_steer_kinematics
from skid_rover import rover

from nics_drl_bridge.config import parse_yaml
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.generator import builtin_model
from nics_drl_bridge.identify.identify import identify
from nics_drl_bridge.recording import textbook
from nics_drl_bridge.robot.braking import (
    Braking,
    Drift,
    TurnBraking,
    derive_slowest_model,
    find_braking,
    list_motions,
)
from nics_drl_bridge.robot.curve import InputCurve
from nics_drl_bridge.robot.spec import build_robot
from nics_drl_bridge.robot.taylor import TaylorModel, list_exponents

WHEELED = ("differential", "jackal", "mecanum")
SHARES = (1.0, 0.83, 0.707, 0.55, 0.31, 0.17)
OWN = parse_yaml(
    """
    lorry:
      kind: tricycle
      footprint: [[0.9, 0.3], [0.9, -0.3], [-0.3, -0.4], [-0.3, 0.4]]
      parameters: {wheelbase: 0.8, speed_lag: 0.4}
      command:
        - {name: speed_command, min: -0.6, max: 1.5}
        - {name: steering_command, min: -0.7, max: 0.7}
    wagon: {kind: mecanum, footprint_radius: 0.4, parameters: {wheel_lag: 0.3}}
    husky:
      kind: skid_steer
      footprint: [[0.5, 0.34], [-0.5, 0.34], [-0.5, -0.34], [0.5, -0.34]]
      parameters: {wheel_lag: 0.25}
    """,
    "own robots",
)


@cache
def known(name):
    """A robot that is shipped, or that a YAML file alone describes, and its model."""
    if name not in OWN:
        model = builtin_model(name)
        return model.robot, model.kinematics
    robot = build_robot({"name": name, **OWN[name]})
    drive = textbook.record(robot, np.random.default_rng(0))
    return robot, identify(drive, robot).model


def limited(model, rate):
    """The model, whose states change by at most a rate per second."""
    return replace(model, limits=np.tile([-rate, rate], (model.state_size, 1)))


def run_stops(model, commands, starting_s=6.0, stopping_s=40.0):
    """Stops robots (N,); returns speeds, turn rates, paths [m] and turns to rest [rad]."""
    rest = np.zeros_like(commands)
    idle = moved_to(model, rest, starting_s)[2]
    pose, state, twist = moved_to(model, commands, starting_s)
    paths = np.zeros(len(commands))
    turns = np.zeros(len(commands))
    for _ in range(round(stopping_s / model.dt)):
        before, (pose, state) = pose, model.step(pose, state, rest)
        step = np.hypot(*(pose - before)[:, :2].T)
        moves = step / model.dt > np.abs(idle[:, 0]) + 1e-4
        angle = np.abs(
            np.remainder(pose[:, 2] - before[:, 2] + np.pi, 2.0 * np.pi) - np.pi
        )
        turns_on = angle / model.dt > np.abs(idle[:, 1]) + 1e-4
        paths += np.maximum(step - np.abs(idle[:, 0]) * model.dt, 0.0)
        turns += np.maximum(angle - np.abs(idle[:, 1]) * model.dt, 0.0)
        if not (moves | turns_on).any():
            break
    return twist[:, 0], np.abs(twist[:, 1]), paths, turns


def moved_to(model, commands, time_s):
    """Returns poses, states and (speed, turn rate) of robots to which held commands led."""
    pose = np.zeros((len(commands), 3))
    state = np.zeros((len(commands), model.state_size))
    quick = replace(model, limits=np.zeros((0, 2)))
    for _ in range(round(time_s / model.dt)):
        before, (pose, state) = pose, quick.step(pose, state, commands)
    turn = np.remainder(pose[:, 2] - before[:, 2] + np.pi, 2.0 * np.pi) - np.pi
    speed = np.hypot(*(pose - before)[:, :2].T)
    return pose, state, np.stack([speed, turn], axis=-1) / model.dt


def straight_ways(robot):
    """Commands (C,) of full speed along each axis, in both directions, and diagonally."""
    speeds = [c.unit == "m/s" or c.unit == "1" for c in robot.command]
    size = len(robot.command)
    for signs in np.ndindex(*(3,) * sum(speeds)):
        command = np.zeros(size)
        ends = [(robot.command_low[i], 0.0, robot.command_high[i]) for i in range(size)]
        moved = [i for i in range(size) if speeds[i]]
        for i, sign in zip(moved, signs, strict=True):
            command[i] = ends[i][sign]
        if command.any():
            yield command


def assert_bounds(robot, model, factor=1.3, late_s=0.0):
    """The bound is above the stops on straight ways, and not far above the worst of a speed."""
    braking = find_braking(robot, model)
    ways = np.array(list(straight_ways(robot)))
    commands = np.concatenate([share * ways for share in SHARES])
    speeds, _, paths, _ = run_stops(model, commands)
    paths = paths + late_s * speeds
    assert speeds.max() > 0.2
    for command, speed, path in zip(commands, speeds, paths, strict=True):
        if speed < 0.06:
            continue
        worst = paths[speeds < 1.1 * speed].max()
        twist = speed * np.append(direction_of(robot, command), 0.0)
        assumed = speed * (
            braking.reaction_s + braking.pace(twist) / (2.0 * braking.deceleration)
        )
        assert assumed >= 0.998 * path - 2e-3, (speed, path, assumed)
        assert assumed <= factor * worst + 0.05, (speed, worst, assumed)


def direction_of(robot, command):
    """Unit vector (2,) in which a robot drives straight."""
    if not robot.takes_cmd_vel:
        return np.array([1.0, 0.0])
    along = robot.to_fields(command)[:2]
    return along / np.hypot(*along)


@pytest.mark.parametrize(
    ("name", "rate"),
    [
        ("ackermann", None),
        ("mecanum", None),
        ("differential", 4.0),  # wheels that brake weakly [rad/s^2]
        ("jackal", 6.1),
        ("lorry", 3.0),
        ("wagon", 3.0),
        ("husky", None),
    ],
)
@pytest.mark.slow
def test_the_bound_is_above_the_stops_of_a_robot_and_not_far_above(name, rate):
    robot, model = known(name)
    assert_bounds(robot, model if rate is None else limited(model, rate))


def test_a_jackal_whose_wheels_brake_by_0_2_needs_two_and_a_half_metres_from_1_m_s():
    robot, model = known("jackal")
    weak = limited(model, 0.2 / 0.098)
    assert 2.4 < find_braking(robot, weak).distance(1.0) < 2.7
    assert find_braking(robot, model).distance(1.0) == pytest.approx(0.2, abs=0.01)


def throttle_car(pull=2.0, decay=0.5, bias=0.0, **changes):
    """A car that is driven by a throttle, without a brake: it rolls until drag has slowed it."""
    robot = build_robot(
        parse_yaml(
            """
            {name: throttle, kind: free, footprint_radius: 0.3,
             command: [{name: throttle, unit: "1", min: -1.0, max: 1.0}],
             state: [{name: speed, unit: m/s, min: -10.0, max: 10.0, twist: vx}]}
            """,
            "car",
        )
    )
    powers = list_exponents(2, 1)
    coefficients = np.zeros((4, 3))
    speed = int(np.flatnonzero((powers == [1, 0]).all(axis=1))[0])
    throttle = int(np.flatnonzero((powers == [0, 1]).all(axis=1))[0])
    coefficients[0, speed] = 1.0
    coefficients[3, 0] = bias
    coefficients[3, speed] = -decay
    coefficients[3, throttle] = pull
    model = TaylorModel(
        ("speed", "throttle"),
        robot.dof_names,
        robot.dof_units,
        powers,
        coefficients,
        0.02,
        np.array([-3.0, -1.0]),
        np.array([3.0, 1.0]),
        **changes,
    )
    return robot, model


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"friction": np.array([0.4])},
        {"drag": np.array([0.3])},
        {"limits": np.array([[-0.5, 2.0]])},
        {"inputs": (InputCurve(command="throttle", dead=0.2, most=0.7, delay=0.3),)},
    ],
)
def test_so_is_that_of_a_car_with_a_throttle(changes):
    robot, model = throttle_car(**changes)
    late = float(model.delays.max(initial=0.0))
    # Friction and drag beside a lag make a bound of two numbers less tight.
    assert_bounds(
        robot,
        model,
        factor=1.6 if model.drag.any() or model.friction.any() else 1.3,
        late_s=late,
    )


def test_a_turn_that_ends_later_is_counted():
    """Wheels that brake weakly stop one after the other: the whole footprint is bounded."""
    robot, model = known("jackal")
    weak = limited(model, 0.2 / 0.098)
    braking = find_braking(robot, weak)
    radius = robot.footprint_radius
    ahead = [2.0, 1.0, 0.4, -0.5, 0.0, 1.5]
    turns = [2.5, -1.5, 2.0, 2.5, 2.5, 0.4]
    stops = run_stops(weak, np.stack([ahead, turns], axis=1))
    for speed, turn, path, turned in zip(*stops, strict=True):
        pace = max(braking.pace(np.array([speed, 0.0, turn])), radius * turn)
        duration = braking.reaction_s + pace / (2.0 * braking.deceleration)
        assert (speed + radius * turn) * duration >= path + radius * turned - 5e-3
        if (
            radius * turn < speed
        ):  # it leaves the arc of its twist by no more than the drift tells
            assert turned / turn <= 1.02 * braking.drift.greatest * path / speed


def test_a_turn_that_ends_apart_from_the_speed_makes_no_mixture_look_slow():
    """Each motion of the range is bounded, by little more than what its slower response needs."""
    robot = rover()
    plant = skid_steer_kinematics()
    slower = derive_slowest_model(plant)
    braking = find_braking(robot, plant)
    assert braking.turn is not None
    shares = [(ahead, turn) for ahead in SHARES for turn in (*SHARES, 0.0)]
    shares += [(0.0, turn) for turn in SHARES]
    commands = np.array(shares) * [0.8, 1.2]
    for model in (plant, slower):
        for speed, rate, path, turned in zip(*run_stops(model, commands), strict=True):
            straight = np.array([speed, 0.0, 0.0])
            assumed = speed * float(braking.mean_time_s(straight))
            turns = rate * float(braking.turn.mean_time_s(rate))
            assert assumed >= 0.998 * path - 2e-3
            assert turns >= 0.998 * turned - 2e-3
            if model is slower:
                assert assumed <= 1.3 * path + 0.05
                assert turns <= 1.3 * turned + 0.05


def test_a_robot_that_stays_on_its_arc_has_no_drift():
    for name in WHEELED:
        braking = find_braking(*known(name))
        assert braking.drift == Drift()
        assert braking.lever_m == 0.0
        assert braking.turn is None


def test_a_ramp_of_the_commands_is_added():
    robot, model = known("differential")
    braking = find_braking(robot, model, ramp=np.array([0.5, np.inf]))
    assert braking.deceleration == pytest.approx(0.5, rel=0.01)
    assert braking.reaction_s == pytest.approx(0.1, abs=2e-3)


def test_delays_of_commands_are_added():
    robot, model = known("differential")
    late = replace(model, inputs=(InputCurve(command="forward_command", delay=0.25),))
    sooner = find_braking(robot, model).reaction_s
    assert find_braking(robot, late).reaction_s == pytest.approx(
        sooner + 0.25, abs=0.02
    )


def test_standard_errors_make_the_response_slower():
    robot, model = throttle_car()
    decay = model.coefficients == -0.5
    unsure = replace(model, std_errors=np.where(decay, 0.05, 0.0))
    slower = derive_slowest_model(unsure)
    assert slower.coefficients[decay] == pytest.approx(-0.4)
    assert find_braking(robot, unsure).distance(2.0) == pytest.approx(5.0, rel=0.05)
    assert find_braking(robot, model).distance(2.0) == pytest.approx(4.0, rel=0.05)


@pytest.mark.parametrize("changes", [{"decay": 0.0}, {"decay": -0.2}, {"bias": 0.4}])
def test_a_model_that_does_not_stop_is_refused_in_a_sentence_that_says_what_to_give(
    changes,
):
    robot, model = throttle_car(**changes)
    with pytest.raises(
        ConfigError, match=r"'throttle'.* does not stop.* generate .* from a drive"
    ):
        find_braking(robot, model)


def test_a_bound_is_computed_once_for_each_model(monkeypatch):
    robot, model = throttle_car()
    first = find_braking(robot, model)
    monkeypatch.setattr("nics_drl_bridge.robot.braking._bound", lambda *_: 1 / 0)
    assert find_braking(robot, replace(model)) is first
    with pytest.raises(ZeroDivisionError):
        find_braking(robot, limited(model, 0.77))


def test_many_commands_are_tried_alone_and_in_pairs():
    low = np.full(12, -1.0)
    high = np.full(12, 2.0)
    tried = list_motions(low, high)
    assert len(tried) < 2000
    assert {tuple(row) for row in 2.0 * np.eye(12)} <= {tuple(row) for row in tried}
    assert (np.count_nonzero(tried, axis=1) <= 2).all()


def test_time_and_distance_are_those_of_even_braking_after_the_reaction():
    braking = Braking(0.2, 0.5, lever_m=0.1)
    assert braking.time_s(np.array([1.0, 0.0, 0.0])) == pytest.approx(2.2)
    assert braking.distance(1.0) == pytest.approx(1.2)
    assert braking.time_s(np.array([-1.0, 0.0, -5.0])) == pytest.approx(3.2)
    diagonal = np.array([0.5, -0.25, 0.0])
    assert replace(braking, order=1.0).pace(diagonal) == pytest.approx(0.75)
    turn = TurnBraking(reaction_s=0.4, deceleration=2.0)
    braking = Braking(0.2, 0.5, turn=turn)
    straight, mixed = np.array([1.0, 0.0, 0.0]), np.array([0.1, 0.0, 2.0])
    assert braking.time_s(straight) == pytest.approx(2.2)
    assert braking.time_s(mixed) == pytest.approx(1.4)  # of its slower part
    assert braking.mean_time_s(mixed) == pytest.approx(0.9)
