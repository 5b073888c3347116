"""Entry points of the nodes, and their help; without ROS 2 they print one sentence."""

import faulthandler
import gc
import os
import signal
import sys
import textwrap
import time
import traceback
from functools import partial
from typing import Any

from nics_drl_bridge.exit_codes import EXIT_BAD_INPUT
from nics_drl_bridge.nodes import own_process, transport

HELP = ("-h", "--help")
ROS = "--ros-args"
WIDTH = 100


def format_help(node: str) -> str:
    """Return the help of a node by the name of its executable."""
    # It needs pydantic, whose absence `_load_main` explains.
    from nics_drl_bridge.nodes.parameters import describe_node, list_nodes

    if node not in list_nodes():
        return f"usage: {node} [{ROS} -p NAME:=VALUE -r FROM:=TO ...]\n"
    facts = describe_node(node)
    hang = partial(textwrap.fill, width=WIDTH, subsequent_indent=" " * 8)
    topics = [
        hang(f"{title}: {', '.join(names)}")
        for title, names in (
            ("subscribes to", facts.subscribes),
            ("publishes", facts.publishes),
            ("services", facts.services),
        )
        if names
    ]
    parts = [
        f"usage: {node} [{ROS} -p NAME:=VALUE -r FROM:=TO --params-file FILE ...]",
        facts.about,
        "\n".join(topics),
        "parameters, with their defaults:",
        "\n".join(
            hang(
                f"    {row.name} = {row.shown or format_value(row.default)}: {row.about}"
            )
            for row in facts.parameters
        ),
        "and `use_sim_time`, like every ROS 2 node. `ros2 param describe` also shows the ranges.",
        f"example:\n    ros2 run nics_drl_bridge {node} {ROS} {facts.example}",
    ]
    return "\n\n".join(parts) + "\n"


def format_value(value: Any) -> str:
    """Return a value as it is written after `:=`."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, list):
        return f"[{', '.join(map(format_value, value))}]"
    text = str(value) if value != "" else "''"
    return f".{text}" if text == "nan" else text


def start(node: str, args: list[str] | None = None) -> None:
    """Run a node by its name and end the process; bad input gives one sentence and exit code 2."""
    for number in own_process.list_ending_signals():  # importing the node takes seconds
        signal.signal(number, signal.SIG_DFL)
    words = sys.argv[1:] if args is None else args[1:]
    if any(word in HELP for word in words):
        sys.stdout.write(format_help(node))
        own_process.leave(0)
    own_process.forward_output(own_process.name_log_file(node, words))
    faulthandler.enable()  # shows where Python was when a library crashes
    # In the format of the ROS 2 log, which is available only seconds later.
    sys.stderr.write(f"[INFO] [{time.time():.9f}] [{node}]: starting\n")
    sys.stderr.flush()
    code: Any = 0
    try:
        transport.set_transport(os.environ)
        gc.disable()  # what is imported stays, so that looking for garbage finds none
        main = _load_main(node)
        gc.freeze()
        gc.enable()
        main(args)
    except SystemExit as end:
        code = end.code
    except BaseException:  # noqa: BLE001  (it is printed, and the process ends)
        traceback.print_exc()
        code = 1
    if code is None:
        code = 0
    own_process.leave(code if isinstance(code, int) else 1)


def _load_main(node: str) -> Any:
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
dart_node = partial(start, "dart_node")
middleware_node = partial(start, "middleware_node")
policy_node = partial(start, "policy_node")
command_gate = partial(start, "command_gate")
record_node = partial(start, "record_node")


if __name__ == "__main__":
    start(sys.argv[1], sys.argv[1:])
