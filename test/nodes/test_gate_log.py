from __future__ import annotations

import contextlib
import os
import re
import signal
import time
import tracemalloc

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="needs ROS 2: rclpy is not installed")

from gate.rig import Rig, config

from nics_drl_bridge.files import write_parts
from nics_drl_bridge.gate.black_box import Entry, replay, write
from nics_drl_bridge.nodes import gate_log
from nics_drl_bridge.nodes.gate_log import (
    BURST_S,
    FILES_KEPT,
    LINE_S,
    MOST_AT_WORK,
    BoxWriter,
    GateLog,
    prune,
)

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
    made = GateLog(config(), tmp_path, "car", logger)
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


@pytest.mark.slow
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


@pytest.mark.slow
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


def test_stops_that_alternate_for_long_are_told_of_ever_more_rarely(log, logger):
    rig = Recorded(log).drive()
    logger.warnings.clear()
    for _ in range(600):  # three minutes
        rig.stop_by_nonsense()
        rig.wish = np.array(MOTION)
        rig.run(0.1)
    lines = [*logger.warnings, *logger.info_lines]
    assert 6 <= len(lines) <= 30
    told = [int(found[1]) for line in lines if (found := re.search(r"\((\d+) more", line))]
    assert max(told) > 8 * min(told)


def test_what_is_the_case_is_said_in_the_end_though_it_was_kept_back_at_first(log, logger):
    rig = Recorded(log).drive()
    for _ in range(2):
        rig.stop_by_nonsense()
        rig.go_on(0.2)
    logger.info_lines.clear()
    rig.go_on(LINE_S)
    assert logger.info_lines == ["commands pass (1 more since the last such line)"]


@pytest.mark.slow
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


@pytest.mark.slow
def test_writing_a_stop_needs_little_more_memory_than_one_of_its_lines(tmp_path, recorded):
    path = tmp_path / "stop.jsonl"
    tracemalloc.start()
    write(recorded.config, tuple(recorded.entries), path)
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert most < 0.2 * path.stat().st_size, (most, path.stat().st_size)


@pytest.fixture
def writer():
    made = BoxWriter()
    yield made
    made.close(0.0)


def hung():
    """A disk that does not answer."""
    time.sleep(LONG_S)


def appears(path):
    deadline = time.monotonic() + DEADLINE_S
    while not path.exists():
        assert time.monotonic() < deadline, f"{path} never came"
        time.sleep(0.01)


def test_it_writes_what_there_was_at_the_moment_it_was_asked(tmp_path, writer):
    known = ["then"]
    assert writer.begin(lambda: (tmp_path / "file").write_text(known[0]))
    known[0] = "later"
    assert writer.close(DEADLINE_S) == []
    assert (tmp_path / "file").read_text() == "then"


@pytest.fixture
def patient(monkeypatch):
    """This machine may be busy: a writer that is to give up has all the time to clean up."""
    monkeypatch.setattr(gate_log, "GRACE_S", DEADLINE_S)


@pytest.mark.usefixtures("patient")
def test_a_disk_that_hangs_holds_up_neither_the_start_nor_the_end(writer):
    began = time.monotonic()
    assert writer.begin(hung)
    assert writer.failures() == []
    assert writer.close(0.1) == ["it took too long"]
    assert time.monotonic() - began < LONG_S / 4


@pytest.mark.slow
def test_one_that_does_not_even_hear_that_it_is_to_give_up_is_left_behind(writer):
    def deaf():
        signal.pthread_sigmask(signal.SIG_BLOCK, gate_log.ENDING)
        hung()

    began = time.monotonic()
    writer.begin(deaf)
    assert writer.close(0.1) == ["the disk does not answer"]
    assert time.monotonic() - began < LONG_S / 4


