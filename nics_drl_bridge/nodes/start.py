"""Entry points of the nodes: one sentence, not a traceback, where ROS 2 is missing.

Nodes of this folder, and those that extensions register in the group `nodes`, are started alike.
"""

from __future__ import annotations

import signal
import sys
from collections.abc import Callable
from functools import partial
from importlib import import_module
from importlib.util import find_spec
from typing import Any

from nics_drl_bridge import extensions
from nics_drl_bridge.errors import ConfigError

EXIT_BAD_INPUT = 2


def start(node: str, args: list[str] | None = None) -> None:
    """Runs a node by its name until it ends; a missing library is one sentence and exit code 2."""
    for number in (signal.SIGINT, signal.SIGTERM):  # to import takes seconds
        signal.signal(number, lambda *_: sys.exit(0))
    try:
        main = _main_of(node)
    except ConfigError as error:
        sys.stderr.write(f"{error}\n")
        raise SystemExit(EXIT_BAD_INPUT) from None
    main(args)


def _main_of(node: str) -> Callable[[list[str] | None], Any]:
    name = f"nics_drl_bridge.nodes.{node}"
    if find_spec(name) is None:
        return extensions.load("nodes", node)  # type: ignore[no-any-return]
    try:
        return import_module(name).main  # type: ignore[no-any-return]
    except ModuleNotFoundError as error:
        if (error.name or "").startswith("nics_drl_bridge"):
            raise
        raise ConfigError(f"{node}: {extensions.missing(error.name or '')}") from None


simulator_node = partial(start, "simulator_node")
mujoco_node = partial(start, "mujoco_node")
middleware_node = partial(start, "middleware_node")
policy_node = partial(start, "policy_node")
command_gate = partial(start, "command_gate")
record_node = partial(start, "record_node")


if __name__ == "__main__":
    start(sys.argv[1], sys.argv[1:])
