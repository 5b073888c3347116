import numpy as np
import pytest

from nics_drl_bridge.config import dump_yaml, parse_yaml
from nics_drl_bridge.errors import ConfigError, RecordingError
from nics_drl_bridge.recording.mapping import load_mapping
from nics_drl_bridge.recording.readers import open_drive, reorder_variables
from nics_drl_bridge.recording.recording import save_recording
from nics_drl_bridge.robot.spec import load_robot

from .tables import change_map, drive, read, write


@pytest.fixture
def columns():
    return drive()


@pytest.fixture
def log(tmp_path, columns):
    """Writes the drive, with other columns beside or instead of its own."""
    return lambda more=None: write(tmp_path / "log.csv", columns | (more or {}))


def same(one, other):
    return all(
        np.allclose(one.streams[name].t, other.streams[name].t, atol=1e-6)
        and np.allclose(one.streams[name].values, other.streams[name].values)
        for name in one.streams
    )


def test_columns_are_streams_by_name_or_by_number(log, tmp_path, columns):
    named = read(log())
    assert np.allclose(named.pose.values[:, 2], columns["yaw"])
    assert named.variables == ("v", "w")
    assert named.repairs == ()
    path = write(tmp_path / "plain.csv", columns, header=False)
    by_number = "{time: 0, pose: {x: 1, y: 2, heading: 3}, command: {v: 4, w: 5}}"
    assert same(named, read(path, by_number))


