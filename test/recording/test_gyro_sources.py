"""A gyro is found in bags and tables, and it is told what measured the pose."""

import bags
import numpy as np
import pytest

from nics_drl_bridge.recording.readers import read_recording
from nics_drl_bridge.recording.topic_roles import (
    ODOMETRY,
    POSE,
    TRANSFORMS,
    TopicRoles,
    guess_source_by_names,
)
from nics_drl_bridge.robot.spec import load_robot

from .tables import drive, read, write


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


@pytest.mark.parametrize("topic", ["/imu/data", "/gyroscope"])
def test_any_topic_of_its_type_is_the_imu_of_a_bag(tmp_path, topic):
    rows = bags.every(0.02, lambda t: bags.imu(t, 0.0, 0.0, 0.25))
    topics = bags.drive()
    topics["/odom"] = bags.along(bags.odometry)
    topics.pop("/pose", None)
    bag = bags.write(tmp_path / "bag", topics | {topic: rows})
    found = read_recording(bag, load_robot("differential"), TopicRoles())
    assert found.imu is not None
    assert found.measured_by == "odometry"


POSE = "pose: {x: odom_x, y: odom_y, heading: odom_yaw%s}\n"


@pytest.mark.parametrize(
    ("key", "measured_by"), [("", "odometry"), (", measured_by: tracker", "tracker")]
)
def test_a_second_heading_column_is_a_turn_rate(tmp_path, key, measured_by):
    columns = drive()
    odometry = {f"odom_{name}": columns[name] for name in ("x", "y", "yaw")}
    second = {"second": np.degrees(columns["yaw"] * 30.0) % 360.0}
    path = write(tmp_path / "log.csv", columns | odometry | second)
    changes = f"{POSE % key}imu: {{heading: {{from: second, unit: deg}}}}"
    found = read(path, changes)
    assert found.imu.values[:, 2] == pytest.approx(0.25 * 30.0, abs=1e-3)
    assert found.measured_by == measured_by  # by the names, unless the mapping says it
