"""Reports of `command_gate`: log lines, counters and the black box. Never waits for a disk."""

import contextlib
import json
import os
import subprocess
import time
from collections import Counter
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from rclpy.impl.rcutils_logger import RcutilsLogger

from nics_drl_bridge.gate.black_box import Entry, format_entry, format_head
from nics_drl_bridge.gate.inputs import get_topic
from nics_drl_bridge.gate.state import Cause, GateConfig, GateState
from nics_drl_bridge.nodes import black_box_writer
from nics_drl_bridge.nodes.black_box_writer import (
    ENTRY,
    FILES_KEPT,
    STATE,
    WRITE,
)
from nics_drl_bridge.nodes.node_process import module_command
from nics_drl_bridge.nodes.own_process import widen_pipe
from nics_drl_bridge.nodes.runner import Condition

BURST_S = (
    3.0  # commands must pass for this long before a stop counts as a new burst [s]
)
LINE_S = 2.0  # time between two log lines of a kind; those in between are counted [s]
# limit of that time, which doubles with each line while a kind persists [s]
LONGEST_LINE_S = 64.0
CLOSING_S = 0.7  # longest wait at the end for files that are being written [s]
GRACE_S = 0.5  # time for the writer to clean up files that it gives up [s]
POLL_S = 0.005
# time without an answer after which a file counts as not written [s]
OVERDUE_S = 25.0
RESTART_S = 5.0  # shortest time between two starts of the writer [s]
STATE_S = 10.0  # time between two states of the gate in the black box [s]
MOST_ENTRIES = 5_000  # between two states
MOST_BACKLOG = 4 * 2**20  # bytes that wait for the writer; a minute of driving
MOST_TOLD = 65_536  # largest read of answers [bytes]


class GateLog:
    """Counts all events, limits log lines, and records the first stop of each rule in a burst."""

    def __init__(
        self, config: GateConfig, folder: Path, robot: str, logger: RcutilsLogger
    ) -> None:
        self.counters: Counter[str] = Counter()
        self._config = config
        self._logger = logger
        self._folder = folder
        self._hardware = robot
        self._cause: Cause | None = None
        self._now = float("-inf")
        self._since = float("-inf")
        # the rule that stops the robot; "" while commands pass, None at first
        self._rule: str | None = None
        # rules whose stop was recorded in the present burst
        self._burst: set[str] = set()
        # For each kind: time of the last line, and minimum time until the next [s].
        self._said: dict[str, tuple[float, float]] = {}
        self._kept: Counter[str] = Counter()  # events of a kind since its last line
        self._owed = False
        self._writer = BoxWriter()
        # time of the last state sent to the writer [s]
        self._state_s = float("-inf")
        self._entries = 0  # sent to the writer since that state
        self._names: list[str] = []

    def note(self, entry: Entry) -> None:
        """Account for a decision."""
        self._record(entry)
        decision = entry.decision
        cause = entry.decision.cause
        self._now = entry.now
        if decision.refused:
            self.refuse(get_topic(entry.given), decision.refused)
        if decision.shielded:
            self.counters["cut by the shield"] += 1
        rule = "" if cause is None else cause.rule
        if rule != self._rule:
            self._changed(rule)
        self._cause = cause
        # a rule that persists is always logged
        lasts = entry.now - self._since >= LINE_S
        # otherwise the line follows later
        more = self._due(rule, lasts) if self._owed else None
        if more is not None:
            self._owed = False
            if cause is None:
                self._logger.info(f"commands pass{more}")
            else:
                self._logger.warning(f"stopped by {cause.line}{more}")
        if self._burst and not rule and entry.now - self._since >= BURST_S:
            self._burst.clear()

    def _record(self, entry: Entry) -> None:
        """Send an entry to the writer, preceded now and then by the state from which it follows."""
        passed = entry.now - self._state_s
        if (
            self._writer.needs_state
            or passed >= STATE_S
            or self._entries >= MOST_ENTRIES
        ):
            self._writer.state(entry.now, format_head(self._config, entry.before))
            self._state_s = entry.now
            self._entries = 0
        self._writer.entry(format_entry(entry))
        self._entries += 1

    def refuse(self, topic: str, fault: str) -> None:
        """Count an input that is refused by its topic, and log what is wrong with it."""
        more = self._counted(f"refused, {topic}")
        if more is not None:
            self._logger.warning(f"refused: {fault}{more}")

    def no_number(self, twist: Sequence[float]) -> None:
        """Count and log a decision that is not finite; that must never happen."""
        more = self._counted("not finite, sent as zero")
        if more is not None:
            then = f"zero is sent, and the e-stop is pressed{more}"
            self._logger.error(f"decided on {list(twist)}, which is not finite: {then}")

    def _counted(self, kind: str) -> str | None:
        self.counters[kind] += 1
        self._kept[kind] += 1
        return self._due(kind)

    def _due(self, kind: str, certainly: bool = False) -> str | None:
        """Return a suffix for the line; None if one of its kind was logged a moment ago."""
        said, wait_s = self._said.get(kind, (float("-inf"), LINE_S))
        if not certainly and self._now - said < wait_s:
            return None
        kept = self._kept.pop(kind, 1) - 1
        self._said[kind] = (
            self._now,
            min(2.0 * wait_s, LONGEST_LINE_S) if kept else LINE_S,
        )
        return f" ({kept} more since the last such line)" if kept else ""

    def _changed(self, rule: str) -> None:
        was_passing = self._rule == ""
        self._rule = rule
        self._since = self._now
        self._owed = True
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
        name = (
            f"{time.strftime('%Y%m%d_%H%M%S')}_{self.counters.total():06d}_{rule}.jsonl"
        )
        self._names = [*self._names[1 - FILES_KEPT :], name]
        self._writer.write(self._folder / name, self._names)

    def _failed(self, reason: str) -> None:
        self.counters["not written"] += 1
        self._logger.error(f"the black box could not be written: {reason}")

    def finding(self, state: GateState) -> Condition:
        """Return the finding for `/diagnostics`."""
        for failure in self._writer.failures():
            self._failed(failure)
        facts: dict[str, object] = {
            "armed": state.armed,
            "latched": state.latched is not None,
        }
        facts |= dict(sorted(self.counters.items()))
        message = self._cause.line if self._cause else "commands pass"
        return Condition(message, self._cause is not None, facts, self._hardware)

    def close(self) -> None:
        """Wait briefly for files that are being written; leave none incomplete."""
        for failure in self._writer.close(CLOSING_S):
            self._failed(failure)


