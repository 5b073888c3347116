from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from nics_drl_bridge import geometry
from nics_drl_bridge.config import parse_yaml
from nics_drl_bridge.errors import ConfigError, RecordingError
from nics_drl_bridge.recording.joining import APART_S, LEARNT_SHARE, join
from nics_drl_bridge.recording.mapping import Mapping
from nics_drl_bridge.recording.mapping_draft import propose_mapping
from nics_drl_bridge.recording.readers import open_source, read_recording
from nics_drl_bridge.recording.recording import (
    Recording,
    load_recording,
    save_recording,
)
from nics_drl_bridge.recording.survey import inspect_tables
from nics_drl_bridge.recording.textbook import record
from nics_drl_bridge.robot.spec import load_robot

from .tables import MAP, drive, write

ROBOT = load_robot("differential")


def drives(*durations: float) -> list[Recording]:
    made = []
    for k, duration in enumerate(durations):
        driven = record(ROBOT, np.random.default_rng(k), duration)
        made.append(replace(driven, source=f"{'abc'[k]}.csv"))
    return made


def test_what_is_learnt_comes_first_and_the_rest_of_each_drive_is_held_out():
    joined = join(drives(12.0, 24.0))
    assert [each.source for each in joined.episodes] == [
        "a.csv",
        "b.csv",
        "a.csv",
        "b.csv",
    ]
    lasting = [each.duration_s for each in joined.episodes]
    assert np.allclose(lasting, [8.0, 16.0, 4.0, 8.0], atol=0.03)
    assert joined.learn_until_s == pytest.approx(joined.episodes[1].end_s)
    assert joined.driven_s() == pytest.approx(36.0, abs=0.1)
    assert joined.driven_s(joined.learn_until_s) == pytest.approx(
        LEARNT_SHARE * 36.0, abs=0.1
    )
    assert "the last third of each was held out" in joined.repairs[0]
    assert "a.csv, b.csv" in joined.repairs[0]


def test_every_pose_keeps_its_motion_and_its_commands():
    (one, other) = drives(12.0, 24.0)
    joined = join([one, other])
    second = joined.episodes[1]
    rows = (joined.pose.t >= second.start_s) & (joined.pose.t <= second.end_s)
    pose = joined.pose.values[rows]
    moved = geometry.between(pose[:-1], pose[1:])
    count = len(pose)
    expected = geometry.between(
        other.pose.values[: count - 1], other.pose.values[1:count]
    )
    assert np.allclose(moved, expected, atol=1e-9)
    at = np.searchsorted(joined.command.t, joined.pose.t[rows], side="right") - 1
    assert np.array_equal(joined.command.values[at], other.command.values[:count])


def test_the_pose_rests_between_two_episodes():
    joined = join(drives(12.0, 24.0))
    across = np.flatnonzero(np.diff(joined.pose.t) > APART_S / 2.0)
    assert len(across) == 3
    step = geometry.between(joined.pose.values[across], joined.pose.values[across + 1])
    assert np.abs(step).max() < 1e-9
    assert list(np.diff(joined.episode_at(joined.pose.t))[across]) == [1, 1, 1]
    assert np.diff(joined.without_gaps(joined.pose.t)).max() < 0.02


def test_joined_recordings_can_be_joined_again_and_saved(tmp_path):
    (one, other, third) = drives(12.0, 24.0, 12.0)
    joined = join([join([one, other]), third])
    assert [e.source for e in joined.episodes] == ["a.csv", "b.csv", "c.csv"] * 2
    save_recording(joined, tmp_path / "joined.npz")
    loaded = load_recording(tmp_path / "joined.npz")
    assert loaded.episodes == joined.episodes
    assert loaded.learn_until_s == joined.learn_until_s


def test_clocks_of_their_own_are_aligned_before():
    (one, other) = drives(12.0, 24.0)
    late = replace(other, pose=replace(other.pose, t=other.pose.t + 7.0, clock="mocap"))
    joined = join([one, late], [0.0, -7.0])
    assert joined.pose.clock == joined.command.clock
    assert np.allclose(joined.pose.t, join([one, other]).pose.t)


