from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rosbags", reason="needs the extra 'bags'")
import bags
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from nics_drl_bridge.config import parse_yaml
from nics_drl_bridge.errors import RecordingError
from nics_drl_bridge.recording.bag_file import open_bag
from nics_drl_bridge.recording.guess import propose_mapping
from nics_drl_bridge.recording.mapping import Mapping
from nics_drl_bridge.recording.readers import open_source, read_recording
from nics_drl_bridge.recording.survey import inspect_tables
from nics_drl_bridge.robot.spec import load_robot

FOREIGN = "my_car_msgs/msg/Drive"
DEFINITION = "std_msgs/Header header\nfloat32[3] motor\nbool armed\nstring mode\n"


def read(path, **given):
    return read_recording(
        path, mapping=Mapping.model_validate({"pose": "/pose"} | given)
    )


def ros_1_bag(path: Path) -> Path:
    """A bag of ROS 1: a throttle without stamps at 10 Hz, poses with stamps at 50 Hz."""
    store = get_typestore(Stores.ROS1_NOETIC)
    header = store.types["std_msgs/msg/Header"]
    time = store.types["builtin_interfaces/msg/Time"]
    with Ros1Writer(path) as writer:
        kinds = {"/throttle": "std_msgs/msg/Float32", "/pose": bags.kinds.POSE}
        topics = {
            t: writer.add_connection(t, kind, typestore=store)
            for t, kind in kinds.items()
        }
        for k, t in enumerate(bags.times()):
            x, y, yaw = bags.place_at(t)
            stamp = time(*divmod(bags.ns(t - 0.003), 10**9))
            pose = store.types[bags.kinds.POSE](
                header(k, stamp, "map"), bags.pose(x, y, yaw)
            )
            raw = store.serialize_ros1(pose, bags.kinds.POSE)
            writer.write(topics["/pose"], bags.ns(t), raw)
            if k % 5 == 0:
                value = store.types["std_msgs/msg/Float32"](0.5 + t)
                raw = store.serialize_ros1(value, "std_msgs/msg/Float32")
                writer.write(topics["/throttle"], bags.ns(t), raw)
    return path


def foreign_bag(path: Path) -> Path:
    """A rosbag2 with a type that only its own definition explains."""
    store = get_typestore(Stores.ROS2_JAZZY)
    store.register(get_types_from_msg(DEFINITION, FOREIGN))
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        drive = writer.add_connection("/drive", FOREIGN, typestore=store)
        poses = writer.add_connection("/pose", bags.kinds.POSE, typestore=store)
        for t in bags.times():
            armed = t > 1.0
            motor = np.array([0.0, t, 2.0 * t], np.float32)
            mode = "auto" if armed else "manual"
            message = store.types[FOREIGN](bags.header(t - 0.001), motor, armed, mode)
            writer.write(drive, bags.ns(t), store.serialize_cdr(message, FOREIGN))
            pose = bags.pose_stamped(t - 0.002, *bags.place_at(t))
            writer.write(poses, bags.ns(t), store.serialize_cdr(pose, bags.kinds.POSE))
    return path


def test_a_bag_of_ros_1_is_read_by_any_number_in_it(tmp_path):
    found = read(
        ros_1_bag(tmp_path / "drive.bag"), command={"throttle": "/throttle:data"}
    )
    assert np.allclose(found.command.values[:, 0], 0.5 + np.array(bags.times())[::5])
    assert np.allclose(found.pose.values[-1], bags.place_at(bags.times()[-1]))
    # Poses by header, the rest by arrival: of one clock, as the headers are 3 ms older only.
    assert found.command.t[0] - found.pose.t[0] == pytest.approx(0.003)
    assert found.command.clock == found.pose.clock


def test_a_bag_of_ros_1_is_read_by_roles_of_topics_too(tmp_path):
    with pytest.raises(RecordingError, match="no topic is known to hold the commands"):
        read_recording(ros_1_bag(tmp_path / "drive.bag"), load_robot("ackermann"))
    with open_bag(tmp_path / "drive.bag") as bag:
        (_, first), *_ = bag.read_serialized("/pose")
    x = bags.STORE.deserialize_cdr(first, bags.kinds.POSE).pose.position.x
    assert x == pytest.approx(0.0)


