from __future__ import annotations

import ctypes
import os
import signal
import subprocess
import sys
import threading
from pathlib import Path

import pytest
import typer
from browser import until

from nics_drl_bridge.commands import console, interrupts

NICS = [sys.executable, "-m", "nics_drl_bridge.commands.start"]
DEADLINE_S = 60.0


@pytest.fixture
def handled():
    before = signal.signal(signal.SIGINT, interrupts._end)
    yield
    signal.signal(signal.SIGINT, before)
    interrupts._interrupts.clear()


def test_ctrl_c_in_a_callback_of_llvm_comes_when_that_is_over(handled):
    # Out of a callback from C no exception comes: Python prints it, and all goes on.
    def _raw_object_cache_notify():
        signal.raise_signal(signal.SIGINT)
        return 1

    assert ctypes.CFUNCTYPE(ctypes.c_int)(_raw_object_cache_notify)() == 1
    with pytest.raises(KeyboardInterrupt):
        assert threading.Event().wait(DEADLINE_S), "no interrupt came"


def children_of(process: int) -> list[int]:
    found = Path(f"/proc/{process}/task/{process}/children")
    return [int(child) for child in found.read_text().split()]


@pytest.mark.process
@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_a_warm_up_that_is_ended_leaves_no_process_and_no_traceback(tmp_path):
    with subprocess.Popen(
        [*NICS, "warmup"],
        env={**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)},
        stderr=subprocess.PIPE,
        text=True,
    ) as warming:
        until(lambda: any(tmp_path.iterdir()), "machine code")
        children = children_of(warming.pid)
        assert len(children) >= 2
        warming.send_signal(signal.SIGTERM)
        assert "Traceback" not in warming.communicate(timeout=DEADLINE_S)[1]
        assert warming.returncode == 128 + signal.SIGTERM
    until(
        lambda: not any(Path(f"/proc/{child}").exists() for child in children),
        "the end of its processes",
    )


class SwallowedError(Exception):
    """What a library makes of an interrupt."""


def swallow(make):
    """Raises what `make` gives while an interrupt is handled."""
    try:
        raise KeyboardInterrupt
    except KeyboardInterrupt as interrupt:
        raise make(interrupt) from None


def nested(interrupt):
    inner = SystemError("a compiled function")
    inner.__cause__ = interrupt
    outer = SystemError("a compiled function that called it")
    outer.__cause__ = inner
    return outer


@pytest.mark.parametrize(
    "make", [nested, lambda _: SwallowedError("lost"), lambda _: typer.Abort()]
)
def test_an_interrupt_is_one_whatever_a_library_made_of_it(make, capsys):
    with pytest.raises(typer.Exit) as caught, console.report_in_one_sentence():
        swallow(make)
    assert caught.value.exit_code == 130
    assert capsys.readouterr().err.startswith("nics: interrupted;")


def test_an_error_without_an_interrupt_stays_an_error():
    with pytest.raises(typer.Abort), console.report_in_one_sentence():
        raise typer.Abort from EOFError()
    with pytest.raises(SystemError), console.report_in_one_sentence():
        raise SystemError("of a library")


# A command that a Ctrl-C meets in a text that is run, and that loses it in an error of its own.
LOSES_IT = """
import os, signal, sys
from nics_drl_bridge.commands import cli, start

def interrupted(**_):
    print("began", flush=True)
    try:
        exec("while True: pass")
    except KeyboardInterrupt:
        {then}

cli.app = interrupted
start.main()
"""


@pytest.mark.process
@pytest.mark.parametrize(
    "then", ["raise", "pass; raise RuntimeError('lost')", "sys.exit(1)"]
)
def test_a_command_that_is_interrupted_ends_with_130_whatever_the_moment(
    tmp_path, then
):
    (tmp_path / "loses_it.py").write_text(LOSES_IT.format(then=then))
    words = [sys.executable, "-m", "loses_it"]
    path = os.pathsep.join([str(tmp_path), *sys.path])
    with subprocess.Popen(
        words, stdout=subprocess.PIPE, text=True, env=os.environ | {"PYTHONPATH": path}
    ) as process:
        assert process.stdout.readline() == "began\n"
        process.send_signal(signal.SIGINT)
        assert process.wait(DEADLINE_S) == 130


@pytest.mark.process
@pytest.mark.skipif(sys.platform != "linux", reason="is about POSIX shells")
def test_a_node_below_a_shell_that_ignores_ctrl_c_takes_it_again():
    ignoring = "import signal; signal.signal(signal.SIGINT, signal.SIG_IGN); "
    name = "nics_drl_bridge.nodes.processes"
    run = f"import subprocess, sys; from {name} import prepare_child; "
    ask = "import signal; print(signal.getsignal(signal.SIGINT) is signal.default_int_handler)"
    child = (
        f"subprocess.run([sys.executable, '-c', {ask!r}], preexec_fn=prepare_child())"
    )
    done = subprocess.run(
        [sys.executable, "-c", f"{ignoring}{run}{child}"],
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout == "True\n"
