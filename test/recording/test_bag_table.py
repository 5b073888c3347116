from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rosbags", reason="needs the extra 'bags'")
import bags
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from nics_drl_bridge.config import parse_yaml
from nics_drl_bridge.errors import RecordingError
from nics_drl_bridge.recording.bag_file import open_bag
from nics_drl_bridge.recording.mapping import DriveMapping
from nics_drl_bridge.recording.mapping_draft import propose_mapping
from nics_drl_bridge.recording.readers import open_source, read_recording
from nics_drl_bridge.recording.survey import inspect_tables
from nics_drl_bridge.robot.spec import load_robot

FOREIGN = "my_car_msgs/msg/Drive"
DEFINITION = "std_msgs/Header header\nfloat32[3] motor\nbool armed\nstring mode\n"


def read(path, text):
    """Reads a bag by a mapping in YAML, with the pose of /pose."""
    given = {"pose": "/pose"} | parse_yaml(text, "mapping")
    return read_recording(path, mapping=DriveMapping.model_validate(given))


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
    drive = []
    poses = []
    for t in bags.times():
        motor = np.array([0.0, t, 2.0 * t], np.float32)
        armed = t > 1.0
        mode = "auto" if armed else "manual"
        about = (bags.header(t - 0.001), motor, armed, mode)
        drive.append((t, store.types[FOREIGN](*about)))
        poses.append((t, bags.pose_stamped(t - 0.002, *bags.place_at(t))))
    return bags.write(path, {"/drive": drive, "/pose": poses}, store=store)


def test_a_bag_of_ros_1_is_read_by_any_number_in_it(tmp_path):
    path = ros_1_bag(tmp_path / "drive.bag")
    found = read(path, "command: {throttle: '/throttle:data'}")
    assert np.allclose(found.command.values[:, 0], 0.5 + np.array(bags.times())[::5])
    assert np.allclose(found.pose.values[-1], bags.place_at(bags.times()[-1]))
    # Poses by header, the rest by arrival: of one clock, as the headers are 3 ms older only.
    assert found.command.t[0] - found.pose.t[0] == pytest.approx(0.003)
    assert found.command.clock == found.pose.clock
    with pytest.raises(RecordingError, match="no topic is known to hold the commands"):
        read_recording(path, load_robot("ackermann"))
    with open_bag(path) as bag:
        (_, first), *_ = bag.read_serialized("/pose")
    x = bags.STORE.deserialize_cdr(first, bags.kinds.POSE).pose.position.x
    assert x == pytest.approx(0.0)


def test_types_that_only_the_bag_knows_are_read_by_field_index_and_flag(tmp_path):
    path = foreign_bag(tmp_path / "bag")
    when = "{'/drive:armed': true, '/drive:mode': AUTO}"
    value = f"{{from: '/drive:motor[2]', when: {when}}}"
    found = read(path, f"command: {{a: {value}, b: 'drive:motor.1'}}")
    t = np.array(bags.times())
    assert np.allclose(found.command.values[:, 0], np.where(t > 1.0, 2.0 * t, 0.0))
    assert np.allclose(found.command.values[:, 1], t)
    for command, sentence in (
        ("/drive:motor", "choose one, such as 'motor[0]'"),
        ("/drive:moter[1]", "did you mean 'motor[1]'?"),
        ("/driv:motor[1]", "did you mean '/drive'?"),
    ):
        with pytest.raises(RecordingError) as refused:
            read(path, f"command: {{a: '{command}'}}")
        assert sentence in str(refused.value)


