from __future__ import annotations

import threading
import tracemalloc
from types import SimpleNamespace

import pytest

pytest.importorskip("rclpy", reason="needs ROS 2: rclpy is not installed")

from safety.rig import Rig, config

from nics_drl_bridge.nodes.gate_log import GateLog
from nics_drl_bridge.safety.black_box import Entry, replay, write


def writers():
    return [one for one in threading.enumerate() if one.name.startswith("black_box")]


class Recorded(Rig):
    """A rig that keeps all that the gate was given."""

    def __init__(self):
        super().__init__()
        self.entries = []

    def give(self, event, now=None):
        before, now = self.state, self.now if now is None else now
        decision = super().give(event, now)
        self.entries.append(Entry(now, event, before, decision))
        return decision


@pytest.fixture(scope="module")
def recorded():
    """Half a minute of driving, and a stop at its end."""
    rig = Recorded().drive()
    rig.run(30.0)
    rig.run(1.0, without="scan")
    assert rig.decision.cause.rule == "scan_silent"
    return rig


def test_its_writer_is_there_before_the_first_stop_and_writes_what_replays(tmp_path, recorded):
    others = set(writers())
    given = SimpleNamespace(config=config(), robot="car", black_box=tmp_path)
    logger = SimpleNamespace(info=str, warning=lambda *_, **__: None, error=pytest.fail)
    log = GateLog(given, logger)
    (writer,) = set(writers()) - others
    for entry in recorded.entries:
        log.note(entry)
    log.close()
    assert not writer.is_alive()
    assert set(writers()) <= others
    files = list(tmp_path.iterdir())
    assert files
    assert all(replay(file).differing == () for file in files)


def test_writing_a_stop_needs_little_more_memory_than_one_of_its_lines(tmp_path, recorded):
    path = tmp_path / "stop.jsonl"
    tracemalloc.start()
    write(recorded.config, tuple(recorded.entries), path)
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert most < 0.1 * path.stat().st_size, (most, path.stat().st_size)
