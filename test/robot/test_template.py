"""A robot in a few words: its kind knows the rest, and a recording its ranges."""

import numpy as np
import pytest

from nics_drl_bridge.config import list_shipped, parse_yaml
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.robot.kinds import find_kind, list_kinds, textbook
from nics_drl_bridge.robot.spec import (
    RobotSpec,
    build_robot,
    load_robot,
    read_definition,
)

WHEELED = "differential_wheels"
SLIPPING = (
    "ackermann",
    "ackermann_throttle",
    "free",
    "mecanum",
    "omnidirectional",
    "skid_steer",
)


def made(kind, ranges=None, **given):
    if kind == "free" and ranges is None:
        ranges = {"valve": (-1.0, 0.5)}
    return build_robot({"kind": kind, "footprint_radius": 0.3, **given}, ranges)


def commands(robot):
    return [(c.name, c.unit, c.min, c.max) for c in robot.command]


@pytest.mark.parametrize("kind", list_kinds())
def test_two_words_are_a_whole_robot_of_every_kind(kind):
    robot = made(kind)
    assert robot.name == robot.textbook == kind
    assert RobotSpec.model_validate(robot.model_dump(mode="json")) == robot
    if find_kind(kind).kinematics is not None and robot.state:
        assert len(textbook(robot).lag) == len(robot.state)


@pytest.mark.parametrize("kind", list_kinds())
def test_its_state_is_its_twist_unless_it_follows_commands_or_wheels_are_the_motion(
    kind,
):
    robot = made(kind)
    if kind == "tricycle":
        assert [v.follows for v in robot.state] == [c.name for c in robot.command]
    else:
        dofs = ("vx", "vy", "wz") if kind in SLIPPING else ("vx", "wz")
        assert tuple(v.twist for v in robot.state) == (() if kind == WHEELED else dofs)


def test_a_state_that_is_called_as_a_command_gets_another_name():
    assert [v.name for v in made("omnidirectional").state] == [
        "body_vx",
        "body_vy",
        "body_wz",
    ]
    car = made("tricycle", {"speed": (0.0, 3.0), "steering": (-0.4, 0.4)})
    assert [(v.name, v.follows) for v in car.state] == [
        ("actual_speed", "speed"),
        ("actual_steering", "steering"),
    ]


def test_a_state_reaches_twice_as_far_as_its_commands_where_they_tell():
    wheels = {"left_wheel": (0.0, 90.0), "right_wheel": (0.0, 90.0)}
    assert [v.max for v in made("skid_steer", wheels).state] == [10.0, 10.0, 10.0]
    fast = made("skid_steer", {"forward": (-1.0, 20.0), "turn": (-0.4, 0.3)})
    assert [v.max for v in fast.state] == [40.0, 40.0, 0.8]


def test_recorded_ranges_hold_where_the_user_gave_none_and_always_include_rest():
    ranges = {"throttle": (0.1, 0.6), "steering": (-0.4, 0.4)}
    robot = made(
        "ackermann_throttle", ranges, command=[{"name": "throttle", "max": 0.9}]
    )
    assert commands(robot) == [("throttle", "1", 0.0, 0.9)]
    robot = made("ackermann_throttle", ranges)
    assert commands(robot) == [
        ("throttle", "1", 0.0, 0.6),
        ("steering", "1", -0.4, 0.4),
    ]
    robot = made("ackermann_throttle", {"throttle": (0.0, 0.0), "steering": (0.2, 0.2)})
    assert commands(robot) == [
        ("throttle", "1", -1.0, 1.0),
        ("steering", "1", 0.0, 0.2),
    ]


def test_commands_stand_in_the_order_of_the_recording():
    ranges = {"steering": (-1.0, 1.0), "throttle": (0.0, 1.0)}
    robot = made("ackermann_throttle", ranges, parameters={"wheelbase": 0.2})
    assert [c.name for c in robot.command] == ["steering", "throttle"]
    assert textbook(robot).compute_twist(np.array([0.0, 1.0])) == pytest.approx(
        [3.0, 0.0, 0.0]
    )


def test_names_of_the_users_own_stand_in_the_usual_order():
    robot = made(
        "tricycle", {"v": (-1.0, 5.0)}, command=[{"name": "v"}, {"name": "delta"}]
    )
    assert commands(robot) == [("v", "m/s", -1.0, 5.0), ("delta", "rad", -0.5, 0.5)]
    assert [c.cmd_vel for c in robot.command] == ["linear.x", "angular.z"]
    assert [(v.name, v.follows, v.max) for v in robot.state] == [
        ("speed", "v", 10.0),
        ("steering", "delta", 1.0),
    ]


