"""Reports of `command_gate`: log lines, counters and the black box. Never waits for a disk."""

import math
import os
import signal
import subprocess
import time
from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from rclpy.impl.rcutils_logger import RcutilsLogger

from nics_drl_bridge.gate.black_box import Entry, format_entry, format_head
from nics_drl_bridge.gate.inputs import get_topic
from nics_drl_bridge.gate.state import Cause, GateConfig, GateState
from nics_drl_bridge.nodes import black_box_writer
from nics_drl_bridge.nodes.black_box_writer import FILES_KEPT
from nics_drl_bridge.nodes.listener import holds
from nics_drl_bridge.nodes.processes import make_module_command
from nics_drl_bridge.nodes.runner import ERROR, OK, STALE, WARN, Condition

BURST_S = (
    3.0  # commands must pass for this long before a stop counts as a new burst [s]
)
LINE_S = 2.0  # time between two log lines of a kind; all are counted [s]
CLOSING_S = 0.7  # longest wait at the end for files that are being written [s]
POLL_S = 0.005
KEPT_S = 30.0  # minimum time span of the lines that are kept [s]
STATE_S = 10.0  # time between two states of the gate in the black box [s]
MOST_ENTRIES = 5_000  # between two states
MOST_LINES = 18_000  # fewer than a replay takes
MOST_BYTES = 48 * 2**20
# What diagnostics call a stop by these rules; any other one is an error.
LEVELS = {
    "disarmed": WARN,
    "scan_silent": STALE,
    "odom_silent": STALE,
    "sensor_silent": STALE,
}


class GateLog:
    """Counts all events, limits log lines, and records the first stop of each rule in a burst."""

    def __init__(
        self, config: GateConfig, folder: Path, robot: str, logger: RcutilsLogger
    ) -> None:
        self.counters: Counter[str] = Counter()
        self._logger = logger
        self._hardware = robot
        self._cause: Cause | None = None
        self._now = -math.inf
        self._since = -math.inf
        # the rule that stops the robot; "" while commands pass, None at first
        self._rule: str | None = None
        # rules whose stop was recorded in the present burst
        self._burst: set[str] = set()
        self._logged_s: dict[str, float] = {}  # time of the last line of a kind
        self._is_untold = False  # the present rule is not logged yet
        self._box = BlackBox(config, folder)

    def note(self, entry: Entry) -> None:
        """Account for a decision."""
        self._box.add(entry)
        decision = entry.decision
        cause = entry.decision.cause
        self._now = entry.now
        if decision.refused:
            self.refuse(get_topic(entry.given), decision.refused)
        if decision.shielded:
            self.counters["cut by the shield"] += 1
        rule = "" if cause is None else cause.rule
        if rule != self._rule:
            self._change_rule(rule)
        self._cause = cause
        # what is the case is always logged in the end, maybe later
        if self._is_untold and self._may_log(f"rule {rule}"):
            self._is_untold = False
            if cause is None:
                self._logger.info("commands pass")
            else:
                self._logger.warning(f"stopped by {cause.line}")
        if self._burst and not rule and entry.now - self._since >= BURST_S:
            self._burst.clear()

    def refuse(self, topic: str, fault: str) -> None:
        """Count an input that is refused by its topic, and log what is wrong with it."""
        self.counters[f"refused, {topic}"] += 1
        if self._may_log(topic):
            self._logger.warning(f"refused: {fault}")

    def report_not_finite(self, twist: Sequence[float]) -> None:
        """Count and log a decision that is not finite; that must never happen."""
        self.counters["not finite, sent as zero"] += 1
        if self._may_log("not finite"):
            self._logger.error(
                f"decided on {list(twist)}, which is not finite: zero is sent, and the e-stop "
                "is pressed"
            )

    def _may_log(self, kind: str) -> bool:
        """Return whether the last line of a kind is old enough; the next one counts as logged."""
        if self._now - self._logged_s.get(kind, -math.inf) < LINE_S:
            return False
        self._logged_s[kind] = self._now
        return True

    def _change_rule(self, rule: str) -> None:
        was_passing = self._rule == ""
        self._rule = rule
        self._since = self._now
        self._is_untold = True
        if not rule:
            return
        self.counters[f"stopped, {rule}"] += 1
        if was_passing and rule in self._burst:
            self.counters["stops of a burst, not in the black box"] += 1
        elif was_passing:
            self._burst.add(rule)
            when = time.strftime("%Y%m%d_%H%M%S")
            self._box.write(f"{when}_{self.counters.total():06d}_{rule}.jsonl")

    def _tell_failures(self, reasons: Sequence[str]) -> None:
        for reason in reasons:
            self.counters["not written"] += 1
            self._logger.error(f"the black box could not be written: {reason}")

    def finding(self, state: GateState) -> Condition:
        """Return the finding for `/diagnostics`."""
        self._tell_failures(self._box.failures())
        facts: dict[str, object] = {
            "armed": state.armed,
            "latched": state.latched is not None,
        }
        facts |= dict(sorted(self.counters.items()))
        if self._cause is None:
            return Condition("commands pass", OK, facts, self._hardware)
        level = LEVELS.get(self._cause.rule, ERROR)
        return Condition(self._cause.line, level, facts, self._hardware)

    def close(self) -> None:
        """Wait briefly for files that are being written."""
        self._tell_failures(self._box.close(CLOSING_S))


