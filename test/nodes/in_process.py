"""A node in a thread of the test's own process, with the interface of `NodeProcess`."""

from __future__ import annotations

import signal
import sys
import threading
import time
from collections.abc import Sequence
from contextlib import AbstractContextManager
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

from rclpy.impl.rcutils_logger import RcutilsLogger

from nics_drl_bridge.config import dump_yaml
from nics_drl_bridge.nodes import runner
from nics_drl_bridge.nodes.listener import open_context
from nics_drl_bridge.nodes.record_node import RecordNode

ENDS_S = 30.0
MODULES = {
    "dart_node": "nics_drl_bridge.extras.dart.node",
    "mujoco_node": "nics_drl_bridge.extras.mujoco.node",
}


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
        if namespace:
            arguments += ["-r", f"__ns:=/{namespace.strip('/')}"]
        for old, new in (remap or {}).items():
            arguments += ["-r", f"{old}:={new}"]
        self.node = node
        self.lines: list[str] = []
        self.returncode: int | None = None
        self.stopping = threading.Event()
        self.log = self._process = self  # what tests ask of a process and of its log
        self._thread = threading.Thread(
            target=self._run,
            args=([*arguments, *words], domain_id),
            daemon=True,
            name=node,
        )
        self._thread.start()

    def _run(self, arguments: list[str], domain_id: int) -> None:
        try:
            made = runner.run_until_end(
                partial(make_logged, self.node, self.lines),
                open_context(arguments, domain_id),
                self.stopping,
                self.node,
            )
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
        """What it has logged, and written to standard error."""
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
        assert self._thread.is_alive(), (
            f"{self.node} ended with {self.returncode}: {self.lines}"
        )

    def close(self) -> int | None:
        self.stopping.set()
        return self.wait()

    def __exit__(self, *_: object) -> None:
        self.close()


def node_class(node: str) -> Any:
    """What makes the node of an executable, by rclpy's keyword arguments."""
    if node == "record_node":
        return RecordNode
    module = import_module(MODULES.get(node, f"nics_drl_bridge.nodes.{node}"))
    return module.main.args[0]


def make_logged(node: str, lines: list[str], **options: Any) -> Any:
    """A node that also keeps what it logs."""
    made = node_class(node)
    kind, *arguments = (made.func, *made.args) if isinstance(made, partial) else (made,)

    said: dict[tuple[str, int], float] = {}

    class Logged(kind):
        def get_logger(self) -> Keeper:
            return Keeper(super().get_logger().name, lines, said)

    return Logged(*arguments, **options)


class Keeper(RcutilsLogger):
    """A logger that also keeps its lines.

    rclpy throttles, and checks the severity, by the caller of `log`, which is always this class. So
    this class throttles itself, and leaves each line to a new logger.
    """

    def __init__(
        self, name: str, lines: list[str], said: dict[tuple[str, int], float]
    ) -> None:
        super().__init__(name)
        self._lines = lines
        self._said = said

    def log(
        self,
        message: str,
        severity: Any,
        throttle_duration_sec: float = 0.0,
        **options: Any,
    ) -> bool:
        caller = sys._getframe(2)
        place = (caller.f_code.co_filename, caller.f_lineno)
        if time.monotonic() < self._said.get(place, -1e9) + throttle_duration_sec:
            return False
        self._said[place] = time.monotonic()
        self._lines.append(str(message))
        return RcutilsLogger(self.name).log(message, severity, **options)
