"""The yaw rate of an IMU is about the axis that points up by gravity, however it is mounted."""

import bags
import numpy as np
import pytest

from nics_drl_bridge.recording.imu_axis import GyroReader, UpAxis, find_up_axis
from nics_drl_bridge.recording.readers import read_recording
from nics_drl_bridge.recording.topic_roles import IMU, TopicRoles
from nics_drl_bridge.robot.spec import load_robot

from .tables import draft


def mounted(t, rate, axis, sign):
    """Returns a message of an IMU of which an axis points up (1) or down (-1)."""
    turn = np.zeros(3)
    acceleration = np.array([0.3, -0.2, 0.1])
    turn[axis] = sign * rate
    acceleration[axis] = sign * 9.81
    return bags.new(
        IMU,
        bags.header(t),
        bags.turned(0.0),
        np.zeros(9),
        bags.vector(*turn),
        np.arange(9.0),
        bags.vector(*acceleration),
        np.zeros(9),
    )


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_live_imu_gives_its_yaw_rate_however_it_is_mounted(axis, sign):
    rate, variance = GyroReader().read(mounted(1.0, 0.4, axis, sign))
    assert rate == pytest.approx(0.4)
    assert variance == 4.0 * axis


@pytest.mark.parametrize(
    "acceleration", [[0.0, 0.0, 0.0], [0.2, 0.1, 0.0], [6.0, 6.0, 6.0]]
)
def test_without_gravity_along_an_axis_z_points_up(acceleration):
    assert find_up_axis(np.array(acceleration)) == UpAxis()


def test_a_bump_does_not_turn_the_axis():
    reader = GyroReader()
    for k in range(50):
        reader.read(mounted(0.01 * k, 0.4, 2, 1.0))
    assert reader.read(mounted(0.6, 0.4, 0, 1.0))[0] == 0.0


@pytest.mark.parametrize(("axis", "sign"), [(1, 1.0), (2, -1.0)])
def test_the_imu_of_a_bag_and_of_its_draft_is_read_as_it_is_mounted(
    tmp_path, axis, sign
):
    topics = bags.drive()
    topics["/imu/data"] = bags.every(
        0.02, lambda t: mounted(t, 0.25 + 0.1 * np.sin(t), axis, sign)
    )
    bag = bags.write(tmp_path / "bag", topics)
    read = read_recording(bag, load_robot("differential"), TopicRoles())
    assert read.imu.values[:, 2].mean() == pytest.approx(0.25, abs=0.08)
    assert any("points up" in told for told in read.repairs)
    text, _ = draft(bag)
    assert f"/imu/data:angular_velocity.{'xyz'[axis]}" in text
    assert ("scale: -1" in text) == (sign < 0.0)