@dataclass
class Segment:
    """Lines of the black box: a state of the gate, and the entries that follow it."""

    begin_s: float  # time of the state
    lines: list[bytes]
    size: int  # of the lines [bytes]


class BlackBox:
    """Keeps the latest inputs of a gate, and starts a process for each file to write.

    So a stop never waits for the disk, and a file is completed even if the gate is killed.
    """

    def __init__(self, config: GateConfig, folder: Path) -> None:
        self._config = config
        self._folder = folder
        self._segments: deque[Segment] = deque()
        self._names: list[str] = []  # of the newest files
        self._writers: list[subprocess.Popen[bytes]] = []
        self._failed: list[str] = []

    def add(self, entry: Entry) -> None:
        """Keep an entry, preceded now and then by the state from which it follows."""
        segments = self._segments
        if (
            not segments
            or entry.now - segments[-1].begin_s >= STATE_S
            or len(segments[-1].lines) > MOST_ENTRIES
        ):
            head = format_head(self._config, entry.before)
            segments.append(Segment(entry.now, [head], len(head)))
        line = format_entry(entry)
        segments[-1].lines.append(line)
        segments[-1].size += len(line)
        while len(segments) > 1 and (
            segments[1].begin_s <= entry.now - KEPT_S
            or sum(len(segment.lines) for segment in segments) > MOST_LINES
            or sum(segment.size for segment in segments) > MOST_BYTES
        ):
            segments.popleft()

    def lines(self) -> list[bytes]:
        """Return the lines for a file: the oldest state, and all entries since."""
        kept: list[bytes] = []
        for segment in self._segments:
            kept += segment.lines[1:] if kept else segment.lines
        return kept

    def write(self, name: str) -> None:
        """Start to write a file of what is kept."""
        self._names = [*self._names[1 - FILES_KEPT :], name]
        program = make_module_command(black_box_writer.__name__)
        try:
            with os.fdopen(os.memfd_create("black_box"), "w+b") as memory:
                memory.writelines(self.lines())
                memory.seek(0)
                writer = subprocess.Popen(
                    [*program, str(self._folder), *self._names],
                    stdin=memory,
                    stdout=subprocess.DEVNULL,
                    stderr=subprocess.PIPE,
                    start_new_session=True,  # not ended by Ctrl-C or the gate's end
                )
        except OSError as error:
            self._failed.append(f"its writer can't be started ({error.strerror})")
        else:
            self._writers.append(writer)

    def failures(self) -> list[str]:
        """Return the failures since the last call."""
        failed = self._failed
        self._failed = []
        for writer in tuple(self._writers):
            code = writer.poll()
            if code is None:
                continue
            self._writers.remove(writer)
            _, reason = writer.communicate()
            if code == -signal.SIGALRM:
                failed.append("the disk does not answer")
            elif code:
                words = reason.decode(errors="replace").strip()
                failed.append(words or f"its writer ended with {code}")
        return failed

    def close(self, seconds: float) -> list[str]:
        """Wait for files that are being written; see `failures`. After that they go on alone."""
        holds(
            lambda: all(writer.poll() is not None for writer in self._writers),
            seconds,
            POLL_S,
        )
        return self.failures()
