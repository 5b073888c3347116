"""Reports of `command_gate`: log lines, counters, and the black box. It never waits for a disk."""

import contextlib
import gc
import os
import signal
import sys
import time
import warnings
from collections import Counter
from collections.abc import Callable, Sequence
from mmap import mmap
from pathlib import Path
from typing import NoReturn

from rclpy.impl.rcutils_logger import RcutilsLogger

from nics_drl_bridge.gate.black_box import BlackBox, Entry, write
from nics_drl_bridge.gate.state import Cause, GateConfig, GateState
from nics_drl_bridge.nodes.runner import Condition

FILES_KEPT = 20
BURST_S = 3.0  # for which commands must pass before a stop is not of the same burst
LINE_S = 2.0  # time between two log lines of a kind [s]; those in between are counted
LONGEST_LINE_S = 64.0  # the same for a kind that does not cease: each time it is doubled [s]
CLOSING_S = 0.7  # longest wait at the end for files that are being written [s]
MOST_AT_WORK = 3  # greatest number of writers at work; each keeps a copy of this process's memory
PATIENCE_S = 20.0  # a writer that takes longer gives up [s]
OVERDUE_S = PATIENCE_S + 5.0  # then a writer never gives up [s]: a lock or the disk blocks it
GRACE_S, POLL_S = 0.5, 0.005
NICENESS = 5
MOST_TOLD = 500
ENDING = (signal.SIGTERM, signal.SIGALRM)


class GateLog:
    """Counts all, logs without flooding, writes the first stop of each rule in a burst of stops."""

    def __init__(self, config: GateConfig, folder: Path, robot: str, logger: RcutilsLogger) -> None:
        self.counters: Counter[str] = Counter()
        self._box, self._logger = BlackBox(config), logger
        self._folder, self._hardware = folder, robot
        self._cause: Cause | None = None
        self._now = self._since = float("-inf")
        self._rule: str | None = None  # that stops the robot; "" while commands pass, None at first
        self._burst: set[str] = set()  # with a written stop since commands last passed for long
        # Of each kind: time of the last line, and least time until the next [s].
        self._said: dict[str, tuple[float, float]] = {}
        self._kept: Counter[str] = Counter()  # events of a kind since then
        self._owed, self._writer = False, BoxWriter()
        self._names: list[str] = []

    def note(self, entry: Entry) -> None:
        """Accounts for a decision."""
        self._box.note(entry)
        decision, cause = entry.decision, entry.decision.cause
        self._now = entry.now
        if decision.refused:
            self.refuse(decision.refused)
        if decision.shielded:
            self.counters["cut by the shield"] += 1
        rule = "" if cause is None else cause.rule
        if rule != self._rule:
            self._changed(rule)
        self._cause = cause
        lasts = entry.now - self._since >= LINE_S  # what does not alternate is told in any case
        if self._owed and (more := self._due(rule, lasts)) is not None:  # else it is told later
            self._owed = False
            if cause is None:
                self._logger.info(f"commands pass{more}")
            else:
                self._logger.warning(f"stopped by {cause.line}{more}")
        if self._burst and not rule and entry.now - self._since >= BURST_S:
            self._burst.clear()

    def refuse(self, reason: str) -> None:
        """Counts an unused input, by the part of the reason before the colon, and logs it."""
        if (more := self._counted(f"refused, {reason.partition(':')[0]}")) is not None:
            self._logger.warning(f"refused: {reason}{more}")

    def no_number(self, twist: Sequence[float]) -> None:
        """Counts and logs a decision that is not finite, which must never happen."""
        if (more := self._counted("not finite, sent as zero")) is not None:
            then = f"zero is sent, and the e-stop is pressed{more}"
            self._logger.error(f"decided on {list(twist)}, which is not finite: {then}")

    def _counted(self, kind: str) -> str | None:
        self.counters[kind] += 1
        self._kept[kind] += 1
        return self._due(kind)

    def _due(self, kind: str, certainly: bool = False) -> str | None:
        """Returns what to append to a line; None if one of its kind was logged a moment ago."""
        said, wait_s = self._said.get(kind, (float("-inf"), LINE_S))
        if not certainly and self._now - said < wait_s:
            return None
        kept = self._kept.pop(kind, 1) - 1
        self._said[kind] = self._now, min(2.0 * wait_s, LONGEST_LINE_S) if kept else LINE_S
        return f" ({kept} more since the last such line)" if kept else ""

    def _changed(self, rule: str) -> None:
        was_passing = self._rule == ""
        self._rule, self._since, self._owed = rule, self._now, True
        self._kept[rule] += 1
        if not rule:
            return
        self.counters[f"stopped, {rule}"] += 1
        if was_passing and rule in self._burst:
            self.counters["stops of a burst, not in the black box"] += 1
        elif was_passing:
            self._burst.add(rule)
            self._write(rule)

    def _write(self, rule: str) -> None:
        name = f"{time.strftime('%Y%m%d_%H%M%S')}_{self.counters.total():06d}_{rule}.jsonl"
        self._names = [*self._names[1 - FILES_KEPT :], name]

        def work() -> None:
            write(self._box.config, self._box.copy(), self._folder / name)
            prune(self._folder, self._names)

        try:
            if not self._writer.begin(work):
                self._failed("the files before it are still being written")
        except OSError as error:
            self._failed(str(error))

    def _failed(self, reason: str) -> None:
        self.counters["not written"] += 1
        self._logger.error(f"the black box could not be written: {reason}")

    def finding(self, state: GateState) -> Condition:
        """Returns the finding for `/diagnostics`."""
        for failure in self._writer.failures():
            self._failed(failure)
        facts: dict[str, object] = {"armed": state.armed, "latched": state.latched is not None}
        facts |= dict(sorted(self.counters.items()))
        message = self._cause.line if self._cause else "commands pass"
        return Condition(message, self._cause is not None, facts, self._hardware)

    def close(self) -> None:
        """Waits briefly for files that are being written; none is left incomplete."""
        for failure in self._writer.close(CLOSING_S):
            self._failed(failure)


