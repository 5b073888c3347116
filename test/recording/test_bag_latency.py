from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("rosbags", reason="needs the extra 'bags'")

import bags

from nics_drl_bridge.recording.bag_file import opened
from nics_drl_bridge.recording.bag_reader import latency_of
from nics_drl_bridge.recording.readers import read_recording
from nics_drl_bridge.recording.recording import load_recording, save_recording
from nics_drl_bridge.robot.spec import load_robot

LEAST_S, JITTER_S = 0.012, 0.010


def delays(count, seed=0):
    return LEAST_S + JITTER_S * np.random.default_rng(seed).uniform(size=count)


def drive(path, ahead=0.0, sweep=0.0, scans=300):
    """A drive whose scans come LEAST_S to JITTER_S more after they were measured."""
    times = bags.times(0.1, 30.0)[:scans]
    topics = bags.drive() | {
        "/odom": [(t + 0.003, bags.odometry(t, *bags.place_at(t))) for t in bags.times(0.05)],
        "/scan": [
            (t + late, bags.scan(t - sweep + ahead, time_increment=sweep / 3))
            for t, late in zip(times, delays(len(times)), strict=True)
        ],
    }
    return bags.write(path, topics)


def measured(path):
    with opened(path) as bag:
        return latency_of(bag)


@pytest.mark.parametrize("sweep", [0.0, 0.09])
def test_scans_are_as_late_after_their_last_beam_as_they_were(tmp_path, sweep):
    scan = measured(drive(tmp_path / "bag", sweep=sweep)).scan
    assert scan.least == pytest.approx(LEAST_S, abs=0.001)
    assert scan.jitter == pytest.approx(JITTER_S, rel=0.1)


def test_odometry_that_is_always_as_late_has_no_jitter(tmp_path):
    odom = measured(drive(tmp_path / "bag")).odom
    assert odom.least == pytest.approx(0.003, abs=1e-6)
    assert odom.jitter == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize("change", [{"ahead": 1.0}, {"ahead": -5.0}, {"scans": 5}])
def test_stamps_of_another_clock_and_a_few_messages_tell_nothing(tmp_path, change):
    latency = measured(drive(tmp_path / "bag", **change))
    assert latency.scan is None
    assert latency.odom is not None


def test_a_recording_keeps_its_latency_in_a_file(tmp_path):
    recording = read_recording(drive(tmp_path / "bag"), load_robot("differential"))
    save_recording(recording, tmp_path / "drive.npz")
    assert load_recording(tmp_path / "drive.npz").latency == recording.latency
    assert set(recording.latency.measured) == {"scan", "odom"}
