"""One input handed to one entry point, in a process of its own: what came of it, at what cost."""

from __future__ import annotations

import os
import pickle
import re
import resource
import select
import signal
import sys
import tempfile
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from nics_drl_bridge.errors import BridgeError
from nics_drl_bridge.kernels import COMPILING

OWN_TIME_S = 2.0
MOST_MEMORY = 500 * 2**20
LONGEST_S = 60.0
"""An answer that takes longer than this is a hang, however little of it is its own time."""
LONGEST_SENTENCE = 1000
ROOM = 4 * 2**30
"""Address space that a process may take besides what it has, so that the machine survives."""
EXIT_BAD_INPUT = 2

# where a step takes long
PROGRESS = re.compile(r"^[a-z][\w ]* \(\d+ s\)\n", re.MULTILINE)


class ReadOtherwiseError(Exception):
    """An input was read without a word, but not as what it was."""


@dataclass(frozen=True)
class Attempt:
    """What is handed to whom."""

    kind: str  # of input, as `policy`
    told: str  # what is wrong with it, in words that reproduce it
    act: Callable[[], object]  # hands it over; raises what the entry point raises
    # `bad` if it has to be refused, `good` if it has to be taken, `same` if it has to be refused
    # or read as it was, `any` if it may be refused or taken
    verdict: str = "bad"


class Outcome(NamedTuple):
    """What came of an attempt."""

    end: str  # `accepted`, `changed`, `refused`, `traceback`, or `hang`
    words: str  # of the refusal or the traceback
    own_s: float  # processor time that it took
    memory: int  # at its peak, beyond what the libraries had taken [bytes]


def make_attempt(attempt: Attempt) -> Outcome:
    """Makes an attempt in a forked process, which is killed when it takes too long."""
    reading, writing = os.pipe()
    begin = time.monotonic()
    child = os.fork()
    if child == 0:
        os.close(reading)
        _answer(attempt, writing)
    os.close(writing)
    data = b""
    with os.fdopen(reading, "rb", buffering=0) as pipe:
        while (left := begin + LONGEST_S - time.monotonic()) > 0.0:
            if not select.select([pipe], [], [], left)[0]:
                break
            part = pipe.read(2**16)
            if not part:
                break
            data += part
    os.kill(child, signal.SIGKILL)
    _, status, used = os.wait4(child, 0)
    own_s = used.ru_utime + used.ru_stime
    if not data:
        waited = time.monotonic() - begin
        end = "hang" if waited >= LONGEST_S else "traceback"
        return Outcome(
            end, f"no answer after {waited:.1f} s, status {status}", own_s, 0
        )
    end, words, memory, compiling_s = pickle.loads(data)
    own_s -= compiling_s  # which is once on a machine, whatever the input
    return Outcome("hang" if own_s > OWN_TIME_S else end, words, own_s, memory)


def _answer(attempt: Attempt, writing: int) -> None:
    """In a process of its own, which it ends."""
    try:
        pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0])
        size = pages * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (size + ROOM, size + ROOM))
        before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        compiled_s = COMPILING.cpu_s
        end, words = _try(attempt.act)
        after = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        told = end, words[:3000], (after - before) * 1024, COMPILING.cpu_s - compiled_s
        os.write(writing, pickle.dumps(told))
    finally:
        os._exit(0)


def _try(act: Callable[[], object]) -> tuple[str, str]:
    try:
        act()
    except ReadOtherwiseError:
        return "changed", ""
    except BridgeError as error:
        sentence = str(error)
        if "\n" not in sentence and 0 < len(sentence) <= LONGEST_SENTENCE:
            return "refused", sentence
        told = f"no sentence, but {len(sentence)} characters: {sentence[:300]!r}"
        return "traceback", told
    except BaseException:  # noqa: BLE001 - these are what is counted
        return "traceback", traceback.format_exc()[-1500:]
    return "accepted", ""


def call_nics(folder: Path, *words: object) -> Callable[[], None]:
    """Returns an act: a command of `nics`. It raises BridgeError for an end with a sentence."""

    def act() -> None:
        from nics_drl_bridge.commands.cli import main

        os.chdir(folder)

        with tempfile.TemporaryFile("w+", errors="replace") as said:
            os.dup2(said.fileno(), 1)
            os.dup2(said.fileno(), 2)
            sys.argv = ["nics", *map(str, words)]
            code: object = 0
            try:
                main()
            except SystemExit as end:
                code = end.code
            sys.stdout.flush()
            sys.stderr.flush()
            said.seek(0)
            text = said.read()
        told = PROGRESS.sub("", text)
        if code == EXIT_BAD_INPUT and told.startswith("nics: "):
            raise BridgeError(told.removesuffix("\n"))
        if code not in (0, None, 1):
            raise ValueError(f"exit code {code}: {text[:2000]}")

    return act
