"""Processes of nodes with a reliable end, and domains for them; needs no ROS 2 itself."""

import ctypes
import os
import random
import signal
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

from nics_drl_bridge.config import PACKAGE, dump_yaml
from nics_drl_bridge.errors import BackendError, ConfigError
from nics_drl_bridge.nodes.starting import NodeStart, find_prefix
from nics_drl_bridge.nodes.transport import GREATEST_DOMAIN_ID, find_used_domains

PR_SET_PDEATHSIG = 1
PATIENCE_S = 5.0  # time limit for a process to end [s]
LAST_DOMAIN_ID = 101  # above it DDS ports may collide with Linux's ephemeral ports
LOG_LINES = 5


def choose_domain_id() -> int:
    """Return the environment's domain id, or a random unused one. ConfigError if it is invalid."""
    variable = os.environ.get("ROS_DOMAIN_ID")
    if not variable:
        return unused_domain_id()
    if not variable.isdecimal() or int(variable) > GREATEST_DOMAIN_ID:
        raise ConfigError(
            f"the environment variable ROS_DOMAIN_ID is {variable!r}; it must be a number from "
            f"0 to {GREATEST_DOMAIN_ID}, or unset."
        )
    return int(variable)


def unused_domain_id() -> int:
    """Return a random domain id that nobody on this machine uses, unless all are used."""
    allowed = range(1, LAST_DOMAIN_ID + 1)
    own = {
        int(word) for word in [os.environ.get("ROS_DOMAIN_ID", "0")] if word.isdecimal()
    }
    unused = set(allowed) - find_used_domains() - own
    return random.SystemRandom().choice(sorted(unused) or allowed)


def make_module_command(module: str) -> list[str]:
    """Return the command that runs a module; its arguments may follow.

    `python -m` looks for modules in the working folder first. That folder may hold arbitrary data,
    such as a model with a file `json.py`. PYTHONSAFEPATH prevents this only since Python 3.11.
    """
    return [
        sys.executable,
        "-c",
        f"import sys; sys.path[:] = {sys.path!r}; from runpy import run_module; "
        f"run_module({module!r}, run_name='__main__')",
    ]


def prepare_child() -> Callable[[], None]:
    """Return what a child runs first: SIGINT ends it, and on Linux the end of its parent thread.

    Shells make background jobs ignore SIGINT, as in `make test &`, and children inherit this.
    """
    prctl = ctypes.CDLL(None).prctl if sys.platform == "linux" else None
    parent = os.getpid()

    def prepare() -> None:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
        if prctl is not None:
            prctl(PR_SET_PDEATHSIG, signal.SIGTERM)
            if os.getppid() != parent:  # the parent died in between
                os._exit(1)

    return prepare


def make_command(node: NodeStart, folder: Path) -> list[str]:
    """Return the command line of a node, and write its parameters to a file in a folder."""
    full_name = f"/{node.namespace}/{node.executable}".replace("//", "/")
    # Values for this very node take precedence over those for all nodes in the user's file.
    nodes = full_name if node.params_file else "/**"
    file = folder / f"{full_name.strip('/').replace('/', '.')}.yaml"
    parameters = {nodes: {"ros__parameters": dict(node.parameters)}}
    file.write_text(dump_yaml(parameters, quote_text=True), encoding="utf-8")
    words = [*find_program(node), *node.arguments, "--ros-args"]
    if node.log_level:
        words += ["--log-level", node.log_level]
    rules = list(node.remappings)
    if node.namespace:
        rules.insert(0, ("__ns", f"/{node.namespace.strip('/')}"))
    if not node.own:
        rules.insert(0, ("__node", node.executable))
    for old, new in rules:
        words += ["-r", f"{old}:={new}"]
    if node.params_file:
        words += ["--params-file", node.params_file]
    if node.parameters:
        words += ["--params-file", str(file)]
    return words


def find_program(node: NodeStart) -> list[str]:
    """Return the words that start a node's program. Raises ConfigError if it is missing."""
    if node.own:
        return [*make_module_command(f"{PACKAGE}.nodes.start"), node.executable]
    prefix = find_prefix(node.package)
    if prefix is None:
        raise ConfigError(
            f"the ROS 2 package {node.package!r} is not installed here; install it with your "
            "ROS 2 distribution, or start without it."
        )
    return [str(prefix / "lib" / node.package / node.executable)]


ChildT = TypeVar("ChildT", bound="ChildProcess")


class ChildProcess:
    """A process that ends with `close`, and on Linux with its parent thread."""

    def __init__(
        self,
        name: str,
        command: Sequence[str],
        log: Path | None = None,
        **environment: str,
    ) -> None:
        """Start the process; its output goes to a file, or to the output of this process."""
        self.name = name
        # Import no modules from the working folder, which may be a model.
        environment["PYTHONSAFEPATH"] = "1"
        output = None if log is None else log.open("wb")
        try:
            # In its own session: Ctrl-C in the terminal reaches only the parent, which then
            # ends this process.
            self._process = subprocess.Popen(
                command,
                env={**os.environ, **environment},
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=output,
                start_new_session=True,
                preexec_fn=prepare_child(),
            )
        finally:
            if output is not None:
                output.close()
        self.pid = self._process.pid

    def poll(self) -> int | None:
        """Return the exit code, or None while the process runs."""
        return self._process.poll()

    def interrupt(self) -> None:
        """Ask the process to end, like Ctrl-C."""
        if self.poll() is None:
            self._process.send_signal(signal.SIGINT)

    def close(self) -> int:
        """End the process by SIGINT, or SIGKILL if it does not react; return its exit code."""
        self.interrupt()
        try:
            return self._process.wait(PATIENCE_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
        return self._process.wait()

    def __enter__(self: ChildT) -> ChildT:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class NodeProcess(ChildProcess):
    """One of the package's nodes in its own process, with its output in a file."""

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
        folder.mkdir(parents=True, exist_ok=True)
        self.node = node
        self.log = folder / f"{node}.log"
        rules = list((remap or {}).items())
        start = NodeStart(
            PACKAGE, node, namespace.strip("/"), parameters, remappings=rules
        )
        super().__init__(
            node,
            make_command(start, folder),
            self.log,
            ROS_DOMAIN_ID=str(domain_id),
            ROS_AUTOMATIC_DISCOVERY_RANGE=discovery,
        )

    def check(self) -> None:
        """Raise BackendError with the end of its log if the node has ended by itself."""
        code = self.poll()
        if code is not None:
            text = self.log.read_text(encoding="utf-8", errors="replace")
            lines = text.strip().splitlines()
            shown = [line for line in lines if not line.startswith("[INFO]")] or lines
            last = " | ".join(shown[-LOG_LINES:]) or "no output"
            raise BackendError(
                f"{self.node} ended with code {code}: {last} (its log is {self.log})."
            )
