from __future__ import annotations

import os
import threading
from pathlib import Path

import pytest

from nics_drl_bridge.nodes import one_core
from nics_drl_bridge.nodes.one_core import OneCore

CORES = os.sched_getaffinity(0) if one_core.CAN_CHOOSE else set()


class Helper:
    """A thread that helps until it is told to end."""

    def __init__(self, core):
        self._ready, self._end = threading.Event(), threading.Event()
        self._thread = threading.Thread(target=self._work, args=(core,), daemon=True)
        self._thread.start()
        assert self._ready.wait(10.0)

    def _work(self, core):
        core.help()
        self.id = threading.get_native_id()
        self._ready.set()
        self._end.wait()

    def end(self):
        self._end.set()
        self._thread.join(10.0)
        for _ in range(100_000):  # the system may take a moment longer to forget it
            if not Path(f"/proc/self/task/{self.id}").exists():
                return
            os.sched_yield()
        raise AssertionError("its thread does not end")


@pytest.fixture
def core():
    return OneCore()


@pytest.fixture
def helper(core):
    made = Helper(core)
    yield made
    made.end()


choosing = pytest.mark.skipif(len(CORES) < 2, reason="needs two cores that a thread may choose")


@choosing
def test_while_it_waits_both_are_on_one_core_and_afterwards_it_is_free(core, helper):
    with core:
        (own,) = os.sched_getaffinity(0)
        assert os.sched_getaffinity(helper.id) == {own}
    assert os.sched_getaffinity(0) == CORES


@choosing
def test_the_helper_follows_the_one_that_waits(core, helper):
    for wanted in sorted(CORES)[:2]:
        os.sched_setaffinity(0, {wanted})  # which moves it at once
        os.sched_setaffinity(0, CORES)
        with core:
            (own,) = os.sched_getaffinity(0)
            assert os.sched_getaffinity(helper.id) == {own}


@choosing
def test_after_an_error_it_is_free_too(core, helper):
    with pytest.raises(KeyboardInterrupt), core:
        raise KeyboardInterrupt
    assert os.sched_getaffinity(0) == CORES


@choosing
def test_a_helper_that_has_ended_changes_nothing(core, helper):
    helper.end()
    with core:
        assert os.sched_getaffinity(0) == CORES
    assert os.sched_getaffinity(0) == CORES


@choosing
def test_who_may_run_on_one_core_only_is_left_alone(core, helper):
    only = {min(CORES)}
    os.sched_setaffinity(0, only)
    try:
        with core:
            assert os.sched_getaffinity(helper.id) == CORES
        assert os.sched_getaffinity(0) == only
    finally:
        os.sched_setaffinity(0, CORES)


def test_without_a_helper_or_such_a_system_nothing_happens(core, monkeypatch):
    with core:
        pass
    core.help()
    monkeypatch.setattr(one_core, "CAN_CHOOSE", False)
    monkeypatch.setattr(one_core, "_allowed", None, raising=False)
    with core:
        pass
