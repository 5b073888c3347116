from __future__ import annotations

import numpy as np
import pytest

from nics_drl_bridge.errors import ConfigError, RecordingError
from nics_drl_bridge.recording.mapping import Mapping, load_mapping
from nics_drl_bridge.recording.readers import (
    open_drive,
    read_recording,
    reorder_variables,
)
from nics_drl_bridge.recording.recording import load_recording, save_recording
from nics_drl_bridge.robot.spec import load_robot

from .tables import MAP, drive, read, write


@pytest.fixture
def columns():
    return drive()


def same(one, other):
    return all(
        np.allclose(one.streams[name].t, other.streams[name].t, atol=1e-6)
        and np.allclose(one.streams[name].values, other.streams[name].values)
        for name in one.streams
    )


def test_columns_are_streams_by_name_or_by_number(tmp_path, columns):
    named = read(write(tmp_path / "log.csv", columns))
    assert np.allclose(named.pose.values[:, 2], columns["yaw"])
    assert named.variables == ("v", "w")
    assert named.repairs == ()
    numbered = read(
        write(tmp_path / "plain.csv", columns, header=False),
        time=0,
        pose={"x": 1, "y": 2, "heading": 3},
        command={"v": 4, "w": 5},
    )
    assert same(named, numbered)


def test_stamps_since_1970_begin_near_zero_split_or_as_dates(tmp_path, columns):
    whole = read(write(tmp_path / "a.csv", columns))
    ns = np.round((1.7e9 + columns["t"]) * 1e9).astype(np.int64)
    split = {"s": ns // 10**9, "ns": ns % 10**9} | columns
    assert same(read(write(tmp_path / "b.csv", split), time=["s", "ns"]), whole)
    dates = {"date": ns.astype("datetime64[ns]").astype(str)} | columns
    assert same(read(write(tmp_path / "c.csv", dates), time="date"), whole)
    assert same(read(tmp_path / "a.csv", time={"rate": 50}), whole)


def test_units_scale_and_offset_lead_to_si(tmp_path, columns):
    whole = read(write(tmp_path / "a.csv", columns))
    other = columns | {
        "t": columns["t"] * 1e3,
        "x": columns["x"] * 100.0,
        "y": columns["y"] * 100.0,
        "yaw": np.degrees(columns["yaw"]),
        "v": columns["v"] * 3.6,
        "w": columns["w"] / 0.4 * 100.0,
    }
    found = read(
        write(tmp_path / "b.csv", other),
        time={"from": "t", "unit": "ms"},
        pose={
            "x": "x",
            "y": "y",
            "heading": "yaw",
            "unit": "cm",
            "heading_unit": "deg",
        },
        command={
            "v": {"from": "v", "unit": "km/h"},
            "w": {"from": "w", "unit": "%", "maximum": 0.4},
        },
    )
    assert same(found, whole)
    pulses = columns | {"v": 1500.0 + columns["v"] * 500.0}
    value = {"from": "v", "scale": 1 / 500.0, "offset": -3.0}
    found = read(write(tmp_path / "c.csv", pulses), command={"v": value, "w": "w"})
    assert same(found, whole)


def test_a_command_counts_only_while_its_flags_are_set(tmp_path, columns):
    more = columns | {
        "safe": columns["t"] > 1.0,
        "mode": np.where(columns["t"] < 3, "AUTO", "RC"),
    }
    value = {
        "from": "v",
        "when": {"safe": 1, "mode": ["auto", "idle"]},
        "otherwise": -1.0,
    }
    found = read(write(tmp_path / "log.csv", more), command={"v": value})
    on = (columns["t"] > 1.0) & (columns["t"] < 3.0)
    assert np.array_equal(found.command.values[:, 0], np.where(on, 0.5, -1.0))


def test_quaternions_are_headings_and_variances_deviations(tmp_path, columns):
    half = columns["yaw"] / 2.0
    zero = np.zeros_like(half)
    other = columns | {
        "qz": np.sin(half),
        "qw": np.cos(half),
        "q": zero,
        "c": zero + 4.0,
    }
    pose = {
        "x": {"from": "x", "scale": 100.0},
        "y": {"from": "y", "scale": 100.0},
        "unit": "cm",
        "quaternion": ["q", "q", "qz", "qw"],
    }
    path = write(tmp_path / "log.csv", other)
    found = read(path, pose=pose | {"covariance": ["c", "c", "c"]})
    assert np.allclose(found.pose.values[:, 2], columns["yaw"])
    assert np.allclose(found.pose.sigma, [2.0, 2.0, 2.0])  # scaled as the values are
    matrix = ["c", "q", "q", "q", "c", "q", "q", "q", "c"]
    pose |= {"x": "x", "y": "y", "covariance": matrix}
    found = read(path, pose=pose)
    assert np.allclose(found.pose.sigma, [0.02, 0.02, 2.0])
    assert read(path, pose=pose | {"covariance": ["q"] * 3}).pose.sigma is None


def test_a_variance_that_is_no_positive_number_is_unknown(tmp_path, columns):
    variance = np.full_like(columns["x"], 4.0)
    variance[3:6] = 0.0, -1.0, np.inf
    path = write(tmp_path / "log.csv", columns | {"c": variance})
    pose = {"x": "x", "y": "y", "heading": "yaw", "covariance": ["c", "c", "c"]}
    found = read(path, pose=pose)
    known = np.isfinite(found.pose.sigma).all(axis=1)
    assert np.flatnonzero(~known).tolist() == [3, 4, 5]
    assert (found.pose.sigma[known] == 2.0).all()
    assert any("3 of " in told and "variance" in told for told in found.repairs)


def test_counts_that_come_at_once_are_of_the_time_since_the_burst_before(
    tmp_path, columns
):
    t = np.repeat(columns["t"][::2], 2)
    t[1::2] += 0.001
    bursts = {
        "t": t,
        "x": t,
        "y": 0.0 * t,
        "yaw": 0.0 * t,
        "n": np.round(700.0 * t),
        "w": 0.0 * t,
    }
    path = write(tmp_path / "log.csv", bursts)
    found = read(
        path, command={"left": {"from": "n", "unit": "ticks", "ticks_per_turn": 100}}
    )
    speed = 700.0 * 2.0 * np.pi / 100.0
    assert found.command.values == pytest.approx(
        speed, rel=0.05
    )  # not that of a millisecond


def test_the_rate_of_a_counter_holds_until_the_stamp_that_shows_it(tmp_path, columns):
    speed = np.where(columns["t"] < 2.0, 400.0, 900.0)
    ticks = 65_000.0 + np.append(0.0, np.cumsum(speed[:-1] * 0.02))
    path = write(tmp_path / "log.csv", columns | {"n": ticks % 65_536, "m": -ticks})
    value = {"from": "n", "ticks_per_turn": 100}
    backwards = {"from": "m", "unit": "ticks", "scale": -1}
    found = read(path, command={"left": value, "right": backwards})
    assert np.allclose(
        found.command.values, speed[:-1, None] * [2.0 * np.pi / 100.0, 1.0]
    )
    assert np.allclose(found.command.t, columns["t"][:-1])
    assert found.repairs == (
        "command.left: the counter overflowed once, at 65536, as it seems, and was continued.",
    )
    wheels = read(path, wheels={"left": value, "right": backwards}).wheels
    assert np.allclose(
        wheels.t, columns["t"][:-1] + 0.01
    )  # measured between two stamps


def test_an_absolute_encoder_is_an_angle_about_zero(tmp_path, columns):
    angle = 0.3 * np.sin(
        columns["t"] - 0.5
    )  # begins below zero, near the end of its range
    counts = np.round(angle / (2.0 * np.pi) * 8192) % 8192
    value = {"from": "n", "ticks_per_turn": 8192, "wrap": 8192, "differentiate": False}
    found = read(
        write(tmp_path / "log.csv", columns | {"n": counts}),
        command={"steering": value},
    )
    assert np.allclose(found.command.values[:, 0], angle, atol=1e-3)


@pytest.mark.parametrize(
    ("reach", "period"), [(50.0, 0.5), (1000.0, 100.0), (0.0, 1.0)]
)
def test_a_wheel_that_goes_to_and_fro_or_trembles_is_counted(
    tmp_path, columns, reach, period
):
    turned = reach * np.sin(columns["t"] * 2.0 * np.pi / period)
    ticks = np.round(turned) + np.round(np.sin(columns["t"] * 100.0))
    path = write(tmp_path / "log.csv", columns | {"n": ticks})
    found = read(path, command={"left": {"from": "n", "unit": "ticks"}})
    assert len(found.command.values) == len(ticks) - 1


def test_a_folder_has_its_values_in_several_files(tmp_path, columns):
    pick = ("t", "x", "y", "yaw")
    write(tmp_path / "pose.csv", {name: columns[name] for name in pick})
    write(tmp_path / "speed.csv", {"t": columns["t"][::10], "v": columns["v"][::10]})
    turn = {"t": columns["t"][::7] + 0.003, "w": columns["w"][::7]}
    write(tmp_path / "turn.tsv", turn, "\t")
    pose = {"in": "pose.csv", "x": "x", "y": "y", "heading": "yaw"}
    found = read(tmp_path, pose=pose, command={"v": "speed.csv:v", "w": "turn:w"})
    assert found.command.t[0] == pytest.approx(0.003)  # from when both are known
    changed = found.command.t[np.argmax(found.command.values[:, 1] > 0.27)]
    assert changed == pytest.approx(turn["t"][np.argmax(turn["w"] > 0.27)])


def test_streams_of_other_clocks_keep_their_offset_or_begin_at_zero(tmp_path, columns):
    path = write(
        tmp_path / "log.csv",
        columns | {"near": columns["t"] + 1.0, "far": columns["t"] + 1e9},
    )
    pose = {"x": "x", "y": "y", "heading": "yaw", "clock": "mocap"}
    near = read(path, pose=pose | {"time": "near"})
    assert (near.pose.t[0], near.command.t[0]) == pytest.approx((1.0, 0.0))
    far = read(path, pose=pose | {"time": "far"})
    assert (far.pose.t[0], far.pose.clock, far.command.clock) == (0.0, "mocap", "robot")
    assert "The clock 'mocap' was set to 0" in far.repairs[0]


def test_what_was_mended_is_told(tmp_path, columns):
    sparse = {name: column.astype(object) for name, column in columns.items()}
    sparse["x"][::2] = sparse["y"][::2] = sparse["yaw"][::2] = ""
    sparse["t"][150:] -= 3.0
    found = read(write(tmp_path / "log.csv", sparse))
    assert len(found.pose.t) == 100
    assert "pose.x: 100 of 200 rows have no value, and were left out." in found.repairs
    assert any("set back once (row 150" in note for note in found.repairs)


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"time": None}, "which column is the time? Say as in `time: t`"),
        ({"time": "ms"}, "write `time: {from: ms, unit: ms}` into the mapping"),
        ({"command": {"v": "vv"}}, "has no column 'vv'; did you mean 'v'?"),
        ({"command": {"v": "other.csv:v"}}, "has no 'other.csv'"),
        ({"pose": {"x": "x", "y": "y", "heading": "deg"}}, "write `heading_unit: deg`"),
        ({"pose": {"x": "mm", "y": "mm", "heading": "yaw"}}, "write `unit: mm`"),
        (
            {"pose": {"x": "x", "y": "y", "quaternion": ["x", "y", "x", "y"]}},
            "x, y, z, w",
        ),
        (
            {"command": {"v": {"from": "v", "time": "later"}}},
            "give one of them a `clock:`",
        ),
    ],
)
def test_a_wrong_mapping_is_told_with_the_line_to_write(
    tmp_path, columns, changes, sentence
):
    wavy = 400.0 * np.sin(columns["t"] * 3.0)
    more = {
        "ms": columns["t"] * 1e3,
        "deg": np.degrees(columns["yaw"] * 60.0),
        "mm": wavy * 3.0,
        "later": columns["t"] + 1e4,
    }
    path = write(tmp_path / "log.csv", columns | more)
    with pytest.raises((ConfigError, RecordingError)) as refused:
        read(path, **changes)
    assert sentence in str(refused.value)


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        (
            "pose: {x: 1, y: 2, heading: 3}\ncommand: {v: {form: 1}}",
            "did you mean 'from'?",
        ),
        (
            "pose: {x: 1, y: 2}\ncommand: {v: 1}",
            "pose needs either heading or quaternion",
        ),
        (
            "pose: {x: 1, y: 2, heading: 3, unit: ms}\ncommand: {v: 1}",
            "must be one of m, dm, cm",
        ),
        (
            "pose: {x: 1, y: 2, heading: 3}\ncommand: {v: {from: 1, unit: kmph}}",
            "did you mean 'mph'?",
        ),
        (
            "pose: {x: 1, y: 2, heading: 3, covariance: [1, 2]}\ncommand: {v: 1}",
            "3, 9 or 36",
        ),
        (
            "pose: {x: 1, y: 2, heading: 3}\ncommand: {}",
            "command: names none, but a model",
        ),
    ],
)
def test_a_mapping_that_is_none_is_refused_with_file_and_key(tmp_path, text, sentence):
    (tmp_path / "my.yaml").write_text(text)
    with pytest.raises(ConfigError) as refused:
        load_mapping(tmp_path / "my.yaml")
    assert "my.yaml: " in str(refused.value)
    assert sentence in str(refused.value)


