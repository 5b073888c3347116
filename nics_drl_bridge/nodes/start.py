"""Entry points of the nodes: one sentence instead of a traceback if ROS 2 is missing."""

from __future__ import annotations

import signal
import sys
from importlib import import_module

from nics_drl_bridge.errors import MISSING_ROS

EXIT_BAD_INPUT = 2


def _start(node: str) -> None:
    for number in (signal.SIGINT, signal.SIGTERM):  # importing takes seconds
        signal.signal(number, lambda *_: sys.exit(0))
    try:
        module = import_module(f"nics_drl_bridge.nodes.{node}")
    except ModuleNotFoundError as error:
        if (error.name or "").startswith("nics_drl_bridge"):
            raise
        sys.stderr.write(f"{node}: {MISSING_ROS.format(module=error.name)}\n")
        raise SystemExit(EXIT_BAD_INPUT) from None
    module.main()


def simulator_node() -> None:
    """Runs `simulator_node`."""
    _start("simulator_node")


def mujoco_node() -> None:
    """Runs `mujoco_node`."""
    _start("mujoco_node")


def middleware_node() -> None:
    """Runs `middleware_node`."""
    _start("middleware_node")


def policy_node() -> None:
    """Runs `policy_node`."""
    _start("policy_node")


def command_gate() -> None:
    """Runs `command_gate`."""
    _start("command_gate")


def record_node() -> None:
    """Runs `record_node`."""
    _start("record_node")
