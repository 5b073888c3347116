from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("rosbags", reason="needs the extra 'bags'")

import bags
from robots import direct_model

from nics_drl_bridge.errors import RecordingError
from nics_drl_bridge.watch.bag import BagSource
from nics_drl_bridge.watch.server import Request

MODEL = direct_model()
DURATION_S = 4.0
STEP_S = 0.05


def bag(folder, **topics):
    """Straight ahead with 0.5 m/s."""
    known = {
        "/odom": [
            (t, bags.moving_odometry(t, (0.5 * t, 0.0, 0.0), (0.5, 0.0, 0.0)))
            for t in bags.times(STEP_S, DURATION_S)
        ],
        "/cmd_vel": [
            (t, bags.twist(0.5, 0.0, 0.0)) for t in bags.times(0.1, DURATION_S)
        ],
    }
    return bags.write(folder / "bag", known | topics)


def test_a_bag_is_shown_frame_by_frame_with_estimate_covariance_and_command(tmp_path):
    made = BagSource(bag(tmp_path), MODEL, {})
    assert made.period_s == pytest.approx(STEP_S, abs=1e-3)
    for _ in range(20):
        made.advance()
    frame = made.frame()
    shot = frame.worlds[0].shot
    assert frame.time_s == pytest.approx(1.0, abs=0.06)
    assert shot.poses[0] == pytest.approx([0.5 * frame.time_s, 0.0, 0.0], abs=0.05)
    assert shot.commands[0] == pytest.approx([0.5, 0.0, 0.0])
    assert np.all(np.linalg.eigvalsh(shot.covariance[0]) > 0.0)
    x = frame.worlds[0].trails[0][:, 0]
    assert x[-1] == pytest.approx(shot.poses[0, 0])
    assert np.all(np.diff(x) >= -1e-6)


def test_time_is_scrubbed_forth_and_back_and_ends(tmp_path):
    made = BagSource(bag(tmp_path), MODEL, {})
    first, last = made.stage().span_s
    assert (first, last) == (0.0, pytest.approx(DURATION_S, abs=0.1))
    for seconds in (3.0, 1.5):
        made.take(Request(kind="seek", value=seconds))
        assert made.frame().time_s == pytest.approx(seconds, abs=STEP_S)
    made.take(Request(kind="seek", value=-5.0))
    assert made.frame().time_s == 0.0
    made.take(Request(kind="seek", value=1e6))
    assert made.frame().time_s == last
    assert not made.unfinished(1)
    made.advance()
    assert made.frame().time_s == last
    made.take(Request(kind="restart"))
    assert made.frame().time_s == 0.0


def test_the_place_holds_the_whole_drive_and_what_was_seen(tmp_path):
    scans = [(t, bags.scan(t, beams=8)) for t in bags.times(0.1, DURATION_S)]
    made = BagSource(bag(tmp_path, **{"/scan": scans}), MODEL, {})
    x1, _, x2, _ = made.stage().plain()["places"][0]["extent"]
    assert x1 < 0.0
    assert x2 > 0.5 * DURATION_S
    assert made.stage().model.lidar.beams == 8
    assert made.frame().worlds[0].shot.ranges.shape == (1, 8)


def test_a_bag_without_odometry_is_one_sentence(tmp_path):
    where = bags.write(
        tmp_path / "bag", {"/cmd_vel": [(0.0, bags.twist(0.5, 0.0, 0.0))]}
    )
    with pytest.raises(RecordingError, match="has no odometry"):
        BagSource(where, MODEL, {})
