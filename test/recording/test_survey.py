from __future__ import annotations

import numpy as np
import pytest

from nics_drl_bridge.config import parse_yaml
from nics_drl_bridge.errors import RecordingError
from nics_drl_bridge.recording.mapping import Mapping
from nics_drl_bridge.recording.mapping_draft import propose_mapping
from nics_drl_bridge.recording.names import split_words
from nics_drl_bridge.recording.readers import (
    explain_no_mapping,
    open_source,
    read_recording,
)
from nics_drl_bridge.recording.survey import inspect_tables
from nics_drl_bridge.recording.textbook import record
from nics_drl_bridge.recording.write import write_drive
from nics_drl_bridge.robot.spec import load_robot

from .tables import drive, write

NAMES = {
    "x": "vicon x",
    "y": "vicon y",
    "yaw": "vicon yaw",
    "v": "throttle",
    "w": "steering",
}


def surveyed(path):
    tables, text = written(path)
    return tables, parse_yaml(text, "guess")


def written(path):
    with open_source(path) as source:
        tables = inspect_tables(source)
    return tables, propose_mapping(tables).text


def test_guesses_reach_over_files_split_stamps_and_quaternions(tmp_path):
    columns = drive()
    ns = np.round((1.7e9 + columns["t"]) * 1e9).astype(np.int64)
    split = {"": np.arange(200), "s": ns // 10**9, "ns": ns % 10**9}
    half = columns["yaw"] / 2.0
    zero = np.zeros(200)
    turned = {"q.x": zero, "q.y": zero, "q.z": np.sin(half), "q.w": np.cos(half)}
    write(
        tmp_path / "pose.csv", split | {"x": columns["x"], "y": columns["y"]} | turned
    )
    write(
        tmp_path / "odom.csv", split | {"x": columns["x"], "y": columns["y"]} | turned
    )
    write(
        tmp_path / "cmd.csv",
        split | {"V": columns["v"] + 0.1 * half, "delta": columns["w"]},
    )
    _, guess = surveyed(tmp_path)
    assert guess["time"] == ["s", "ns"]
    assert guess["pose"]["in"] == "pose.csv"
    found = read_recording(tmp_path, mapping=Mapping.model_validate(guess))
    assert found.variables == ("speed_command", "steering_command")
    assert np.allclose(found.pose.values[:, 2], columns["yaw"])


@pytest.mark.parametrize(
    "column", [np.array([["2024-01-01T00:00:01"]], "datetime64[s]"), np.zeros((0, 3))]
)
def test_dates_and_empty_arrays_are_listed(tmp_path, column):
    np.save(tmp_path / "log.npy", column)
    with open_source(tmp_path / "log.npy") as source:
        (table,) = inspect_tables(source)
    assert table.rows == len(column)


def test_a_unit_of_the_pose_that_no_name_shows_is_in_doubt(tmp_path):
    columns = drive()
    wavy = {"pose.x": 3e3 * np.sin(columns["t"] * 3.0), "pose.y": columns["y"] * 1e3}
    wavy["pose.theta"] = np.degrees(columns["yaw"] * 40.0)
    _, text = written(write(tmp_path / "log.csv", {"time": columns["t"] * 1e3} | wavy))
    guess = parse_yaml(text, "guess")
    assert guess["time"] == {"from": "time", "unit": "ms"}
    assert "heading_unit" not in guess["pose"]
    assert text.startswith("# doubt: pose: the heading ")
    assert text.splitlines()[0].endswith("add `heading_unit: deg`")


def test_columns_without_names_are_no_pose(tmp_path):
    columns = drive(1500) | {"v": np.sin(np.arange(1500) * 0.05)}
    _, guess = surveyed(write(tmp_path / "log.csv", columns, header=False))
    assert guess["time"] == 0
    assert guess["pose"] == {"x": None, "y": None}
    assert guess["command"] is None


def test_gaps_backward_stamps_repeated_and_missing_rows_are_listed(tmp_path):
    columns = drive()
    order = np.concatenate([np.arange(50), [49, 49], np.arange(90, 200)])
    t = columns["t"].copy()
    t[150:] -= 0.5
    columns["yaw"][130:142] = np.nan
    path = write(
        tmp_path / "log.csv", {k: c[order] for k, c in (columns | {"t": t}).items()}
    )
    (table,), _ = surveyed(path)
    text = "\n".join(table.regularity)
    assert "12 of 162 rows have no yaw" in text
    assert "gaps: 1, the longest of 0.82 s after 1.0 s" in text
    assert "stamps that run backwards: 1" in text
    assert "stamps like the one before: 2, in rows that repeat all of it: 2" in text


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("Left_Tick", ["left", "tick"]),
        ("cmdVel", ["cmd", "vel"]),
        ("acc x (IMU)", ["acc", "x", "imu"]),
    ],
)
def test_names_are_split_into_words(name, words):
    assert split_words(name) == words


