import re
from pathlib import Path

import pytest

from nics_drl_bridge.errors import ConfigError, RecordingError
from nics_drl_bridge.recording import topic_roles as kinds
from nics_drl_bridge.recording.topic_roles import (
    TopicRoles,
    assign,
    guess_source_by_names,
    load_topic_roles,
)

USUAL = {
    "/cmd_vel": kinds.TWIST,
    "/odom": kinds.ODOMETRY,
    "/joint_states": kinds.JOINTS,
    "/imu/data": kinds.IMU,
    "/scan": "sensor_msgs/msg/LaserScan",
}


def refused(types, empty=(), **roles) -> str:
    with pytest.raises(RecordingError) as caught:
        assign(TopicRoles(**roles), types, empty, "drive")
    return str(caught.value)


def test_usual_names_need_no_mapping():
    assert assign(TopicRoles(), USUAL, (), "drive") == {
        "cmd_vel": "/cmd_vel",
        "odom": "/odom",
        "joint_states": "/joint_states",
        "imu": "/imu/data",
    }


@pytest.mark.parametrize(
    ("role", "topic", "kind"),
    [
        ("cmd_vel", "/car/cmd_vel", kinds.TWIST_STAMPED),
        ("pose", "/groundtruth", kinds.POSE),
        ("pose", "/ground_truth/state", kinds.ODOMETRY),
        ("cmd_vel", "/ackermann_cmd", kinds.ACKERMANN),
        ("cmd_vel", "/drive", kinds.ACKERMANN_STAMPED),
        ("pose", "/vrpn_mocap/car/pose", kinds.POSE),
        ("pose", "/vicon/car/car", kinds.TRANSFORM),
        ("odom", "/diff_drive_controller/odom", kinds.ODOMETRY),
        ("odom", "/odometry/filtered", kinds.ODOMETRY),
    ],
)
def test_usual_names_of_other_robots_are_known(role, topic, kind):
    types = {"/cmd_vel": kinds.TWIST, "/odom": kinds.ODOMETRY}
    types.pop({"cmd_vel": "/cmd_vel", "odom": "/odom"}.get(role, ""), None)
    assert assign(TopicRoles(), types | {topic: kind}, (), "drive")[role] == topic


def test_motion_capture_goes_before_odometry_and_none_takes_it_away():
    types = USUAL | {"/mocap/car": kinds.POSE}
    found = assign(TopicRoles(), types, (), "drive")
    assert found["pose"] == "/mocap/car"
    assert "odom" not in found
    assert assign(TopicRoles(pose="none"), types, (), "drive")["odom"] == "/odom"
    given = assign(TopicRoles(cmd_vel="x"), types | {"/x": kinds.TWIST}, (), "drive")
    assert given["cmd_vel"] == "/x"


def test_what_is_measured_is_no_command():
    """A motion capture publishes twists too."""
    types = {"/vrpn_mocap/car/twist": kinds.TWIST_STAMPED, "/odom": kinds.ODOMETRY}
    sentence = refused(types)
    assert "no topic is known to hold the commands" in sentence
    assert "for example with --topic cmd_vel=/vrpn_mocap/car/twist" in sentence


def test_several_topics_for_a_role_are_listed_with_what_to_write():
    sentence = refused(USUAL | {"/b/cmd_vel": kinds.TWIST_STAMPED})
    assert (
        "/b/cmd_vel (geometry_msgs/msg/TwistStamped), /cmd_vel (geometry_msgs"
        in sentence
    )
    assert sentence.endswith("choose one with --topic cmd_vel=/b/cmd_vel.")
    sentence = refused(USUAL | {"/imu": kinds.IMU})
    assert sentence.endswith("choose one with --topic imu=/imu, or imu=none for none.")


def test_without_poses_the_topics_are_listed_with_their_types():
    sentence = refused(
        {"/cmd_vel": kinds.TWIST, "/tf": kinds.TRANSFORMS, "/a": "a/msg/A"}
    )
    assert (
        "no topic is known to hold the poses; name one, for example with --topic pose=/tf"
        in sentence
    )
    assert sentence.endswith(
        "its topics are /tf (tf2_msgs/msg/TFMessage), /a (a/msg/A), /cmd_vel "
        "(geometry_msgs/msg/Twist)."
    )


