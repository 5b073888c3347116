import os
import signal
import time
from dataclasses import replace

import numpy as np
import pytest
from gate.rig import Rig, config

from nics_drl_bridge.gate import inputs
from nics_drl_bridge.gate.black_box import MOST_INPUTS, Entry, replay
from nics_drl_bridge.nodes import gate_log
from nics_drl_bridge.nodes.black_box_writer import FILES_KEPT, prune
from nics_drl_bridge.nodes.gate_log import (
    BURST_S,
    KEPT_S,
    LINE_S,
    STATE_S,
    BlackBox,
    GateLog,
)
from nics_drl_bridge.nodes.runner import ERROR, OK, STALE, WARN

pytestmark = pytest.mark.ros

DEADLINE_S = 20.0
LONG_S = 60.0
MOTION = [0.5, 0.0, 0.1]
NONSENSE = [np.nan, 0.0, 0.0]


class Logger:
    """Keeps the lines of each level."""

    def __init__(self):
        self.info_lines = []
        self.warnings = []
        self.errors = []
        self.info = self.info_lines.append
        self.warning = self.warnings.append
        self.error = self.errors.append


class Recorded(Rig):
    """A rig that keeps all inputs of the gate, and passes them to a log."""

    def __init__(self, log=None):
        super().__init__()
        self.entries = []
        self.log = log

    def give(self, event, now=None):
        before = self.state
        now = self.now if now is None else now
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


@pytest.fixture
def logger():
    return Logger()


@pytest.fixture
def log(tmp_path, logger):
    made = GateLog(config(), tmp_path, "car", logger)
    yield made
    made.close()


def test_its_level_tells_an_unarmed_gate_a_fault_and_a_silent_source_apart(log):
    rig = Recorded(log)
    rig.run(0.2)
    levels = {"unarmed": log.finding(rig.state).level}
    rig.drive()
    levels["driving"] = log.finding(rig.state).level
    rig.stop_by_nonsense()
    levels["nonsense"] = log.finding(rig.state).level
    rig.go_on(1.0)
    rig.run(0.5, without="scan")
    levels["no scan"] = log.finding(rig.state).level
    rig.give(inputs.EStop(True))
    levels["e-stop"] = log.finding(rig.state).level
    assert levels == {
        "unarmed": WARN,
        "driving": OK,
        "nonsense": ERROR,
        "no scan": STALE,
        "e-stop": ERROR,
    }


def files(folder):
    return sorted(folder.glob("*.jsonl"))


def written(log, folder, count):
    """Return the files, once there are so many."""
    until(lambda: len(files(folder)) >= count)
    return files(folder)


def until(condition):
    """Wait until a condition holds."""
    deadline = time.monotonic() + DEADLINE_S
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.01)


def test_a_file_holds_what_there_was_at_the_stop_and_nothing_of_later(tmp_path, log):
    rig = Recorded(log).drive()
    rig.run(0.5, without="scan")
    stopped = next(
        i
        for i, one in enumerate(rig.entries[-30:], len(rig.entries) - 30)
        if one.decision.cause is not None
    )
    rig.run(5.0)
    (file,) = written(log, tmp_path, 1)
    again = replay(file)
    assert again.differing == ()
    assert again.entries[-1].now == rig.entries[stopped].now


def test_of_a_burst_the_first_stop_of_a_rule_is_written_and_the_others_are_counted(
    tmp_path, log
):
    rig = Recorded(log).drive()
    first = rig.now
    for _ in range(10):
        rig.stop_by_nonsense()
        rig.go_on(0.3)
    (file,) = written(log, tmp_path, 1)
    assert file.name.endswith("_command_malformed.jsonl")
    assert replay(file).entries[-1].now - first < 0.3
    assert log.counters["stopped, command_malformed"] == 10
    assert log.counters["stops of a burst, not in the black box"] == 9
    rig.go_on(BURST_S + 1.0)
    rig.stop_by_nonsense()
    assert len(written(log, tmp_path, 2)) == 2  # of the next burst
    rig.go_on(0.3)
    rig.run(1.0, without="scan")  # another rule
    assert written(log, tmp_path, 3)[-1].name.endswith("_scan_silent.jsonl")


