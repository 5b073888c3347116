"""Drafts of mappings for bags of usual robots: types and names of topics decide."""

from typing import Any

import pytest

from nics_drl_bridge.config import parse_yaml
from nics_drl_bridge.recording import topic_roles as kinds
from nics_drl_bridge.recording.mapping_draft import propose_mapping
from nics_drl_bridge.recording.survey import Field, TableSurvey

from .test_drafts import M


def topic(name: str, kind: str, columns: dict[str, str]) -> TableSurvey:
    table = TableSurvey(name, kind, t=M["t"], is_single=False)
    table.columns += [
        Field(table, field, M[column]) for field, column in columns.items()
    ]
    return table


def number(name: str, column: str) -> TableSurvey:
    return topic(name, "std_msgs/msg/Float64", {"data": column})


def twist(name: str, v: str = "v", w: str = "w") -> TableSurvey:
    fields = dict.fromkeys(("linear.y", "linear.z", "angular.x", "angular.y"), "zero")
    return topic(name, kinds.TWIST, fields | {"linear.x": v, "angular.z": w})


def ackermann(name: str, v: str = "v") -> TableSurvey:
    drive = {"speed": v, "acceleration": "zero"}
    drive |= {"steering_angle": "w", "steering_angle_velocity": "zero"}
    fields = {f"drive.{field}": column for field, column in drive.items()}
    return topic(name, kinds.ACKERMANN_STAMPED, fields)


def turned(place: str) -> dict[str, Any]:
    position = zip("xyz", ("x", "y", "zero"), strict=True)
    quaternion = zip("xyzw", ("zero", "zero", "qz", "qw"), strict=True)
    return {
        **{f"{place}position.{axis}": column for axis, column in position},
        **{f"{place}orientation.{axis}": column for axis, column in quaternion},
    }


def pose(name: str) -> TableSurvey:
    return topic(name, kinds.POSE, turned("pose."))


def odometry(name: str = "/odom") -> TableSurvey:
    rates = {"twist.twist.linear.x": "speed", "twist.twist.angular.z": "rate"}
    return topic(name, kinds.ODOMETRY, turned("pose.pose.") | rates)


RATES = {"angular_velocity.z": "rate", "linear_acceleration.x": "noise"}
IMU = topic("/imu", kinds.IMU, RATES)
JOINTS = {"velocity[left]": "v", "velocity[right]": "w"}
FIX = {"latitude": "x", "longitude": "y", "altitude": "noise"}
OF_TWIST = "{0}:linear.x {0}:angular.z"
OF_DRIVE = "{0}:drive.speed {0}:drive.steering_angle"
# Topics of a bag; then the pose and the commands that are to be drafted.
BAGS: dict[str, tuple[list[TableSurvey], str, str]] = {
    "turtlebot 2": (
        [
            odometry(),
            twist("/mobile_base/commands/velocity"),
            IMU,
            twist("/cmd_vel_mux/input/teleop", "noise", "noise"),
            pose("/move_base_simple/goal"),
        ],
        "/odom",
        OF_TWIST.format("/mobile_base/commands/velocity"),
    ),
    "a topic called groundtruth": (
        [odometry(), twist("/cmd_vel"), pose("/groundtruth"), IMU],
        "/groundtruth",
        OF_TWIST.format("/cmd_vel"),
    ),
    "true odometry of a simulator": (
        [odometry(), twist("/cmd_vel"), odometry("/ground_truth/state")],
        "/ground_truth/state",
        OF_TWIST.format("/cmd_vel"),
    ),
    "measured twists": (
        [odometry(), twist("/vehicle/twist"), twist("/vel")],
        "/odom",
        "",
    ),
    "commands of two robots": (
        [odometry(), twist("/r1/cmd_vel"), twist("/r2/cmd_vel", "noise", "noise")],
        "/odom",
        "",
    ),
    "a car": (
        [
            odometry(),
            ackermann("/drive"),
            number("/commands/motor/speed", "v"),
            pose("/pf/viz/inferred_pose"),
        ],
        "/pf/viz/inferred_pose",
        OF_DRIVE.format("/drive"),
    ),
    "the output of a mux": (
        [odometry(), ackermann("/mux/output"), ackermann("/mux/input/nav", "noise")],
        "/odom",
        OF_DRIVE.format("/mux/output"),
    ),
    "targets of wheels": (
        [odometry(), number("/lwheel_vtarget", "v"), number("/rwheel_vtarget", "w")],
        "/odom",
        "/lwheel_vtarget:data /rwheel_vtarget:data",
    ),
    "a car's measured steering": ([odometry(), ackermann("/ack_odom")], "/odom", ""),
    "joints": ([odometry(), topic("/joint_states", kinds.JOINTS, JOINTS)], "/odom", ""),
    "wheels": (
        [
            pose("/vrpn/robot/pose"),
            number("/wheel_cmd_left", "v"),
            number("/wheel_cmd_right", "w"),
        ],
        "/vrpn/robot/pose",
        "/wheel_cmd_left:data /wheel_cmd_right:data",
    ),
    "satellites": (
        [odometry(), topic("/gps/fix", "sensor_msgs/msg/NavSatFix", FIX)],
        "/odom",
        "",
    ),
    "a start that was set": (
        [pose("/slam_out_pose"), pose("/initialpose"), twist("/cmd_vel")],
        "/slam_out_pose",
        OF_TWIST.format("/cmd_vel"),
    ),
}


@pytest.mark.parametrize("bag", BAGS)
def test_a_draft_of_a_bag_is_right_or_blank(bag):
    tables, place, commands = BAGS[bag]
    text = propose_mapping(tables).text
    draft = parse_yaml(text, "draft")
    assert draft["pose"] == place, text
    assert list((draft["command"] or {}).values()) == commands.split(), text
    if bag == "satellites":
        assert text.startswith("# doubt: no command was recorded")
        assert draft["robot"] is None