def test_commands_come_in_the_order_of_the_robot(tmp_path, columns):
    car = {"steering_command": "w", "speed_command": "v"}
    path = write(tmp_path / "log.csv", columns)
    pose = {"x": "x", "y": "y", "heading": "yaw"}
    given = {"robot": "ackermann", "time": "t", "command": car, "pose": pose}
    mapping = Mapping.model_validate(given)
    spec, found = open_drive(path, None, mapping)
    assert spec.name == "ackermann"
    assert found.variables == spec.variable_names
    assert np.allclose(found.command.values[0], [0.5, 0.25])
    with pytest.raises(
        ConfigError, match="the command is v, w, that of the robot 'ackermann'"
    ):
        reorder_variables(read(path), load_robot("ackermann"))
    with pytest.raises(ConfigError, match="names no robot; add `robot:` to it"):
        open_drive(path, None, Mapping.model_validate(given | {"robot": None}))


LORRY = "kind: tricycle\nfootprint_radius: 0.9\nparameters: {wheelbase: 1.2}\n"
STEERED = {
    "speed_command": {"from": "v", "scale": 3.0},
    "steering_command": {"from": "w"},
}


def test_a_robots_file_is_the_same_robot_however_it_is_named(tmp_path, columns):
    (tmp_path / "lorry.yaml").write_text(LORRY)
    path = write(tmp_path / "log.csv", columns)
    robot = str(tmp_path / "lorry.yaml")
    given = MAP | {"command": STEERED}
    one, other = (
        Mapping.model_validate(given | {"robot": each}) for each in ("car", robot)
    )
    spec, _ = open_drive(path, robot, one)
    assert spec == open_drive(path, None, other)[0]
    assert spec.command_high.tolist() == [1.5, 0.3]  # as recorded


