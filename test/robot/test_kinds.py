"""A kind of robot is one file and its YAML; everything else asks the spec for facts."""

from importlib.metadata import EntryPoint
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from robots import lidar

from nics_drl_bridge import extensions
from nics_drl_bridge.config import validate
from nics_drl_bridge.env.bridge_env import BridgeEnv
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.gate.limits import load_limits
from nics_drl_bridge.generator import generate
from nics_drl_bridge.policy.policies import make_policy
from nics_drl_bridge.recording.textbook import record
from nics_drl_bridge.robot.kinds import (
    compute_steady_twist,
    find_command,
    find_kind,
    has_textbook,
    list_kinds,
    reach,
    textbook,
)
from nics_drl_bridge.robot.spec import RobotSpec, build_robot, load_robot
from nics_drl_bridge.robot.urdf import make_urdf

PACKAGE = Path(__file__).resolve().parents[2] / "nics_drl_bridge"
NEW = "tricycle"
SHIPPED = ("ackermann", "differential", "mecanum", NEW)
MADE = (
    "ackermann_throttle",
    "differential_wheels",
    "free",
    "omnidirectional",
    "skid_steer",
)
KINDS = sorted((*SHIPPED, *MADE))


def test_the_kinds_are_the_modules_that_define_one():
    assert list_kinds() == KINDS
    assert find_kind("spec") is find_kind("a tank") is find_kind("..") is None


def test_no_other_file_of_the_package_names_the_newest_kind():
    naming = {
        path
        for path in PACKAGE.rglob("*.py")
        if NEW in path.read_text(encoding="utf-8")
    }
    assert naming == {PACKAGE / "robot" / f"{NEW}.py"}


@pytest.mark.parametrize(
    ("name", "steers", "moves_sideways", "turns"),
    [
        ("ackermann", True, False, [False, True]),
        ("differential", False, False, [False, True]),
        ("mecanum", False, True, [False, False, True]),
        ("jackal", False, False, [False, True]),
        (NEW, True, False, [False, True]),
    ],
)
def test_the_spec_tells_what_its_commands_mean(name, steers, moves_sideways, turns):
    robot = load_robot(name)
    assert (robot.steers, robot.moves_sideways) == (steers, moves_sideways)
    assert [command.turns for command in robot.command] == turns
    assert all(command.is_twist for command in robot.command) == (not steers)


def made(kind, **given):
    return build_robot({"kind": kind, "footprint_radius": 0.2, **given})


KNOWN = [kind for kind in KINDS if kind != "free"]


@pytest.mark.parametrize("kind", KNOWN)
def test_the_command_for_a_twist_leads_to_it(kind):
    robot = made(kind)
    for share in np.random.default_rng(0).uniform(-1.0, 1.0, (20, len(robot.command))):
        command = share * robot.command_high
        assert find_command(
            robot, compute_steady_twist(robot, command)
        ) == pytest.approx(command)
    far = find_command(robot, np.full((2, 3), 1e3))
    assert (far <= robot.command_high).all()


HELD = [*map(load_robot, (*SHIPPED, "jackal")), *map(made, KNOWN)]


@pytest.mark.parametrize("robot", HELD, ids=lambda robot: robot.name)
def test_a_held_command_leads_to_its_steady_twist(robot):
    command = 0.6 * robot.command_high
    book = textbook(robot)
    state = book.respond(np.zeros(len(book.lag)), book.target(command), 60.0)
    steady = compute_steady_twist(robot, command)
    assert book.twist(state) == pytest.approx(steady, abs=1e-9)


def test_a_skid_steer_robot_turns_less_than_it_is_commanded():
    sizes = {"track": 0.4, "effective_track": 0.8, "wheel_radius": 0.1}
    robot = made("skid_steer", parameters=sizes)
    assert compute_steady_twist(robot, [0.5, 1.0]) == pytest.approx([0.5, 0.0, 0.5])
    sides = [{"name": "left_wheel"}, {"name": "right_wheel"}]
    robot = made("skid_steer", parameters=sizes, command=sides)
    assert compute_steady_twist(robot, [-4.0, 4.0]) == pytest.approx([0.0, 0.0, 1.0])