SAID = {"x": "utm_easting", "y": "utm_northing", "yaw": "tracker_heading_deg"}
MEASURES = {"v": "cmd speed [km/h]", "w": "cmd_steer_angle", "t": "stamp"}


def test_units_and_places_are_understood_from_names(tmp_path):
    columns = drive()
    columns |= {
        "x": 4e5 + columns["x"],
        "yaw": np.degrees(columns["yaw"]),
        "v": columns["w"] * 3.6,
    }
    names = SAID | MEASURES
    path = write(
        tmp_path / "log.csv", {names[name]: column for name, column in columns.items()}
    )
    _, guess = surveyed(path)
    assert guess["pose"]["heading_unit"] == "deg"
    found = read_recording(path, mapping=Mapping.model_validate(guess))
    assert np.allclose(found.pose.values[:, 2], drive()["yaw"])
    assert np.allclose(found.command.values[:, 0], columns["w"])


def test_a_source_without_a_readable_table_is_refused(tmp_path):
    (tmp_path / "log.csv").write_bytes(b"\0\1\2")
    with pytest.raises(RecordingError, match="is not text"):
        surveyed(tmp_path)
    write(tmp_path / "good.csv", drive())
    tables, _ = surveyed(tmp_path)
    assert "is not text" in tables[1].findings[0]


def test_a_command_that_was_zero_throughout_stays_one(tmp_path):
    columns = {NAMES.get(name, name): column for name, column in drive().items()}
    path = write(tmp_path / "log.csv", columns | {"steering": 0.0 * columns["t"]})
    assert "  steering: steering  # guessed; it is 0" in written(path)[1]
    _, guess = surveyed(path)
    assert guess["robot"]["kind"] == "ackermann_throttle"


def test_a_pose_that_shares_no_time_with_the_commands_has_a_clock_of_its_own(tmp_path):
    columns = drive()
    write(
        tmp_path / "pose.csv", {name: columns[name] for name in ("t", "x", "y", "yaw")}
    )
    late = {
        "t": columns["t"] + 1.7e9,
        "throttle": columns["v"],
        "steering": columns["w"],
    }
    write(tmp_path / "cmd.csv", late)
    _, guess = surveyed(tmp_path)
    assert guess["pose"]["clock"] == "tracker"
    found = read_recording(tmp_path, mapping=Mapping.model_validate(guess))
    assert found.pose.t[0] == found.command.t[0] == pytest.approx(0.0)


def test_a_drive_over_midnight_has_one_clock(tmp_path):
    columns = drive()
    times = np.datetime64("2026-01-01T23:59:58") + np.round(columns["t"] * 1e3).astype(
        "m8[ms]"
    )
    stamps = [str(time).partition("T")[2] for time in times]
    rest = {"x": columns["x"], "y": columns["y"], "theta": columns["yaw"]}
    commands = {"v_cmd": columns["v"], "w_cmd": columns["w"]}
    _, guess = surveyed(
        write(tmp_path / "log.csv", {"timestamp": stamps} | rest | commands)
    )
    assert "clock" not in guess["pose"]


