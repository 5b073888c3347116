from __future__ import annotations

import json
import os
import subprocess
from pathlib import Path

import pytest
from typer.testing import CliRunner

pytest.importorskip("rosbags", reason="needs the extra 'bags'")
pytest.importorskip("pyarrow", reason="writes Parquet")

import bags
import numpy as np
from mcap.reader import make_reader
from pyarrow import parquet
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from nics_drl_bridge.commands.cli import app
from nics_drl_bridge.extras.bags.frames import frames_of
from nics_drl_bridge.generator import open_model
from nics_drl_bridge.interface import NS_PER_S

FPS = 20
LEROBOT = os.environ.get("LEROBOT_PYTHON")  # an interpreter that has lerobot


def export(*words):
    return CliRunner().invoke(app, ["bag", "export", *map(str, words)])


def drive(duration=3.0, silent=(), anew_s=None, beams=6):
    """A drive along a circle that is silent for some spans, and begins anew at `anew_s`."""

    def heard(step):
        times = bags.times(step, duration)
        return [t for t in times if not any(a < t < b for a, b in silent)]

    def where(t):
        return bags.place_at(t - (anew_s or 0.0) if t >= (anew_s or duration) else t)

    scans = [(t, bags.scan(t, beams)) for t in heard(0.1)]
    for k, (_, scan) in enumerate(scans):
        scan.ranges[:] = np.linspace(1.0, 2.0, beams) + 0.001 * k
    return {
        "/odom": [(t, bags.odometry(t, *where(t))) for t in heard(0.02)],
        "/scan": scans,
        "/cmd_vel": [
            (t + 0.013, bags.twist(0.1 * t, 0.0, 0.2)) for t in heard(1.0 / FPS)
        ],
    }


def newest(rows, t):
    """What was received last by a time."""
    return [message for received, message in rows if bags.ns(received) <= t][-1]


@pytest.fixture
def exported(tmp_path):
    """A drive in three episodes, as topics and as a dataset."""
    topics = drive(6.0, silent=[(1.5, 3.0)], anew_s=4.5)
    bag = bags.write(tmp_path / "bag", topics)
    folder = tmp_path / "set"
    words = ("--lerobot", folder, "--task", "Go round.", "--succeeded", "0,2")
    told = export(bag, *words)
    assert told.exit_code == 0, told.output
    return topics, folder, bag


def rows_of(folder):
    return parquet.read_table(folder / "data/chunk-000/file-000.parquet").to_pydict()


def test_each_frame_has_the_newest_data_received_by_its_time(tmp_path):
    topics = drive()
    bag = bags.write(tmp_path / "bag", topics)
    frames = frames_of(bag, {})
    assert frames.fps == FPS
    assert len(frames.received_ns) > 50
    state, scan, action = (feature.values for feature in frames.features.values())
    for k, t in enumerate(frames.received_ns):
        place = newest(topics["/odom"], t).pose.pose.position
        assert state[k, :2] == pytest.approx([place.x, place.y])
        np.testing.assert_array_equal(scan[k], newest(topics["/scan"], t).ranges)
        assert action[k, 0] == pytest.approx(newest(topics["/cmd_vel"], t).linear.x)


def test_what_is_received_later_changes_no_frame(tmp_path):
    topics = drive()
    whole = frames_of(bags.write(tmp_path / "whole", topics), {}, fps=FPS)
    until = bags.ns(2.0)
    early = {
        name: [r for r in rows if bags.ns(r[0]) <= until]
        for name, rows in topics.items()
    }
    cut = frames_of(bags.write(tmp_path / "cut", early), {}, fps=FPS)
    same = int((cut.received_ns <= until).sum())
    assert same > 30
    for name, feature in cut.features.items():
        np.testing.assert_array_equal(
            feature.values[:same], whole.features[name].values[:same]
        )