def test_a_command_that_the_shield_cuts_is_counted(log):
    rig = Recorded(log).drive()
    cut = replace(rig.decision, shielded=True)
    log.note(Entry(rig.now, inputs.Tick(), rig.state, cut))
    assert log.finding(rig.state).facts["cut by the shield"] == 1


def test_a_burst_does_not_flood_the_log_and_what_is_the_case_is_said_in_the_end(
    log, logger
):
    rig = Recorded(log).drive()
    logger.warnings.clear()
    logger.info_lines.clear()
    began = rig.now
    for _ in range(20):
        rig.stop_by_nonsense()
        rig.go_on(0.3)
    lines = [*logger.warnings, *logger.info_lines]
    refusals = [line for line in lines if line.startswith("refused")]
    most = (rig.now - began) / LINE_S + 1  # of a kind
    assert 2 <= len(lines) - len(refusals) <= 2 * most
    assert len(refusals) <= most
    logger.info_lines.clear()
    rig.go_on(2.0 * LINE_S)
    assert logger.info_lines in (["commands pass"], [])
    rig.run(2.0 * LINE_S, without="scan")
    assert logger.warnings[-1].startswith("stopped by scan_silent")


def freeze_writers(log):
    for writer in log._box._writers:
        os.kill(writer.pid, signal.SIGSTOP)


def test_writers_that_hang_delay_neither_a_decision_nor_the_end_and_are_told_of(
    tmp_path, log, logger
):
    rig = Recorded(log).drive()
    began = time.monotonic()
    for _ in range(3):
        rig.stop_by_nonsense()
        freeze_writers(log)
        rig.go_on(BURST_S + 1.0)
    log.close()
    assert time.monotonic() - began < LONG_S / 3
    for writer in log._box._writers:
        os.kill(writer.pid, signal.SIGALRM)  # as its own timeout does
        os.kill(writer.pid, signal.SIGCONT)
    until(lambda: log.finding(rig.state).facts.get("not written") == 3)
    assert set(logger.errors) == {
        "the black box could not be written: the disk does not answer"
    }
    assert files(tmp_path) == []


def test_a_file_that_can_not_be_written_is_told_of_in_the_log_and_the_diagnostics(
    tmp_path, logger
):
    (tmp_path / "file").touch()
    log = GateLog(config(), tmp_path / "file", "car", logger)
    rig = Recorded(log).drive()
    rig.stop_by_nonsense()
    until(lambda: log.finding(rig.state).facts.get("not written") == 1)
    assert "exists" in logger.errors[0]
    log.close()


def test_the_oldest_files_go_first_whatever_the_clock_says(tmp_path):
    for i in range(FILES_KEPT + 2):
        (tmp_path / f"2026{i:02d}_rule.jsonl").touch()
    (tmp_path / "1970_rule.jsonl").touch()
    prune(tmp_path, ["1970_rule.jsonl"])
    newest = [f"2026{i:02d}_rule.jsonl" for i in range(3, FILES_KEPT + 2)]
    assert sorted(os.listdir(tmp_path)) == ["1970_rule.jsonl", *newest]


@pytest.mark.parametrize("most_lines", [10_000, 40])
def test_what_is_kept_begins_with_a_state_and_can_always_be_replayed(
    tmp_path, monkeypatch, most_lines
):
    monkeypatch.setattr(gate_log, "MOST_LINES", most_lines)
    monkeypatch.setattr(gate_log, "format_head", lambda _, state: b"S%d" % state)
    monkeypatch.setattr(gate_log, "format_entry", lambda entry: b"%d" % entry.now)
    box = BlackBox(None, tmp_path)
    for now in range(100):
        box.add(Entry(now, None, now, None))
        head, *entries = box.lines()
        begin = int(head.removeprefix(b"S"))
        assert entries == [b"%d" % k for k in range(begin, now + 1)]
        if most_lines > 100:
            assert min(now, KEPT_S) <= now - begin <= KEPT_S + STATE_S
        else:
            assert 20 <= len(entries) <= most_lines or now < 20
    assert gate_log.MOST_LINES < MOST_INPUTS