def test_wheels_turn_by_their_difference_and_a_throttle_leads_to_a_speed():
    robot = made("differential_wheels", parameters={"track": 0.5, "wheel_radius": 0.1})
    assert compute_steady_twist(robot, [3.0, 5.0]) == pytest.approx([0.4, 0.0, 0.4])
    sizes = {"wheelbase": 0.2, "speed_gain": 4.0, "greatest_steering": 0.5}
    twist = compute_steady_twist(
        made("ackermann_throttle", parameters=sizes), [0.5, -1.0]
    )
    assert twist == pytest.approx([2.0, 0.0, -2.0 * np.tan(0.5) / 0.2])


def test_a_car_that_is_to_turn_on_the_spot_stands():
    for kind in ("ackermann", "ackermann_throttle", "tricycle"):
        assert not find_command(made(kind), [0.0, 0.0, 1.0]).any()
    assert reach(made("ackermann")) == pytest.approx([1.0, 0.0, np.tan(0.5) / 0.26])


def test_where_the_commands_of_a_free_robot_lead_is_not_known():
    robot = build_robot({"kind": "free", "footprint_radius": 0.2}, {"pump": (0.0, 1.0)})
    assert not has_textbook(robot)
    assert robot.moves_sideways
    for ask in (textbook, reach, lambda robot: find_command(robot, np.zeros(3))):
        with pytest.raises(ConfigError, match="has no textbook kinematics"):
            ask(robot)


@pytest.mark.parametrize(
    ("kind", "changes", "fault"),
    [
        ("differential", {"parameters": {"wheel_rate": 3.0}}, "a rate limit"),
        ("differential", {"state": []}, "a state of 2 actuators, not none"),
        (
            "differential_wheels",
            {"command": [{"name": "left_wheel"}]},
            "kinematics need 2 commands, not 1",
        ),
    ],
)
def test_a_robot_that_does_not_fit_its_kind_is_refused(kind, changes, fault):
    with pytest.raises(ConfigError, match=fault):
        textbook(made(kind, **changes))


def reaches_goal(env, policy):
    observation, info = env.reset(seed=0)
    for _ in range(200):
        observation, _, ended, _, info = env.step(policy.act(observation))
        if ended:
            break
    return info["is_success"]


GENERATED = {
    "wheels": made("differential_wheels"),
    "of a guessed wheelbase": made("ackermann"),
    NEW: load_robot(NEW),
}


@pytest.fixture(scope="module", params=GENERATED)
def model(request):
    """A robot, generated from a drive of its own; one has no field of cmd_vel."""
    robot = GENERATED[request.param]
    drive = record(robot, np.random.default_rng(0), duration=30.0)
    return generate(drive, robot, lidar(), ())[0]


@pytest.mark.slow
def test_a_model_moves_as_its_kind_and_drives_in_an_env_to_goals(model):
    robot = model.robot
    assert robot.takes_cmd_vel == (robot.name in ("ackermann", NEW))
    drive = record(robot, np.random.default_rng(1), duration=20.0)
    if robot.name == NEW:
        x = np.concatenate([drive.state.values, drive.command.values], axis=1)
        twist = textbook(robot).twist(drive.state.values)
        off = model.kinematics.rates(x)[:, :3] - twist
        # Cosine and sine of the steering are fitted to the second order.
        assert ((off**2).mean(axis=0) <= 0.01 * (twist**2).mean(axis=0)).all()
    options = {"actions": "discrete"}
    env = BridgeEnv(model=model, world="arena", estimator=True, task_options=options)
    env.reset(seed=0)
    for _ in range(20):
        observation, *_, info = env.step(env.action_space.sample())
    assert env.observation_space.contains(observation)
    assert np.isfinite(info["true_pose"]).all()
    env = BridgeEnv(model=model, world="empty")
    names = ("dynamic_window",) if robot.name == NEW else ("straight", "dynamic_window")
    for name in names if robot.name != "ackermann" else ():
        assert reaches_goal(env, make_policy(name, env.task))
        assert reaches_goal(env, make_policy(name, env.task, model))


