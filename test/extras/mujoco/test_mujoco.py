import sys
from dataclasses import replace

import numpy as np
import pytest

from nics_drl_bridge import geometry
from nics_drl_bridge.errors import BackendError, ConfigError
from nics_drl_bridge.extras.mujoco.machines import build_machine, load_mujoco
from nics_drl_bridge.extras.mujoco.simulator import MujocoRobot
from nics_drl_bridge.extras.physics.machines import Physics, fit_roller
from nics_drl_bridge.extras.physics.simulator import Reading, record
from nics_drl_bridge.recording.recording import check
from nics_drl_bridge.robot.kinds import textbook
from nics_drl_bridge.robot.spec import RobotSpec, load_robot

NAMES = ("ackermann", "differential", "mecanum", "jackal")
STEADY_S = 1.5

try:
    load_mujoco()
    MISSING = False
except ConfigError:
    MISSING = True
needs_mujoco = pytest.mark.skipif(MISSING, reason="needs MuJoCo: the extra `mujoco`")


@pytest.fixture(scope="module")
def robots() -> dict[str, MujocoRobot]:
    return {name: MujocoRobot(load_robot(name)) for name in NAMES}


def steady(
    robot: MujocoRobot, command, settle_s: float = STEADY_S
) -> tuple[np.ndarray, np.ndarray, Reading]:
    """Mean twist (3,) and state of half a second under a command, and the last reading."""
    robot.reset(np.zeros(3))
    robot.step(command, settle_s)
    readings = [robot.step(command, 0.01) for _ in range(50)]
    twist, state = (
        np.mean([getattr(r, name) for r in readings], axis=0)
        for name in ("twist", "state")
    )
    return twist, state, readings[-1]


@needs_mujoco
@pytest.mark.parametrize("name", NAMES)
def test_it_stands_still_without_a_command(robots, name):
    reading = robots[name].reset([1.0, -2.0, 3.0])
    assert reading.time == 0.0
    assert np.allclose(reading.pose, [1.0, -2.0, 3.0])
    rest = robots[name].step(np.zeros(len(robots[name].spec.command)), 1.0)
    assert np.allclose(rest.pose, reading.pose, atol=2e-3)
    assert rest.time == pytest.approx(1.0)


@needs_mujoco
@pytest.mark.parametrize(
    ("name", "command"),
    [
        ("ackermann", [0.4, 0.3]),
        ("differential", [0.4, 0.8]),
        ("mecanum", [0.3, 0.0, 1.0]),
        ("jackal", [0.4, 0.8]),
    ],
)
def test_it_turns_with_the_curvature_of_the_textbook(robots, name, command):
    robot = robots[name]
    book = textbook(robot.spec)
    expected = book.twist(book.target(np.array(command)))
    left, *_ = steady(robot, command)
    right, *_ = steady(robot, [*command[:-1], -command[-1]])
    # The motors give way under load, as those of a real robot do.
    assert left[2] / left[0] == pytest.approx(expected[2] / expected[0], rel=0.15)
    assert right[2] == pytest.approx(-left[2], rel=0.02)


@needs_mujoco
def test_a_mecanum_robot_moves_sideways_to_the_left(robots):
    twist, _, reading = steady(robots["mecanum"], [0.0, 0.5, 0.0])
    assert twist[1] == pytest.approx(0.5, rel=0.1)
    assert abs(twist[0]) < 0.02
    assert abs(reading.pose[2]) < 0.05


@needs_mujoco
@pytest.mark.parametrize("command", [[0.0, 2.0], [1.0, 1.0]])
def test_a_jackal_skids_in_turns_and_so_about_reaches_the_commanded_rate(
    robots, command
):
    """Wheels whose speeds are made by 1.5 times the distance between them."""
    robot = robots["jackal"]
    twist, state, _ = steady(robot, command, 2.5)
    assert twist[2] == pytest.approx(command[1], rel=0.04)
    p = robot.spec.parameters
    turned_by = (state[1] - state[0]) * p["wheel_radius"] / twist[2]
    assert turned_by == pytest.approx(p["effective_track"], rel=0.04)
    assert turned_by > 1.4 * 2.0 * p["half_width"]