@pytest.mark.parametrize(
    ("unit", "since", "own"), [(1e9, 0.0, True), (1.0, 0.0, False), (1e9, 5.0, False)]
)
def test_a_pose_that_counts_from_its_first_row_in_another_unit_has_a_clock(
    tmp_path, unit, since, own
):
    columns = drive()
    pose = {name: columns[name] for name in ("t", "x", "y", "yaw")}
    write(tmp_path / "pose.csv", pose | {"t": unit * (since + columns["t"])})
    later = {
        "t": since + 0.13 + columns["t"],
        "throttle": columns["v"],
        "steering": columns["w"],
    }
    write(tmp_path / "cmd.csv", later)
    assert ("clock" in surveyed(tmp_path)[1]["pose"]) == own


@pytest.mark.parametrize(
    ("names", "alike"),
    [
        (
            ("cmd_vel.linear.x", "cmd_vel.angular.z"),
            "{kind: differential, *, or skid_steer; ",
        ),
        (("speed_cmd", "steering_cmd"), "{kind: ackermann, *, or tricycle; "),
        (("throttle", "steering"), "{kind: ackermann_throttle, *guessed; "),
    ],
)
def test_kinds_of_robots_with_the_same_commands_are_named_beside_the_guess(
    tmp_path, names, alike
):
    columns = drive()
    columns |= {names[0]: columns.pop("v"), names[1]: columns.pop("w")}
    _, text = written(write(tmp_path / "log.csv", columns))
    start, end = alike.split("*")
    assert start in text.splitlines()[0]
    assert end in text.splitlines()[0]


def test_a_recording_that_this_package_wrote_needs_no_mapping(tmp_path):
    robot = load_robot("differential")
    driven = record(robot, np.random.default_rng(0), 5.0)
    write_drive(driven, tmp_path / "drive.npz", robot)
    write_drive(driven, tmp_path / "bag", robot)
    assert explain_no_mapping(tmp_path / "drive.npz") == "was written by this package"
    assert "/cmd_vel and /odom" in explain_no_mapping(tmp_path / "bag")
    assert explain_no_mapping(write(tmp_path / "log.csv", drive())) == ""


def test_columns_that_a_mapping_does_not_use_are_named_by_table(tmp_path):
    columns = drive()
    write(tmp_path / "a.csv", {name: columns[name] for name in ("t", "x", "y", "yaw")})
    more = {f"pump{k}": np.full(200, k) for k in range(22)}
    write(tmp_path / "b.csv", {"t": columns["t"], "throttle": columns["v"]} | more)
    rest = {"seq": np.arange(200), "rest": columns["t"], "mode": ["FAST"] * 200}
    write(tmp_path / "c.csv", {"t": columns["t"], "steering": columns["w"]} | rest)
    first, last = written(tmp_path)[1].splitlines()[-2:]
    assert first.startswith("# not used: b.csv: pump0 (constant), pump1 (constant), ")
    assert first.endswith("pump19 (constant) and 2 more")
    assert last == "# not used: c.csv: rest, mode (no numbers)"


def test_streams_of_different_lengths_in_one_file_are_guessed_apart(tmp_path):
    columns = drive()
    half = columns["yaw"][:150] / 2.0
    turned = {f"q{axis}": 0.0 * half for axis in "xy"}
    turned |= {"qz": np.sin(half), "qw": np.cos(half)}
    quick = np.linspace(0.0, 20.0, 321)
    streams = {"wheel_t": quick, "ticks_left": quick, "ticks_right": quick[:300]}
    for name, pose in (("yaw", {"yaw": columns["yaw"]}), ("quaternion", turned)):
        place = {key: columns[key] for key in ("t", "x", "y", "v")}
        np.savez(tmp_path / f"{name}.npz", **place, **pose, **streams)
        guess = surveyed(tmp_path / f"{name}.npz")[1]["pose"]
        found = guess.get("quaternion") or [guess["heading"]]
        assert found == list(pose)
