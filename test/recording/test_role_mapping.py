import pytest

pytest.importorskip("rosbags", reason="needs the extra 'bags'")

import bags
import numpy as np

from nics_drl_bridge.config import parse_yaml
from nics_drl_bridge.errors import ConfigError, RecordingError
from nics_drl_bridge.recording.bag_file import Message, open_bag
from nics_drl_bridge.recording.bag_table import Bag, select_transforms
from nics_drl_bridge.recording.mapping import DriveMapping
from nics_drl_bridge.recording.readers import read_recording
from nics_drl_bridge.recording.role_mapping import read_joint_streams, write_mapping
from nics_drl_bridge.recording.topic_roles import TopicRoles
from nics_drl_bridge.recording.write import open_bag_sink
from nics_drl_bridge.robot.spec import build_robot, load_robot

CAR = load_robot("ackermann")
CART = load_robot("differential")
PLACES = np.array([bags.place_at(t) for t in bags.times()])


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


TURNING = CAR.model_copy(update={"angular_is": "turn_rate"})


@pytest.mark.parametrize(
    ("kind", "storage", "spec", "angle"),
    [
        *((kind, "mcap", CAR, 0.1) for kind in COMMANDS),
        ("Twist", "sqlite3", CAR, 0.1),
        ("Twist", "mcap", TURNING, np.arctan(0.04)),
        ("AckermannDrive", "mcap", TURNING, 0.1),
    ],
)
def test_every_kind_of_command_is_read(tmp_path, kind, storage, spec, angle):
    command = bags.every(0.1, COMMANDS[kind])
    topics = {"/cmd_vel": command, "/pose": bags.poses()}
    recording = read(tmp_path, topics, spec, storage)
    assert np.allclose(recording.command.values, [0.5, angle])
    assert np.allclose(recording.command.t - recording.command.t[0], bags.times(0.1))


@pytest.mark.parametrize("kind", POSES)
def test_every_kind_of_pose_is_read(tmp_path, kind):
    pose = bags.along(POSES[kind])
    topics = {"/cmd_vel": bags.commands(), "/where": pose}
    recording = read(tmp_path, topics, pose="/where")
    assert np.allclose(recording.pose.values[:, :2], PLACES[:, :2])
    assert np.allclose(
        np.exp(1j * recording.pose.values[:, 2]), np.exp(1j * PLACES[:, 2])
    )
    assert np.allclose(recording.pose.t, bags.times())


def test_a_mapping_may_name_a_topic_of_commands(tmp_path):
    bag = bags.write(tmp_path / "bag", bags.drive())
    mapping = DriveMapping.model_validate({"command": "/cmd_vel", "pose": "/pose"})
    by_roles = read_recording(bag, CAR)
    mapped = read_recording(bag, CAR, mapping=mapping)
    for name, stream in by_roles.streams.items():
        assert np.array_equal(stream.values, mapped.streams[name].values)
        assert np.array_equal(stream.t, mapped.streams[name].t)
    with pytest.raises(ConfigError, match="only of a known robot"):
        read_recording(bag, mapping=mapping)


def test_steering_angles_are_refused_for_a_robot_that_has_none(tmp_path):
    command = bags.every(0.1, COMMANDS["AckermannDrive"])
    topics = {"/cmd_vel": command, "/pose": bags.poses()}
    assert "holds steering angles" in refused(tmp_path, topics, CART)


BODIES = bags.transforms(
    bags.transform(0.0, (0.0, 0.0, 0.0), "odom", "base_link"),
    bags.transform(0.0, (0.0, 0.1, 0.2), "base_link", "wheel"),
    bags.transform(0.0, (1.0, 2.0, 0.0), "/mocap", "base_link"),
    bags.transform(0.0, (5.0, 5.0, 0.0), "mocap", "ball"),
)


@pytest.mark.parametrize(
    ("frames", "content", "fault"),
    [
        (("mocap", "/base_link"), BODIES, ""),
        ((None, None), BODIES, "several transforms;"),
        ((None, "base_link"), BODIES, "several transforms with the given names;"),
        ((None, "robot"), BODIES, "no transform with the given names;"),
        (("map", None), BODIES, "no transform with the given names;"),
        ((None, None), bags.transforms(), "no transform"),
    ],
)
def test_the_robot_is_found_among_transforms_or_all_are_listed(frames, content, fault):
    messages = [Message(k, content) for k in range(3)]
    if not fault:
        found = select_transforms("drive", messages, *frames)
        assert [m.content.transform.translation.x for m in found] == [1.0] * 3
        return
    with pytest.raises(RecordingError, match=f"drive holds {fault}") as caught:
        select_transforms("drive", messages, *frames)
    listed = "mocap -> ball, mocap -> base_link, odom -> base_link"
    assert (listed in str(caught.value)) == (content is BODIES)


