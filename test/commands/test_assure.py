"""`nics assure`: its evidence, its resumption after a kill, its control, its refusals."""

from __future__ import annotations

import json
import shutil
import signal
import subprocess
import sys
from dataclasses import replace
from unittest import mock

import pytest
from command_line import nics, split_words
from gate.assurance.samples import PROTOCOL, fault, row

from nics_drl_bridge import extensions
from nics_drl_bridge.commands.assure import _choose_faults, _is_as_expected, _tell
from nics_drl_bridge.config import find_config
from nics_drl_bridge.gate.assurance.protocol import (
    CLAIMS_BY_TURN_RATE,
    LIMITS,
    NO_GATE,
    STOPS,
    TOUCHES,
)
from nics_drl_bridge.gate.assurance.results import summarise

ORDER = "assure differential --limits mine.yaml --world arena --episodes 2 --faults 0"

KILLED = """
import os, signal, sys
from nics_drl_bridge.commands.cli import main
from nics_drl_bridge.gate.assurance.run import Run

driven = []
drive = Run.drive

def drive_until_killed(run, trial):
    driven.append(trial)
    if len(driven) > 2:
        os.kill(os.getpid(), signal.SIGKILL)
    return drive(run, trial)

Run.drive = drive_until_killed
sys.argv = ["nics", *sys.argv[1:]]
main()
"""


def make_place(folder):
    """A folder with a file of limits that may be changed."""
    text = find_config("differential", "limits").read_text(encoding="utf-8")
    (folder / "mine.yaml").write_text(text)
    return folder


@pytest.fixture
def place(tmp_path):
    return make_place(tmp_path)


@pytest.fixture(scope="module")
def evidence(tmp_path_factory):
    """The folder above that of an uninterrupted run, which wants faults but has no ROS 2."""
    folder = make_place(tmp_path_factory.mktemp("evidence"))
    with mock.patch.object(extensions, "find_lacking", return_value="rclpy"):
        done = nics(ORDER.replace("--faults 0", "--faults 5"), "--out out", cwd=folder)
    assert done.returncode == 0, done.stderr
    assert "0 of 2" in done.stdout
    assert "no faults over DDS: nics assure --faults needs the module" in done.stderr
    return folder


def read(folder):
    return json.loads((folder / "out" / "assurance.json").read_text(encoding="utf-8"))


@pytest.mark.slow
def test_the_evidence_has_counts_bounds_and_a_control_that_failed(evidence):
    result = read(evidence)
    assert result["complete"]
    assert result["protocol"]["faults"] == 0
    for claim in (LIMITS, TOUCHES):
        assert result["claims"][claim]["trials"] == 2
        assert result["claims"][claim]["failures"] == 0
        assert result["claims"][claim]["rate_high"] == pytest.approx(0.776, abs=1e-3)
        assert result["control"][claim]["failures"] > 0
    assert result["claims"][STOPS]["trials"] == 0
    page = (evidence / "out" / "assurance.html").read_text(encoding="utf-8")
    assert "stopping in time was not tested" in page
    assert result["protocol_sha256"] in page
    for value in result["protocol"]["hashes"].values():
        assert value in page


def control(number, **changes):
    """Some episodes without the gate, which all keep what is claimed unless changed."""
    return [row(seed, gated=False, **changes) for seed in range(number)]


BY_TURN_RATE = replace(PROTOCOL, claims=CLAIMS_BY_TURN_RATE)
UNGATED = replace(PROTOCOL, control=NO_GATE)
EXCEEDED = {"rate": 1}


@pytest.mark.parametrize(
    ("protocol", "rows", "expected"),
    [
        (PROTOCOL, [row(1), *control(4, contact=True, violations=EXCEEDED)], True),
        (PROTOCOL, [row(1), *control(4, contact=True)], False),
        (PROTOCOL, [row(1), *control(4, violations=EXCEEDED)], False),
        (PROTOCOL, [row(1), *control(3)], True),  # too few
        (BY_TURN_RATE, [row(1), *control(4, contact=True)], True),
        (UNGATED, control(1, contact=True), False),
        (UNGATED, control(1, contact=True, violations=EXCEEDED), True),
    ],
)
def test_enough_episodes_without_the_gate_must_fail(protocol, rows, expected):
    assert _is_as_expected(protocol, summarise(rows, faults=0)) == expected


