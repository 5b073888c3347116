import numpy as np
import pytest

from nics_drl_bridge.config import parse_yaml, validate
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.robot.kinds import require_textbook
from nics_drl_bridge.robot.spec import RobotSpec, build_robot, load_robot

ROBOTS = ("ackermann", "differential", "mecanum")


def data(**changes):
    speed = {"name": "speed", "unit": "m/s", "min": -1.0, "max": 1.0}
    return {
        "name": "cart",
        "footprint_radius": 0.2,
        "state": [{**speed, "follows": "push"}],
        "command": [
            {**speed, "name": "push", "cmd_vel": "linear.x"},
            {**speed, "name": "turn", "unit": "rad/s", "cmd_vel": "angular.z"},
        ],
    } | changes


def test_names_and_units_stand_in_the_order_of_x_and_of_dq():
    robot = RobotSpec.model_validate(data())
    assert robot.variable_names == ("speed", "push", "turn")
    assert robot.variable_units == ("m/s", "m/s", "rad/s")
    assert robot.dof_names == ("vx", "vy", "wz", "d_speed")
    assert robot.dof_units == ("m/s", "m/s", "rad/s", "m/s/s")


def test_each_command_travels_in_the_field_of_cmd_vel_that_it_names():
    assert np.array_equal(
        load_robot("ackermann").to_cmd_vel([0.5, -0.2]), [0.5, 0.0, -0.2]
    )
    assert np.array_equal(
        load_robot("mecanum").to_cmd_vel([1.0, 2.0, 3.0]), [1.0, 2.0, 3.0]
    )
    backwards = RobotSpec.model_validate(data(command=data()["command"][::-1]))
    assert np.array_equal(backwards.to_cmd_vel([0.1, 0.7]), [0.7, 0.0, 0.1])


@pytest.mark.parametrize("name", ROBOTS)
def test_commands_come_back_from_cmd_vel_in_any_batch(name):
    robot = load_robot(name)
    command = np.random.default_rng(0).normal(size=(4, 5, len(robot.command)))
    assert np.array_equal(robot.from_cmd_vel(robot.to_cmd_vel(command)), command)


def car(kind="ackermann", **changes):
    given = load_robot(kind).model_dump(exclude={"angular_is"})
    return RobotSpec.model_validate(given | changes)


def test_a_car_takes_a_turn_rate_unless_its_file_says_steering():
    robot = car()
    turn = 0.5 * np.tan(0.3) / 0.2
    assert robot.to_cmd_vel([0.5, 0.3]) == pytest.approx([0.5, 0.0, turn])
    assert robot.from_cmd_vel([0.5, 9.0, turn]) == pytest.approx([0.5, 0.3])
    assert robot.from_cmd_vel([-0.5, 0.0, turn]) == pytest.approx([-0.5, -0.3])
    as_angle = load_robot("ackermann")
    assert as_angle.angular_is == "steering"
    assert as_angle.to_cmd_vel([0.5, 0.3]).tolist() == [0.5, 0.0, 0.3]


def test_a_tricycle_turns_by_its_front_wheel():
    robot = car("tricycle")
    twist = robot.to_cmd_vel([0.5, 0.4])
    assert twist == pytest.approx([0.5 * np.cos(0.4), 0.0, 0.5 * np.sin(0.4) / 0.3])
    assert robot.from_cmd_vel(twist) == pytest.approx([0.5, 0.4])


def test_a_car_at_rest_holds_its_wheels_straight_and_one_that_can_turn_no_further_its_limit():
    robot = car()
    given = [
        [0.0, 0.0, 1.0],
        [0.0, 0.0, -1e300],
        [0.1, 0.0, 3.0],
        [-1e-320, 0.0, 1e300],
    ]
    wanted = [[0.0, 0.0], [0.0, 0.0], [0.1, 0.5], [-1e-320, -0.5]]
    assert robot.from_cmd_vel(given) == pytest.approx(np.array(wanted))


def test_what_goes_through_cmd_vel_is_what_the_robot_takes():
    given = np.array([[0.5, 0.3], [0.0, 0.3]])
    assert car().pass_through_cmd_vel(given) == pytest.approx(
        np.array([[0.5, 0.3], [0.0, 0.0]])
    )
    assert (
        car(assumed=["wheelbase"]).pass_through_cmd_vel(given).tolist()
        == given.tolist()
    )
    assert (
        load_robot("ackermann").pass_through_cmd_vel(given).tolist() == given.tolist()
    )


@pytest.mark.parametrize("changes", [{"parameters": {}}, {"assumed": ["wheelbase"]}])
def test_a_turn_rate_needs_a_wheelbase_that_is_known(changes):
    with pytest.raises(
        ConfigError, match=r"its wheelbase is not known; add `wheelbase:` \[m\] to"
    ):
        car(**changes).require_cmd_vel()
    car(angular_is="steering", **changes).require_cmd_vel()


def test_a_node_is_told_which_command_is_no_field_of_cmd_vel():
    given = data()
    del given["command"][1]["cmd_vel"]
    with pytest.raises(
        ConfigError, match="'cart': the command 'turn' names no field of cmd_vel"
    ):
        RobotSpec.model_validate(given).require_cmd_vel()