def test_a_skid_steer_robot_is_driven_by_twist_or_by_sides():
    by_wheels = {"left_wheel": (-5.0, 5.0), "right_wheel": (-5.0, 5.0)}
    assert [c.unit for c in made("skid_steer").command] == ["m/s", "rad/s"]
    assert [c.unit for c in made("skid_steer", by_wheels).command] == ["rad/s", "rad/s"]
    own = [{"name": "a", "unit": "rad/s"}, {"name": "b", "unit": "rad/s"}]
    assert [c.cmd_vel for c in made("skid_steer", command=own).command] == [None, None]


def test_free_takes_whatever_was_recorded():
    robot = made(
        "free",
        {"pump": (0.0, 2.0), "valve": (-1.0, 1.0)},
        command=[{"name": "pump", "unit": "V"}, {"name": "valve"}],
    )
    assert commands(robot) == [("pump", "V", 0.0, 2.0), ("valve", "1", -1.0, 1.0)]


def test_parameters_and_a_state_that_are_given_stand():
    state = [
        {"name": "vx", "max": 3.0},
        {"name": "angle", "unit": "rad", "min": -1, "max": 1},
    ]
    robot = made("differential", parameters={"track": 0.5}, state=state)
    assert robot.parameters["track"] == 0.5
    assert robot.assumed == (
        "wheel_lag",
        "wheel_radius",
    )  # lengths by the footprint, usual lags
    assert [(v.name, v.twist, v.max) for v in robot.state] == [
        ("vx", "vx", 3.0),
        ("angle", None, 1.0),
    ]


def test_sizes_come_from_a_footprint_too():
    corners = [[0.3, 0.4], [-0.3, 0.4], [-0.3, -0.4], [0.3, -0.4]]
    robot = build_robot({"kind": "mecanum", "footprint": corners})
    assert robot.parameters["half_width"] == pytest.approx(0.6 * 0.5)


def test_a_file_without_a_name_is_a_robot_of_the_files_name(tmp_path):
    file = tmp_path / "husky.yaml"
    file.write_text("kind: skid_steer\nfootprint_radius: 0.6\n")
    assert load_robot(file).name == read_definition(file)["name"] == "husky"
    assert (
        build_robot({"kind": "skid_steer", "footprint_radius": 0.6}).name
        == "skid_steer"
    )
    for name in list_shipped("robots"):
        robot = load_robot(name)
        assert robot.name == name
        assert build_robot(robot.model_dump()) == robot


BAD = """
{kind: tank} -> robot: key 'kind': there is no 'tank'; valid are: 'ackermann',
{kind: free} -> commands of a robot of the kind 'free' are not known
{kind: mecanum, footprint_radius: wide} -> key 'footprint_radius'
{kind: mecanum} -> the key 'footprint_radius' is missing
{kind: mecanum, textbook: mecanum} -> a `kind` and a `textbook`
{kind: mecanum, footprint_radius: 0.3, command: 3} -> key 'command'
{kind: mecanum, footprint_radius: 0.3, state: none} -> key 'state'
{kind: mecanum, footprint_radius: 0.3, parameters: [1]} -> key 'parameters'
{kind: mecanum, footprint_radius: 0.3, wheels: 4} -> unknown key 'wheels'
{kind: mecanum, footprint: [[0, 0], [1, 1]]} -> entries must be at least 3, not 2.
{kind: mecanum, footprint_radius: 0.3, command: [{name: [v]}]} -> key 'command.0.name'
{kind: mecanum, footprint_radius: 0.3, state: [{name: vx, twist: [vx]}]} -> key 'state.0.twist
{kind: ackermann, name: kart} -> 'speed', 'steering', not 'gas', 'wheel'
{kind: ackermann_throttle, name: kart} -> are 'throttle', 'steering', not 'gas', 'wheel'
"""


@pytest.mark.parametrize("case", BAD.strip().splitlines())
def test_what_is_no_robot_is_refused_in_one_sentence(case):
    text, sentence = case.split(" -> ")
    ranges = {"gas": (0.0, 1.0), "wheel": (0.0, 1.0)} if "kart" in text else None
    with pytest.raises(ConfigError) as caught:
        build_robot(parse_yaml(text, "case"), ranges)
    assert sentence in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_misspelt_parameter_is_refused_and_one_of_the_users_own_is_not():
    with pytest.raises(
        ConfigError, match=r"unknown parameter 'trak'; did you mean 'track'\?"
    ):
        made("differential", parameters={"trak": 0.16})
    robot = made(
        "ackermann", parameters={"wheelbase": 0.3, "steering_rate": 2.0, "mass": 3.0}
    )
    assert robot.parameters["mass"] == 3.0
