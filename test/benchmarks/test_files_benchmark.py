from __future__ import annotations

import pytest

from .runs import asked, fails

pytest.importorskip("torch", reason="needs the extra 'train'")
pytest.importorskip("rosbags", reason="needs the extra 'bags'")

SHORT = ("--kills", "8", "--flips", "12", "--cuts", "8", "--changes", "8")
KILLS = ("--kills", "12", "--flips", "1", "--cuts", "1", "--changes", "1")
FLIPS = ("--kills", "1", "--flips", "12", "--cuts", "1", "--changes", "1")


@pytest.mark.campaign
@pytest.mark.timeout(300)
def test_no_kill_tears_a_file_although_kills_hit_writes():
    code, found = asked("files.py", *SHORT)
    assert (code, found["failures"]) == (0, []), found["told"]
    assert found["kills"] == 48
    assert found["kills_during_a_write"] > 0
    assert set(found["artefacts"]) == {
        "drive.npz",
        "model",
        "table",
        "stop.jsonl",
        "policy.onnx",
        "checkpoint.pt",
    }


@pytest.mark.campaign
@pytest.mark.timeout(300)
def test_a_naive_writer_is_torn():
    missed = fails("files.py", "naive_writer", *KILLS)
    assert any(line.startswith("torn ") for line in missed)


@pytest.mark.campaign
@pytest.mark.timeout(300)
def test_without_checksums_flipped_bits_are_taken():
    missed = fails("files.py", "no_checksum", *FLIPS)
    assert any(line.startswith("accepted_corrupt ") for line in missed)


@pytest.mark.campaign
def test_a_run_without_kills_or_cuts_is_no_success():
    code, found = asked(
        "files.py", "--kills", "0", "--flips", "0", "--cuts", "0", "--changes", "0"
    )
    assert code == 1
    assert len(found["failures"]) >= 4
