"""Entry points of the nodes; without ROS 2 they print one sentence, not a traceback."""

import faulthandler
import os
import signal
import sys
import time
import traceback
from functools import partial
from typing import Any

from nics_drl_bridge.exit_codes import EXIT_BAD_INPUT


def start(node: str, args: list[str] | None = None) -> None:
    """Run a node by its name and end the process; bad input gives one sentence and exit code 2."""
    from nics_drl_bridge.nodes import ending, output, transport, usage

    for number in ending.ending_signals():  # importing the node takes seconds
        signal.signal(number, signal.SIG_DFL)
    words = sys.argv[1:] if args is None else args[1:]
    if any(word in usage.HELP for word in words):
        sys.stdout.write(usage.help_of(node))
        ending.leave(0)
    sentence = usage.wrong_with(node, words)
    if sentence:
        sys.stderr.write(f"{sentence}\n")
        ending.leave(EXIT_BAD_INPUT)
    output.forward_output(output.log_file(node, words))
    faulthandler.enable()  # shows where Python was when a library crashes
    # In the format of the ROS 2 log, which is available only seconds later.
    sys.stderr.write(f"[INFO] [{time.time():.9f}] [{node}]: starting\n")
    sys.stderr.flush()
    code: Any = 0
    try:
        transport.set_transport(os.environ)
        ending.own_process()
        main = _main_of(node)
        main(args)
    except SystemExit as end:
        code = end.code
    except BaseException:  # noqa: BLE001  (it is printed, and the process ends)
        traceback.print_exc()
        code = 1
    if code is None:
        code = 0
    ending.leave(code if isinstance(code, int) else 1)


def _main_of(node: str) -> Any:
    from importlib import import_module
    from importlib.util import find_spec

    from nics_drl_bridge import extensions
    from nics_drl_bridge.errors import ConfigError

    name = f"nics_drl_bridge.nodes.{node}"
    try:
        if find_spec(name):
            main = import_module(name).main
        else:
            main = extensions.load("nodes", node)
        from rclpy.logging import get_logger

        from nics_drl_bridge.kernels import COMPILING
    except (ConfigError, ImportError) as error:
        sentence = str(error)
        if isinstance(error, ImportError):
            clause = extensions.explain_unmet(error)
            if clause is None:
                raise
            sentence = f"{node}: {clause}"
        sys.stderr.write(f"{sentence}\n")
        raise SystemExit(EXIT_BAD_INPUT) from None
    COMPILING.patience_s = 0.0
    COMPILING.tell = get_logger(node).info
    return main


simulator_node = partial(start, "simulator_node")
mujoco_node = partial(start, "mujoco_node")
middleware_node = partial(start, "middleware_node")
policy_node = partial(start, "policy_node")
command_gate = partial(start, "command_gate")
record_node = partial(start, "record_node")


if __name__ == "__main__":
    start(sys.argv[1], sys.argv[1:])
