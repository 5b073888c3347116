"""Entry points of the nodes: one sentence, not a traceback, where ROS 2 is missing."""

import signal
import sys
from functools import partial
from importlib import import_module
from importlib.util import find_spec

from nics_drl_bridge import extensions
from nics_drl_bridge.errors import ConfigError

EXIT_BAD_INPUT = 2


def start(node: str, args: list[str] | None = None) -> None:
    """Runs a node by its name until it ends; a missing library is one sentence and exit code 2."""
    for number in (signal.SIGINT, signal.SIGTERM):  # to import takes seconds
        signal.signal(number, lambda *_: sys.exit(0))
    name = f"nics_drl_bridge.nodes.{node}"
    try:
        main = import_module(name).main if find_spec(name) else extensions.load("nodes", node)
    except (ConfigError, ImportError) as error:
        sentence = str(error)
        if isinstance(error, ImportError):
            if (clause := extensions.unmet(error)) is None:
                raise
            sentence = f"{node}: {clause}"
        sys.stderr.write(f"{sentence}\n")
        raise SystemExit(EXIT_BAD_INPUT) from None
    main(args)


simulator_node = partial(start, "simulator_node")
mujoco_node = partial(start, "mujoco_node")
middleware_node = partial(start, "middleware_node")
policy_node = partial(start, "policy_node")
command_gate = partial(start, "command_gate")
record_node = partial(start, "record_node")


if __name__ == "__main__":
    start(sys.argv[1], sys.argv[1:])
