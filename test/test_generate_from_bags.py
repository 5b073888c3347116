"""`nics generate` on bags: the same model as from the package's own recordings."""

from __future__ import annotations

import numpy as np
import pytest
from typer.testing import CliRunner

pytest.importorskip("rosbags", reason="needs the extra 'bags'")

import bags

from nics_drl_bridge.commands.cli import app
from nics_drl_bridge.generator import SimulatorModel, load_model
from nics_drl_bridge.identify.identify import identify
from nics_drl_bridge.recording.readers import read_recording
from nics_drl_bridge.recording.recording import save_recording
from nics_drl_bridge.recording.textbook import record
from nics_drl_bridge.recording.write import write_bag
from nics_drl_bridge.robot.spec import RobotSpec, load_robot

SECONDS = 20.0
CAMPAIGN = pytest.mark.campaign
SAME = 1e-6
"""Stamps are rounded to nanoseconds, and headings go through quaternions."""


def generate(*words: object):
    return CliRunner().invoke(app, ["generate", *map(str, words)])


def model_of(recording, out, robot, *words) -> SimulatorModel:
    done = generate(recording, "--out", out, "--robot", robot, *words)
    assert done.exit_code == 0, done.output
    return load_model(out)


def refused(*words: object) -> str:
    done = generate(*words)
    assert done.exit_code == 2, done.output
    *progress, sentence = done.stderr.splitlines()
    assert all(line.endswith(" s)") for line in progress)  # of a slow machine
    return sentence


def assert_alike(one: SimulatorModel, other: SimulatorModel, spec: RobotSpec) -> None:
    variables = (*spec.state, *spec.command)
    low, high = np.array([(v.min, v.max) for v in variables]).T
    x = np.random.default_rng(0).uniform(low, high, (200, len(variables)))
    expected = one.kinematics.rates(x)
    scale = np.abs(expected).max()
    assert np.abs(other.kinematics.rates(x) - expected).max() < SAME * scale
    assert other.timing == one.timing


@pytest.mark.slow
@pytest.mark.parametrize(
    "robot",
    [
        "ackermann",
        *(pytest.param(r, marks=CAMPAIGN) for r in ("differential", "mecanum")),
    ],
)
def test_a_bag_gives_the_model_of_the_same_drive(tmp_path, robot):
    spec = load_robot(robot)
    drive = record(spec, np.random.default_rng(1), duration=SECONDS)
    save_recording(drive, tmp_path / "drive.npz")
    expected = model_of(tmp_path / "drive.npz", tmp_path / "expected", robot)
    for storage in ("mcap", "sqlite3"):
        write_bag(drive, tmp_path / storage, spec, storage)
        made = model_of(tmp_path / storage, tmp_path / f"of_{storage}", robot)
        assert_alike(expected, made, spec)


def car_bag(drive, path, storage):
    """A car as real ones are: own names, a steering joint, an axle in rad/s, motion capture."""
    command = drive.command
    pose = drive.pose
    state = drive.state
    names = ["rear_axle_joint", "front_steering_joint"]
    mocap = [
        (t, bags.transforms(bags.transform(t, row, "room", "car")))
        for t, row in zip(pose.t, pose.values, strict=True)
    ]
    return bags.write(
        path,
        {
            "/car/drive_cmd": [
                (t, bags.ackermann_stamped(t, *row))
                for t, row in zip(command.t, command.values, strict=True)
            ],
            "/joint_states": [
                (t, bags.joints(t, names, (0.0, row[1]), (row[0] / 0.05, 0.0)))
                for t, row in zip(state.t, state.values, strict=True)
            ],
            "/tf": mocap,
            "/odom": [(t, bags.odometry(t, 0.0, 0.0, 0.0)) for t in pose.t],
        },
        storage,
    )


TOPICS = """
cmd_vel: /car/drive_cmd
frame: room
child_frame: car
state:
  speed: {joint: rear_axle_joint, scale: 0.05}
  steering: front_steering_joint
"""