@needs_mujoco
@pytest.mark.parametrize("name", NAMES)
def test_the_encoders_agree_with_the_motion(robots, name):
    """State order and units: the textbook turns the measured state into the true twist."""
    robot = robots[name]
    command = 0.4 * robot.spec.command_high
    twist, state, _ = steady(robot, command)
    assert np.allclose(textbook(robot.spec).twist(state), twist, rtol=0.1, atol=0.02)


@needs_mujoco
@pytest.mark.parametrize("name", ["ackermann", "differential"])
def test_a_robot_that_turns_round_knows_where_it_is_by_its_encoders(robots, name):
    """Wheels keep up with the floor while they accelerate, and those that steer do not scrub."""
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
    off = geometry.between(reading.pose, pose)
    assert np.hypot(*off[:2]) < 0.01
    assert abs(off[2]) < 0.01


@needs_mujoco
def test_commands_saturate_at_the_limits_of_the_spec(robots):
    robot = robots["differential"]
    robot.reset(np.zeros(3))
    at_limit = robot.step(robot.spec.command_high, 0.2)
    robot.reset(np.zeros(3))
    beyond = robot.step(10.0 * robot.spec.command_high, 0.2)
    assert np.array_equal(at_limit.pose, beyond.pose)


@needs_mujoco
def test_on_slippery_ground_a_car_slides_out_of_its_turn(robots):
    """The contact is real: the wheels hold a turn by friction alone."""
    ice = MujocoRobot(robots["ackermann"].spec, replace(Physics(), friction=0.1))
    dry, *_ = steady(robots["ackermann"], [1.0, 0.4])
    icy, *_ = steady(ice, [1.0, 0.4])
    assert abs(dry[1]) < 0.02 * dry[0]
    assert abs(icy[1]) > 0.1 * abs(icy[0])


@needs_mujoco
def test_a_robot_that_falls_over_says_so(robots):
    data = robots["ackermann"].spec.model_dump()
    data["command"][0]["max"] = 8.0
    fast = RobotSpec.model_validate(data)
    robot = MujocoRobot(fast, replace(Physics(), friction=5.0, acceleration=20.0))
    robot.step([8.0, 0.0], 1.0)
    with pytest.raises(BackendError, match="fallen over"):
        robot.step([8.0, 0.5], 0.5)


@needs_mujoco
def test_a_drive_is_a_recording_of_this_robot(robots):
    spec = robots["ackermann"].spec
    recording = record(robots["ackermann"], np.random.default_rng(0), duration=5.0)
    assert check(recording, spec) is recording
    assert recording.variables == spec.variable_names
    streams = (recording.pose, recording.state, recording.command)
    assert [len(stream.t) for stream in streams] == [500] * 3


@pytest.mark.slow
@needs_mujoco
def test_a_model_is_identified_from_a_drive(robots):
    from nics_drl_bridge.identify.identify import identify

    spec = robots["differential"].spec
    found = identify(
        record(robots["differential"], np.random.default_rng(0), 30.0), spec
    )
    assert found.held_out is not None
    assert found.held_out.mean_position_error_m < 0.03 * found.held_out.mean_path_m


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


def test_a_spec_without_a_length_is_refused_by_its_name():
    data = load_robot("ackermann").model_dump()
    del data["parameters"]["wheelbase"]
    with pytest.raises(ConfigError, match="wheelbase"):
        build_machine(RobotSpec.model_validate(data))


def test_a_missing_library_is_one_sentence_that_names_the_fix(monkeypatch):
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(ConfigError, match=r"pip install 'nics_drl_bridge\[mujoco\]'"):
        load_mujoco()