def test_drives_of_different_robots_are_refused():
    car = load_robot("ackermann")
    other = record(car, np.random.default_rng(0), 12.0)
    with pytest.raises(RecordingError, match="join only drives of one robot"):
        join([*drives(12.0), other])


def test_a_stream_that_one_recording_lacks_is_left_out_and_said():
    (one, other) = drives(12.0, 24.0)
    joined = join([one, replace(other, odometry=other.pose)])
    assert joined.odometry is None
    assert "odometry was left out because not all recordings have it." in joined.repairs


@pytest.mark.parametrize("restarts", [True, False])
def test_an_episode_column_makes_episodes_whether_its_times_begin_anew_or_go_on(
    tmp_path, restarts
):
    columns = drive(1000)
    episode = np.repeat([0, 1], [400, 600])
    if restarts:
        columns["t"] = np.concatenate([columns["t"][:400], columns["t"][:600]])
    path = write(tmp_path / "log.csv", columns | {"run": episode})
    joined = read_recording(
        path, mapping=Mapping.model_validate(MAP | {"episode": "run"})
    )
    sources = [each.source.rpartition("(")[2] for each in joined.episodes]
    assert sources == ["episode 0)", "episode 1)"] * 2
    assert joined.driven_s() == pytest.approx(20.0, abs=0.2)


@pytest.mark.parametrize("restarts", [True, False])
@pytest.mark.parametrize("name", ["episode", "trial_id"])
def test_a_draft_names_the_column_that_numbers_episodes(tmp_path, name, restarts):
    columns = drive(1000)
    if restarts:
        columns["t"] = np.concatenate([columns["t"][:400], columns["t"][:600]])
    episode = np.repeat([0, 1], [400, 600])
    path = write(tmp_path / "log.csv", columns | {name: episode})
    with open_source(path) as source:
        draft = parse_yaml(propose_mapping(inspect_tables(source)).text, "draft")
    assert draft["episode"] == name


@pytest.mark.parametrize(
    "values",
    [np.repeat([0, 1, 0], [400, 400, 200]), np.arange(1000), np.zeros(1000)],
)
def test_a_draft_leaves_out_a_column_that_numbers_no_episodes(tmp_path, values):
    path = write(tmp_path / "log.csv", drive(1000) | {"episode": values})
    with open_source(path) as source:
        draft = propose_mapping(inspect_tables(source)).text
    assert "episode:" not in draft


def test_episodes_reach_over_the_tables_of_a_folder(tmp_path):
    columns = drive(1000)
    pose = {name: columns[name] for name in ("t", "x", "y", "yaw")}
    write(tmp_path / "pose.csv", pose)
    commands = {
        "t": columns["t"][::10],
        "v": columns["v"][::10],
        "w": columns["w"][::10],
    }
    write(tmp_path / "cmd.csv", commands | {"run": np.repeat([3, 7], [40, 60])})
    given = {
        "time": "t",
        "pose": {"in": "pose.csv", "x": "x", "y": "y", "heading": "yaw"},
        "command": {"v": "cmd.csv:v", "w": "cmd.csv:w"},
        "episode": "cmd.csv:run",
    }
    joined = read_recording(tmp_path, mapping=Mapping.model_validate(given))
    assert len(joined.episodes) == 4
    assert joined.episodes[1].source.endswith("(episode 7)")
    assert joined.driven_s() == pytest.approx(20.0, abs=0.2)


def test_a_column_that_numbers_no_episodes_is_refused(tmp_path):
    path = write(tmp_path / "log.csv", drive(100) | {"row": np.arange(100)})
    mapping = Mapping.model_validate(MAP | {"episode": "row"})
    with pytest.raises(ConfigError, match="name the column that numbers the episodes"):
        read_recording(path, mapping=mapping)
