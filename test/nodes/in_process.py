"""A node in a thread of the test's own process, with the interface of `NodeProcess`."""

from __future__ import annotations

import math
import signal
import sys
import threading
import time
from collections import defaultdict
from collections.abc import Sequence
from contextlib import AbstractContextManager
from functools import partialmethod
from importlib import import_module
from pathlib import Path
from typing import Any

from nics_drl_bridge.config import dump_yaml
from nics_drl_bridge.nodes import runner
from nics_drl_bridge.nodes.listener import open_context, spin
from nics_drl_bridge.nodes.qos import BridgeNode
from nics_drl_bridge.nodes.record_node import RecordNode

ENDS_S = 30.0
MODULES = {
    "dart_node": "nics_drl_bridge.extras.dart.node",
    "mujoco_node": "nics_drl_bridge.extras.mujoco.node",
}
LINES: defaultdict[str, list[str]] = defaultdict(list)
"""What has been logged in each thread, by its name."""


class KeptLogger:
    """A node's logger that keeps its lines; equal lines are throttled, wherever they come from."""

    def __init__(self) -> None:
        self._logged_s: dict[str, float] = {}

    def _keep(
        self,
        level: str,
        line: str,
        once: bool = False,
        throttle_duration_sec: float = 0.0,
    ) -> None:
        now = time.monotonic()
        least_s = math.inf if once else throttle_duration_sec
        if now - self._logged_s.get(line, -math.inf) < least_s:
            return
        self._logged_s[line] = now
        LINES[threading.current_thread().name].append(line)
        print(f"[{level}] {line}", file=sys.stderr)

    info = partialmethod(_keep, "INFO")
    warning = partialmethod(_keep, "WARN")
    error = partialmethod(_keep, "ERROR")

    def debug(self, *_: Any, **__: Any) -> None:
        """Say nothing, as by default."""

    def get_child(self, _: str) -> KeptLogger:
        return self


def get_kept_logger(node: BridgeNode) -> KeptLogger:
    logger: KeptLogger = vars(node).setdefault("kept_logger", KeptLogger())
    return logger


BridgeNode.get_logger = get_kept_logger


class NodeThread(AbstractContextManager["NodeThread", None]):
    """Runs the node of an executable; a signal sets what its handler would set."""

    def __init__(
        self,
        node: str,
        folder: Path,
        parameters: dict[str, Any],
        domain_id: int,
        namespace: str = "",
        remap: dict[str, str] | None = None,
        words: Sequence[str] = (),
    ) -> None:
        file = folder / f"{node}.yaml"
        file.write_text(
            dump_yaml({"/**": {"ros__parameters": parameters}}), encoding="utf-8"
        )
        arguments = [node, "--ros-args", "--params-file", str(file)]
        rules = {"__ns": f"/{namespace.strip('/')}"} if namespace else {}
        for old, new in (rules | (remap or {})).items():
            arguments += ["-r", f"{old}:={new}"]
        self.node = node
        self.lines = LINES[str(folder)]
        self.returncode: int | None = None
        self.stopping = threading.Event()
        self.log = self._process = self  # what tests ask of a process and of its log
        given = [*arguments, *words], domain_id
        self._thread = threading.Thread(
            target=self._run, args=given, daemon=True, name=str(folder)
        )
        self._thread.start()

    def _run(self, arguments: list[str], domain_id: int) -> None:
        try:
            make = node_class(self.node)
            context = open_context(arguments, domain_id)
            with runner.open_node(make, context, self.node) as made:
                spin(made, self.stopping)
            outcome = getattr(made, "outcome", None)  # of record_node
            self.returncode = 0
            if outcome is not None:
                self.lines.append(f"record_node: {outcome.line}")
                self.returncode = 2 if outcome.failure is not None else 0
        except runner.INPUT_ERRORS as error:
            self.lines.append(runner.explain(error))
            self.returncode = 2
        except BaseException as error:
            self.lines.append(f"Traceback: {type(error).__name__}: {error}")
            self.returncode = 1
            raise

    def read_text(self, **_: Any) -> str:
        """Return what it has logged, and written to standard error."""
        return "".join(f"{line}\n" for line in self.lines)

    def poll(self) -> int | None:
        return None if self._thread.is_alive() else self.returncode

    def wait(self, seconds: float = ENDS_S) -> int | None:
        self._thread.join(seconds)
        told = f"{self.node} did not end within {seconds} s: {self.lines}"
        assert not self._thread.is_alive(), told
        return self.returncode

    def send_signal(self, number: int) -> None:
        assert number in (signal.SIGINT, signal.SIGTERM), "needs a process of its own"
        self.stopping.set()

    def check(self) -> None:
        told = f"{self.node} ended with {self.returncode}: {self.lines}"
        assert self._thread.is_alive(), told

    def close(self) -> int | None:
        self.stopping.set()
        return self.wait()

    def __exit__(self, *_: object) -> None:
        self.close()


def node_class(node: str) -> Any:
    """Return what makes the node of an executable, by rclpy's keyword arguments."""
    if node == "record_node":
        return RecordNode
    module = import_module(MODULES.get(node, f"nics_drl_bridge.nodes.{node}"))
    return module.main.args[0]
