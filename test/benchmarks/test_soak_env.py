"""The soak of the environments in small: it finds nothing, unless something is put there."""

from __future__ import annotations

import pytest

from .runs import asked, fails

SOAK = "soak_env.py"
CASES = ("--cases", "arena", "crowd", "team")
SHORT = ("--steps", "30000", "--cases", "arena")
pytestmark = [pytest.mark.campaign, pytest.mark.timeout(300)]  # a cold start compiles


def test_a_soak_finds_no_nan_and_no_world_that_is_stuck():
    code, found = asked(SOAK, "--steps", "60000", *CASES)
    assert (code, found["failures"]) == (0, [])
    assert found["steps"] >= 60_000
    assert found["nans"] == found["stuck_worlds"] == 0
    assert set(found["cases"]) == set(CASES[1:])
    for case in found["cases"].values():
        assert case["episodes"] > 0
        assert case["longest"] > 1


@pytest.mark.parametrize(
    ("control", "given", "sentence"),
    [
        ("stuck", SHORT, "a robot that stood for"),
        ("blind", SHORT, "an observation that stood for"),
        ("endless", (*SHORT, "--limit", "10"), "an episode of"),
        ("nan", SHORT, "not finite"),
        ("leak", SHORT, "memory grew by"),
        ("leak", ("--resets", "100"), "file descriptors more"),
    ],
)
def test_what_is_put_there_is_found(control, given, sentence):
    assert any(sentence in line for line in fails(SOAK, control, *given))


def test_resets_of_a_single_env_leave_no_files_and_threads_behind():
    code, found = asked(SOAK, "--resets", "300")
    assert (code, found["failures"]) == (0, [])
    assert (found["resets"], found["nans"]) == (300, 0)
    assert found["fds_growth"] == found["threads_growth"] == 0