def test_stamps_since_1970_begin_near_zero_split_or_as_dates(tmp_path, columns):
    whole = read(write(tmp_path / "a.csv", columns))
    ns = np.round((1.7e9 + columns["t"]) * 1e9).astype(np.int64)
    stamps = {"s": ns // 10**9, "ns": ns % 10**9}
    stamps["date"] = ns.astype("datetime64[ns]").astype(str)
    stamps["zone"] = [f"{date[:-3]}+02:00" for date in stamps["date"]]
    stamps["clock"] = [f"12:00:{t:09.6f}" for t in columns["t"]]
    path = write(tmp_path / "b.csv", stamps | columns)
    for time in ("[s, ns]", "date", "zone", "clock", "{rate: 50}"):
        assert same(read(path, f"time: {time}"), whole)


def test_units_scale_and_offset_lead_to_si(tmp_path, columns):
    whole = read(write(tmp_path / "a.csv", columns))
    other = columns | {
        "t": columns["t"] * 1e3,
        "x": columns["x"] * 100.0,
        "y": columns["y"] * 100.0,
        "yaw": np.degrees(columns["yaw"]),
        "v": columns["v"] * 3.6,
        "w": columns["w"] / 0.4 * 100.0,
        "pulse": 1500.0 + columns["v"] * 500.0,
    }
    changes = """
        time: {from: t, unit: ms}
        pose: {x: x, y: y, heading: yaw, unit: cm, heading_unit: deg}
        command:
          v: {from: v, unit: km/h}
          w: {from: w, unit: "%", maximum: 0.4}
    """
    path = write(tmp_path / "b.csv", other)
    assert same(read(path, changes), whole)
    pulses = changes.replace("v, unit: km/h", "pulse, scale: 0.002, offset: -3.0")
    assert same(read(path, pulses), whole)


def test_a_command_counts_only_while_its_flags_are_set(tmp_path, columns):
    more = columns | {
        "safe": columns["t"] > 1.0,
        "mode": np.where(columns["t"] < 3, "AUTO", "RC"),
    }
    found = read(
        write(tmp_path / "log.csv", more),
        "command: {v: {from: v, when: {safe: 1, mode: [auto, idle]}, otherwise: -1.0}}",
    )
    on = (columns["t"] > 1.0) & (columns["t"] < 3.0)
    assert np.array_equal(found.command.values[:, 0], np.where(on, 0.5, -1.0))


def test_quaternions_are_headings_and_variances_deviations(log, columns):
    half = columns["yaw"] / 2.0
    turned = {"qz": np.sin(half), "qw": np.cos(half), "q": 0.0 * half}
    path = log(turned | {"c": np.full(200, 4.0)})
    place = "x: {from: x, scale: 100.0}, y: {from: y, scale: 100.0}, unit: cm"
    pose = f"pose: {{{place}, quaternion: [q, q, qz, qw], covariance: [%s]}}"
    found = read(path, pose % "c, c, c")
    assert np.allclose(found.pose.values[:, 2], columns["yaw"])
    assert np.allclose(found.pose.sigma, [2.0, 2.0, 2.0])  # scaled as the values are
    unscaled = pose.replace(place, "x: x, y: y, unit: cm")
    found = read(path, unscaled % "c, q, q, q, c, q, q, q, c")
    assert np.allclose(found.pose.sigma, [0.02, 0.02, 2.0])
    assert read(path, pose % "q, q, q").pose.sigma is None


def test_a_variance_that_is_no_positive_number_is_unknown(log, columns):
    variance = np.full_like(columns["x"], 4.0)
    variance[3:6] = 0.0, -1.0, np.inf
    path = log({"c": variance})
    found = read(path, "pose: {x: x, y: y, heading: yaw, covariance: [c, c, c]}")
    known = np.isfinite(found.pose.sigma).all(axis=1)
    assert np.flatnonzero(~known).tolist() == [3, 4, 5]
    assert (found.pose.sigma[known] == 2.0).all()
    assert any("3 of " in told and "variance" in told for told in found.repairs)


def test_counts_that_come_at_once_are_of_the_time_since_the_burst_before(
    tmp_path, columns
):
    t = np.repeat(columns["t"][::2], 2)
    t[1::2] += 0.001
    still = dict.fromkeys(("y", "yaw", "w"), 0.0 * t)
    path = write(tmp_path / "log.csv", {"t": t, "x": t, "n": np.round(700 * t)} | still)
    found = read(path, "command: {left: {from: n, unit: ticks, ticks_per_turn: 100}}")
    speed = 700.0 * 2.0 * np.pi / 100.0  # not that of a millisecond
    assert found.command.values == pytest.approx(speed, rel=0.05)


def test_the_rate_of_a_counter_holds_until_the_stamp_that_shows_it(log, columns):
    speed = np.where(columns["t"] < 2.0, 400.0, 900.0)
    ticks = 65_000.0 + np.append(0.0, np.cumsum(speed[:-1] * 0.02))
    path = log({"n": ticks % 65_536, "m": -ticks})
    sides = "{left: {from: n, ticks_per_turn: 100}, right: {from: m, unit: ticks, scale: -1}}"
    found = read(path, f"command: {sides}")
    assert np.allclose(
        found.command.values, speed[:-1, None] * [2.0 * np.pi / 100.0, 1.0]
    )
    assert np.allclose(found.command.t, columns["t"][:-1])
    (told,) = found.repairs
    assert "command.left: the counter overflowed once, at 65536" in told
    wheels = read(path, f"wheels: {sides}").wheels
    assert np.allclose(wheels.t, columns["t"][:-1] + 0.01)  # between two stamps


def test_an_absolute_encoder_is_an_angle_about_zero(log, columns):
    # It begins below zero, near the end of its range.
    angle = 0.3 * np.sin(columns["t"] - 0.5)
    counts = np.round(angle / (2.0 * np.pi) * 8192) % 8192
    value = "{from: n, ticks_per_turn: 8192, wrap: 8192, differentiate: false}"
    path = log({"n": counts})
    found = read(path, f"command: {{steering: {value}}}")
    assert np.allclose(found.command.values[:, 0], angle, atol=1e-3)


def test_a_folder_has_its_values_in_several_files(tmp_path, columns):
    pick = ("t", "x", "y", "yaw")
    write(tmp_path / "pose.csv", {name: columns[name] for name in pick})
    write(tmp_path / "speed.csv", {"t": columns["t"][::10], "v": columns["v"][::10]})
    turn = {"t": columns["t"][::7] + 0.003, "w": columns["w"][::7]}
    write(tmp_path / "turn.tsv", turn, "\t")
    changes = """
        pose: {in: pose.csv, x: x, y: y, heading: yaw}
        command: {v: "speed.csv:v", w: "turn:w"}
    """
    found = read(tmp_path, changes)
    assert found.command.t[0] == pytest.approx(0.003)  # from when both are known
    changed = found.command.t[np.argmax(found.command.values[:, 1] > 0.27)]
    assert changed == pytest.approx(turn["t"][np.argmax(turn["w"] > 0.27)])


def test_streams_of_other_clocks_keep_their_offset_or_begin_at_zero(log, columns):
    stamps = {"near": columns["t"] + 1.0, "far": columns["t"] + 1e9}
    path = log(stamps)
    pose = "pose: {x: x, y: y, heading: yaw, clock: mocap, time: %s}"
    near = read(path, pose % "near")
    assert (near.pose.t[0], near.command.t[0]) == pytest.approx((1.0, 0.0))
    far = read(path, pose % "far")
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


def spoil(columns):
    """Adds columns of which no mapping makes sense."""
    t = columns["t"]
    wavy = 400.0 * np.sin(t * 3.0)
    more = {
        "cov_xx": t,
        "lat": 47.5 + t / 1e5,
        "ms": t * 1e3,
        "still": t * 0.0,
        "short": t / 3600.0,
        "later": t + 1e4,
        "sec": t // 1,
        "nanosec": t % 1 * 1e9,
        "deg": np.degrees(columns["yaw"] * 60.0),
        "mm": wavy * 3.0,
        "qw": np.cos(t),
        "zero": 0.0 * t,
        "qz": np.sin(t),
        "count": np.arange(200) * 2017 % 2**16,
        "back": -40 * np.arange(200),
        "noisy": 30.0 + np.round(10.0 * np.sin(200.0 * t)),
    }
    return columns | more


WRONG = """
time: null -> `time: t`
time: ms -> `time: {from: ms, unit: ms}`
time: still -> all of its stamps are 0 s
time: short -> add `unit:` to its `time:`
time: sec -> `time: [sec, nanosec]`
{time: sec, in: log.csv} -> with 50 rows each
command: {v: vv} -> did you mean 'v'?
command: {v: "other.csv:v"} -> has no 'other.csv'
command: {v: {from: v, time: later}} -> separate `clock:`
command: {v: {from: v, when: {w: 7}}} -> w is 7.0
command: {v: {from: count, unit: rpm}} -> {from: count, unit: ticks,
command: {v: back} -> {from: back, unit: ticks,
command: {v: {from: back, unit: m/s}} -> changed by 7960 in one direction, not a speed
command: {v: lat} -> 'lat' looks like a latitude or longitude, which was
command: {v: 6} -> 'cov_xx' shows how uncertain a measurement is
command: {v: {from: noisy, unit: ticks}} -> `unit: ticks/s`
pose: {x: x, y: y, heading: deg} -> `heading_unit: deg`
pose: {x: mm, y: mm, heading: yaw} -> `unit: mm`
pose: {x: x, y: y, quaternion: [x, y, x, y]} -> order x, y, z, w
pose: {x: x, y: y, quaternion: [qw, zero, zero, qz]} -> look like w, x, y, z
"""


@pytest.mark.parametrize("case", WRONG.strip().splitlines())
def test_what_only_a_wrong_mapping_explains_is_refused_with_the_line_to_write(
    log, columns, case
):
    changes, fix = case.split(" -> ")
    path = log(spoil(columns))
    with pytest.raises((ConfigError, RecordingError)) as refused:
        read(path, changes)
    assert fix in str(refused.value)


NO_MAPPINGS = """
command: {v: {form: 1}} -> mean 'from'?
pose: {x: 1, y: 2} -> either heading or quaternion
pose: {x: 1, y: 2, heading: 3, unit: ms} -> one of m, dm
command: {v: {from: 1, unit: kmph}} -> mean 'mph'?
pose: {x: 1, y: 2, heading: 3, covariance: [1, 2]} -> 3, 9 or 36
command: -> command: is empty, but
command: {v: "/fix:longitude"} -> shows where the robot was, and was not
"""


@pytest.mark.parametrize("case", NO_MAPPINGS.strip().splitlines())
def test_a_mapping_that_is_none_is_refused_with_file_and_key(tmp_path, case):
    text, sentence = case.split(" -> ")
    given = {"pose": "/odom", "command": {"v": 1}} | parse_yaml(text, "changes")
    (tmp_path / "my.yaml").write_text(dump_yaml(given))
    with pytest.raises(ConfigError) as refused:
        load_mapping(tmp_path / "my.yaml")
    assert "my.yaml: " in str(refused.value)
    assert sentence in str(refused.value)


STEERED = """
robot: %s
command: {steering_command: {from: w}, speed_command: {from: v, scale: 3.0}}
"""
LORRY = "kind: tricycle\nfootprint_radius: 0.9\nparameters: {wheelbase: 1.2}\n"


def test_commands_come_in_the_order_of_the_robot(log):
    path = log()
    spec, found = open_drive(path, None, change_map(STEERED % "ackermann"))
    assert spec.name == "ackermann"
    assert found.variables == spec.variable_names
    assert np.allclose(found.command.values[0], [1.5, 0.25])
    with pytest.raises(ConfigError, match="the command is v, w, that of"):
        reorder_variables(read(path), load_robot("ackermann"))
    with pytest.raises(ConfigError, match="names no robot; add `robot:` to it"):
        open_drive(path, None, change_map(STEERED % "null"))


def test_a_robots_file_is_one_robot_however_it_is_named_and_is_kept(log, tmp_path):
    file = tmp_path / "lorry.yaml"
    file.write_text(LORRY)
    path = log()
    spec, drive = open_drive(path, None, change_map(STEERED % file))
    assert spec == open_drive(path, str(file), change_map(STEERED % "car"))[0]
    assert sorted(spec.command_high) == [0.3, 1.5]  # as recorded
    save_recording(drive, tmp_path / "drive.npz")
    file.unlink()
    back, again = open_drive(tmp_path / "drive.npz")
    assert back == spec
    assert same(drive, again)
    by_mapping = change_map("{robot: ackermann, command: {x: 3}}")
    for named in (("ackermann", None), (None, by_mapping)):  # tells the robot only
        assert open_drive(tmp_path / "drive.npz", *named)[0].name == "ackermann"


def test_poses_far_from_the_origin_of_a_fast_car_are_read(log, columns):
    moved = {"x": 60.0 * columns["x"] + 4e5, "y": 60.0 * columns["y"] + 5e6}
    path = log(moved)
    found = read(path, "robot: {kind: ackermann_throttle, footprint_radius: 2.0}")
    assert np.allclose(np.diff(found.pose.values[:, 0]), np.diff(moved["x"]), atol=1e-6)


def test_longitude_and_latitude_are_places_on_the_ground(log, columns):
    # 111.2 km to a degree of latitude at 48 degrees north, 74.6 km of longitude
    far = {
        "lon": 11.5 + columns["x"] / 74.626e3,
        "lat": 48.0 + columns["y"] / 111.197e3,
    }
    path = log(far)
    pose = "pose: {x: lon, y: %s, heading: yaw, unit: deg}"
    found = read(path, pose % "lat").pose.values[:, :2]
    moved = np.stack([columns["x"], columns["y"]], axis=1)
    assert np.allclose(found - found[0], moved - moved[0], rtol=1e-3, atol=1e-4)
    with pytest.raises(ConfigError, match=r"pose.y: is in m, where rad is needed"):
        read(path, pose % "{from: y, unit: m}")


@pytest.mark.parametrize(
    ("unit", "says"),
    [
        ("m/s", "command.steering_command: is in m/s, where rad is needed"),
        ("V", "is in V, where rad is needed; check its unit, or give `scale"),
        ('"%"', "is in 1, where rad is needed"),
        ("ticks, differentiate: false", "add `ticks_per_turn:`"),
    ],
)
def test_a_unit_of_another_kind_than_the_command_s_is_refused(log, unit, says):
    path = log()
    changes = """
        robot: {kind: ackermann, footprint_radius: 0.2, parameters: {wheelbase: 0.3}}
        command:
          speed_command: {from: v, unit: km/h}
          steering_command: {from: w, unit: %s}
    """
    with pytest.raises(ConfigError, match=says):
        open_drive(path, None, change_map(changes % unit))
    open_drive(path, None, change_map(changes % f"{unit}, scale: 0.5"))


POSE = "pose: {x: odom_x, y: odom_y, heading: odom_yaw%s}\n"


@pytest.mark.parametrize(
    ("key", "measured_by"), [("", "odometry"), (", measured_by: tracker", "tracker")]
)
def test_a_second_heading_column_is_a_turn_rate(log, columns, key, measured_by):
    odometry = {f"odom_{name}": columns[name] for name in ("x", "y", "yaw")}
    second = {"second": np.degrees(columns["yaw"] * 30.0) % 360.0}
    path = log(odometry | second)
    changes = f"{POSE % key}imu: {{heading: {{from: second, unit: deg}}}}"
    found = read(path, changes)
    assert found.imu.values[:, 2] == pytest.approx(0.25 * 30.0, abs=1e-3)
    assert found.measured_by == measured_by  # by the names, unless the mapping says it
