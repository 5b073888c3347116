"""A gyro is found in bags and tables, and it is told what measured the pose."""

from __future__ import annotations

import bags
import numpy as np
import pytest

from nics_drl_bridge.recording.readers import read_recording
from nics_drl_bridge.recording.recording import load_recording, save_recording
from nics_drl_bridge.recording.topic_roles import (
    ODOMETRY,
    POSE,
    TRANSFORMS,
    TopicRoles,
    guess_source_by_names,
)
from nics_drl_bridge.robot.spec import load_robot

HEADER = "t,cmd_v,cmd_w,odom_x,odom_y,odom_yaw,second\n"


@pytest.mark.parametrize(
    ("names", "kind", "measured_by"),
    [
        (["/odom"], ODOMETRY, "odometry"),
        (["/husky_velocity_controller/odom"], ODOMETRY, "odometry"),
        (["/ground_truth"], ODOMETRY, "tracker"),
        (["/vrpn/car/pose"], POSE, "tracker"),
        (["/pose"], POSE, "tracker"),
        (["/tf", "map"], TRANSFORMS, "tracker"),
        (["/tf", "odom"], TRANSFORMS, "odometry"),
        (["pfPoseData.csv", "x"], "", "tracker"),
        (["vicon x"], "", "tracker"),
        (["x(m)"], "", ""),
    ],
)
def test_the_names_tell_what_measured_a_pose(names, kind, measured_by):
    assert guess_source_by_names(names, kind) == measured_by


@pytest.mark.parametrize("topic", ["/imu", "/imu/data", "/front/imu_raw", "/gyroscope"])
def test_any_topic_of_its_type_is_the_imu_of_a_bag(tmp_path, topic):
    rows = [(t, bags.imu(t, 0.0, 0.0, 0.25)) for t in bags.times(0.02)]
    topics = bags.drive()
    topics["/odom"] = [(t, bags.odometry(t, *bags.place_at(t))) for t in bags.times()]
    topics.pop("/pose", None)
    bag = bags.write(tmp_path / "bag", topics | {topic: rows})
    read = read_recording(bag, load_robot("differential"), TopicRoles())
    assert read.imu is not None
    assert read.measured_by == "odometry"


def table(tmp_path, rows=400):
    t = np.arange(rows) * 0.05
    heading = 0.3 * t
    second = np.degrees(heading) % 360.0
    pose = [np.sin(heading), 1.0 - np.cos(heading), heading]
    columns = [t, np.full(rows, 0.3), np.full(rows, 0.3), *pose, second]
    path = tmp_path / "drive.csv"
    text = "\n".join(
        ",".join(f"{v:.6f}" for v in row) for row in np.stack(columns, axis=1)
    )
    path.write_text(HEADER + text + "\n", encoding="utf-8")
    return path


def test_a_second_heading_column_is_a_turn_rate(tmp_path):
    mapping = tmp_path / "map.yaml"
    mapping.write_text(
        "robot: differential\ntime: t\n"
        "pose: {x: odom_x, y: odom_y, heading: odom_yaw}\n"
        "command: {forward_command: cmd_v, turn_command: cmd_w}\n"
        "imu: {heading: {from: second, unit: deg}}\n",
        encoding="utf-8",
    )
    read = read_recording(table(tmp_path), mapping=mapping)
    assert read.measured_by == "odometry"
    assert read.imu.values[:, 2] == pytest.approx(0.3, abs=1e-3)
    assert load_recording(saved(read, tmp_path)).measured_by == "odometry"


def saved(recording, folder):
    save_recording(recording, folder / "saved.npz")
    return folder / "saved.npz"


def test_a_mapping_says_itself_what_measured_the_pose(tmp_path):
    mapping = tmp_path / "map.yaml"
    mapping.write_text(
        "robot: differential\ntime: t\n"
        "pose: {x: odom_x, y: odom_y, heading: odom_yaw, measured_by: tracker}\n"
        "command: {forward_command: cmd_v, turn_command: cmd_w}\n",
        encoding="utf-8",
    )
    assert read_recording(table(tmp_path), mapping=mapping).measured_by == "tracker"
