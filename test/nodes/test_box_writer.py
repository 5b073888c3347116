from __future__ import annotations

import contextlib
import os
import signal
import time

import pytest

from nics_drl_bridge.files import write_parts
from nics_drl_bridge.nodes import box_writer
from nics_drl_bridge.nodes.box_writer import MOST_AT_WORK, BoxWriter

LONG_S = 60.0
DEADLINE_S = 20.0


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
    monkeypatch.setattr(box_writer, "GRACE_S", DEADLINE_S)


@pytest.mark.usefixtures("patient")
def test_a_disk_that_hangs_holds_up_neither_the_start_nor_the_end(writer):
    began = time.monotonic()
    assert writer.begin(hung)
    assert writer.failures() == []
    assert writer.close(0.1) == ["it took too long"]
    assert time.monotonic() - began < LONG_S / 4


def test_one_that_does_not_even_hear_that_it_is_to_give_up_is_left_behind(writer):
    def deaf():
        signal.pthread_sigmask(signal.SIG_BLOCK, box_writer.ENDING)
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
    monkeypatch.setattr(box_writer, "PATIENCE_S", 0.05)
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
            os.waitid(os.P_ALL, 0, os.WEXITED | os.WNOWAIT)
    assert len(writer.close(DEADLINE_S)) == 2 * MOST_AT_WORK


def test_one_that_does_not_even_give_up_is_ended_for_the_next_to_have_room(writer, monkeypatch):
    def deaf():
        signal.pthread_sigmask(signal.SIG_BLOCK, box_writer.ENDING)
        hung()

    for _ in range(MOST_AT_WORK):
        writer.begin(deaf)
    assert not writer.begin(deaf)
    monkeypatch.setattr(box_writer, "OVERDUE_S", 0.0)
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
