import os
import subprocess
import sys

import pytest

from nics_drl_bridge.nodes.own_process import take_priority

CODE = """
import os, threading
from nics_drl_bridge.nodes.own_process import take_priority

stop = threading.Event()
other = threading.Thread(target=stop.wait)
other.start()
refused = take_priority(7)
threads = [int(name) for name in os.listdir("/proc/self/task")]
policies = {os.sched_getscheduler(thread) for thread in threads}
levels = {os.sched_getparam(thread).sched_priority for thread in threads}
stop.set()
print(policies, levels)
print(refused)
"""


@pytest.mark.process
def test_all_threads_of_the_process_get_the_priority_where_the_system_allows_it():
    code = [sys.executable, "-c", CODE]
    done = subprocess.run(code, capture_output=True, text=True, check=True)
    scheduled, refused = done.stdout.splitlines()
    if "does not allow" in refused:
        pytest.skip(refused)
    policy = (
        os.SCHED_FIFO | os.SCHED_RESET_ON_FORK
    )  # processes that it starts have none
    assert scheduled == f"{ {policy} } { {7} }"
    assert refused == ""


def test_none_is_asked_for_by_default(monkeypatch):
    monkeypatch.delattr(os, "sched_setscheduler")
    assert take_priority(0) == ""


def test_where_the_system_does_not_allow_it_a_sentence_says_how_to(monkeypatch):
    def refuse(*_):
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(os, "sched_setscheduler", refuse)
    told = take_priority(42)
    assert "a real-time priority of 42 (operation not permitted)" in told
    for fix in ("`ulimit -r 42`", "`LimitRTPRIO=42`", "CAP_SYS_NICE", "set 0"):
        assert fix in told


def test_where_there_are_no_such_priorities_a_sentence_says_so(monkeypatch):
    monkeypatch.delattr(os, "sched_setscheduler")
    assert "a real-time priority of 1 (it has none)" in take_priority(1)
