"""What `command_gate` tells about itself: lines, counters, and the black box."""

from __future__ import annotations

import time
from collections import Counter
from concurrent.futures import Future, ThreadPoolExecutor

from rclpy.impl.rcutils_logger import RcutilsLogger

from nics_drl_bridge.nodes.diagnostics import Finding
from nics_drl_bridge.nodes.gate_parameters import GateParameters
from nics_drl_bridge.safety.black_box import BlackBox, Entry, write
from nics_drl_bridge.safety.state import Cause, GateState

FILES_KEPT = 20


class GateLog:
    """One line and one file for each stop, and counters of everything.

    Args:
        parameters: of the gate.
        logger: takes the lines.
    """

    def __init__(self, parameters: GateParameters, logger: RcutilsLogger) -> None:
        self.counters: Counter[str] = Counter()
        self._box, self._logger = BlackBox(parameters.config), logger
        self._folder, self._hardware = parameters.black_box, parameters.robot
        self._cause: Cause | None = None
        self._passing = False
        # Beside the gate: a disk may take its time.
        self._writer = ThreadPoolExecutor(1, "black_box")
        self._writer.submit(lambda: None)  # its thread is there before the first stop

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

    def finding(self, state: GateState) -> Finding:
        """For `/diagnostics`."""
        facts = {
            "armed": state.armed,
            "latched": state.latched is not None,
            **dict(sorted(self.counters.items())),
        }
        message = self._cause.line if self._cause else "commands pass"
        return Finding(message, self._cause is not None, facts, self._hardware)

    def close(self) -> None:
        """Waits for the files that are being written."""
        self._writer.shutdown(wait=True)
