"""The soak of the environments in small: it finds nothing, unless something is put there."""

from __future__ import annotations

import pytest

from .runs import asked, fails

SOAK = "soak_env.py"
CASES = ("--cases", "arena", "crowd", "team")
ONE = ("--cases", "arena")
pytestmark = pytest.mark.timeout(300)  # a cold start compiles


@pytest.mark.campaign
def test_a_soak_finds_no_nan_and_no_world_that_is_stuck():
    code, found = asked(SOAK, "--steps", "60000", *CASES)
    assert (code, found["failures"]) == (0, [])
    assert found["steps"] >= 60_000
    assert found["nans"] == found["stuck_worlds"] == 0
    assert set(found["cases"]) == set(CASES[1:])
    for case in found["cases"].values():
        assert case["episodes"] > 0
        assert case["longest"] > 1


@pytest.mark.campaign
def test_a_world_that_does_not_move_though_it_is_told_to_is_found():
    missed = fails(SOAK, "stuck", "--steps", "20000", *ONE)
    assert any("a robot that stood for" in line for line in missed)


@pytest.mark.campaign
def test_a_world_that_tells_the_same_while_it_moves_is_found():
    missed = fails(SOAK, "blind", "--steps", "20000", *ONE)
    assert any("an observation that stood for" in line for line in missed)


@pytest.mark.campaign
def test_an_episode_that_does_not_end_is_found():
    missed = fails(SOAK, "endless", "--steps", "30000", "--limit", "10", *ONE)
    assert any("an episode of" in line for line in missed)


@pytest.mark.campaign
def test_a_number_that_is_none_is_found():
    missed = fails(SOAK, "nan", "--steps", "20000", *ONE)
    assert any("not finite" in line for line in missed)


@pytest.mark.campaign
def test_memory_that_grows_is_found():
    missed = fails(SOAK, "leak", "--steps", "20000", *ONE)
    assert any("memory grew by" in line for line in missed)


@pytest.mark.campaign
def test_resets_of_a_single_env_leave_no_files_and_threads_behind():
    code, found = asked(SOAK, "--resets", "300")
    assert (code, found["failures"]) == (0, [])
    assert (found["resets"], found["nans"]) == (300, 0)
    assert found["fds_growth"] == found["threads_growth"] == 0


@pytest.mark.campaign
def test_files_that_resets_leave_behind_are_found():
    missed = fails(SOAK, "leak", "--resets", "100")
    assert any("file descriptors more" in line for line in missed)