def test_an_imported_drive_keeps_its_robot_as_text(tmp_path, columns):
    (tmp_path / "lorry.yaml").write_text(LORRY)
    given = MAP | {"command": STEERED, "robot": str(tmp_path / "lorry.yaml")}
    mapping = Mapping.model_validate(given)
    spec, drive = open_drive(write(tmp_path / "log.csv", columns), None, mapping)
    save_recording(drive, tmp_path / "drive.npz")
    (tmp_path / "lorry.yaml").unlink()
    back, again = open_drive(tmp_path / "drive.npz")
    assert back == spec
    assert same(drive, again)
    bare, _ = open_drive(tmp_path / "drive.npz", "ackermann")
    assert bare.name == "ackermann"


def test_an_imported_drive_keeps_deviations_and_repairs(tmp_path, columns):
    more = columns | {"c": np.full(200, 4.0)}
    more["t"] = np.concatenate([more["t"][:150], more["t"][150:] - 3.0])
    pose = {"x": "x", "y": "y", "heading": "yaw", "covariance": ["c", "c", "c"]}
    drive = read(write(tmp_path / "log.csv", more), pose=pose)
    save_recording(drive, tmp_path / "drive.npz")
    back = load_recording(tmp_path / "drive.npz")
    assert np.array_equal(back.pose.sigma, drive.pose.sigma)
    assert back.command.sigma is None
    assert back.repairs == drive.repairs != ()
    assert back.variables == ("v", "w")
    again = read_recording(
        tmp_path / "drive.npz", mapping=Mapping.model_validate(MAPPED)
    )
    assert same(
        back, again
    )  # of a recording of this package a mapping tells the robot only