def test_an_episode_ends_in_a_silence_and_where_the_robot_is_placed_anew(exported):
    _, folder, _ = exported
    rows = rows_of(folder)
    assert sorted(set(rows["episode_index"])) == [0, 1, 2]
    x = np.array(rows["observation.state"])[:, 0]
    episode = np.array(rows["episode_index"])
    for k in range(3):
        own = x[episode == k]
        assert np.abs(np.diff(own)).max() < 0.1, "a jump within an episode"
    begins = [np.array(rows["timestamp"])[episode == k][0] for k in range(3)]
    assert begins == [0.0, 0.0, 0.0]


def test_no_frame_has_data_older_than_the_gap(tmp_path):
    topics = drive(silent=[(1.0, 2.0)])
    topics["/odom"] = [(t, bags.odometry(t, 0.0, 0.0, 0.0)) for t, _ in topics["/odom"]]
    frames = frames_of(bags.write(tmp_path / "bag", topics), {}, gap_s=0.3)
    heard = np.array([bags.ns(t) for t, _ in topics["/odom"]])
    ages = [t - heard[heard <= t].max() for t in frames.received_ns]
    assert max(ages) <= 0.3 * NS_PER_S
    assert len(frames.lengths) == 2


def test_no_frame_after_a_reset_has_data_of_before_it(tmp_path):
    topics = drive(4.0, anew_s=2.02)  # between two scans and two commands
    frames = frames_of(bags.write(tmp_path / "bag", topics), {}, fps=100)
    assert len(frames.lengths) == 2
    begin = int(frames.lengths[0])
    for topic in topics:
        after = [bags.ns(t) for t, _ in topics[topic] if bags.ns(t) >= bags.ns(2.02)]
        assert frames.received_ns[begin] >= after[0]


def test_the_dataset_is_of_the_format_v3(exported):
    _, folder, _ = exported
    info = json.loads((folder / "meta/info.json").read_text())
    assert info["codebase_version"] == "v3.0"
    assert info["fps"] == FPS
    assert (info["total_episodes"], info["splits"]) == (3, {"train": "0:3"})
    place = {"chunk_index": 0, "file_index": 0}
    table = parquet.read_table(folder / info["data_path"].format(**place))
    assert table.num_rows == info["total_frames"]
    assert table.column_names == list(info["features"])
    kinds = {"float32": "float", "int64": "int64", "bool": "bool"}
    for name, feature in info["features"].items():
        (width,), kind = feature["shape"], kinds[feature["dtype"]]
        wide = f"fixed_size_list<element: {kind}>[{width}]"
        assert str(table.schema.field(name).type) in (kind if width == 1 else wide,), (
            name
        )
    stats = json.loads((folder / "meta/stats.json").read_text())
    assert stats.keys() == info["features"].keys()
    action = np.array(table["action"].to_pylist())
    assert stats["action"]["mean"] == pytest.approx(action.mean(0))
    assert stats["action"]["count"] == [table.num_rows]
    episodes = parquet.read_table(
        folder / "meta/episodes/chunk-000/file-000.parquet"
    ).to_pylist()
    assert [each["dataset_from_index"] for each in episodes[1:]] == [
        each["dataset_to_index"] for each in episodes[:-1]
    ]
    assert sum(each["length"] for each in episodes) == table.num_rows
    assert all(each["tasks"] == ["Go round."] for each in episodes)
    first = episodes[0]
    assert first["stats/action/max"] == pytest.approx(action[: first["length"]].max(0))
    tasks = parquet.read_table(folder / "meta/tasks.parquet")
    index = json.loads(tasks.schema.metadata[b"pandas"])["index_columns"]
    assert tasks.to_pydict() == {"task_index": [0], index[0]: ["Go round."]}


def test_times_are_regular_and_indices_count(exported):
    _, folder, _ = exported
    rows = rows_of(folder)
    assert rows["index"] == list(range(len(rows["index"])))
    expected = np.array(rows["frame_index"]) / FPS
    np.testing.assert_allclose(rows["timestamp"], expected, atol=1e-6)


def test_success_stands_in_the_last_frame_of_the_episodes_that_had_it(exported):
    _, folder, _ = exported
    rows = rows_of(folder)
    reached = [
        e
        for e, yes in zip(rows["episode_index"], rows["next.success"], strict=True)
        if yes
    ]
    assert reached == [0, 2]


