"""What `command_gate` tells about itself: lines, counters, and the black box."""

from __future__ import annotations

import time
from collections import Counter
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

from diagnostic_msgs.msg import DiagnosticStatus, KeyValue
from rclpy.impl.rcutils_logger import RcutilsLogger

from nics_drl_bridge.safety.black_box import BlackBox, Entry, write
from nics_drl_bridge.safety.state import Cause, GateConfig, GateState

FILES_KEPT = 20


class GateLog:
    """One line and one file for each stop, and counters of everything.

    Args:
        config: of the gate.
        folder: of the files.
        logger: takes the lines.
    """

    def __init__(self, config: GateConfig, folder: Path, logger: RcutilsLogger) -> None:
        self.counters: Counter[str] = Counter()
        self._box, self._folder, self._logger = BlackBox(config), folder, logger
        self._cause: Cause | None = None
        self._passing = False
        # Beside the gate: a disk may take its time.
        self._writer = ThreadPoolExecutor(1, "black_box")

    def note(self, entry: Entry) -> None:
        """Takes a decision into account."""
        self._box.note(entry)
        decision, cause = entry.decision, entry.decision.cause
        if decision.refused:
            self.counters[f"refused, {decision.refused.partition(':')[0]}"] += 1
            self._logger.warning(f"refused: {decision.refused}", throttle_duration_sec=1.0)
        if decision.shielded:
            self.counters["cut by the shield"] += 1
        if (cause and cause.rule) != (self._cause and self._cause.rule):
            self._changed(cause)
        self._cause, self._passing = cause, cause is None

    def _changed(self, cause: Cause | None) -> None:
        if cause is None:
            self._logger.info("commands pass")
            return
        self.counters[f"stopped, {cause.rule}"] += 1
        self._logger.warning(f"stopped by {cause.line}")
        if self._passing:
            self._writer.submit(self._write, cause.rule).add_done_callback(self._written)

    def _write(self, rule: str) -> None:
        name = f"{time.strftime('%Y%m%d_%H%M%S')}_{self.counters.total():06d}_{rule}.jsonl"
        write(self._box.config, self._box.copy(), self._folder / name)
        for old in sorted(self._folder.glob("*.jsonl"))[:-FILES_KEPT]:
            old.unlink(missing_ok=True)

    def _written(self, done: Future[None]) -> None:
        error = done.exception()
        if error is not None:
            self._logger.error(f"the black box could not be written: {error}")

    def status(self, name: str, state: GateState) -> DiagnosticStatus:
        """For `/diagnostics`."""
        status = DiagnosticStatus(name=f"{name}: gate")
        status.level = DiagnosticStatus.WARN if self._cause else DiagnosticStatus.OK
        status.message = self._cause.line if self._cause else "commands pass"
        facts: dict[str, object] = {
            "armed": state.armed,
            "latched": state.latched is not None,
            **dict(sorted(self.counters.items())),
        }
        status.values = [KeyValue(key=key, value=str(value)) for key, value in facts.items()]
        return status

    def close(self) -> None:
        """Waits for the files that are being written."""
        self._writer.shutdown(wait=True)