def test_a_run_whose_faults_were_not_all_injected_is_not_as_expected(tmp_path, capsys):
    whole = summarise([row(1), fault(7)], faults=1)
    assert _is_as_expected(PROTOCOL, whole)
    partial = summarise([row(1), fault(7)], faults=2)
    assert not _is_as_expected(PROTOCOL, partial)
    _tell(PROTOCOL, partial, tmp_path)
    assert "faults not injected: 1; the same command" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.process
@pytest.mark.timeout(300)
def test_a_run_that_was_killed_goes_on_bit_equal_to_one_that_was_not(evidence, place):
    log = place / "out" / "episodes.jsonl"
    command = [sys.executable, "-c", KILLED, *split_words(ORDER, "--out out")]
    killed = subprocess.run(command, cwd=place, stderr=subprocess.DEVNULL)
    assert killed.returncode == -signal.SIGKILL
    kept = log.read_bytes()
    assert kept.count(b"\n") == 2
    begun = read(place)
    assert not begun["complete"]
    assert begun["protocol_sha256"] == read(evidence)["protocol_sha256"]
    done = nics(ORDER, "--out out", cwd=place)
    assert done.returncode == 0, done.stderr
    assert log.read_bytes().startswith(kept)
    for name in ("episodes.jsonl", "assurance.json", "assurance.html"):
        whole = (evidence / "out" / name).read_bytes()
        assert (place / "out" / name).read_bytes() == whole


@pytest.mark.slow
def test_without_the_gate_failures_are_found_clustered_and_replayed(place):
    done = nics(ORDER, "--control no_gate --out out", cwd=place)
    assert done.returncode == 0, done.stderr
    result = read(place)
    assert result["control"][TOUCHES]["failures"] > 0
    failed = next(row for row in result["failures"] if row["contact"])
    touched = [one for one in result["clusters"] if one["claim"] == TOUCHES]
    assert failed["seed"] in [seed for one in touched for seed in one["seeds"]]
    page = (place / "out" / "assurance.html").read_text(encoding="utf-8")
    assert f"--replay {result['clusters'][0]['seeds'][0]}" in page
    again = f"--control no_gate --out out --json --replay {failed['seed']}"
    replayed = json.loads(nics(ORDER, again, cwd=place).stdout)
    assert replayed["same"]
    assert replayed.items() >= failed.items()
    assert (place / replayed["picture"]).read_bytes().startswith(b"\x89PNG")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("words", "named"),
    [
        ("--seed 3", "'seed' was 1000000 and is now 3"),
        ("--episodes 7", "'episodes' was 2 and is now 7"),
        ("--replay 999999", "--replay 999999: the run has the seeds 1000000 to"),
    ],
)
def test_a_run_in_the_folder_of_another_is_refused_in_one_sentence(
    evidence, words, named
):
    refused = nics(ORDER, "--out out", words, cwd=evidence)
    assert refused.returncode == 2
    (sentence,) = refused.stderr.splitlines()
    assert named in sentence
    assert read(evidence)["complete"]


def test_without_faults_the_protocol_is_the_same_with_ros_2_and_without(monkeypatch):
    monkeypatch.setattr(extensions, "find_lacking", lambda modules: None)
    with_ros_2 = _choose_faults(0)
    monkeypatch.setattr(extensions, "find_lacking", lambda modules: "rclpy")
    assert _choose_faults(0) == with_ros_2 == {"faults": 0}


@pytest.mark.slow
def test_other_limits_in_the_same_file_are_refused_by_their_hash(evidence, tmp_path):
    folder = shutil.copytree(evidence, tmp_path / "copy")
    with (folder / "mine.yaml").open("a") as limits:
        limits.write("\n# changed\n")
    refused = nics(ORDER, "--out out", cwd=folder)
    assert refused.returncode == 2
    assert "'hashes.limits file, SHA-256' was" in refused.stderr