def test_types_that_only_the_bag_knows_are_read_by_field_index_and_flag(tmp_path):
    value = {
        "from": "/drive:motor[2]",
        "when": {"/drive:armed": True, "/drive:mode": "AUTO"},
    }
    found = read(
        foreign_bag(tmp_path / "bag"), command={"a": value, "b": "drive:motor.1"}
    )
    t = np.array(bags.times())
    assert np.allclose(found.command.values[:, 0], np.where(t > 1.0, 2.0 * t, 0.0))
    assert np.allclose(found.command.values[:, 1], t)


@pytest.mark.parametrize(
    ("command", "sentence"),
    [
        ("/drive:motor", "'motor' is no single number; say which, as 'motor[0]'"),
        ("/drive:moter[1]", "has no 'moter[1]'; did you mean 'motor[1]'?"),
        ("/driv:motor[1]", "has no '/driv'; did you mean '/drive'?"),
    ],
)
def test_a_wrong_field_or_topic_is_named(tmp_path, command, sentence):
    with pytest.raises(RecordingError) as refused:
        read(foreign_bag(tmp_path / "bag"), command={"a": command})
    assert sentence in str(refused.value)


def test_joints_are_found_by_name_whatever_their_order_and_where_one_is_missing(
    tmp_path,
):
    def joints(k, t):
        names = [["left", "right"], ["right", "left"], ["left"]][k % 3]
        velocity = [t if name == "left" else -t for name in names]
        return bags.joints(t, names, [0.0] * len(names), velocity)

    rows = [(t, joints(k, t)) for k, t in enumerate(bags.times())]
    bag = bags.write(tmp_path / "bag", {"/pose": bags.poses(), "/joints": rows})
    wheels = {"left": "/joints:velocity[left]", "right": "/joints:velocity[right]"}
    found = read(bag, command=wheels)
    t = np.array(bags.times())
    held = np.where(np.arange(len(t)) % 3 == 2, t - bags.STEP_S, t)
    assert np.allclose(found.command.values, np.stack([t, -held], axis=1))
    assert (
        "command.right: 100 of 300 rows have no value, and were left out."
        in found.repairs
    )


def test_transforms_are_poses_between_two_frames(tmp_path):
    def both(t):
        car = bags.transform(t, bags.place_at(t))
        return bags.transforms(bags.transform(t, (9.0, 9.0, 0.0), child="box"), car)

    rows = [(t, both(t)) for t in bags.times()]
    bag = bags.write(tmp_path / "bag", {"/tf": rows, "/cmd_vel": bags.commands()})
    command = {"v": "/cmd_vel:linear.x"}
    found = read(bag, command=command, pose={"in": "/tf", "child_frame": "car"})
    assert np.allclose(found.pose.values[-1], bags.place_at(bags.times()[-1]))
    with pytest.raises(RecordingError, match="holds several transforms"):
        read(bag, command=command, pose="/tf")


def test_all_times_may_be_those_of_arrival(tmp_path):
    bag = bags.write(
        tmp_path / "bag", {"/pose": bags.poses(offset=5.0), "/v": bags.commands()}
    )
    command = {"v": "/v:linear.x"}
    clocks = read(bag, command=command)
    assert (
        clocks.pose.clock != clocks.command.clock
    )  # the headers are of a foreign clock
    arrived = read(bag, command=command, time="arrival")
    assert arrived.pose.clock == arrived.command.clock


@pytest.mark.parametrize("offset", [0.0, 5.0])
def test_a_clock_that_the_mapping_names_decides(tmp_path, offset):
    bag = bags.write(
        tmp_path / "bag", {"/pose": bags.poses(offset=offset), "/v": bags.commands()}
    )
    command = {"v": "/v:linear.x"}
    own = read(bag, command=command, pose={"in": "/pose", "clock": "mocap"})
    assert (own.pose.clock, own.command.clock) == ("mocap", "robot")
    same = read(bag, command=command, pose={"in": "/pose", "clock": "robot"})
    assert (same.pose.clock, same.command.clock) == ("robot", "robot")


