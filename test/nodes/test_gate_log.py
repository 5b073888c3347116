from __future__ import annotations

import os
import time
import tracemalloc
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="needs ROS 2: rclpy is not installed")

from gate.rig import Rig, config

from nics_drl_bridge.gate.black_box import Entry, replay, write
from nics_drl_bridge.nodes import gate_log
from nics_drl_bridge.nodes.gate_log import BURST_S, FILES_KEPT, LINE_S, GateLog, prune

DEADLINE_S = 20.0
LONG_S = 60.0
MOTION, NONSENSE = [0.5, 0.0, 0.1], [np.nan, 0.0, 0.0]


class Logger:
    """Keeps the lines, by level."""

    def __init__(self):
        self.info_lines, self.warnings, self.errors = [], [], []
        self.info, self.warning = self.info_lines.append, self.warnings.append
        self.error = self.errors.append


class Recorded(Rig):
    """A rig that keeps all that the gate was given, and tells a log about it."""

    def __init__(self, log=None):
        super().__init__()
        self.entries, self.log = [], log

    def give(self, event, now=None):
        before, now = self.state, self.now if now is None else now
        decision = super().give(event, now)
        self.entries.append(Entry(now, event, before, decision))
        if self.log is not None:
            self.log.note(self.entries[-1])
        return decision

    def stop_by_nonsense(self):
        self.wish = np.array(NONSENSE)
        self.run(0.2)
        assert self.rule == "command_malformed"

    def go_on(self, seconds):
        self.wish = np.array(MOTION)
        self.run(seconds)
        assert self.decision.cause is None, self.decision.cause


@pytest.fixture(scope="module")
def recorded():
    """Half a minute of driving, and a stop at its end."""
    rig = Recorded().drive()
    rig.run(30.0)
    rig.run(1.0, without="scan")
    assert rig.decision.cause.rule == "scan_silent"
    return rig


@pytest.fixture
def logger():
    return Logger()


@pytest.fixture
def log(tmp_path, logger):
    made = GateLog(SimpleNamespace(config=config(), robot="car", black_box=tmp_path), logger)
    yield made
    made.close()


def files(folder):
    return sorted(path for path in folder.iterdir() if path.suffix == ".jsonl")


def written(log, folder, count):
    """The files, once there are so many."""
    deadline = time.monotonic() + DEADLINE_S
    while len(files(folder)) < count:
        assert time.monotonic() < deadline, f"{len(files(folder))} of {count} files came"
        time.sleep(0.01)
    return files(folder)


def hang(*_):
    """A disk that does not answer."""
    time.sleep(LONG_S)


def test_a_stop_is_written_whole_and_replays(tmp_path, recorded, log, logger):
    for entry in recorded.entries:
        log.note(entry)
    (file,) = written(log, tmp_path, 1)
    again = replay(file)
    assert again.differing == ()
    assert again.entries[-1].decision.cause.rule == "scan_silent"
    assert logger.errors == []


def test_a_file_holds_what_there_was_at_the_stop_and_nothing_of_later(tmp_path, log):
    rig = Recorded(log).drive()
    rig.run(0.5, without="scan")
    stopped = next(i for i, one in enumerate(rig.entries[-30:], len(rig.entries) - 30)
                   if one.decision.cause is not None)  # fmt: skip
    rig.run(5.0)
    (file,) = written(log, tmp_path, 1)
    assert replay(file).entries[-1].now == rig.entries[stopped].now


def test_of_a_burst_the_first_stop_is_written_and_the_others_are_counted(tmp_path, log):
    rig = Recorded(log).drive()
    first = rig.now
    for _ in range(30):
        rig.stop_by_nonsense()
        rig.go_on(0.3)
    (file,) = written(log, tmp_path, 1)
    log.close()
    assert files(tmp_path) == [file]
    assert file.name.endswith("_command_malformed.jsonl")
    assert replay(file).entries[-1].now - first < 0.3
    assert log.counters["stopped, command_malformed"] == 30
    assert log.counters["stops of a burst, not in the black box"] == 29


