from __future__ import annotations

import json
from dataclasses import dataclass, replace

import pytest

from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.gate.assurance import run as runs
from nics_drl_bridge.generator import builtin_model

from .samples import PROTOCOL

TRIALS = list(PROTOCOL.list_trials())[:4]
LINES = [json.dumps(trial._asdict()).encode() + b"\n" for trial in TRIALS]


def test_a_line_that_a_killed_run_left_unfinished_is_dropped(tmp_path):
    log = tmp_path / runs.LOG
    log.write_bytes(b"".join(LINES[:2]) + LINES[2][:20])
    rows, size = runs.read_rows(log, TRIALS)
    assert rows == [trial._asdict() for trial in TRIALS[:2]]
    assert size == len(LINES[0]) + len(LINES[1])


@pytest.mark.parametrize(
    ("lines", "number"),
    [
        ([LINES[0], b"\0\0\n"], 2),
        ([LINES[0], LINES[0]], 2),
        ([LINES[0], b"[]\n"], 2),
        ([*LINES, LINES[0]], 5),
    ],
)
def test_a_log_of_other_episodes_is_refused_by_its_line(tmp_path, lines, number):
    log = tmp_path / runs.LOG
    log.write_bytes(b"".join(lines))
    with pytest.raises(
        ConfigError, match=f"line {number} is not an episode of this run"
    ):
        runs.read_rows(log, TRIALS)


def test_a_row_is_on_disk_before_the_next_trial_and_one_that_gave_none_is_tried_again(
    tmp_path,
):
    asked = []
    log = tmp_path / runs.FAULT_LOG

    def run(failing):
        def drive(trials):
            asked.append(list(trials))
            for one in trials:
                if one != failing:
                    before = log.read_bytes().count(b"\n")
                    yield one._asdict()
                    assert log.read_bytes().count(b"\n") == before + 1

        return runs.drive_all(log, TRIALS, drive, lambda *_: None)

    assert run(failing=TRIALS[1]) == [
        one._asdict() for one in TRIALS if one != TRIALS[1]
    ]
    assert run(failing=None) == [one._asdict() for one in TRIALS]
    assert asked == [TRIALS, [TRIALS[1]]]


def test_a_log_that_another_run_writes_is_refused(tmp_path):
    log = tmp_path / runs.LOG

    def drive_twice(trials):
        with pytest.raises(ConfigError, match="another process is writing it"):
            runs.drive_all(log, TRIALS, iter, lambda *_: None)
        return iter([])

    runs.drive_all(log, TRIALS, drive_twice, lambda *_: None)
    runs.drive_all(log, TRIALS, lambda trials: [], lambda *_: None)  # free again


def test_the_protocol_is_on_disk_with_its_hash_before_any_episode(tmp_path):
    runs.begin(tmp_path, PROTOCOL)
    written = runs.read_result(tmp_path)
    assert written["protocol"] == json.loads(json.dumps(PROTOCOL.data))
    assert written["protocol_sha256"] == PROTOCOL.sha256
    assert not written["complete"]
    runs.begin(tmp_path, PROTOCOL)  # the same again


@pytest.mark.parametrize("log", [runs.LOG, runs.FAULT_LOG])
def test_a_log_without_its_protocol_is_refused(tmp_path, log):
    (tmp_path / log).touch()
    with pytest.raises(ConfigError, match="without assurance"):
        runs.begin(tmp_path, PROTOCOL)


@pytest.mark.parametrize("text", ["", "{}", '{"format": "other", "protocol": {}}', "3"])
def test_another_json_file_is_no_result(tmp_path, text):
    (tmp_path / runs.RESULT).write_text(text)
    with pytest.raises(ConfigError, match="is not a result of nics assure"):
        runs.begin(tmp_path, PROTOCOL)


def test_a_model_that_no_shield_fits_is_refused_before_any_episode():
    model = builtin_model("differential")
    single = replace(model, lidar=model.lidar.model_copy(update={"beams": 1}))
    with pytest.raises(ConfigError, match="the shield needs a lidar"):
        runs.Run(PROTOCOL, single)


@dataclass
class Driven:
    """What an episode came to."""

    contact: bool = False


@pytest.mark.parametrize("gated", [True, False])
def test_a_trial_without_the_gate_is_driven_without_it(monkeypatch, gated):
    given = []

    def drive(place, config, job, see):
        given.append(config)
        return Driven()

    monkeypatch.setattr(runs, "drive", drive)
    trial = next(each for each in PROTOCOL.list_trials() if each.gated == gated)
    run = runs.Run(PROTOCOL, builtin_model("differential"))
    assert run.drive(trial) == {**trial._asdict(), "contact": False, "violations": {}}
    assert [config is not None for config in given] == [gated]
