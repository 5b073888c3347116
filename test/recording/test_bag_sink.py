import sqlite3
import subprocess
import sys

import pytest

pytest.importorskip("rosbags", reason="needs the extra 'bags'")

import bags

from nics_drl_bridge.errors import RecordingError
from nics_drl_bridge.recording import write
from nics_drl_bridge.recording.bag_file import open_bag
from nics_drl_bridge.recording.messages import Offer
from nics_drl_bridge.recording.write import open_bag_sink

STORAGES = ("mcap", "sqlite3")


def held(bag):
    """All messages of a bag."""
    with open_bag(bag) as whole:
        return {topic: whole.read_serialized(topic) for topic in whole.types}


@pytest.mark.parametrize("storage", STORAGES)
def test_of_a_killed_recorder_all_that_was_flushed_is_there(tmp_path, storage):
    """A process that is killed leaves the hidden folder as it is."""
    message = bags.STORE.serialize_cdr(bags.twist(1.0, 0.0, 0.0), bags.kinds.TWIST)
    writing = open_bag_sink(tmp_path / "drive", storage)
    sink = writing.__enter__()
    sink.add_topic("/cmd_vel", bags.kinds.TWIST, [Offer(depth=1)])
    for k in range(50):
        sink.write("/cmd_vel", bags.ns(0.1 * k), bytes(message))
        if k == 39:
            sink.flush()
    (left,) = tmp_path.glob(".drive.*")
    assert bags.unfinished_messages(left / "drive") >= 40
    writing.__exit__(KeyboardInterrupt, KeyboardInterrupt(), None)
    assert not (tmp_path / "drive").exists()
    assert not list(tmp_path.glob(".drive.*"))


def record(place, storage, count, then=None):
    """Messages of a second, as the recorder writes them; `then` is raised after the last one."""
    message = bags.STORE.serialize_cdr(bags.twist(1.0, 0.0, 0.0), bags.kinds.TWIST)
    with open_bag_sink(place, storage, keep=True) as sink:
        sink.add_topic("/cmd_vel", bags.kinds.TWIST, [Offer(depth=1)])
        for k in range(count):
            try:
                sink.write("/cmd_vel", bags.ns(0.1 * k), bytes(message))
            except OSError:  # as callers do
                raise RecordingError(f"{place}: is lost.") from None
            if k % 10 == 9:
                sink.flush()
        if then is not None:
            raise then


@pytest.mark.parametrize(
    ("storage", "fault", "method"),
    [
        ("mcap", ValueError("of any kind"), "write"),
        ("mcap", OSError(28, "No space left on device"), "write"),
        ("mcap", ValueError("of any kind"), "close"),
        ("sqlite3", sqlite3.OperationalError("database or disk is full"), "write"),
        ("sqlite3", ValueError("of any kind"), "close"),
    ],
)
def test_an_error_of_the_storage_of_any_type_keeps_what_was_recorded(
    tmp_path, monkeypatch, storage, fault, method
):
    from rosbags.rosbag2 import Writer

    working = getattr(Writer, method)
    count = [0]

    def fail(self, *given):
        count[0] += 1
        if method == "close" or count[0] > 50:
            raise fault
        return working(self, *given)

    monkeypatch.setattr(Writer, method, fail)
    reason = getattr(fault, "strerror", fault)
    said = f"drive: {reason}; the data written so far are in"
    with pytest.raises(RecordingError, match=said) as caught:
        record(tmp_path / "drive", storage, 60)
    assert str(caught.value).count(f"{tmp_path / 'drive'}: ") == 1
    (left,) = tmp_path.glob(".drive.*/drive")
    monkeypatch.undo()
    assert bags.unfinished_messages(left) == (50 if method == "write" else 60)


