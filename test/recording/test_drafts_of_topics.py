"""Drafts of mappings for bags of usual robots: types and names of topics decide."""

from __future__ import annotations

from typing import Any

import pytest

from nics_drl_bridge.config import parse_yaml
from nics_drl_bridge.recording import topic_roles as kinds
from nics_drl_bridge.recording.mapping_draft import propose_mapping
from nics_drl_bridge.recording.survey import Field, TableSurvey

from .test_drafts import COUNT, M

FLOAT = "std_msgs/msg/Float64"


def topic(name: str, kind: str, columns: dict[str, Any]) -> TableSurvey:
    data = {field: M[c] if isinstance(c, str) else c for field, c in columns.items()}
    table = TableSurvey(name, COUNT, t=M["t"], data=data, kind=kind, is_single=False)
    for field, c in data.items():
        table.columns.append(Field(table, field, float(c.min()), float(c.max())))
    return table


def twist(name: str, v: str = "v", w: str = "w") -> TableSurvey:
    fields = dict.fromkeys(("linear.y", "linear.z", "angular.x", "angular.y"), "zero")
    return topic(name, kinds.TWIST, fields | {"linear.x": v, "angular.z": w})


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


IMU = topic(
    "/imu", kinds.IMU, {"angular_velocity.z": "rate", "linear_acceleration.x": "noise"}
)
STEERED = {"drive.steering_angle": "w", "drive.steering_angle_velocity": "zero"}
STEERED |= {"drive.speed": "v", "drive.acceleration": "zero"}
# Topics of a bag; then the pose, and the topics of the commands, that are to be drafted.
BAGS: dict[str, tuple[list[TableSurvey], str, list[str]]] = {
    "turtlebot 2": (
        [
            odometry(),
            twist("/mobile_base/commands/velocity"),
            IMU,
            twist("/cmd_vel_mux/input/teleop", "noise", "noise"),
            pose("/move_base_simple/goal"),
        ],
        "/odom",
        [
            "/mobile_base/commands/velocity:linear.x",
            "/mobile_base/commands/velocity:angular.z",
        ],
    ),
    "a topic called groundtruth": (
        [odometry(), twist("/cmd_vel"), pose("/groundtruth"), IMU],
        "/groundtruth",
        ["/cmd_vel:linear.x", "/cmd_vel:angular.z"],
    ),
    "true odometry of a simulator": (
        [odometry(), twist("/cmd_vel"), odometry("/ground_truth/state")],
        "/ground_truth/state",
        ["/cmd_vel:linear.x", "/cmd_vel:angular.z"],
    ),
    "a controller with its own odometry": (
        [
            odometry("/husky_velocity_controller/odom"),
            twist("/husky_velocity_controller/cmd_vel"),
        ],
        "/husky_velocity_controller/odom",
        [
            "/husky_velocity_controller/cmd_vel:linear.x",
            "/husky_velocity_controller/cmd_vel:angular.z",
        ],
    ),
    "measured twists": (
        [odometry(), twist("/vehicle/twist"), twist("/vel")],
        "/odom",
        [],
    ),
    "commands of two robots": (
        [odometry(), twist("/r1/cmd_vel"), twist("/r2/cmd_vel", "noise", "noise")],
        "/odom",
        [],
    ),
    "a car": (
        [
            odometry(),
            topic("/drive", kinds.ACKERMANN_STAMPED, STEERED),
            topic("/commands/motor/speed", FLOAT, {"data": "v"}),
            pose("/pf/viz/inferred_pose"),
        ],
        "/pf/viz/inferred_pose",
        ["/drive:drive.speed", "/drive:drive.steering_angle"],
    ),
    "the output of a mux": (
        [
            odometry(),
            topic("/ackermann_cmd_mux/output", kinds.ACKERMANN_STAMPED, STEERED),
            topic(
                "/ackermann_cmd_mux/input/nav",
                kinds.ACKERMANN_STAMPED,
                STEERED | {"drive.speed": "noise"},
            ),
        ],
        "/odom",
        [
            "/ackermann_cmd_mux/output:drive.speed",
            "/ackermann_cmd_mux/output:drive.steering_angle",
        ],
    ),
    "targets of wheels": (
        [
            odometry(),
            topic("/lwheel_vtarget", FLOAT, {"data": "v"}),
            topic("/rwheel_vtarget", FLOAT, {"data": "w"}),
        ],
        "/odom",
        ["/lwheel_vtarget:data", "/rwheel_vtarget:data"],
    ),
    "a car's measured steering": (
        [odometry(), topic("/ackermann_odom", kinds.ACKERMANN_STAMPED, STEERED)],
        "/odom",
        [],
    ),
    "joints": (
        [
            odometry(),
            topic(
                "/joint_states",
                kinds.JOINTS,
                {"velocity[left]": "v", "velocity[right]": "w"},
            ),
        ],
        "/odom",
        [],
    ),
    "wheels": (
        [
            pose("/vrpn_client_node/robot/pose"),
            topic("/wheel_cmd_left", FLOAT, {"data": "v"}),
            topic("/wheel_cmd_right", FLOAT, {"data": "w"}),
        ],
        "/vrpn_client_node/robot/pose",
        ["/wheel_cmd_left:data", "/wheel_cmd_right:data"],
    ),
    "satellites": (
        [
            odometry(),
            topic(
                "/gps/fix",
                "sensor_msgs/msg/NavSatFix",
                {"latitude": "x", "longitude": "y", "altitude": "noise"},
            ),
        ],
        "/odom",
        [],
    ),
    "a start that was set": (
        [pose("/slam_out_pose"), pose("/initialpose"), twist("/cmd_vel")],
        "/slam_out_pose",
        ["/cmd_vel:linear.x", "/cmd_vel:angular.z"],
    ),
}


@pytest.mark.parametrize("bag", BAGS)
def test_a_draft_of_a_bag_is_right_or_blank(bag):
    tables, place, commands = BAGS[bag]
    text = propose_mapping(tables).text
    draft = parse_yaml(text, "draft")
    assert draft["pose"] == place, text
    assert list((draft["command"] or {}).values()) == commands, text
