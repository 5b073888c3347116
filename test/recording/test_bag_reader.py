from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("rosbags", reason="needs the extra 'bags'")

import bags

from nics_drl_bridge.errors import RecordingError
from nics_drl_bridge.recording.readers import read_recording
from nics_drl_bridge.recording.topic_roles import TopicRoles
from nics_drl_bridge.robot.spec import load_robot

CAR, CART = load_robot("ackermann"), load_robot("differential")
PLACES = np.array([bags.place_at(t) for t in bags.times()])
NAMES = ["rear_left_wheel_joint", "front_left_steering_joint"]


def read(tmp_path, topics, spec=CAR, storage="mcap", **roles):
    bag = bags.write(tmp_path / "bag", topics, storage)
    return read_recording(bag, spec, TopicRoles.model_validate(roles))


def refused(tmp_path, topics, spec=CAR, **roles) -> str:
    with pytest.raises(RecordingError) as caught:
        read(tmp_path, topics, spec, **roles)
    sentence = str(caught.value)
    assert sentence.startswith(str(tmp_path / "bag"))
    assert sentence.endswith(".")
    assert "\n" not in sentence
    return sentence


COMMANDS = {
    "Twist": lambda t: bags.twist(0.5, 0.0, 0.1),
    "TwistStamped": lambda t: bags.twist_stamped(t, 0.5, 0.0, 0.1),
    "AckermannDrive": lambda t: bags.ackermann(0.5, 0.1),
    "AckermannDriveStamped": lambda t: bags.ackermann_stamped(t, 0.5, 0.1),
}
POSES = {
    "PoseStamped": bags.pose_stamped,
    "PoseWithCovarianceStamped": bags.pose_with_covariance,
    "TransformStamped": lambda t, *place: bags.transform(t, place),
    "TFMessage": lambda t, *place: bags.transforms(bags.transform(t, place)),
    "Odometry": bags.odometry,
}


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
@pytest.mark.parametrize("kind", COMMANDS)
def test_every_kind_of_command_is_read(tmp_path, kind, storage):
    command = [(t, COMMANDS[kind](t)) for t in bags.times(0.1)]
    recording = read(tmp_path, {"/cmd_vel": command, "/pose": bags.poses()}, storage=storage)
    assert np.allclose(recording.command.values, [0.5, 0.1])
    assert np.allclose(recording.command.t - recording.command.t[0], bags.times(0.1))


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
@pytest.mark.parametrize("kind", POSES)
def test_every_kind_of_pose_is_read(tmp_path, kind, storage):
    pose = [(t, POSES[kind](t, *bags.place_at(t))) for t in bags.times()]
    topics = {"/cmd_vel": bags.commands(), "/where": pose}
    recording = read(tmp_path, topics, storage=storage, pose="/where")
    assert np.allclose(recording.pose.values[:, :2], PLACES[:, :2])
    assert np.allclose(np.exp(1j * recording.pose.values[:, 2]), np.exp(1j * PLACES[:, 2]))
    assert np.allclose(recording.pose.t, bags.times())


def test_steering_angles_are_refused_for_a_robot_that_has_none(tmp_path):
    command = [(t, bags.ackermann(0.5, 0.1)) for t in bags.times(0.1)]
    topics = {"/cmd_vel": command, "/pose": bags.poses()}
    assert "holds steering angles" in refused(tmp_path, topics, CART)


def several_bodies():
    """What a robot's /tf holds: odometry, a wheel, and the motion capture's view of two bodies."""
    return [
        (
            t,
            bags.transforms(
                bags.transform(t, (0.0, 0.0, 0.0), "odom", "base_link"),
                bags.transform(t, (0.0, 0.1, t), "base_link", "wheel"),
                bags.transform(t, bags.place_at(t), "/mocap", "base_link"),
                bags.transform(t, (5.0, 5.0, 0.0), "mocap", "ball"),
            ),
        )
        for t in bags.times()
    ]


def test_the_robot_is_found_among_the_transforms_of_many(tmp_path):
    topics = {"/cmd_vel": bags.commands(), "/tf": several_bodies()}
    recording = read(tmp_path, topics, pose="/tf", frame="mocap", child_frame="/base_link")
    assert np.allclose(recording.pose.values[:, :2], PLACES[:, :2])


@pytest.mark.parametrize(
    ("named", "sentence"),
    [
        ({}, "holds several transforms;"),
        ({"child_frame": "base_link"}, "holds several transforms with the given names;"),
        ({"child_frame": "robot"}, "holds no transform with the given names;"),
        ({"frame": "map"}, "holds no transform with the given names;"),
    ],
)
def test_transforms_that_could_be_of_several_bodies_are_listed(tmp_path, named, sentence):
    topics = {"/cmd_vel": bags.commands(), "/tf": several_bodies()}
    told = refused(tmp_path, topics, pose="/tf", **named)
    assert sentence in told
    assert "mocap -> ball, mocap -> base_link, odom -> base_link" in told


