"""A robot on an infinite floor, in each engine."""

from dataclasses import replace

import numpy as np
import pytest
from robots import DIRECT

from nics_drl_bridge import geometry
from nics_drl_bridge.errors import BackendError, ConfigError
from nics_drl_bridge.extras.physics.machines import Physics, design_machine, fit_roller
from nics_drl_bridge.extras.physics.simulator import PhysicsRobot, record
from nics_drl_bridge.recording.recording import check
from nics_drl_bridge.robot.kinds import textbook
from nics_drl_bridge.robot.spec import RobotSpec, load_robot

from .driving import drive_steadily
from .engines import Engine, list_rows

NAMES = ("ackermann", "differential", "mecanum", "jackal")


@pytest.fixture(scope="module", params=list_rows())
def engine(request) -> Engine:
    return request.param


@pytest.fixture(scope="module")
def robots(engine) -> dict[str, PhysicsRobot]:
    return {name: engine.robot(load_robot(name)) for name in NAMES}


@pytest.mark.parametrize("name", NAMES)
def test_it_stands_still_without_a_command(engine, robots, name):
    robot = robots[name]
    start = robot.reset([1.0, -2.0, 3.0])
    assert start.time == 0.0
    assert np.allclose(start.pose, [1.0, -2.0, 3.0])
    rest = robot.step(np.zeros(len(robot.spec.command)), 1.0)
    assert np.allclose(rest.pose, start.pose, atol=engine.rest_error)
    assert rest.time == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("name", "settle_s"),
    [("ackermann", 1.0), ("differential", 1.0), ("mecanum", 1.0), ("jackal", 2.5)],
)
def test_it_drives_straight_ahead(robots, name, settle_s):
    robot = robots[name]
    command = np.zeros(len(robot.spec.command))
    command[0] = 0.4
    twist, state, reading = drive_steadily(robot, command, settle_s)
    assert twist[0] == pytest.approx(0.4, rel=0.02)
    assert textbook(robot.spec).twist(state) == pytest.approx(twist, abs=0.01)
    assert abs(reading.pose[1]) < 0.01
    assert abs(reading.pose[2]) < 0.01


@pytest.mark.parametrize(
    ("name", "command"),
    [
        ("ackermann", [0.4, 0.3]),
        ("differential", [0.4, 0.8]),
        ("mecanum", [0.3, 0.0, 1.0]),
    ],
)
def test_it_turns_as_the_textbook_and_its_encoders_say(robots, name, command):
    robot = robots[name]
    book = textbook(robot.spec)
    expected = book.twist(book.target(np.array(command)))
    left, state, _ = drive_steadily(robot, command)
    right, *_ = drive_steadily(robot, [*command[:-1], -command[-1]])
    assert left == pytest.approx(expected, rel=0.03, abs=0.02)
    assert book.twist(state) == pytest.approx(left, rel=0.03, abs=0.02)
    assert right[2] == pytest.approx(-left[2], rel=0.02)


@pytest.mark.parametrize("command", [[0.0, 2.0], [1.0, 1.0]])
def test_a_jackal_skids_in_turns_and_so_about_reaches_the_commanded_rate(
    engine, robots, command
):
    """The spec turns the wheels as if they stood 1.5 times as far apart."""
    robot = robots["jackal"]
    twist, state, _ = drive_steadily(robot, command, 2.0)
    assert twist[2] == pytest.approx(command[1], rel=engine.skid_error)
    parameters = robot.spec.parameters
    track = (state[1] - state[0]) * parameters["wheel_radius"] / twist[2]
    assert track == pytest.approx(parameters["effective_track"], rel=engine.skid_error)


def test_a_mecanum_robot_moves_sideways_to_the_left(robots):
    twist, _, reading = drive_steadily(robots["mecanum"], [0.0, 0.5, 0.0])
    assert twist[1] == pytest.approx(0.5, rel=0.05)
    assert abs(twist[0]) < 0.02
    assert abs(reading.pose[2]) < 0.05


@pytest.mark.parametrize("name", ["ackermann", "differential"])
def test_a_robot_that_turns_round_knows_where_it_is_by_its_encoders(
    engine, robots, name
):
    """Wheels keep up with the floor while they accelerate, and do not scrub when they steer."""
    robot = robots[name]
    pose = np.zeros(3)
    low = robot.spec.command_low
    high = robot.spec.command_high
    reading = robot.reset(pose)
    for step in range(200):
        before = reading
        reading = robot.step(high * [1.0, 0.0] if step > 100 else low, 0.01)
        twist = textbook(robot.spec).twist(0.5 * (before.state + reading.state))
        pose = geometry.compose(pose, geometry.exp(0.01 * twist))
    error = geometry.between(reading.pose, pose)
    assert np.hypot(*error[:2]) < engine.encoder_error
    assert abs(error[2]) < engine.encoder_error


def test_commands_saturate_at_the_limits_of_the_spec(robots):
    robot = robots["differential"]
    robot.reset(np.zeros(3))
    at_limit = robot.step(robot.spec.command_high, 0.2)
    robot.reset(np.zeros(3))
    beyond = robot.step(10.0 * robot.spec.command_high, 0.2)
    assert np.array_equal(at_limit.pose, beyond.pose)


def test_on_slippery_ground_a_car_slides_out_of_its_turn(engine, robots):
    """The contact is real: the wheels hold a turn by friction alone."""
    car = robots["ackermann"]
    ice = engine.robot(car.spec, replace(engine.physics, friction=0.1))
    on_dry, *_ = drive_steadily(car, [1.0, 0.4])
    on_ice, *_ = drive_steadily(ice, [1.0, 0.4])
    assert abs(on_dry[1]) < 0.02 * on_dry[0]
    assert abs(on_ice[1]) > 0.1 * abs(on_ice[0])


def test_a_robot_that_falls_over_says_so(engine):
    data = load_robot("ackermann").model_dump()
    data["command"][0]["max"] = 8.0
    fast = RobotSpec.model_validate(data)
    physics = replace(engine.physics, friction=5.0, acceleration=20.0)
    robot = engine.robot(fast, physics)
    robot.step([8.0, 0.0], 1.0)
    with pytest.raises(BackendError, match="fallen over"):
        robot.step([8.0, 0.5], 0.5)


def test_a_drive_is_a_recording_of_this_robot(engine, robots):
    robot = robots["ackermann"]
    recording = record(robot, np.random.default_rng(0), duration=2.0)
    assert check(recording, robot.spec) is recording
    assert recording.source == f"{engine.name} ackermann"
    assert recording.variables == robot.spec.variable_names
    streams = (recording.pose, recording.state, recording.command)
    assert [len(stream.t) for stream in streams] == [200] * 3


def test_rollers_make_a_wheel_round():
    radius = 0.05
    count = 12
    a, b = fit_roller(radius, count)
    q = np.linspace(0.0, np.pi / count, 50)
    reach = (radius - a) * np.cos(q) + np.sqrt(
        a**2 + (b**2 - a**2) * np.sin(q) ** 2 / 2.0
    )
    assert reach == pytest.approx(radius, rel=2e-3)
    assert reach[[0, -1]] == pytest.approx(radius)


def test_what_makes_no_machine_is_refused_by_its_name():
    data = load_robot("ackermann").model_dump()
    del data["parameters"]["wheelbase"]
    for robot, reason in (
        (RobotSpec.model_validate(data), "wheelbase"),
        (DIRECT, "no textbook kinematics"),
    ):
        with pytest.raises(ConfigError, match=reason):
            design_machine(robot, Physics(), "MuJoCo")