def test_roles_write_a_mapping_with_the_joints_and_the_gyro(tmp_path):
    names = ["rear_left_wheel_joint", "front_left_steering_joint"]
    joints = bags.joints(0.0, names, (0.0, 0.1), (10.0, 0.0))
    topics = {
        "/cmd_vel": [(0.0, bags.twist(0.5, 0.0, 0.1))],
        "/where": [(0.0, bags.pose_stamped(0.0, 0.0, 0.0, 0.0))],
        "/odom": [(0.0, bags.odometry(0.0, 0.0, 0.0, 0.0))],
        "/joint_states": [(0.0, joints)],
        "/imu": [(0.0, bags.imu(0.0, 0.1, 0.2, 0.3))],
    }
    speed = {"joint": names[0], "field": "velocity", "scale": 0.05}
    roles = TopicRoles.model_validate(
        {
            "pose": "/where",
            "odom": "/odom",
            "state": {"speed": speed, "steering": names[1]},
            "wheels": names,
            "stamps": "receive",
        }
    )
    bag = bags.write(tmp_path / "bag", topics)
    with open_bag(bag) as file:
        mapping = write_mapping(roles, Bag(file), CAR)
    assert mapping == DriveMapping.model_validate(
        parse_yaml(
            f"""
            time: arrival
            pose: {{in: /where, covariance: ""}}
            command: /cmd_vel
            state:
              speed: {{from: "/joint_states:velocity[{names[0]}]", scale: 0.05, unit: m/s}}
              steering: {{from: "/joint_states:position[{names[1]}]", unit: rad}}
            wheels: {{in: /joint_states, left: "velocity[{names[0]}]", right: "velocity[{names[1]}]"}}
            odometry:
              {{in: /odom, vx: twist.twist.linear.x, vy: twist.twist.linear.y, wz: twist.twist.angular.z}}
            imu:
              in: /imu
              ax: linear_acceleration.x
              ay: linear_acceleration.y
              yaw_rate: angular_velocity.z
            """,  # noqa: E501
            "mapping",
        )
    )


def test_a_topic_of_a_type_that_nobody_knows_is_left_alone(tmp_path):
    with open_bag_sink(tmp_path / "bag") as sink:
        sink.add_topic("/strange", "my_msgs/msg/Own", definition="of no known form")
        sink.write("/strange", bags.ns(1.0), bytes(8))
        for topic, rows in bags.drive().items():
            kind = rows[0][1].__msgtype__
            sink.add_topic(topic, kind)
            for t, message in rows:
                data = bags.STORE.serialize_cdr(message, kind)
                sink.write(topic, bags.ns(t), bytes(data))
    drive = read_recording(tmp_path / "bag", CAR)
    assert len(drive.command.t) == len(bags.commands())


def test_a_bag_without_a_robot_is_refused(tmp_path):
    with pytest.raises(RecordingError, match="RobotSpec"):
        read_recording(bags.write(tmp_path / "bag", bags.drive()))


def test_topics_for_what_is_no_bag_are_refused(tmp_path):
    (tmp_path / "drive.npz").write_bytes(b"")
    with pytest.raises(RecordingError, match="remove --topics and --topic"):
        read_recording(tmp_path / "drive.npz", CAR, TopicRoles(pose="/pose"))


MECANUM = load_robot("mecanum")
ARM = (("elbow",), (0.0,), (1.0,))
BOTH = ("left_wheel", "right_wheel")


def joints(*messages, spec=CART, **roles):
    """State and wheels of messages (names, positions, velocities)."""
    kind = "sensor_msgs/msg/JointState"
    made = [
        Message(k, bags.new(kind, bags.header(k), names, position, velocity, ()))
        for k, (names, position, velocity) in enumerate(messages)
    ]
    given = TopicRoles.model_validate(roles)
    streams = read_joint_streams("/joint_states", made, spec, given, "drive")
    return {name: data.values.tolist() for name, data in streams.items()}


@pytest.mark.parametrize(
    "names",
    [
        BOTH,
        ("wheel_left_joint", "wheel_right_joint"),
        ("base/Left_Wheel", "base/Right_Wheel"),
        ("bot.left_wheel", "bot.right_wheel"),
    ],
)
def test_wheels_are_known_by_the_words_of_their_names(names):
    found = joints((names, (0.0, 0.0), (1.0, 2.0)), (names, (0.1, 0.2), (3.0, 4.0)))
    assert found["state"] == found["wheels"] == [[1.0, 2.0], [3.0, 4.0]]


@pytest.mark.parametrize("names", [("1", "0"), ("11", "12")])
def test_a_joint_whose_name_is_a_number_is_found_by_its_name(names):
    state = dict(zip(BOTH, names, strict=True))
    found = joints((names, (0.0, 0.0), (1.0, 2.0)), state=state)
    assert found["state"] == [[1.0, 2.0]]