def test_joints_are_found_by_name_whatever_their_order_and_where_one_is_missing(
    tmp_path,
):
    def joints(k, t):
        names = [["left"], ["right", "left"], ["left", "right"]][k % 3]
        velocity = [t if name == "left" else -t for name in names]
        return bags.joints(t, names, [0.0] * len(names), velocity)

    rows = [(t, joints(k, t)) for k, t in enumerate(bags.times())]
    bag = bags.write(tmp_path / "bag", {"/pose": bags.poses(), "/joints": rows})
    wheels = "left: '/joints:velocity[left]', right: '/joints:velocity[right]'"
    found = read(bag, f"command: {{{wheels}}}")
    t = np.array(bags.times())[1:]
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

    rows = bags.every(bags.STEP_S, both)
    bag = bags.write(tmp_path / "bag", {"/tf": rows, "/cmd_vel": bags.commands()})
    pose = "pose: {in: /tf, child_frame: car}"
    found = read(bag, f"command: {{v: '/cmd_vel:linear.x'}}\n{pose}")
    assert np.allclose(found.pose.values[-1], bags.place_at(bags.times()[-1]))


COMMAND = "command: {v: '/v:linear.x'}\n"
MOCAP = "pose: {in: /pose, clock: mocap}"
BY_HEADER = "pose: {in: /pose, time: header}"


@pytest.mark.parametrize(
    ("offset", "mapping", "clocks"),
    [
        (5.0, "", ("header", "robot")),  # the headers are of a foreign clock
        (5.0, "time: arrival", ("robot", "robot")),
        (0.0, MOCAP, ("mocap", "robot")),
        (5.0, MOCAP.replace("mocap", "robot"), ("robot", "robot")),
        (0.0, BY_HEADER, ("robot", "robot")),
        (5.0, BY_HEADER, ("header", "robot")),
        (5.0, f"{BY_HEADER}\nclock: robot", ("robot", "robot")),
    ],
)
def test_pose_and_commands_are_on_the_clock_that_mapping_or_headers_say(
    tmp_path, offset, mapping, clocks
):
    topics = {"/pose": bags.poses(offset=offset), "/v": bags.commands()}
    bag = bags.write(tmp_path / "bag", topics)
    found = read(bag, COMMAND + mapping)
    assert (found.pose.clock, found.command.clock) == clocks
    assert np.allclose(np.diff(found.pose.t), bags.STEP_S)
    if offset == 0.0:
        assert found.command.t[0] - found.pose.t[0] == pytest.approx(0.002)
    if mapping == BY_HEADER:
        with pytest.raises(RecordingError, match="have no header stamps"):
            read(bag, f"{COMMAND}{mapping}\ntime: header")


def test_the_covariance_of_a_message_gives_deviations(tmp_path):
    rows = bags.along(bags.pose_with_covariance)
    topics = {"/pose": rows, "/v": bags.commands()}
    assert read(bags.write(tmp_path / "none", topics), COMMAND).pose.sigma is None
    for _, message in rows:
        message.pose.covariance[[0, 7, 35]] = 0.01, 0.04, 0.09
    found = read(bags.write(tmp_path / "some", topics), COMMAND)
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
    poses = bags.along(lambda t, *at: bags.pose_stamped(t - 30.0 * (t > 1.0), *at))
    bag = bags.write(tmp_path / "set", {"/pose": poses, "/v": bags.commands()})
    found = read(bag, COMMAND)
    assert np.allclose(np.diff(found.pose.t), np.diff(bags.times()))
    assert any("stamped by their arrival" in note for note in found.repairs)
    with pytest.raises(RecordingError, match="run backwards"):
        read(bag, f"{COMMAND}time: header")


@pytest.mark.parametrize("rate", [0.2, 5.0])
def test_a_bag_of_simulated_time_at_another_rate_is_stamped_by_its_headers_and_says_so(
    tmp_path, rate
):
    rows = [
        (t / rate, bags.pose_stamped(100.0 + t, *bags.place_at(t)))
        for t in bags.times()
    ]
    bag = bags.write(tmp_path / "set", {"/pose": rows, "/target": rows})
    found = read(bag, "command: {v: '/target:pose.position.x'}")
    assert np.allclose(np.diff(found.pose.t), np.diff(bags.times()))
    assert any(
        "stamped by their headers, which go on together" in note
        for note in found.repairs
    )
