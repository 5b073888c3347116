from __future__ import annotations

import base64
import json

import numpy as np
import pytest
from robots import direct_model, field
from scipy.stats import chi2

from nics_drl_bridge.sim.world_set import load_worlds
from nics_drl_bridge.watch.frame import (
    Frame,
    Stage,
    Track,
    WorldFrame,
    round_to_thousandths,
)
from watch.rig import shot


def plain(**changes):
    return json.loads(json.dumps(Frame(1.5, (WorldFrame(shot(**changes)),)).plain()))


def test_a_frame_goes_over_the_wire_in_thousandths_without_what_is_not_finite():
    ranges = np.array([[0.5, np.inf, -np.inf, np.nan]], np.float32)
    bodies = np.concatenate([np.zeros((1, 7)), shot().bodies])
    frame = plain(ranges=ranges, bodies=bodies)
    (world,) = frame["worlds"]
    assert frame["time"] == 1.5
    assert world["poses"] == [[1000, 0, 1571]]
    assert world["goals"] == [[2000, 500]]
    assert (world["bodies"], world["kinds"]) == ([[1000, 1500, 0, 250]], [0])
    assert world["ranges"] == [[500, -1, -1, -1]]
    assert round_to_thousandths([np.nan, np.inf, -np.inf]) == [0, 0, 0]


def test_the_ellipse_holds_95_percent_of_the_positions():
    turn = np.array([[0.6, -0.8], [0.8, 0.6]])
    covariance = np.zeros((1, 3, 3))
    covariance[0, :2, :2] = turn @ np.diag([0.09, 0.01]) @ turn.T
    large, small, angle = plain(covariance=covariance)["worlds"][0]["ellipses"][0]
    known = np.sqrt(chi2.ppf(0.95, 2))
    assert (large, small) == pytest.approx((0.3 * known, 0.1 * known), abs=1e-4)
    assert np.tan(angle) == pytest.approx(0.8 / 0.6, rel=1e-3)


def test_a_trail_begins_anew_with_each_episode_and_never_grows_without_end():
    trail = Track()
    for step in range(3 * Track.MOST):
        trail.add(np.array([[step * 0.01, 0.0, 0.0]]), step)
    (path,) = trail.paths
    assert len(path) <= Track.MOST
    assert path[-1, 0] == pytest.approx(0.01 * (3 * Track.MOST - 1))
    trail.add(np.zeros((1, 3)), 0)
    assert len(trail.paths[0]) == 1


def test_a_stage_tells_all_that_is_drawn_once():
    stage = Stage(
        "a title", direct_model(), (field(count=2), load_worlds("room"))
    ).plain()
    one, room = json.loads(json.dumps(stage))["places"]
    assert stage["model"] == {
        "name": "direct",
        "robot": "direct",
        "lidar": "72 beams, 3 m",
    }
    assert one["extent"] == [-3.0, -3.0, 3.0, 3.0]
    assert len(one["walls"]) == 4
    assert one["map"] is None
    assert one["shapes"] == [[]]  # a disc has no corners
    cells = base64.b64decode(room["map"]["cells"])
    assert len(cells) == room["map"]["rows"] * room["map"]["columns"]
    assert set(cells) <= {0, 1, 2}
    assert max(np.hypot(*np.transpose(room["shapes"][0]))) == pytest.approx(
        1.0, abs=1e-3
    )