class BoxWriter:
    """Handle of the black box's writer, which is a separate process (`black_box_writer.py`).

    The writer is restarted if it has ended or does not read. Only `close` waits for it.
    """

    def __init__(self) -> None:
        self.needs_state = True  # before the next entry
        self._backlog = bytearray()  # not yet taken by the pipe
        # path of each file without an answer yet -> time of the order [s]
        self._orders: dict[str, float] = {}
        self._answers = b""  # an incomplete line
        self._failed: list[str] = []
        self._entrance = self._exit = -1  # our ends of its pipes
        self._start()

    def __del__(self) -> None:
        self._close_pipes()  # this ends the writer

    def state(self, now: float, line: bytes) -> None:
        """Send the gate's state at a time [s]; the next entries follow from it."""
        self.needs_state = False
        self._send(STATE, f"{now} ".encode() + line)

    def entry(self, line: bytes) -> None:
        """Send an entry."""
        self._send(ENTRY, line)

    def write(self, path: Path, own: Sequence[str]) -> None:
        """Order a file of what was sent last; `own` are the names of this gate's files."""
        self._orders[str(path)] = time.monotonic()
        order = {"path": str(path), "own": list(own)}
        self._send(WRITE, json.dumps(order).encode() + b"\n")

    def failures(self) -> list[str]:
        """Return the failures since the last call; start a new writer if there is none."""
        self._flush()
        self._hear()
        now = time.monotonic()
        for path, begun_s in tuple(self._orders.items()):
            if now - begun_s > OVERDUE_S:
                self._lose(path, "the disk does not answer")
        if self._process.poll() is not None and now - self._started_s > RESTART_S:
            self._restart(f"its writer ended with {self._process.returncode}")
        failed = self._failed
        self._failed = []
        return failed

    def close(self, seconds: float) -> list[str]:
        """Wait for files that are being written, then let the writer give up; see `failures`."""
        self._finish(seconds)
        if self._process.poll() is None:
            self._process.terminate()
            self._finish(GRACE_S)
        reason = f"its writer ended with {self._process.poll()}"
        # the disk blocks the writer, which ends once it is released
        if self._process.poll() is None:
            self._process.kill()
            reason = "the disk does not answer"
        self._hear()
        for path in tuple(self._orders):
            self._lose(path, reason)
        self._close_pipes()
        failed = self._failed
        self._failed = []
        return failed

    def _send(self, kind: bytes, line: bytes) -> None:
        self._backlog += kind + line
        self._flush()
        if len(self._backlog) > MOST_BACKLOG:
            self._process.kill()
            self._restart("its writer did not read")

    def _flush(self) -> None:
        with contextlib.suppress(OSError):  # the pipe is full, or the writer has ended
            while self._backlog:
                sent = os.write(self._entrance, self._backlog)
                del self._backlog[:sent]

    def _hear(self) -> None:
        with contextlib.suppress(OSError):  # there is nothing more
            for part in iter(partial(os.read, self._exit, MOST_TOLD), b""):
                self._answers += part
        *lines, self._answers = self._answers.split(b"\n")
        for line in lines:
            answer = json.loads(line)
            if answer["failed"]:
                self._lose(answer["path"], answer["failed"])
            self._orders.pop(answer["path"], None)

    def _lose(self, path: str, reason: str) -> None:
        if self._orders.pop(path, None) is not None:
            self._failed.append(reason)

    def _restart(self, reason: str) -> None:
        self._hear()
        lost = tuple(self._orders)
        for path in lost:
            self._lose(path, reason)
        if not lost:
            self._failed.append(reason)
        try:
            self._start()
        except OSError as error:
            self._failed.append(f"its writer can't be started ({error.strerror})")

    def _start(self) -> None:
        """Start the writer; executed, not forked, because DDS has threads in this process."""
        self._close_pipes()
        self._backlog = bytearray()
        self._answers = b""
        self.needs_state = True
        self._started_s = time.monotonic()
        source, self._entrance = os.pipe()
        self._exit, target = os.pipe()
        widen_pipe(self._entrance)
        os.set_blocking(self._exit, False)
        try:
            self._process = subprocess.Popen(
                module_command(black_box_writer.__name__),
                stdin=source,
                stdout=target,
                stderr=subprocess.DEVNULL,
                start_new_session=True,  # Ctrl-C would reach the writer; the gate ends it
            )
        finally:
            os.close(source)
            os.close(target)

    def _close_pipes(self) -> None:
        for descriptor in (self._entrance, self._exit):
            if descriptor >= 0:
                os.close(descriptor)
        self._entrance = -1
        self._exit = -1

    def _finish(self, seconds: float) -> None:
        deadline = time.monotonic() + seconds
        while self._process.poll() is None and time.monotonic() < deadline:
            self._flush()
            if not self._backlog and self._entrance >= 0:
                os.close(self._entrance)  # the writer ends once it has read everything
                self._entrance = -1
            time.sleep(POLL_S)
