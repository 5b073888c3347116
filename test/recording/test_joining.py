from dataclasses import replace

import numpy as np
import pytest

from nics_drl_bridge import geometry
from nics_drl_bridge.errors import ConfigError, RecordingError
from nics_drl_bridge.recording.joining import APART_S, LEARNT_SHARE, join
from nics_drl_bridge.recording.recording import Recording
from nics_drl_bridge.recording.textbook import record
from nics_drl_bridge.robot.spec import load_robot

from .tables import draft, drive, read, write

ROBOT = load_robot("differential")


def drives(*durations: float) -> list[Recording]:
    made = []
    for k, duration in enumerate(durations):
        driven = record(ROBOT, np.random.default_rng(k), duration)
        made.append(replace(driven, source=f"{'abc'[k]}.csv"))
    return made


def test_what_is_learnt_comes_first_and_the_rest_of_each_drive_is_held_out():
    joined = join(drives(12.0, 24.0))
    assert [each.source for each in joined.episodes] == ["a.csv", "b.csv"] * 2
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


def test_joined_recordings_can_be_joined_again():
    (one, other, third) = drives(12.0, 24.0, 12.0)
    joined = join([join([one, other]), third])
    assert [e.source for e in joined.episodes] == ["a.csv", "b.csv", "c.csv"] * 2


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


def two_runs(name="run", restarts=True):
    """Columns of two drives in one table, whose times may begin anew."""
    columns = drive(1000)
    if restarts:
        columns["t"] = np.concatenate([columns["t"][:400], columns["t"][:600]])
    return columns | {name: np.repeat([0, 1], [400, 600])}


@pytest.mark.parametrize("restarts", [True, False])
def test_an_episode_column_makes_episodes_whether_its_times_begin_anew_or_go_on(
    tmp_path, restarts
):
    path = write(tmp_path / "log.csv", two_runs(restarts=restarts))
    joined = read(path, "episode: run")
    sources = [each.source.rpartition("(")[2] for each in joined.episodes]
    assert sources == ["episode 0)", "episode 1)"] * 2
    assert joined.driven_s() == pytest.approx(20.0, abs=0.2)


@pytest.mark.parametrize(
    ("name", "restarts", "known"),
    [
        ("episode", False, True),
        ("trial_id", True, True),
        ("run", True, True),
        ("run", False, False),  # it may be a switch
    ],
)
def test_a_draft_names_the_column_that_numbers_episodes(
    tmp_path, name, restarts, known
):
    _, drafted = draft(write(tmp_path / "log.csv", two_runs(name, restarts)))
    assert drafted.get("episode") == (name if known else None)


@pytest.mark.parametrize(
    "values", [np.repeat([0, 1, 0], [400, 400, 200]), np.arange(1000), np.zeros(1000)]
)
def test_a_draft_leaves_out_a_column_that_numbers_no_episodes(tmp_path, values):
    path = write(tmp_path / "log.csv", drive(1000) | {"episode": values})
    assert "episode" not in draft(path)[1]


def test_episodes_reach_over_the_tables_of_a_folder(tmp_path):
    columns = drive(1000)
    write(
        tmp_path / "pose.csv", {name: columns[name] for name in ("t", "x", "y", "yaw")}
    )
    commands = {name: columns[name][::10] for name in ("t", "v", "w")}
    write(tmp_path / "cmd.csv", commands | {"run": np.repeat([3, 7], [40, 60])})
    changes = """
        pose: {in: pose.csv, x: x, y: y, heading: yaw}
        command: {v: "cmd.csv:v", w: "cmd.csv:w"}
        episode: cmd.csv:run
    """
    joined = read(tmp_path, changes)
    assert len(joined.episodes) == 4
    assert joined.episodes[1].source.endswith("(episode 7)")
    assert joined.driven_s() == pytest.approx(20.0, abs=0.2)


def test_a_column_that_numbers_no_episodes_is_refused(tmp_path):
    path = write(tmp_path / "log.csv", drive(100) | {"row": np.arange(100)})
    with pytest.raises(ConfigError, match="name the column that numbers the episodes"):
        read(path, "episode: row")
