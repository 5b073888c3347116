import json

import pytest
from typer.testing import CliRunner

pytest.importorskip("rosbags", reason="needs the extra 'bags'")

import bags
import numpy as np
from mcap.reader import make_reader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from nics_drl_bridge.commands.cli import app
from nics_drl_bridge.generator import open_model


def export(*words):
    return CliRunner().invoke(app, ["bag", "export", *map(str, words)])


def drive(duration=3.0, beams=6):
    """A drive along a circle."""

    def heard(step):
        return bags.times(step, duration)

    scans = [(t, bags.scan(t, beams)) for t in heard(0.1)]
    for k, (_, scan) in enumerate(scans):
        scan.ranges[:] = np.linspace(1.0, 2.0, beams) + 0.001 * k
    return {
        "/odom": [(t, bags.odometry(t, *bags.place_at(t))) for t in heard(0.02)],
        "/scan": scans,
        "/cmd_vel": [(t + 0.013, bags.twist(0.1 * t, 0.0, 0.2)) for t in heard(0.05)],
    }


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("--mcap", "{full}"), "already exists"),
        (("--mcap", "{new}", "--model", "nobody"), "nobody"),
    ],
)
def test_what_can_not_be_exported_is_one_sentence(tmp_path, words, told):
    bag = bags.write(tmp_path / "bag", drive())
    places = {"new": tmp_path / "new", "full": tmp_path / "full"}
    places["full"].mkdir()
    said = export(bag, *(word.format(**places) for word in words))
    assert said.exit_code == 2, said.output
    (sentence,) = said.stderr.splitlines()
    assert told in sentence
    assert not places["new"].exists()


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
    words = ("--mcap", tmp_path / "shown", "--model", "ackermann", "--json")
    told = json.loads(export(bag, *words).stdout)
    assert told["mcap"] == str(tmp_path / "shown")
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
