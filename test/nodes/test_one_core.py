from __future__ import annotations

import os
import threading
from pathlib import Path

import pytest

from nics_drl_bridge.nodes import dds_backend
from nics_drl_bridge.nodes.dds_backend import OneCore

CORES = os.sched_getaffinity(0) if dds_backend.CAN_CHOOSE else set()


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


class Waiting(threading.Event):
    """An event that is there at once; looks at the cores of both threads while it is waited for."""

    def __init__(self, helper, error=None):
        super().__init__()
        self.helper, self.error = helper, error

    def wait(self, timeout=None):
        self.own = os.sched_getaffinity(0)
        self.other = os.sched_getaffinity(self.helper.id) if self.helper else None
        if self.error:
            raise self.error
        return True


@choosing
def test_while_it_waits_both_are_on_one_core_and_afterwards_it_is_free(core, helper):
    event = Waiting(helper)
    assert core.wait(event, 1.0)
    assert len(event.own) == 1
    assert event.other == event.own
    assert os.sched_getaffinity(0) == CORES


@choosing
def test_the_helper_follows_the_one_that_waits(core, helper):
    for wanted in sorted(CORES)[:2]:
        os.sched_setaffinity(0, {wanted})  # which moves it at once
        os.sched_setaffinity(0, CORES)
        event = Waiting(helper)
        core.wait(event, 1.0)
        assert event.other == event.own


@choosing
def test_after_an_error_it_is_free_too(core, helper):
    with pytest.raises(KeyboardInterrupt):
        core.wait(Waiting(helper, KeyboardInterrupt()), 1.0)
    assert os.sched_getaffinity(0) == CORES


@choosing
@pytest.mark.parametrize("after", [0, 1], ids=["the helper's", "its own"])
def test_interrupted_right_after_a_core_was_chosen_it_is_free_too(core, helper, monkeypatch, after):
    calls, allow = [], os.sched_setaffinity

    def interrupted(thread, cores):
        allow(thread, cores)
        calls.append(thread)
        if len(calls) == after + 1:
            raise KeyboardInterrupt

    monkeypatch.setattr(dds_backend, "_allow", interrupted)
    with pytest.raises(KeyboardInterrupt):
        core.wait(Waiting(helper), 1.0)
    assert os.sched_getaffinity(0) == CORES


@choosing
@pytest.mark.parametrize("nowhere", [-1, 10**6])
def test_where_no_core_can_be_told_or_chosen_it_only_waits(core, helper, monkeypatch, nowhere):
    monkeypatch.setattr(dds_backend, "_core_now", lambda: nowhere)
    event = Waiting(helper)
    assert core.wait(event, 1.0)
    assert event.own == event.other == os.sched_getaffinity(0) == CORES


@choosing
def test_a_helper_that_has_ended_changes_nothing(core, helper):
    helper.end()
    event = Waiting(None)
    assert core.wait(event, 1.0)
    assert event.own == os.sched_getaffinity(0) == CORES


@choosing
def test_who_may_run_on_one_core_only_is_left_alone(core, helper):
    only, event = {min(CORES)}, Waiting(helper)
    os.sched_setaffinity(0, only)
    try:
        core.wait(event, 1.0)
        assert os.sched_getaffinity(0) == only
    finally:
        os.sched_setaffinity(0, CORES)
    assert event.other == CORES


def test_without_a_helper_or_such_a_system_it_only_waits(core, monkeypatch):
    event = threading.Event()
    assert not core.wait(event, 0.0)
    event.set()
    assert core.wait(event, 0.0)
    core.help()
    monkeypatch.setattr(dds_backend, "CAN_CHOOSE", False)
    monkeypatch.setattr(dds_backend, "_allowed", None, raising=False)
    assert core.wait(event, 0.0)