def test_messages_without_any_transform_are_refused(tmp_path):
    nothing = [(t, bags.transforms()) for t in bags.times()]
    topics = {"/cmd_vel": bags.commands(), "/tf": nothing}
    assert "holds no transform" in refused(tmp_path, topics, pose="/tf")


def moving_joints(t: float):
    """A car's joints: the wheel of 5 cm at 0.5 m/s, and the steering."""
    return bags.joints(t, NAMES, (10.0 * t, 0.1), (10.0, 0.0))


def test_the_state_is_read_from_the_joints_that_the_mapping_names(tmp_path):
    topics = bags.drive() | {"/joint_states": [(t, moving_joints(t)) for t in bags.times()]}
    speed = {"joint": NAMES[0], "field": "velocity", "scale": 0.05}
    state = read(tmp_path, topics, state={"speed": speed, "steering": NAMES[1]}).state
    assert state is not None
    assert np.allclose(state.values, [0.5, 0.1])


def test_wheel_speeds_are_read_from_the_joints_that_the_mapping_names(tmp_path):
    joints = [(t, bags.joints(t, ["a", "b"], (0.0, 0.0), (9.0, 11.0))) for t in bags.times()]
    wheels = read(tmp_path, bags.drive() | {"/joint_states": joints}, wheels=["b", "a"]).wheels
    assert wheels is not None
    assert np.allclose(wheels.values, [11.0, 9.0])


def test_the_imu_is_read(tmp_path):
    imu = [(t, bags.imu(t, 0.1, 0.2, 0.3)) for t in bags.times()]
    read_back = read(tmp_path, bags.drive() | {"/imu": imu}).imu
    assert read_back is not None
    assert np.allclose(read_back.values, [0.1, 0.2, 0.3])


@pytest.mark.parametrize("topic", ["/cmd_vel", "/pose", "/imu"])
def test_a_message_with_nan_is_named(tmp_path, topic):
    topics = bags.drive() | {"/imu": [(t, bags.imu(t, 0.1, 0.2, 0.3)) for t in bags.times()]}
    bad = {
        "/cmd_vel": bags.twist(np.nan, 0.0, 0.0),
        "/pose": bags.pose_stamped(7 * bags.STEP_S, np.inf, 0.0, 0.0),
        "/imu": bags.imu(7 * bags.STEP_S, 0.0, np.nan, 0.0),
    }
    topics[topic][7] = (topics[topic][7][0], bad[topic])
    assert f"topic '{topic}': message 7 holds NaN or inf" in refused(tmp_path, topics)


@pytest.mark.parametrize("length", [0.0, np.nan, 1e200])
def test_a_quaternion_that_is_none_is_named(tmp_path, length):
    topics = bags.drive()
    topics["/pose"][3][1].pose.orientation.w = length
    assert "message 3: the quaternion has the length" in refused(tmp_path, topics)


def test_a_topic_of_a_type_that_nobody_knows_is_left_alone(tmp_path):
    bag = tmp_path / "bag"
    with bags.Writer(bag, version=9, storage_plugin=bags.StoragePlugin.MCAP) as writer:
        for topic, rows in bags.drive().items():
            kind = rows[0][1].__msgtype__
            connection = writer.add_connection(topic, kind, typestore=bags.STORE)
            for t, message in rows:
                writer.write(connection, bags.ns(t), bags.STORE.serialize_cdr(message, kind))
        strange = writer.add_connection(
            "/strange", "my_msgs/msg/Own", msgdef="int32 x", rihs01="RIHS01_00"
        )
        writer.write(strange, bags.ns(1.0), b"\x00\x01\x00\x00\x01\x00\x00\x00")
    assert len(read_recording(bag, CAR).command.t) == len(bags.commands())
    with pytest.raises(RecordingError, match="is of type my_msgs/msg/Own; cmd_vel must be one of"):
        read_recording(bag, CAR, TopicRoles(cmd_vel="/strange"))


def test_a_bag_without_a_robot_is_refused(tmp_path):
    with pytest.raises(RecordingError, match="RobotSpec"):
        read_recording(bags.write(tmp_path / "bag", bags.drive()))


def test_topics_for_what_is_no_bag_are_refused(tmp_path):
    (tmp_path / "drive.npz").write_bytes(b"")
    with pytest.raises(RecordingError, match="leave out --topics and --topic"):
        read_recording(tmp_path / "drive.npz", CAR, TopicRoles(pose="/pose"))


def test_odometry_named_beside_a_pose_shows_its_twist(tmp_path):
    odometry = [(t, bags.odometry(t, *bags.place_at(t))) for t in bags.times()]
    topics = {"/cmd_vel": bags.commands(), "/pose": bags.poses(), "/odom": odometry}
    recording = read(tmp_path, topics, odom="/odom")
    assert recording.odometry is not None
    assert recording.odometry.values.shape == (len(odometry), 3)
    assert np.allclose(recording.pose.values[:, :2], PLACES[:, :2])