@pytest.mark.parametrize("offset", [0.0, 5.0])
def test_a_pose_by_header_goes_with_commands_that_have_none(tmp_path, offset):
    bag = bags.write(
        tmp_path / "bag", {"/pose": bags.poses(offset=offset), "/v": bags.commands()}
    )
    given = {"command": {"v": "/v:linear.x"}, "pose": {"in": "/pose", "time": "header"}}
    found = read(bag, **given)
    assert (found.pose.clock == found.command.clock) == (offset == 0.0)
    same = read(bag, **given, clock="robot")
    assert same.pose.clock == same.command.clock == "robot"
    assert np.allclose(np.diff(found.pose.t), bags.STEP_S)
    if offset == 0.0:
        assert found.command.t[0] - found.pose.t[0] == pytest.approx(0.002)
    with pytest.raises(
        RecordingError, match="topic '/v': its messages have no header stamps"
    ):
        read(bag, **given, time="header")


def test_the_covariance_of_a_message_gives_deviations(tmp_path):
    rows = [(t, bags.pose_with_covariance(t, *bags.place_at(t))) for t in bags.times()]
    topics = {"/pose": rows, "/v": bags.commands()}
    command = {"v": "/v:linear.x"}
    assert (
        read(bags.write(tmp_path / "none", topics), command=command).pose.sigma is None
    )
    for _, message in rows:
        message.pose.covariance[[0, 7, 35]] = 0.01, 0.04, 0.09
    found = read(bags.write(tmp_path / "some", topics), command=command)
    assert np.allclose(found.pose.sigma, [0.1, 0.2, 0.3])


def test_a_bag_is_surveyed_to_a_first_mapping(tmp_path):
    with open_source(foreign_bag(tmp_path / "bag")) as source:
        tables = {table.name: table for table in inspect_tables(source)}
        guess = parse_yaml(propose_mapping(list(tables.values())).text, "guess")
    assert [column.name for column in tables["/drive"].columns][-2:] == [
        "armed",
        "mode",
    ]
    assert any("50 Hz" in line for line in tables["/pose"].regularity)
    assert guess["pose"] == "/pose"


def test_a_bag_whose_headers_were_set_back_is_stamped_by_arrival_and_says_so(tmp_path):
    store = bags.STORE
    with Writer(
        tmp_path / "set", version=9, storage_plugin=StoragePlugin.MCAP
    ) as writer:
        poses = writer.add_connection("/pose", bags.kinds.POSE, typestore=store)
        speed = writer.add_connection("/speed", "std_msgs/msg/Float32", typestore=store)
        for t in bags.times():
            stamp = t - (30.0 if t > 1.0 else 0.0)
            pose = bags.pose_stamped(stamp, *bags.place_at(t))
            writer.write(poses, bags.ns(t), store.serialize_cdr(pose, bags.kinds.POSE))
            value = store.types["std_msgs/msg/Float32"](t)
            raw = store.serialize_cdr(value, "std_msgs/msg/Float32")
            writer.write(speed, bags.ns(t), raw)
    found = read(tmp_path / "set", command={"v": "/speed:data"})
    assert np.allclose(np.diff(found.pose.t), np.diff(bags.times()))
    assert any("stamped by their arrival" in note for note in found.repairs)
    with pytest.raises(RecordingError, match="run backwards"):
        read(tmp_path / "set", command={"v": "/speed:data"}, time="header")


@pytest.mark.parametrize("rate", [0.2, 5.0])
def test_a_bag_of_simulated_time_at_another_rate_is_stamped_by_its_headers_and_says_so(
    tmp_path, rate
):
    store = bags.STORE
    with Writer(
        tmp_path / "set", version=9, storage_plugin=StoragePlugin.MCAP
    ) as writer:
        topics = ("/pose", "/target")
        poses = [
            writer.add_connection(t, bags.kinds.POSE, typestore=store) for t in topics
        ]
        for t in bags.times():
            message = bags.pose_stamped(100.0 + t, *bags.place_at(t))
            raw = store.serialize_cdr(message, bags.kinds.POSE)
            for topic in poses:
                writer.write(topic, bags.ns(t / rate), raw)
    found = read(tmp_path / "set", command={"v": "/target:pose.position.x"})
    assert np.allclose(np.diff(found.pose.t), np.diff(bags.times()))
    assert any(
        "stamped by their headers, which go on together" in note
        for note in found.repairs
    )
