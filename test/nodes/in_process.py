"""A node in a thread of the test's own process, with the interface of `NodeProcess`."""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Sequence
from contextlib import AbstractContextManager
from importlib import import_module
from pathlib import Path
from typing import Any

from rclpy.impl import rcutils_logger

from nics_drl_bridge.config import dump_yaml
from nics_drl_bridge.nodes import runner

ENDS_S = 30.0
MODULES = {"mujoco_node": "nics_drl_bridge.extras.mujoco.node"}
RUNNING: dict[int, NodeThread] = {}
"""By the thread of each."""


class NodeThread(AbstractContextManager["NodeThread", None]):
    """Runs what the executable runs; a signal is a call of its handler."""

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
        self.arguments = [node, "--ros-args", "--params-file", str(file)]
        if namespace:
            self.arguments += ["-r", f"__ns:=/{namespace.strip('/')}"]
        for old, new in (remap or {}).items():
            self.arguments += ["-r", f"{old}:={new}"]
        self.arguments += words
        self.node = node
        self.domain_id = domain_id
        self.lines = []
        self.handler = None
        self.returncode = None
        self.log = self._process = self  # what tests ask of a process and of its log
        self._thread = threading.Thread(target=self._run, daemon=True, name=node)
        self._thread.start()

    def _run(self) -> None:
        RUNNING[threading.get_ident()] = self
        try:
            module = MODULES.get(self.node, f"nics_drl_bridge.nodes.{self.node}")
            import_module(module).main(self.arguments)
            self.returncode = 0
        except SystemExit as error:
            self.returncode = int(error.code or 0)
        except BaseException as error:
            self.lines.append(f"Traceback: {type(error).__name__}: {error}")
            self.returncode = 1
            raise
        finally:
            RUNNING.pop(threading.get_ident())

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
        try:
            if self.handler is not None:
                self.handler(number, None)
        except SystemExit:  # for a node that has not started yet
            pass

    def check(self) -> None:
        assert self._thread.is_alive(), (
            f"{self.node} ended with {self.returncode}: {self.lines}"
        )

    def close(self) -> int | None:
        while self.handler is None and self._thread.is_alive():
            self._thread.join(0.01)
        self.send_signal(signal.SIGINT)
        return self.wait()

    def __exit__(self, *_: object) -> None:
        self.close()


class _Proxy:
    """A module, some of whose attributes depend on the thread."""

    def __init__(self, module: Any, **own: Any) -> None:
        self._module = module
        self._own = own

    def __getattr__(self, name: str) -> Any:
        return self._own[name]() if name in self._own else getattr(self._module, name)


class _Lines:
    """Standard error of a node."""

    def __init__(self, node: NodeThread) -> None:
        self.node = node

    def write(self, text: str) -> None:
        self.node.lines += text.splitlines()


def _stderr() -> Any:
    node = RUNNING.get(threading.get_ident())
    return sys.stderr if node is None else _Lines(node)


def _set_handler() -> Any:
    node = RUNNING.get(threading.get_ident())
    return (
        signal.signal
        if node is None
        else lambda _, handler: setattr(node, "handler", handler)
    )


def _log() -> Any:
    node = RUNNING.get(threading.get_ident())
    log = LIBRARY.rclpy_logging_rcutils_log
    if node is None:
        return log

    def kept(severity: Any, name: str, message: str, *place: Any) -> Any:
        node.lines.append(message)
        return log(severity, name, message, *place)

    return kept


def _open_context(args: Any = None, domain_id: int | None = None) -> Any:
    node = RUNNING.get(threading.get_ident())
    return OPEN_CONTEXT(args, domain_id if node is None else node.domain_id)


LIBRARY = rcutils_logger._rclpy
OPEN_CONTEXT = runner.open_context
rcutils_logger._rclpy = _Proxy(LIBRARY, rclpy_logging_rcutils_log=_log)
runner.open_context = _open_context
runner.signal = _Proxy(signal, signal=_set_handler)
for each in ("runner", "record_node"):
    import_module(f"nics_drl_bridge.nodes.{each}").sys = _Proxy(sys, stderr=_stderr)