@pytest.mark.slow
def test_a_free_robot_reaches_goals_by_its_model_and_not_without():
    car = made("ackermann_throttle")
    ranges = {c.name: (c.min, c.max) for c in car.command}
    robot = build_robot({"kind": "free", "footprint_radius": 0.2}, ranges)
    model = generate(record(car, np.random.default_rng(0)), robot, lidar(), ())[0]
    env = BridgeEnv(model=model, world="empty")
    for name in ("straight", "dynamic_window"):
        assert reaches_goal(env, make_policy(name, env.task, model))
        observation, _ = env.reset(seed=0)
        with pytest.raises(ConfigError, match="has no textbook kinematics"):
            make_policy(name, env.task).act(observation)


def test_a_front_wheel_across_turns_a_tricycle_about_its_rear_axle():
    book = textbook(load_robot(NEW))
    assert book.twist(np.array([0.6, np.pi / 2])) == pytest.approx(
        [0.0, 0.0, 0.6 / 0.3]
    )
    assert book.twist(np.array([0.6, 0.0])) == pytest.approx([0.6, 0.0, 0.0])


def test_it_has_limits_and_is_drawn_on_three_wheels():
    robot = load_robot(NEW)
    assert load_limits(NEW, robot).linear.tolist() == [True, False]
    root = ElementTree.fromstring(make_urdf(robot))
    wheels = [
        link.attrib["name"]
        for link in root.iter("link")
        if "wheel" in link.attrib["name"]
    ]
    assert wheels == [
        "rear_left_wheel_link",
        "rear_right_wheel_link",
        "front_wheel_link",
    ]
    (steering,) = [j for j in root.iter("joint") if j.attrib["type"] == "revolute"]
    assert steering.attrib["name"] == "steering"
    assert steering.find("mimic") is None


@pytest.mark.parametrize("name", ["tank", "mecanum"])
def test_another_package_adds_a_kind_by_an_entry_point_or_takes_the_place_of_one(
    monkeypatch, name
):
    points = {name: EntryPoint(name, f"nics_drl_bridge.robot.{NEW}:KIND", "")}
    monkeypatch.setattr(
        extensions, "find_extensions", lambda group: points if group == "kinds" else {}
    )
    robot = RobotSpec.model_validate(load_robot(NEW).model_dump() | {"textbook": name})
    assert textbook(robot).twist(np.array([1.0, 0.0])) == pytest.approx([1.0, 0.0, 0.0])
    assert name in list_kinds()


def test_an_unknown_kind_is_refused_with_all_that_there_are():
    data = load_robot(NEW).model_dump() | {"textbook": "tank"}
    with pytest.raises(ConfigError) as caught:
        validate(data, RobotSpec, "tank.yaml")
    known = ", ".join(KINDS)
    assert (
        str(caught.value)
        == f"tank.yaml: key 'textbook': must be one of {known}, not 'tank'."
    )


def textbook_and_drawing(robot):
    return textbook(robot), make_urdf(robot)


@pytest.mark.parametrize("name", SHIPPED)
def test_a_parameter_that_is_missing_is_named(name):
    robot = load_robot(name)
    for parameter in robot.parameters:
        left = {
            key: value for key, value in robot.parameters.items() if key != parameter
        }
        spoilt = robot.model_copy(update={"parameters": left})
        with pytest.raises(
            ConfigError, match=f"need the parameter '{parameter}'; add it under"
        ):
            textbook_and_drawing(spoilt)
