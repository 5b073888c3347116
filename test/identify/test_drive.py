from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from identify.drives import in_bursts, slipping_car
from nics_drl_bridge.identify.drive import Drive, find_bursts, spread


@pytest.mark.parametrize("lost", [(0.0, 0.0), (3.0, 3.4)])
def test_uniform_stamps_with_or_without_a_gap_are_not_bursts(lost):
    t = np.arange(1000) * 0.01
    t = t[(t <= lost[0]) | (t > lost[1])]
    assert find_bursts(t) is None
    assert spread(t, None) is t


@pytest.mark.parametrize("size", [2, 5, 10])
def test_samples_of_bursts_get_back_their_times(size):
    t = np.arange(1, 1001) * 0.1 / size
    arrival = in_bursts(t, 0.1)
    bursts = find_bursts(arrival)
    assert bursts is not None
    assert bursts.period_s == pytest.approx(0.1, abs=1e-4)
    assert np.abs(spread(arrival, bursts) - t).max() < 1e-3


def test_the_newest_of_each_burst_is_dated_at_its_arrival():
    arrival = in_bursts(np.arange(1, 201) * 0.02, 0.1)
    bursts = find_bursts(arrival)
    assert len(bursts.newest) == 40
    assert (
        np.abs(spread(arrival, bursts)[bursts.newest] - np.arange(1, 41) * 0.1).max()
        < 1e-3
    )


def test_after_a_gap_a_burst_fills_one_period_only():
    t = np.arange(1, 201) * 0.02
    t = t[(t <= 1.0) | (t > 1.4)]
    arrival = in_bursts(t, 0.1)
    assert np.abs(spread(arrival, find_bursts(arrival)) - t).max() < 1e-3


def test_a_motion_is_trusted_by_the_variances_of_the_poses_at_both_ends():
    spec, recording = slipping_car(duration=4.0)
    pose = recording.pose
    start = np.array([0.5, 0.5])
    assert (Drive(recording, spec).trust(start, start + 1.0) == 1.0).all()
    sigma = np.where((pose.t > 1.4)[:, None], [0.03, 0.03, 0.01], 0.01)
    drive = Drive(replace(recording, pose=replace(pose, sigma=sigma)), spec)
    usual = np.array([0.03, 0.03, 0.01])  # of most poses
    before = 1.0 / (0.01 / usual) ** 2
    across = 1.0 / (((0.01 / usual) ** 2 + 1.0) / 2.0)
    trust = drive.trust(start, np.array([1.0, 2.0]))
    assert trust == pytest.approx(np.stack([before, across]))