BAD = """
state: [{name: a, unit: m/s, min: -1, max: 1, twist: vx}, {name: b, unit: m/s, min: -1, max: 1, twist: vx}]
  -> two states are the same component
state: [{name: a, unit: rad, min: -1, max: 1, twist: vx}]
  -> state 'a' is vx of the twist, so its unit is m/s
name: ../../evil -> name '../../evil': it is used in file names
name: a\\b -> remove .., / and
angular_is: sideways -> 'turn_rate' or 'steering'
footprint_radius: 0.0 -> greater than or equal to 0.001
footprint_radius: 30.0 -> reaches 30 m from base_link, the maximum is 10 m
parameters: {track: -0.3} -> track -0.3: must be more than 0
parameters: {wheel_radius: 0.0} -> wheel_radius 0: must be more than 0
parameters: {wheel_lag: 0.0} -> wheel_lag 0: must be more than 0
parameters: {track: 330.0} -> track 330 m is too long for a robot of 0.2 m
lidar_mount: [0.0, 0.0, 180] -> 'lidar_mount.2': must be in radians, within 2 pi
lidar_mount: [-40, 0.0, 3.14] -> 'lidar_mount.0': must be in metres, within 10
command: [] -> number of entries must be at least 1
command: [{name: push, unit: m/s, min: -1, max: 1, cmd_vel: linear.x}, {name: turn, unit: m/s, min: -1, max: 1, cmd_vel: linear.x}]
  -> two commands share one field
state: [{name: push, unit: m/s, min: 0, max: 1, cmd_vel: linear.x}] -> unknown key 'state.0.cmd_vel'
state: [{name: push, unit: m, min: 0, max: 1}] -> a unique name
state: [{name: a, unit: m, min: 1, max: 1}] -> min must be less than max of variable 'a'
state: [{name: a, unit: m, min: 0, max: 1, follows: b}] -> follows 'b', which is not a command
state: [{name: A b, unit: m, min: 0, max: 1}] -> state.0.name
textbook: tank -> key 'textbook'
footprint: [[0.1, 0.0], [0.0, 0.1]] -> number of entries must be at least 3
footprint: [[0.1, 0.0], [0.0, a], [0.0, 0.0]] -> footprint.1.1
footprint: [[0.1, 0.1], [-0.1, -0.1], [0.1, -0.1], [-0.1, 0.1]] -> cross or touch
footprint: [[0.1, 0.0], [0.2, 0.0], [0.1, 0.0]] -> cross or touch
footprint: [[0.1, 0.0], [0.1, 0.0], [0.0, 0.1]] -> cross or touch
footprint: [[0.1, 0.1], [-0.1, 0.1], [0.0, -0.1]] -> remove footprint_radius
"""  # noqa: E501


@pytest.mark.parametrize("case", BAD.strip().replace("\n  ->", " ->").splitlines())
def test_a_robot_that_cant_be_is_refused_in_one_sentence(case):
    changes, sentence = case.split(" -> ")
    with pytest.raises(ConfigError) as caught:
        validate(data(**parse_yaml(changes, "case")), RobotSpec, "cart.yaml")
    assert sentence in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_steering_in_degrees_is_refused_where_the_robot_is_read_but_not_one_that_was_recorded():
    kind = {"kind": "ackermann", "footprint_radius": 0.2}
    speed = {"name": "speed_command"}
    angle = {"name": "steering_command", "min": -24, "max": 22}
    with pytest.raises(
        ConfigError, match=r"steering_command reaches -24 rad, .* are in radians"
    ):
        build_robot(kind | {"command": [speed, angle]})
    ranges = {"speed_command": (-1.0, 1.0), "steering_command": (-24.0, 22.0)}
    assert (
        build_robot(kind, ranges).command[1].min == -24.0
    )  # its mapping can turn it into radians


def test_a_robot_without_textbook_is_told_so():
    with pytest.raises(ConfigError, match="robot 'cart' names no textbook kinematics"):
        require_textbook(RobotSpec.model_validate(data()))


def test_a_grown_robot_keeps_the_margin_from_each_edge_of_its_outline_and_around_its_circle():
    corners = [[0.3, 0.1], [-0.1, 0.1], [-0.1, -0.1], [0.3, -0.1]]
    for order in (1, -1):
        given = data(
            footprint=corners[::order], footprint_radius=float(np.hypot(0.3, 0.1))
        )
        grow_footprint = RobotSpec.model_validate(given).grow_footprint(0.05)
        assert np.abs(np.array(grow_footprint.footprint)).max(axis=0) == pytest.approx(
            [0.35, 0.15]
        )
        assert grow_footprint.footprint_radius == pytest.approx(
            np.hypot(0.3, 0.1)
        )  # where it may stand
    assert RobotSpec.model_validate(data()).grow_footprint(
        0.05
    ).footprint_radius == pytest.approx(0.25)


def test_a_footprint_gives_the_radius_of_the_circle_that_holds_it():
    given = data(footprint=[[0.3, 0.1], [-0.1, 0.1], [-0.1, -0.1], [0.3, -0.1]])
    del given["footprint_radius"]
    robot = RobotSpec.model_validate(given)
    assert robot.footprint_radius == pytest.approx(np.hypot(0.3, 0.1))
    assert RobotSpec.model_validate(robot.model_dump(mode="json")) == robot