@pytest.mark.parametrize(
    ("storage", "raised"),
    [
        ("mcap", RuntimeError("of a callback")),
        ("mcap", SystemExit(1)),
        ("sqlite3", KeyboardInterrupt()),
    ],
)
def test_a_recording_that_something_else_ends_is_a_whole_bag(tmp_path, storage, raised):
    with pytest.raises(type(raised)) as caught:
        record(tmp_path / "drive", storage, 45, then=raised)
    assert caught.value is raised
    assert len(held(tmp_path / "drive")["/cmd_vel"]) == 45
    assert not list(tmp_path.glob(".drive.*"))


def test_a_bag_whose_place_was_taken_meanwhile_is_kept(tmp_path, monkeypatch):
    finish = write._finish

    def taken(unfinished, path, storage):
        path.mkdir()
        finish(unfinished, path, storage)

    monkeypatch.setattr(write, "_finish", taken)
    with pytest.raises(RecordingError, match=r"was made meanwhile.* are in") as refused:
        record(tmp_path / "drive", "mcap", 12)
    (left,) = tmp_path.glob(".drive.*/drive")
    assert str(left) in str(refused.value)
    assert len(held(left)["/cmd_vel"]) == 12


@pytest.mark.parametrize("storage", STORAGES)
def test_what_publishers_offer_is_kept(tmp_path, storage):
    offers = (Offer(depth=1, transient_local=True), Offer(depth=7, reliable=False))
    message = bags.STORE.serialize_cdr(bags.twist(1.0, 0.0, 0.0), bags.kinds.TWIST)
    with open_bag_sink(tmp_path / "bag", storage) as sink:
        sink.add_topic("/cmd_vel", bags.kinds.TWIST, offers)
        sink.write("/cmd_vel", bags.ns(0.0), bytes(message))
    with open_bag(tmp_path / "bag") as bag:
        assert bag.offers("/cmd_vel") == offers


def test_a_type_that_nobody_knows_is_written_with_its_text(tmp_path):
    texts = {
        "my_msgs/msg/Own": "int32 x\nmy_msgs/Part part",
        "my_msgs/msg/Part": "float64 y",
    }
    data = b"\x00\x01\x00\x00\x01\x00\x00\x00\x00\x00\x00\x00" + b"\x00" * 8
    with open_bag_sink(tmp_path / "bag") as sink:
        sink.add_topic("/own", "my_msgs/msg/Own", texts=texts)
        sink.write("/own", bags.ns(0.0), data)
    assert b"float64 y" in bags.storage_file(tmp_path / "bag").read_bytes()
    assert held(tmp_path / "bag") == {"/own": [(bags.ns(0.0), data)]}


KILLED = """
import sys
from pathlib import Path
from nics_drl_bridge.recording.write import open_bag_sink
place = Path(sys.argv[1])
with open_bag_sink(place / "kept", keep=True) as one, open_bag_sink(place / "not") as two:
    for sink in (one, two):
        sink.add_topic("/chatter", "std_msgs/msg/String")
        sink.write("/chatter", 1, b"\\0\\1\\0\\0\\2\\0\\0\\0x\\0\\0\\0")
        sink.flush()
    print("begun", flush=True)
    sys.stdin.read()
"""


@pytest.mark.process
def test_what_a_killed_recorder_left_stays_and_what_a_conversion_left_does_not(
    tmp_path,
):
    words = [sys.executable, "-c", KILLED, str(tmp_path)]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    with subprocess.Popen(words, **pipes) as writer:
        assert writer.stdout.readline() == b"begun\n"
        record(tmp_path / "first", "mcap", 12)
        assert len(list(tmp_path.glob(".*"))) == 2, "their writer lives"
        writer.kill()
    record(tmp_path / "second", "mcap", 12)
    (left,) = tmp_path.glob(".*")
    assert left.name.startswith(".kept.")


def test_a_disk_that_was_full_before_leaves_nothing(tmp_path, monkeypatch):
    from rosbags.rosbag2 import Writer

    def fail(*_, **__):
        raise sqlite3.OperationalError("database or disk is full")

    monkeypatch.setattr(Writer, "add_connection", fail)
    with pytest.raises(RecordingError, match="disk is full; nothing was written"):
        record(tmp_path / "drive", "sqlite3", 12)
    assert not list(tmp_path.iterdir())