MAPPED = {
    "robot": "ackermann",
    "pose": {"x": 0, "y": 1, "heading": 2},
    "command": {"v": 3, "w": 4},
}


@pytest.mark.parametrize(
    ("changes", "columns", "sentence"),
    [
        (
            {},
            {"yaw": lambda d: np.degrees(d["yaw"] + d["t"])},
            "write `heading_unit: deg` into",
        ),
        (
            {},
            {"t": lambda d: d["t"] * 0.0},
            "all of its stamps are 0 s; choose another column",
        ),
        (
            {},
            {"t": lambda d: d["t"] / 3600.0},
            "lasts 0.00111 s; give the `unit:` of its `time:`",
        ),
        (
            {"command": {"v": {"from": "v", "when": {"w": 7}}}},
            {},
            "'v' never counts: there is no row in which w is 7.0; check `when:`",
        ),
        (
            {"pose": {"x": "x", "y": "y", "quaternion": ["w", "x", "y", "z"]}},
            {
                "w": lambda d: np.cos(d["t"]),
                "x": lambda d: 0.0 * d["t"],
                "y": lambda d: 0.0 * d["t"],
                "z": lambda d: np.sin(d["t"]),
            },
            "look like w, x, y, z of a level body; list them in the order x, y, z, w",
        ),
        (
            {"command": {"v": {"from": "v", "unit": "rpm"}}},
            {"v": lambda d: np.arange(200) * 2017 % 2**16},
            "'v' is a counter that overflows at 65536, no speed: write `{from: v, unit: ticks, ",
        ),
        *(
            (
                {"command": {"v": {"from": "v", **unit}}},
                {"v": lambda d: -40 * np.arange(200)},
                "'v' is a counter that went on by 7960, no speed: write `{from: v, unit: ticks, ",
            )
            for unit in (
                {},
                *({"unit": unit} for unit in ("rad/s", "rpm", "m/s", "ticks/s")),
            )
        ),
        (
            {"command": {"v": {"from": "v", "unit": "ticks"}}},
            {"v": lambda d: 30.0 + np.round(10.0 * np.sin(200.0 * d["t"]))},
            "'v' goes up and down like a speed, and is no counter: write `unit: ticks/s` for comm",
        ),
        (
            {"time": "sec"},
            {"sec": lambda d: d["t"] // 1, "nanosec": lambda d: d["t"] % 1 * 1e9},
            "whole seconds, of 50 rows each; write `time: [sec, nanosec]` into the mapping",
        ),
        ({}, {"t": lambda d: d["t"] // 1}, "of 50 rows each; write `time: {rate: 50}`"),
    ],
)
def test_what_only_a_wrong_mapping_explains_is_refused_with_the_line_to_write(
    tmp_path, changes, columns, sentence
):
    made = drive()
    made |= {name: of(drive()) for name, of in columns.items()}
    path = write(tmp_path / "log.csv", made)
    with pytest.raises(RecordingError) as refused:
        read(path, **changes)
    assert sentence in str(refused.value)


@pytest.mark.parametrize(
    "pwm",
    [np.where(np.arange(400) % 100 < 50, -127, 127), np.zeros(400), 5 * np.arange(400)],
)
def test_commands_in_whole_numbers_are_no_counters(tmp_path, pwm):
    columns = drive(400) | {"v": pwm + np.arange(400) % 2}
    found = read(write(tmp_path / "log.csv", columns))
    assert np.array_equal(
        np.unique(found.command.values[:, 0]), np.unique(columns["v"])
    )


@pytest.mark.parametrize("form", ["2024-05-01T12:00:{:09.6f}+02:00", "12:00:{:09.6f}"])
def test_dates_with_a_zone_and_times_of_day_are_stamps(tmp_path, form):
    columns = drive()
    stamps = np.array([form.format(t) for t in columns["t"]])
    found = read(write(tmp_path / "log.csv", columns | {"t": stamps}))
    assert np.allclose(found.pose.t, columns["t"], atol=1e-6)


def test_poses_far_from_the_origin_of_a_fast_car_are_read(tmp_path):
    columns = drive()
    moved = {"x": 60.0 * columns["x"] + 4e5, "y": 60.0 * columns["y"] + 5e6}
    path = write(tmp_path / "log.csv", columns | moved)
    found = read(path, robot={"kind": "ackermann_throttle", "footprint_radius": 2.0})
    assert np.allclose(np.diff(found.pose.values[:, 0]), np.diff(moved["x"]), atol=1e-6)


def test_longitude_and_latitude_are_places_on_the_ground(tmp_path):
    columns = drive()
    far = (
        columns
        | {  # 111.2 km to a degree of latitude at 48 degrees north, 74.6 km of longitude
            "lon": 11.5 + columns["x"] / 74.626e3,
            "lat": 48.0 + columns["y"] / 111.197e3,
        }
    )
    path = write(tmp_path / "log.csv", far)
    pose = {"x": "lon", "y": "lat", "heading": "yaw", "unit": "deg"}
    found = read(path, pose=pose).pose.values[:, :2]
    moved = np.stack([columns["x"], columns["y"]], axis=1)
    assert np.allclose(found - found[0], moved - moved[0], rtol=1e-3, atol=1e-4)
    with pytest.raises(
        ConfigError, match=r"pose.y: is in m, where rad is needed; check its unit"
    ):
        read(path, pose=pose | {"y": {"from": "y", "unit": "m"}})


@pytest.mark.parametrize(
    ("value", "says"),
    [
        (
            {"from": "w", "unit": "m/s"},
            "command.steering_command: is in m/s, where rad is needed",
        ),
        (
            {"from": "w", "unit": "V"},
            "is in V, where rad is needed; check its unit, or give `scale",
        ),
        ({"from": "w", "unit": "%"}, "is in 1, where rad is needed"),
        (
            {"from": "w", "unit": "ticks", "differentiate": False},
            "add `ticks_per_turn:`",
        ),
    ],
)
def test_a_unit_of_another_kind_than_the_command_s_is_refused(
    tmp_path, columns, value, says
):
    path = write(tmp_path / "log.csv", columns)
    robot = {
        "kind": "ackermann",
        "footprint_radius": 0.2,
        "parameters": {"wheelbase": 0.3},
    }
    given = {
        "robot": robot,
        "time": "t",
        "pose": {"x": "x", "y": "y", "heading": "yaw"},
        "command": {
            "speed_command": {"from": "v", "unit": "km/h"},
            "steering_command": value,
        },
    }
    with pytest.raises(ConfigError, match=says):
        open_drive(path, None, Mapping.model_validate(given))
    scaled = given | {
        "command": given["command"] | {"steering_command": value | {"scale": 0.5}}
    }
    open_drive(path, None, Mapping.model_validate(scaled))