def test_another_rule_is_written_though_a_burst_goes_on(tmp_path, log):
    rig = Recorded(log).drive()
    for _ in range(5):
        rig.stop_by_nonsense()
        rig.go_on(0.3)
    rig.run(1.0, without="scan")
    names = [file.name for file in written(log, tmp_path, 2)]
    assert [name.split("_", 3)[3] for name in names] == [
        "command_malformed.jsonl", "scan_silent.jsonl",
    ]  # fmt: skip


def test_a_stop_after_commands_have_passed_for_long_is_written_again(tmp_path, log):
    rig = Recorded(log).drive()
    for _ in range(3):
        rig.stop_by_nonsense()
        rig.go_on(BURST_S + 1.0)
    assert len(written(log, tmp_path, 3)) == 3
    assert log.counters["stops of a burst, not in the black box"] == 0


def test_a_burst_does_not_flood_the_log_and_each_line_says_how_many_it_stands_for(log, logger):
    rig = Recorded(log).drive()
    logger.warnings.clear()
    began = rig.now
    for _ in range(40):
        rig.stop_by_nonsense()
        rig.go_on(0.3)
    lasted = rig.now - began
    stops = [line for line in logger.warnings if line.startswith("stopped by command_malformed")]
    assert 2 <= len(stops) <= lasted / LINE_S + 1
    assert len(logger.warnings) <= 2 * len(stops)
    assert " more since the last such line)" in stops[1]


def test_what_is_the_case_is_said_in_the_end_though_it_was_kept_back_at_first(log, logger):
    rig = Recorded(log).drive()
    for _ in range(2):
        rig.stop_by_nonsense()
        rig.go_on(0.2)
    logger.info_lines.clear()
    rig.go_on(LINE_S)
    assert logger.info_lines == ["commands pass (1 more since the last such line)"]


def test_a_disk_that_hangs_delays_neither_a_decision_nor_the_end(log, logger, monkeypatch):
    monkeypatch.setattr(gate_log, "write", hang)
    rig = Recorded(log).drive()
    began = time.monotonic()
    for _ in range(6):
        rig.stop_by_nonsense()
        rig.go_on(BURST_S + 1.0)
    log.close()
    assert time.monotonic() - began < LONG_S / 3
    assert log.counters["not written"] == 6
    assert "the black box could not be written: it took too long" in logger.errors


def test_a_disk_that_is_full_is_told_of_in_the_log_and_the_diagnostics(log, logger, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(gate_log, "write", full)
    rig = Recorded(log).drive()
    rig.stop_by_nonsense()
    deadline = time.monotonic() + DEADLINE_S
    while log.finding(rig.state).facts.get("not written") != 1:
        assert time.monotonic() < deadline
        time.sleep(0.01)
    assert "No space left on device" in logger.errors[0]


def test_the_oldest_files_go_first(tmp_path):
    for i in range(FILES_KEPT + 3):
        (tmp_path / f"2026{i:02d}_rule.jsonl").touch()
    prune(tmp_path, [f"2026{FILES_KEPT + 2:02d}_rule.jsonl"])
    assert [file.name[:6] for file in files(tmp_path)] == [
        f"2026{i:02d}" for i in range(3, FILES_KEPT + 3)
    ]


def test_a_clock_that_was_set_back_does_not_make_the_newest_file_the_oldest(tmp_path):
    for i in range(FILES_KEPT):
        (tmp_path / f"2026{i:02d}_rule.jsonl").touch()
    (tmp_path / "1970_rule.jsonl").touch()
    prune(tmp_path, ["1970_rule.jsonl"])
    names = os.listdir(tmp_path)
    assert len(names) == FILES_KEPT
    assert "1970_rule.jsonl" in names
    assert "202600_rule.jsonl" not in names


def test_writing_a_stop_needs_little_more_memory_than_one_of_its_lines(tmp_path, recorded):
    path = tmp_path / "stop.jsonl"
    tracemalloc.start()
    write(recorded.config, tuple(recorded.entries), path)
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert most < 0.2 * path.stat().st_size, (most, path.stat().st_size)
