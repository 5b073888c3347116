"""Reports of `command_gate`: log lines, counters, and the black box."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from rclpy.impl.rcutils_logger import RcutilsLogger

from nics_drl_bridge.gate.black_box import BlackBox, Entry, write
from nics_drl_bridge.gate.state import Cause, GateState
from nics_drl_bridge.nodes.box_writer import BoxWriter
from nics_drl_bridge.nodes.diagnostics import Condition
from nics_drl_bridge.nodes.gate_parameters import GateParameters

FILES_KEPT = 20
BURST_S = 3.0
"""Time for which commands must pass before a stop counts as new, not as part of a burst [s]."""
LINE_S = 2.0
"""Time between two log lines of a kind [s]; those in between are counted."""
CLOSING_S = 0.7
"""Longest wait at the end for files that are being written [s]."""


class _Lines:
    """Log lines, at most one of a kind within `LINE_S`."""

    def __init__(self) -> None:
        self._said: dict[str, float] = {}
        self._kept: Counter[str] = Counter()

    def count(self, kind: str) -> None:
        """Counts one more line of a kind."""
        self._kept[kind] += 1

    def due(self, kind: str, now: float) -> str | None:
        """Returns a suffix about lines that were not logged; None if one has just been logged."""
        if now - self._said.get(kind, float("-inf")) < LINE_S:
            return None
        kept, self._said[kind] = self._kept.pop(kind, 1) - 1, now
        return f" ({kept} more since the last such line)" if kept else ""


class GateLog:
    """Counts everything, logs without flooding, and writes one file for each new stop.

    Stops in quick succession are a burst. The first stop of each rule in a burst is written, as it
    was at that moment; the others are counted.

    Args:
        parameters: of the gate.
        logger: for the lines.
    """

    def __init__(self, parameters: GateParameters, logger: RcutilsLogger) -> None:
        self.counters: Counter[str] = Counter()
        self._box, self._logger = BlackBox(parameters.config), logger
        self._folder, self._hardware = parameters.black_box, parameters.robot
        self._cause: Cause | None = None
        self._now = self._since = float("-inf")
        self._rule: str | None = None
        """Rule that stops the robot; empty while commands pass, None at first."""
        self._burst: set[str] = set()
        """Rules with a written stop since commands last passed for long."""
        self._lines, self._owed = _Lines(), False
        self._names: list[str] = []
        self._writer = BoxWriter()

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
        if self._owed:
            self._tell(rule)
        if self._burst and not rule and entry.now - self._since >= BURST_S:
            self._burst.clear()

    def refuse(self, reason: str) -> None:
        """Counts an unused input, by the part of the reason before the colon, and logs it."""
        kind = f"refused, {reason.partition(':')[0]}"
        self.counters[kind] += 1
        self._lines.count(kind)
        more = self._lines.due(kind, self._now)
        if more is not None:
            self._logger.warning(f"refused: {reason}{more}")

    def no_number(self, twist: Sequence[float]) -> None:
        """Counts and logs a decision that is not finite, which must never happen."""
        kind = "not finite, sent as zero"
        self.counters[kind] += 1
        self._lines.count(kind)
        more = self._lines.due(kind, self._now)
        if more is not None:
            self._logger.error(
                f"decided on {list(twist)}, which is not finite: zero is sent, and the e-stop is "
                f"pressed{more}"
            )

    def _changed(self, rule: str) -> None:
        """Handles a change of the rule that stops the robot."""
        was_passing = self._rule == ""
        self._rule, self._since, self._owed = rule, self._now, True
        self._lines.count(rule)
        if not rule:
            return
        self.counters[f"stopped, {rule}"] += 1
        if not was_passing:
            return
        if rule in self._burst:
            self.counters["stops of a burst, not in the black box"] += 1
            return
        self._burst.add(rule)
        self._write(rule)

    def _tell(self, rule: str) -> None:
        """Logs the present state; later, if it was logged a moment ago."""
        more = self._lines.due(rule, self._now)
        self._owed = more is None
        if more is None:
            return
        if self._cause is None:
            self._logger.info(f"commands pass{more}")
        else:
            self._logger.warning(f"stopped by {self._cause.line}{more}")

    def _write(self, rule: str) -> None:
        name = f"{time.strftime('%Y%m%d_%H%M%S')}_{self.counters.total():06d}_{rule}.jsonl"
        self._names = [*self._names[1 - FILES_KEPT :], name]

        def work() -> None:
            write(self._box.config, self._box.copy(), self._folder / name)
            prune(self._folder, self._names)

        try:
            begun = self._writer.begin(work)
        except OSError as error:
            self._failed(str(error))
            return
        if not begun:
            self._failed("the files before it are still being written")

    def _failed(self, reason: str) -> None:
        self.counters["not written"] += 1
        self._logger.error(f"the black box could not be written: {reason}")

    def finding(self, state: GateState) -> Condition:
        """Returns the finding for `/diagnostics`."""
        for failure in self._writer.failures():
            self._failed(failure)
        facts = {
            "armed": state.armed,
            "latched": state.latched is not None,
            **dict(sorted(self.counters.items())),
        }
        message = self._cause.line if self._cause else "commands pass"
        return Condition(message, self._cause is not None, facts, self._hardware)

    def close(self) -> None:
        """Waits briefly for files that are being written; none is left incomplete."""
        for failure in self._writer.close(CLOSING_S):
            self._failed(failure)


def prune(folder: Path, own: Sequence[str]) -> None:
    """Removes the files of stops beyond `FILES_KEPT`, oldest first.

    Args:
        folder: of the black box.
        own: names of this gate's files, oldest first. They count as the newest: the names of the
            others may come from a clock that has been set back since.
    """
    place = {name: i for i, name in enumerate(own, 1)}
    files = sorted(folder.glob("*.jsonl"), key=lambda file: (place.get(file.name, 0), file.name))
    for old in files[:-FILES_KEPT]:
        old.unlink(missing_ok=True)
