"""Operating-system processes for the package's nodes, with a reliable end."""

from __future__ import annotations

import ctypes
import os
import random
import signal
import subprocess
import sys
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

from nics_drl_bridge.config import dump_yaml
from nics_drl_bridge.errors import BackendError, ConfigError
from nics_drl_bridge.nodes.transport import domains_in_use

LAST_DOMAIN_ID, GREATEST_DOMAIN_ID = 101, 232
"""Above the first, DDS ports may collide with Linux's ephemeral ports; above the other there
are none."""
PR_SET_PDEATHSIG = 1
PATIENCE_S = 5.0
LOG_LINES = 5


def free_domain_id() -> int:
    """Returns the domain id of the environment, or a random one, so that runs keep apart.

    A random one is drawn from those that are not in use on this machine.

    Raises:
        ConfigError: the environment's value is not a domain id.
    """
    given = os.environ.get("ROS_DOMAIN_ID")
    if not given:
        all_of_them = range(1, LAST_DOMAIN_ID + 1)
        unused = sorted(set(all_of_them) - domains_in_use())
        return random.SystemRandom().choice(unused or all_of_them)
    if not given.isdecimal() or int(given) > GREATEST_DOMAIN_ID:
        raise ConfigError(
            f"the environment variable ROS_DOMAIN_ID is {given!r}; it must be a number from 0 to "
            f"{GREATEST_DOMAIN_ID}, or unset."
        )
    return int(given)


def _dies_with_parent() -> Callable[[], None] | None:
    """Returns what a child does first, on Linux: request SIGTERM for any death of its parent.

    The library is loaded before the fork, because little is safe after it.
    """
    if sys.platform != "linux":
        return None
    prctl, parent = ctypes.CDLL(None).prctl, os.getpid()

    def ask() -> None:
        prctl(PR_SET_PDEATHSIG, signal.SIGTERM)
        if os.getppid() != parent:  # it died in between
            os._exit(1)

    return ask


class NodeProcess(AbstractContextManager["NodeProcess", None]):
    """One node in its own process; a context manager that ends it.

    On Linux the node also ends when the thread that started it does.

    Args:
        node: name of its executable.
        folder: for its log and its parameter file.
        parameters: of the node.
        domain_id: DDS domain.
        namespace: of the node.
        remap: names, from -> to.
        discovery: range of its discovery: LOCALHOST or SUBNET.
    """

    def __init__(
        self,
        node: str,
        folder: Path,
        parameters: Mapping[str, Any],
        domain_id: int,
        namespace: str = "",
        remap: Mapping[str, str] | None = None,
        discovery: str = "LOCALHOST",
    ) -> None:
        self.node = node
        folder.mkdir(parents=True, exist_ok=True)
        self.log = folder / f"{node}.log"
        file = folder / f"{node}.yaml"
        file.write_text(dump_yaml({"/**": {"ros__parameters": dict(parameters)}}), encoding="utf-8")
        command = [sys.executable, "-m", "nics_drl_bridge.nodes.start", node, "--ros-args"]
        command += ["--params-file", str(file)]
        if namespace:
            command += ["-r", f"__ns:=/{namespace.strip('/')}"]
        for old, new in (remap or {}).items():
            command += ["-r", f"{old}:={new}"]
        environment = os.environ | {
            "ROS_DOMAIN_ID": str(domain_id),
            "ROS_AUTOMATIC_DISCOVERY_RANGE": discovery,
        }
        with self.log.open("wb") as log:
            # Its own session: Ctrl-C in the terminal reaches the parent alone, which then ends its
            # children in order.
            self._process = subprocess.Popen(
                command,
                env=environment,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                start_new_session=True,
                preexec_fn=_dies_with_parent(),
            )

    @property
    def pid(self) -> int:
        """Process id."""
        return self._process.pid

    def check(self) -> None:
        """Raises BackendError with the end of its log if the node has ended by itself."""
        code = self._process.poll()
        if code is not None:
            lines = self.log.read_text(encoding="utf-8", errors="replace").strip().splitlines()
            raise BackendError(
                f"{self.node} ended with code {code}: "
                f"{' | '.join(lines[-LOG_LINES:]) or 'no output'} (its log is {self.log})."
            )

    def close(self) -> int:
        """Ends the node: SIGINT, then SIGKILL if it does not react. Returns its exit code."""
        if self._process.poll() is None:
            self._process.send_signal(signal.SIGINT)
            try:
                self._process.wait(PATIENCE_S)
            except subprocess.TimeoutExpired:
                self._process.kill()
        return self._process.wait()

    def __exit__(self, *_: object) -> None:
        self.close()