def test_an_empty_topic_plays_no_role():
    sentence = refused(USUAL, empty=("/cmd_vel",))
    assert "record one of type geometry_msgs/msg/Twist, " in sentence
    assert "which `nics inspect BAG --map my.yaml` drafts" in sentence
    assert "no topic is known to hold the commands" in sentence
    assert "/cmd_vel (geometry_msgs/msg/Twist, empty)" in sentence
    sentence = refused(USUAL, empty=("/cmd_vel",), cmd_vel="/cmd_vel")
    assert "holds no messages of the topic '/cmd_vel' (cmd_vel)" in sentence
    assert "imu" not in assign(TopicRoles(), USUAL, ("/imu/data",), "drive")


def test_a_topic_that_is_not_there_or_of_a_wrong_type_is_refused():
    assert "has no topic '/cmd' (cmd_vel)" in refused(USUAL, cmd_vel="/cmd")
    sentence = refused(USUAL, cmd_vel="/odom")
    assert (
        "'/odom' is of type nav_msgs/msg/Odometry; cmd_vel must be one of" in sentence
    )


def test_the_list_of_many_topics_is_cut_short():
    many = {f"/camera/{k:03}": "sensor_msgs/msg/Image" for k in range(200)}
    sentence = refused(many | {"/odom": kinds.ODOMETRY})
    assert sentence.endswith("and 181 more.")


def test_the_options_go_before_the_file(tmp_path):
    file = tmp_path / "topics.yaml"
    file.write_text(
        "cmd_vel: /drive\npose: /tf\nframe: world\nchild_frame: car\n"
        "state: {speed: {joint: wheel, scale: 0.05}, steering: rack}\n"
        "wheels: [left, right]\nstamps: receive\n",
        encoding="utf-8",
    )
    roles = load_topic_roles(file, ["pose=/vrpn/pose", "imu = none"])
    assert (roles.cmd_vel, roles.pose, roles.imu) == ("/drive", "/vrpn/pose", "none")
    assert roles.wheels == ("left", "right")
    assert roles.state["steering"] == "rack"
    assert roles.state["speed"].scale == 0.05  # type: ignore[union-attr]
    assert load_topic_roles() == TopicRoles()


def test_the_example_of_the_docs_is_a_mapping(tmp_path):
    page = Path(__file__).parents[2] / "docs" / "recordings.md"
    text = page.read_text(encoding="utf-8")
    (example,) = re.findall(r"```yaml\n(cmd_vel.*?)```", text, re.DOTALL)
    (tmp_path / "topics.yaml").write_text(example, encoding="utf-8")
    roles = load_topic_roles(tmp_path / "topics.yaml")
    assert set(roles.state) == {"speed", "steering"}


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (["cmd_vel"], "must be ROLE=TOPIC"),
        (["cmd_vel="], "must be ROLE=TOPIC"),
        (["cmd_val=/a"], "unknown role 'cmd_val'; did you mean 'cmd_vel'?"),
        (["odom=/a", "odom=/b"], "odom was given before"),
    ],
)
def test_a_wrong_option_is_refused(options, sentence):
    with pytest.raises(ConfigError) as caught:
        load_topic_roles(None, options)
    assert sentence in str(caught.value)


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("cmd_val: /a", "unknown key 'cmd_val'; did you mean 'cmd_vel'?"),
        ("stamps: sent", "key 'stamps'"),
        ("wheels: [left]", "key 'wheels"),
        ("state: {speed: {joynt: a}}", "state.speed"),
    ],
)
def test_a_wrong_file_is_refused(tmp_path, text, sentence):
    file = tmp_path / "topics.yaml"
    file.write_text(text, encoding="utf-8")
    with pytest.raises(ConfigError) as caught:
        load_topic_roles(file)
    assert sentence in str(caught.value)
    assert str(caught.value).startswith(str(file))


@pytest.mark.parametrize(
    ("names", "kind", "measured_by"),
    [
        (["/odom"], kinds.ODOMETRY, "odometry"),
        (["/husky_velocity_controller/odom"], kinds.ODOMETRY, "odometry"),
        (["/ground_truth"], kinds.ODOMETRY, "tracker"),
        (["/vrpn/car/pose"], kinds.POSE, "tracker"),
        (["/pose"], kinds.POSE, "tracker"),
        (["/tf", "map"], kinds.TRANSFORMS, "tracker"),
        (["/tf", "odom"], kinds.TRANSFORMS, "odometry"),
        (["pfPoseData.csv", "x"], "", "tracker"),
        (["vicon x"], "", "tracker"),
        (["x(m)"], "", ""),
    ],
)
def test_the_names_tell_what_measured_a_pose(names, kind, measured_by):
    assert guess_source_by_names(names, kind) == measured_by