def test_wheels_in_another_order_are_put_in_the_robots():
    names = [
        f"{end}_{side}_wheel" for end in ("rear", "front") for side in ("right", "left")
    ]
    found = joints((names, np.zeros(4), (4.0, 3.0, 2.0, 1.0)), spec=MECANUM)
    assert found["state"] == [[1.0, 2.0, 3.0, 4.0]]


@pytest.mark.parametrize(
    ("speed", "state"),
    [
        ("motor", [0.5, 0.3]),
        ({"joint": "motor", "field": "position", "scale": 0.1}, [0.7, 0.3]),
    ],
)
def test_angles_are_positions_and_speeds_are_velocities_unless_the_roles_say_otherwise(
    speed, state
):
    message = (("rack", "motor"), (0.3, 7.0), (9.0, 0.5))
    found = joints(message, spec=CAR, state={"speed": speed, "steering": "rack"})
    assert np.allclose(found["state"], [state])


def test_messages_about_other_joints_are_left_out():
    found = joints(ARM, (BOTH, (), (1.0, 2.0)), ARM, (BOTH, (), (np.nan, 2.0)))
    assert found["state"] == [[1.0, 2.0]]


def test_what_follows_its_command_or_is_told_by_the_pose_need_not_be_measured():
    husky = build_robot({"kind": "skid_steer", "footprint_radius": 0.6})
    assert joints(ARM, spec=CAR) == joints(ARM, spec=husky) == {}


@pytest.mark.parametrize(
    ("message", "roles", "words"),
    [
        (ARM, {}, ("'left_wheel'", "are elbow:")),
        (
            (("front_left_wheel", "rear_left_wheel", "right_wheel"), (), (1, 1, 1)),
            {},
            ("'left_wheel'",),
        ),
        ((BOTH, (0.0, 0.0), (np.nan, np.nan)), {}, ("left_wheel",)),
        ((BOTH, (0.0, 0.0), ()), {}, ("left_wheel",)),
        (
            (("wheel_l", "wheel_r"), (), (1.0, 1.0)),
            {"state": {"left_wheel": "weel_l"}},
            ("'weel_l'", "'wheel_l'"),
        ),
        (
            (("wheel_l", "wheel_r"), (), (1.0, 1.0)),
            {"state": {"left_weel": "wheel_l"}},
            ("no state 'left_weel'",),
        ),
        ((BOTH, (), (1.0, 1.0)), {"wheels": ["left", BOTH[1]]}, ("'left'",)),
    ],
)
def test_joints_that_do_not_fit_are_refused_with_what_there_is(message, roles, words):
    with pytest.raises(RecordingError) as caught:
        joints(message, **roles)
    assert all(word in str(caught.value) for word in ("drive: topic", *words))


LEAST_S = 0.012
JITTER_S = 0.010


def drive(path, ahead=0.0, sweep=0.0, scans=300):
    """A drive whose scans come LEAST_S to JITTER_S more after they were measured."""
    times = bags.times(0.1, 30.0)[:scans]
    late = LEAST_S + JITTER_S * np.random.default_rng(0).uniform(size=len(times))
    topics = bags.drive() | {
        "/odom": [
            (t + 0.003, bags.odometry(t, *bags.place_at(t))) for t in bags.times(0.05)
        ],
        "/scan": [
            (t + late_s, bags.scan(t - sweep + ahead, time_increment=sweep / 3))
            for t, late_s in zip(times, late, strict=True)
        ],
    }
    return bags.write(path, topics)


def measured(path):
    return read_recording(path, CART).latency


@pytest.mark.parametrize("sweep", [0.0, 0.09])
def test_scans_are_as_late_after_their_last_beam_as_they_were(tmp_path, sweep):
    latency = measured(drive(tmp_path / "bag", sweep=sweep))
    assert latency.scan.least == pytest.approx(LEAST_S, abs=0.001)
    assert latency.scan.jitter == pytest.approx(JITTER_S, rel=0.1)
    assert latency.odom.least == pytest.approx(0.003, abs=1e-6)
    assert latency.odom.jitter == pytest.approx(0.0, abs=1e-6)  # it is always as late


@pytest.mark.parametrize("change", [{"ahead": 1.0}, {"ahead": -5.0}, {"scans": 5}])
def test_stamps_of_another_clock_and_a_few_messages_tell_nothing(tmp_path, change):
    latency = measured(drive(tmp_path / "bag", **change))
    assert set(latency.measured) == {"odom"}


@pytest.mark.parametrize("topic", ["/imu/data", "/gyroscope"])
def test_any_topic_of_its_type_is_the_imu_of_a_bag(tmp_path, topic):
    rows = bags.every(0.02, lambda t: bags.imu(t, 0.0, 0.0, 0.25))
    topics = bags.drive()
    topics["/odom"] = bags.along(bags.odometry)
    topics.pop("/pose", None)
    found = read(tmp_path, topics | {topic: rows}, CART)
    assert found.imu is not None
    assert found.measured_by == "odometry"
