import re

import numpy as np
import pytest

from nics_drl_bridge.errors import RecordingError
from nics_drl_bridge.recording.readers import explain_no_mapping, open_source
from nics_drl_bridge.recording.survey import inspect_tables
from nics_drl_bridge.recording.textbook import record
from nics_drl_bridge.recording.write import write_drive
from nics_drl_bridge.robot.spec import load_robot

from .tables import draft, drive, read_draft, write


@pytest.fixture
def columns():
    return drive()


def surveyed(path):
    with open_source(path) as source:
        return inspect_tables(source)


def turned(heading):
    """Columns of a quaternion."""
    zero = np.zeros_like(heading)
    half = heading / 2.0
    return {"qx": zero, "qy": zero, "qz": np.sin(half), "qw": np.cos(half)}


def pick(columns, names):
    """Columns `name` or `name=column`."""
    pairs = (name.partition("=") for name in names.split())
    return {name: columns[column or name] for name, _, column in pairs}


def test_guesses_reach_over_files_split_stamps_and_quaternions(tmp_path, columns):
    ns = np.round((1.7e9 + columns["t"]) * 1e9).astype(np.int64)
    split = {"": np.arange(200), "s": ns // 10**9, "ns": ns % 10**9}
    pose = split | pick(columns, "x y") | turned(columns["yaw"])
    for file in ("pose.csv", "odom.csv"):
        write(tmp_path / file, pose)
    commands = {"V": columns["v"] + 0.05 * columns["yaw"], "delta": columns["w"]}
    write(tmp_path / "cmd.csv", split | commands)
    _, drafted = draft(tmp_path)
    assert drafted["time"] == ["s", "ns"]
    assert drafted["pose"]["in"] == "pose.csv"
    found = read_draft(tmp_path, drafted)
    assert found.variables == ("speed_command", "steering_command")
    assert np.allclose(found.pose.values[:, 2], columns["yaw"])


@pytest.mark.parametrize(
    "column", [np.array([["2024-01-01T00:00:01"]], "datetime64[s]"), np.zeros((0, 3))]
)
def test_dates_and_empty_arrays_are_listed(tmp_path, column):
    np.save(tmp_path / "log.npy", column)
    (table,) = surveyed(tmp_path / "log.npy")
    assert table.rows == len(column)


def test_a_unit_of_the_pose_that_no_name_shows_is_in_doubt(tmp_path, columns):
    wavy = {"pose.x": 3e3 * np.sin(columns["t"] * 3.0), "pose.y": columns["y"] * 1e3}
    wavy["pose.theta"] = np.degrees(columns["yaw"] * 40.0)
    path = write(tmp_path / "log.csv", {"time": columns["t"] * 1e3} | wavy)
    text, drafted = draft(path)
    assert drafted["time"] == {"from": "time", "unit": "ms"}
    assert "heading_unit" not in drafted["pose"]
    doubt = text.splitlines()[0]
    assert doubt.startswith("# doubt: pose: the heading ")
    assert doubt.endswith("add `heading_unit: deg`")


def test_gaps_backward_stamps_repeated_and_missing_rows_are_listed(tmp_path, columns):
    order = np.concatenate([np.arange(50), [49, 49], np.arange(90, 200)])
    columns["t"][150:] -= 0.5
    columns["yaw"][130:142] = np.nan
    rows = {name: column[order] for name, column in columns.items()}
    (table,) = surveyed(write(tmp_path / "log.csv", rows))
    text = "\n".join(table.regularity)
    for sentence in (
        "12 of 162 rows have no yaw",
        "gaps: 1, the longest of 0.82 s after 1.0 s",
        "stamps that run backwards: 1",
        "stamps like the one before: 2, in rows that repeat all of it: 2",
    ):
        assert sentence in text


def test_a_source_without_a_readable_table_is_refused(tmp_path, columns):
    (tmp_path / "log.csv").write_bytes(b"\0\1\2")
    with pytest.raises(RecordingError, match="is not text"):
        surveyed(tmp_path)
    write(tmp_path / "good.csv", columns)
    assert "is not text" in surveyed(tmp_path)[1].findings[0]


def test_a_command_that_was_zero_throughout_stays_one(tmp_path, columns):
    rows = pick(columns, "t x y yaw throttle=v") | {"steering": 0.0 * columns["t"]}
    text, drafted = draft(write(tmp_path / "log.csv", rows))
    assert "  steering: steering  # guessed; it is 0" in text
    assert drafted["robot"]["kind"] == "ackermann_throttle"


def test_a_pose_that_shares_no_time_with_the_commands_has_a_clock(tmp_path, columns):
    write(tmp_path / "pose.csv", pick(columns, "t x y yaw"))
    columns["t"] += 1.7e9
    write(tmp_path / "cmd.csv", pick(columns, "t throttle=v steering=w"))
    _, drafted = draft(tmp_path)
    assert drafted["pose"]["clock"] == "tracker"
    found = read_draft(tmp_path, drafted)
    assert found.pose.t[0] == found.command.t[0] == pytest.approx(0.0)


def test_a_drive_over_midnight_has_one_clock(tmp_path, columns):
    begin = np.datetime64("2026-01-01T23:59:58")
    times = begin + np.round(columns["t"] * 1e3).astype("m8[ms]")
    stamps = {"timestamp": [str(time).partition("T")[2] for time in times]}
    rows = stamps | pick(columns, "x y theta=yaw v_cmd=v w_cmd=w")
    _, drafted = draft(write(tmp_path / "log.csv", rows))
    assert "clock" not in drafted["pose"]


@pytest.mark.parametrize(
    ("unit", "since", "own"), [(1e9, 0.0, True), (1.0, 0.0, False), (1e9, 5.0, False)]
)
def test_a_pose_that_counts_from_its_first_row_in_another_unit_has_a_clock(
    tmp_path, columns, unit, since, own
):
    t = since + columns["t"]
    write(tmp_path / "pose.csv", {"t": unit * t} | pick(columns, "x y yaw"))
    commands = pick(columns, "throttle=v steering=w")
    write(tmp_path / "cmd.csv", {"t": 0.13 + t} | commands)
    assert ("clock" in draft(tmp_path)[1]["pose"]) == own


@pytest.mark.parametrize(
    ("names", "robot"),
    [
        ("cmd_vel.linear.x=v cmd_vel.angular.z=w", "differential, .*, or skid_steer; "),
        ("speed_cmd=v steering_cmd=w", "ackermann, .*, or tricycle; "),
        ("throttle=v steering=w", "ackermann_throttle, .*guessed; "),
    ],
)
def test_kinds_of_robots_with_the_same_commands_are_named_beside_the_guess(
    tmp_path, columns, names, robot
):
    rows = pick(columns, f"t x y yaw {names}")
    text, _ = draft(write(tmp_path / "log.csv", rows))
    assert re.match(rf"robot: \{{kind: {robot}", text)


def test_a_recording_that_this_package_wrote_needs_no_mapping(tmp_path, columns):
    robot = load_robot("differential")
    driven = record(robot, np.random.default_rng(0), 5.0)
    write_drive(driven, tmp_path / "drive.npz", robot)
    write_drive(driven, tmp_path / "bag", robot)
    assert explain_no_mapping(tmp_path / "drive.npz") == "was written by this package"
    assert "/cmd_vel and /odom" in explain_no_mapping(tmp_path / "bag")
    assert explain_no_mapping(write(tmp_path / "log.csv", columns)) == ""


def test_columns_that_a_mapping_does_not_use_are_named_by_table(tmp_path, columns):
    write(tmp_path / "a.csv", pick(columns, "t x y yaw"))
    more = {f"pump{k}": np.full(200, k) for k in range(22)}
    write(tmp_path / "b.csv", pick(columns, "t throttle=v") | more)
    rest = {"seq": np.arange(200), "mode": ["FAST"] * 200}
    write(tmp_path / "c.csv", pick(columns, "t steering=w rest=t") | rest)
    first, last = draft(tmp_path)[0].splitlines()[-2:]
    assert first.startswith("# not used: b.csv: pump0 (constant), pump1 (constant), ")
    assert first.endswith("pump19 (constant) and 2 more")
    assert last == "# not used: c.csv: rest, mode (no numbers)"


def test_streams_of_different_lengths_in_one_file_are_guessed_apart(tmp_path, columns):
    quick = np.linspace(0.0, 20.0, 321)
    streams = {"wheel_t": quick, "ticks_left": quick, "ticks_right": quick[:300]}
    for pose in (pick(columns, "yaw"), turned(columns["yaw"][:150])):
        np.savez(tmp_path / "log.npz", **pick(columns, "t x y v"), **pose, **streams)
        guess = draft(tmp_path / "log.npz")[1]["pose"]
        assert (guess.get("quaternion") or [guess["heading"]]) == list(pose)
