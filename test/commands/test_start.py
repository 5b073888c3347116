from __future__ import annotations

import ctypes
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from nics_drl_bridge.commands import start

NICS = [sys.executable, "-m", "nics_drl_bridge.commands.start"]
DEADLINE_S = 60.0


@pytest.fixture
def handled():
    before = signal.signal(signal.SIGINT, start._end)
    yield
    signal.signal(signal.SIGINT, before)


def test_ctrl_c_in_a_callback_of_llvm_comes_when_that_is_over(handled):
    # Out of a callback from C no exception comes: Python prints it, and all goes on.
    def _raw_object_cache_notify():
        signal.raise_signal(signal.SIGINT)
        return 1

    assert ctypes.CFUNCTYPE(ctypes.c_int)(_raw_object_cache_notify)() == 1
    with pytest.raises(KeyboardInterrupt):
        time.sleep(DEADLINE_S)


def test_ctrl_c_anywhere_else_comes_at_once(handled):
    with pytest.raises(KeyboardInterrupt):
        signal.raise_signal(signal.SIGINT)


def children_of(process: int) -> list[int]:
    found = Path(f"/proc/{process}/task/{process}/children")
    return [int(child) for child in found.read_text().split()]


def until(condition):
    deadline = time.monotonic() + DEADLINE_S
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.01)


@pytest.mark.process
@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_a_warm_up_that_is_ended_leaves_no_process_and_no_traceback(tmp_path):
    with subprocess.Popen(
        [*NICS, "warmup"], env={**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)},
        stderr=subprocess.PIPE, text=True,
    ) as warming:  # fmt: skip
        until(lambda: any(tmp_path.iterdir()))  # the workers compile
        children = children_of(warming.pid)
        assert len(children) >= 2
        warming.send_signal(signal.SIGTERM)
        assert "Traceback" not in warming.communicate(timeout=DEADLINE_S)[1]
        assert warming.returncode == 128 + signal.SIGTERM
    until(lambda: not any(Path(f"/proc/{child}").exists() for child in children))