@pytest.mark.usefixtures("patient")
def test_a_file_that_is_given_up_leaves_nothing_behind(tmp_path, writer):
    def parts():
        yield b"the beginning"
        (tmp_path / "begun").touch()
        hung()

    writer.begin(lambda: write_parts(tmp_path / "file", parts()))
    appears(tmp_path / "begun")
    assert writer.close(0.0) == ["it took too long"]
    assert os.listdir(tmp_path) == ["begun"]


def test_one_that_takes_too_long_gives_up_by_itself(writer, monkeypatch):
    monkeypatch.setattr(gate_log, "PATIENCE_S", 0.05)
    writer.begin(hung)
    assert writer.close(DEADLINE_S) == ["it took too long"]


def test_there_are_never_more_at_work_than_a_few(writer):
    begun = [writer.begin(hung) for _ in range(MOST_AT_WORK + 2)]
    assert begun == [True] * MOST_AT_WORK + [False] * 2
    assert len(writer.close(0.0)) == MOST_AT_WORK
    assert writer.begin(lambda: None)


def test_those_that_have_ended_make_room_before_anybody_asks_what_failed(tmp_path, writer):
    for number in range(2 * MOST_AT_WORK):
        assert writer.begin(lambda name=str(number): (tmp_path / name / "file").write_text(""))
        with contextlib.suppress(ChildProcessError):
            os.waitid(os.P_PID, list(writer._writers)[-1], os.WEXITED | os.WNOWAIT)
    assert len(writer.close(DEADLINE_S)) == 2 * MOST_AT_WORK


def test_one_that_does_not_even_give_up_is_ended_for_the_next_to_have_room(writer, monkeypatch):
    def deaf():
        signal.pthread_sigmask(signal.SIG_BLOCK, gate_log.ENDING)
        hung()

    for _ in range(MOST_AT_WORK):
        writer.begin(deaf)
    assert not writer.begin(deaf)
    monkeypatch.setattr(gate_log, "OVERDUE_S", 0.0)
    deadline = time.monotonic() + DEADLINE_S
    while not writer.begin(lambda: None):
        assert time.monotonic() < deadline, "they stay for ever"
        time.sleep(0.01)


def test_an_error_is_told_by_its_sentence(tmp_path, writer):
    writer.begin(lambda: (tmp_path / "missing" / "file").write_text(""))
    (failure,) = writer.close(DEADLINE_S)
    assert "No such file or directory" in failure


def test_a_system_that_has_no_room_for_a_copy_leaves_no_file_open(writer, monkeypatch):
    def full():
        raise BlockingIOError(11, "Resource temporarily unavailable")

    monkeypatch.setattr(os, "fork", full)
    before = os.listdir("/proc/self/fd")
    with pytest.raises(BlockingIOError):
        writer.begin(lambda: None)
    assert os.listdir("/proc/self/fd") == before
    assert writer.failures() == []


def test_the_copy_lets_go_of_all_files_and_ignores_ctrl_c(tmp_path, writer):
    with (tmp_path / "socket").open("w"):

        def look():
            os.kill(os.getpid(), signal.SIGINT)
            held = {os.readlink(f"/proc/self/fd/{name}") for name in os.listdir("/proc/self/fd")
                    if os.path.exists(f"/proc/self/fd/{name}")}  # fmt: skip
            (tmp_path / "held").write_text("\n".join(sorted(held)))

        writer.begin(look)
        assert writer.close(DEADLINE_S) == []
    held = (tmp_path / "held").read_text().splitlines()
    assert [name for name in held if "pipe" not in name and "fd" not in name] == [os.devnull]


def test_the_copy_has_no_real_time_priority(tmp_path, writer):
    before = os.sched_getscheduler(0)
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))
    except OSError as error:
        pytest.skip(f"no real-time priority here: {error}")
    try:
        writer.begin(lambda: (tmp_path / "kind").write_text(str(os.sched_getscheduler(0))))
    finally:
        os.sched_setscheduler(0, before, os.sched_param(0))
    assert writer.close(DEADLINE_S) == []
    assert (tmp_path / "kind").read_text() == str(os.SCHED_OTHER)