def prune(folder: Path, own: Sequence[str]) -> None:
    """Removes the oldest files beyond `FILES_KEPT`; `own` names are newer than all others."""
    place = {name: i for i, name in enumerate(own, 1)}
    files = sorted(folder.glob("*.jsonl"), key=lambda file: (place.get(file.name, 0), file.name))
    for old in files[:-FILES_KEPT]:
        old.unlink(missing_ok=True)


class BoxWriter:
    """Writes files, each in a forked copy of this process: a hanging disk blocks only the copy."""

    def __init__(self) -> None:
        self._writers: dict[int, tuple[mmap, float]] = {}  # pid: what failed, begin [s]
        self._failed: list[str] = []

    def begin(self, write: Callable[[], object]) -> bool:
        """Starts a copy of this process that writes; False if too many are at work; OSError."""
        self._failed = self.failures()
        if len(self._writers) >= MOST_AT_WORK:
            return False
        told = mmap(-1, MOST_TOLD)  # memory that the copy shares, for what failed
        # The copy must not run the handlers of the original.
        signals = signal.pthread_sigmask(signal.SIG_BLOCK, (signal.SIGINT, *ENDING))
        try:
            with warnings.catch_warnings():
                # Of Python 3.12: locks that other threads hold stay locked in the copy. It needs
                # none of theirs, and a copy that hangs nevertheless gives up.
                warnings.simplefilter("ignore", DeprecationWarning)
                pid = os.fork()
                if pid == 0:
                    _live(write, told)
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, signals)
        self._writers[pid] = told, time.monotonic()
        return True

    def failures(self) -> list[str]:
        """Returns the failures since the last call; kills the writers that are overdue."""
        for pid, (told, begun_s) in tuple(self._writers.items()):
            try:
                ended, status = os.waitpid(pid, os.WNOHANG)
            except ChildProcessError:  # if SIGCHLD is ignored, no status is kept
                ended, status = pid, 0
            if ended:
                del self._writers[pid]
                if status != 0:
                    text = told[:].rstrip(b"\0").decode(errors="replace")
                    self._failed.append(text or f"its writer ended with {status}")
            elif time.monotonic() - begun_s > OVERDUE_S:
                os.kill(pid, signal.SIGKILL)
        failed, self._failed = self._failed, []
        return failed

    def close(self, seconds: float) -> list[str]:
        """Waits for the writers, and makes those give up that take longer; returns the failures."""
        failed = self._wait(seconds)
        for pid in self._writers:
            os.kill(pid, signal.SIGTERM)
        failed += self._wait(GRACE_S)
        for pid in self._writers:  # blocked by the disk; it ends when that releases it
            os.kill(pid, signal.SIGKILL)
            failed.append("the disk does not answer")
        return failed

    def _wait(self, seconds: float) -> list[str]:
        failed, deadline = self.failures(), time.monotonic() + seconds
        while self._writers and time.monotonic() < deadline:
            time.sleep(POLL_S)
            failed += self.failures()
        return failed


def _live(write: Callable[[], object], told: mmap) -> NoReturn:
    code = 1
    try:
        gc.disable()  # which would touch, and so copy, all memory
        _let_go()
        write()
        code = 0
    finally:  # on any exception, also from a signal
        error = sys.exc_info()[1]
        if error is not None:
            told.write((str(error) or type(error).__name__).encode()[:MOST_TOLD])
        os._exit(code)


def _let_go() -> None:
    for name in os.listdir("/proc/self/fd"):
        with contextlib.suppress(OSError):
            os.close(int(name))
    for _ in range(3):
        os.open(os.devnull, os.O_RDWR)
    with contextlib.suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
        os.nice(NICENESS)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches all; the original decides
    for number in ENDING:
        signal.signal(number, _give_up)
    signal.setitimer(signal.ITIMER_REAL, PATIENCE_S)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, (signal.SIGINT, *ENDING))


def _give_up(*_: object) -> NoReturn:
    raise TimeoutError("it took too long")