def test_without_a_word_on_success_there_is_no_such_column(tmp_path):
    bag = bags.write(tmp_path / "bag", drive())
    assert export(bag, "--lerobot", tmp_path / "set").exit_code == 0
    assert "next.success" not in rows_of(tmp_path / "set")


def test_ranges_are_finite_and_counter_clockwise(tmp_path):
    topics = drive()
    for _, scan in topics["/scan"]:
        # clockwise
        scan.angle_min = 1.0
        scan.angle_increment = -0.4
        scan.ranges[:] = [0.5, np.inf, -np.inf, np.nan, 9.0, 2.5]
    frames = frames_of(bags.write(tmp_path / "bag", topics), {})
    expected = [2.5, 3.0, 3.0, 0.05, 3.0, 0.5]  # of 0.05 to 3 m
    np.testing.assert_allclose(frames.features["observation.scan"].values[0], expected)
    assert frames.features["observation.scan"].info["angle_min"] == pytest.approx(-1.0)


def test_with_a_model_actions_are_the_robots_commands(tmp_path):
    bag = bags.write(tmp_path / "bag", drive(beams=720))
    model = open_model("ackermann")
    action = frames_of(bag, {}, model).features["action"]
    assert action.names == tuple(v.name for v in model.robot.command)
    twist = frames_of(bag, {}).features["action"]
    np.testing.assert_allclose(
        action.values, model.robot.from_cmd_vel(twist.values.astype(float)), atol=1e-6
    )


def test_commands_of_a_car_keep_their_names(tmp_path):
    topics = drive()
    topics["/cmd_vel"] = [
        (t, bags.ackermann_stamped(t, 0.5, 0.1)) for t in bags.times(0.05, 3.0)
    ]
    action = frames_of(bags.write(tmp_path / "bag", topics), {}).features["action"]
    assert action.names == ("speed", "steering_angle")
    np.testing.assert_allclose(action.values[0], [0.5, 0.1], rtol=1e-6)


def test_a_named_pose_takes_the_place_of_the_odometrys(tmp_path):
    topics = drive()
    topics["/mocap"] = [
        (t, bags.pose_stamped(t, 7.0, 8.0, 0.5)) for t in bags.times(0.05, 3.0)
    ]
    frames = frames_of(bags.write(tmp_path / "bag", topics), {"pose": "/mocap"})
    state = frames.features["observation.state"].values
    np.testing.assert_allclose(state[:, :3], [[7.0, 8.0, 0.5]] * len(state), rtol=1e-6)


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ((), "--lerobot FOLDER or --mcap FOLDER"),
        (("--lerobot", "{set}", "--gap", "0"), "--gap 0: must be greater than 0"),
        (("--lerobot", "{set}", "--gap", "0.001"), "give a longer --gap"),
        (("--lerobot", "{set}", "--succeeded", "some"), "all, none, or numbers"),
        (("--lerobot", "{set}", "--succeeded", "9"), "there is no such episode"),
        (("--lerobot", "{set}", "--topic", "odom=/nothing"), "has no topic '/nothing'"),
        (("--lerobot", "{set}", "--model", "nobody"), "nobody"),
        (("--lerobot", "{full}"), "holds other files"),
        (("--mcap", "{full}"), "is there already"),
    ],
)
def test_what_can_not_be_exported_is_one_sentence(tmp_path, words, told):
    bag = bags.write(tmp_path / "bag", drive())
    places = {"set": tmp_path / "set", "full": tmp_path / "full"}
    places["full"].mkdir()
    (places["full"] / "work.txt").touch()
    said = export(bag, *(word.format(**places) for word in words))
    assert said.exit_code == 2, said.output
    (sentence,) = said.stderr.splitlines()
    assert told in sentence
    assert not places["set"].exists()


def test_a_bag_without_commands_is_refused(tmp_path):
    topics = drive()
    del topics["/cmd_vel"]
    said = export(bags.write(tmp_path / "bag", topics), "--lerobot", tmp_path / "set")
    assert said.exit_code == 2
    assert "has no commands" in said.stderr


