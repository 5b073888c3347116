from __future__ import annotations

import json

import numpy as np
import pytest
from typer.testing import CliRunner

pytest.importorskip("rosbags", reason="needs the extra 'bags'")

import bags

from nics_drl_bridge.commands.cli import app
from nics_drl_bridge.errors import RecordingError
from nics_drl_bridge.generator import builtin_model
from nics_drl_bridge.middleware.playback import estimate, write_estimate

DURATION_S = 4.0
MODEL = builtin_model("ackermann")
STEP = 0.05


def odometry(t, stamp):
    return bags.moving_odometry(stamp, bags.place_at(t), (0.5, 0.0, 0.25))


def drive(**changed):
    """Half a circle."""
    topics = {
        "/odom": [(t + 0.01, odometry(t, t)) for t in bags.times(STEP, DURATION_S)],
        "/cmd_vel": [
            (t, bags.twist(0.5, 0.0, 0.1)) for t in bags.times(0.1, DURATION_S)
        ],
        "/pose": [
            (t + 0.08, bags.pose_stamped(t, *bags.place_at(t)))
            for t in bags.times(0.1, DURATION_S)
        ],
        "/imu": [
            (t + 0.01, bags.imu(t, 0.0, 0.0, 0.25))
            for t in bags.times(STEP, DURATION_S)
        ],
    }
    return topics | changed


@pytest.fixture
def bag(tmp_path):
    return bags.write(tmp_path / "bag", drive())


def test_the_estimate_follows_the_drive(bag):
    made = estimate(bag, MODEL, {"pose": "/pose", "imu": "/imu"})
    truth = np.array([bags.place_at(t) for t in bags.times(STEP, DURATION_S)])
    assert len(made.pose) == len(truth)
    assert np.abs(made.pose[-20:, :2] - truth[-20:, :2]).max() < 0.05
    assert np.abs(made.twist[-20:, 0] - 0.5).max() < 0.05


def test_an_estimate_of_the_command_line_is_that_of_the_library(bag):
    words = ["bag", "replay", str(bag), "--estimate", "--model", "ackermann", "--json"]
    told = json.loads(CliRunner().invoke(app, words).stdout)
    made = estimate(bag, MODEL, {})
    assert told["sha256"] == made.digest
    assert told["last"] == made.pose[-1].tolist()
    assert told["estimates"] == len(made.pose)


def test_an_estimate_is_written_exactly(bag, tmp_path):
    made = estimate(bag, MODEL, {})
    write_estimate(made, tmp_path / "estimate.npz")
    with np.load(tmp_path / "estimate.npz", allow_pickle=False) as arrays:
        for name in ("stamp_ns", "pose", "twist", "covariance"):
            assert np.array_equal(arrays[name], getattr(made, name))
    write_estimate(made, tmp_path / "estimate.csv")
    head, *rows = (tmp_path / "estimate.csv").read_text().splitlines()
    assert head == "stamp_ns,x,y,heading,vx,vy,wz"
    values = np.array([[float(cell) for cell in row.split(",")[1:]] for row in rows])
    assert np.array_equal(values, np.hstack([made.pose, made.twist]))


@pytest.mark.parametrize(
    ("changed", "topics", "said"),
    [
        (
            {"/odom": [(t, odometry(t, None)) for t in bags.times(STEP, 3.0)]},
            {},
            "not stamped",
        ),
        (
            {
                "/pose": [
                    (t, bags.pose_stamped(t + 70.0, 0.0, 0.0, 0.0))
                    for t in bags.times()
                ]
            },
            {"pose": "/pose"},
            "from two clocks",
        ),
        ({}, {"pose": "/mocap"}, "has no topic '/mocap'"),
        ({}, {"odom": "/pose"}, "odom needs messages of nav_msgs/msg/Odometry"),
    ],
)
def test_a_bag_that_gives_no_estimate_is_refused(tmp_path, changed, topics, said):
    bag = bags.write(tmp_path / "bag", drive(**changed))
    with pytest.raises(RecordingError, match=said):
        estimate(bag, MODEL, topics)