@pytest.mark.slow
@pytest.mark.parametrize("storage", ["mcap", pytest.param("sqlite3", marks=CAMPAIGN)])
def test_a_mapping_leads_to_the_same_model(tmp_path, storage):
    spec = load_robot("ackermann")
    drive = record(spec, np.random.default_rng(1), duration=SECONDS)
    save_recording(drive, tmp_path / "drive.npz")
    bag = car_bag(drive, tmp_path / "bag", storage)
    (tmp_path / "topics.yaml").write_text(TOPICS, encoding="utf-8")
    words = ("--topics", tmp_path / "topics.yaml", "--topic", "pose=/tf")
    made = model_of(bag, tmp_path / "made", "ackermann", *words)
    expected = model_of(tmp_path / "drive.npz", tmp_path / "expected", "ackermann")
    low, high = np.array([(v.min, v.max) for v in (*spec.state, *spec.command)]).T
    x = np.random.default_rng(0).uniform(low, high, (200, 4))
    difference = made.kinematics.rates(x) - expected.kinematics.rates(x)
    assert np.abs(difference).max() < 0.01  # an AckermannDrive is of single precision


@pytest.mark.slow
@pytest.mark.parametrize("storage", ["mcap", pytest.param("sqlite3", marks=CAMPAIGN)])
def test_a_real_drive_with_two_clocks_gives_the_same_model(
    shared_recordings, tmp_path, storage
):
    spec = load_robot("ackermann")
    drive = read_recording(shared_recordings / "xtark_ackermann" / "random_drive_45s")
    write_bag(drive, tmp_path / "bag", spec, storage)
    one, other = (
        identify(d, spec) for d in (drive, read_recording(tmp_path / "bag", spec))
    )
    assert np.allclose(other.model.coefficients, one.model.coefficients, atol=1e-5)
    latency = one.calibration.command_latency_s
    assert other.calibration.command_latency_s == pytest.approx(latency, abs=1e-5)


def test_without_a_mapping_the_topics_are_listed_and_nothing_is_made(tmp_path):
    drive = record(load_robot("ackermann"), np.random.default_rng(1), duration=5.0)
    bag = car_bag(drive, tmp_path / "bag", "mcap")
    sentence = refused(bag, "--out", tmp_path / "car")
    assert "--topic cmd_vel=/car/drive_cmd" in sentence
    assert "/tf (tf2_msgs/msg/TFMessage)" in sentence
    assert not (tmp_path / "car").exists()


def test_a_wrong_mapping_is_one_sentence(tmp_path):
    bag = bags.write(tmp_path / "bag", bags.drive())
    assert "must be ROLE=TOPIC" in refused(
        bag, "--out", tmp_path / "a", "--topic", "odom"
    )
    assert "no such file" in refused(
        bag, "--out", tmp_path / "a", "--topics", tmp_path / "t.yaml"
    )
    assert "has no topic '/x' (odom)" in refused(
        bag, "--out", tmp_path / "a", "--topic", "odom=/x", "--topic", "pose=none"
    )


def test_topics_for_a_recording_that_is_no_bag_are_refused(tmp_path):
    (tmp_path / "drive.npz").write_bytes(b"")
    words = ("--out", tmp_path / "a", "--topic", "odom=/odom")
    assert "is no bag" in refused(tmp_path / "drive.npz", *words)


@pytest.mark.parametrize("out", ["file", "file/below", "folder"])
def test_a_place_where_no_model_can_be_written_is_refused_before_the_recording_is_read(
    tmp_path, out
):
    (tmp_path / "file").write_text("mine", encoding="utf-8")
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "thesis.tex").write_text("mine", encoding="utf-8")
    sentence = refused("no_such_recording.npz", "--out", tmp_path / out)
    assert str(tmp_path / out) in sentence
    assert "no_such_recording" not in sentence