def messages_in(folder):
    """The messages of an MCAP, decoded by what stands in the file alone, as a viewer does."""
    (file,) = folder.glob("*.mcap")
    stores = {}
    found = {}
    with file.open("rb") as opened:
        for schema, channel, message in make_reader(opened).iter_messages():
            assert (schema.encoding, channel.message_encoding) == ("ros2msg", "cdr")
            if schema.name not in stores:
                stores[schema.name] = get_typestore(Stores.EMPTY)
                text = schema.data.decode()
                stores[schema.name].register(get_types_from_msg(text, schema.name))
            content = stores[schema.name].deserialize_cdr(message.data, schema.name)
            found.setdefault(channel.topic, []).append((message.log_time, content))
    return found


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_the_mcap_tells_all_that_a_viewer_needs(tmp_path, storage):
    topics = drive()
    bag = bags.write(tmp_path / "bag", topics, storage)
    both = ("--mcap", tmp_path / "shown", "--lerobot", tmp_path / "set")
    told = json.loads(export(bag, *both, "--model", "ackermann", "--json").stdout)
    assert {told["mcap"], told["lerobot"]} == {
        str(tmp_path / "shown"),
        str(tmp_path / "set"),
    }
    assert (told["episodes"], told["left_out"], told["fps"]) == (1, 0, FPS)
    assert len(told["added"]) == 2
    found = messages_in(tmp_path / "shown")
    assert found.keys() == {*topics, "/tf", "/tf_static"}
    assert [len(found[topic]) for topic in topics] == [
        len(rows) for rows in topics.values()
    ]
    received, (first,) = found["/tf"][0][0], found["/tf"][0][1].transforms
    assert received == bags.ns(topics["/odom"][0][0])
    assert (first.header.frame_id, first.child_frame_id) == ("odom", "base_link")
    (mounted,) = found["/tf_static"][0][1].transforms
    assert (mounted.header.frame_id, mounted.child_frame_id) == ("base_link", "laser")
    assert mounted.transform.translation.x == open_model("ackermann").lidar.mount[0]


def test_transforms_that_a_bag_has_are_left_as_they_are(tmp_path):
    topics = drive()
    topics["/tf"] = [
        (t, bags.transforms(bags.transform(t, (1.0, 2.0, 0.0), "odom", "base_link")))
        for t in bags.times(0.1, 3.0)
    ]
    told = export(bags.write(tmp_path / "bag", topics), "--mcap", tmp_path / "shown")
    assert "added" not in told.stdout
    assert len(messages_in(tmp_path / "shown")["/tf"]) == len(topics["/tf"])


@pytest.mark.process
@pytest.mark.skipif(
    LEROBOT is None, reason="make test-lerobot installs lerobot and runs it"
)
def test_lerobot_opens_a_dataset_and_gives_its_frames(exported, tmp_path):
    _, folder, bag = exported
    reader = Path(__file__).with_name("read_lerobot.py")
    where = os.environ | {"HF_HUB_OFFLINE": "1", "HF_HOME": str(tmp_path / "cache")}
    told = subprocess.run(
        [LEROBOT, reader, folder],
        env=where,
        capture_output=True,
        text=True,
        timeout=240,
    )
    assert told.returncode == 0, told.stderr
    given = json.loads(told.stdout.splitlines()[-1])
    frames = frames_of(bag, {})
    for name, feature in frames.features.items():
        np.testing.assert_array_equal(np.array(given[name], np.float32), feature.values)
    begins = np.cumsum(frames.lengths) - frames.lengths
    since = (
        frames.received_ns - np.repeat(frames.received_ns[begins], frames.lengths)
    ) / NS_PER_S
    np.testing.assert_allclose(given["timestamp"], since, atol=1e-6)
    assert set(given["task"]) == {"Go round."}
    second = frames.features["action"].values[frames.lengths[0] :][:3]
    np.testing.assert_array_equal(np.array(given["ahead"], np.float32), second)
