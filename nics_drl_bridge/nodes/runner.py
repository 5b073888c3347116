"""How every node of the package starts, spins, and ends."""

from __future__ import annotations

import contextlib
import signal
import sys
import threading
from collections.abc import Callable, Sequence
from typing import Any

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.context import Context
from rclpy.duration import Duration
from rclpy.exceptions import ParameterException
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.publisher import Publisher

from nics_drl_bridge.errors import BackendError, BridgeError
from nics_drl_bridge.generator import SimulatorModel, open_model
from nics_drl_bridge.nodes.executor import StandingExecutor
from nics_drl_bridge.nodes.overrides import warn_of_unknown, widen
from nics_drl_bridge.nodes.sole import sole
from nics_drl_bridge.nodes.transport import OF_THIS_PROCESS

SPIN_S = 0.1
DELIVERY_S = 0.5
EXIT_BAD_INPUT = 2
RANGES = {
    int: (IntegerRange, "integer_range"),
    float: (FloatingPointRange, "floating_point_range"),
}


def open_context(args: Sequence[str] | None = None, domain_id: int | None = None) -> Context:
    """A context of one's own, with discovery on this machine unless the environment names a range.

    A robot that should be seen by others sets `ROS_AUTOMATIC_DISCOVERY_RANGE` (on Humble
    `ROS_LOCALHOST_ONLY=0`); a simulator started in a lab does not move somebody's robot. Fast DDS
    sends by UDP, unless the environment chooses for itself (`transport`).

    Args:
        args: ROS arguments.
        domain_id: DDS domain; the environment's by default.

    Raises:
        BackendError: the arguments are wrong, no ROS 2 middleware is there, or discovery should go
            further than that of an earlier context of this process.
    """

    def make() -> Context:
        context = Context()
        context.init(None if args is None else list(args), domain_id=domain_id)
        return context

    try:
        return OF_THIS_PROCESS.open(make)
    except RuntimeError as error:
        raise BackendError(f"ROS 2 does not start: {' '.join(str(error).split())}") from None


def last_word(publisher: Publisher, message: Any) -> None:
    """Publishes what has to arrive although the publisher is destroyed next."""
    publisher.publish(message)
    publisher.wait_for_all_acked(Duration(seconds=DELIVERY_S))


def run_node(
    make: Callable[[Context], Node], args: Sequence[str] | None = None, sole_name: str = ""
) -> None:
    """Runs a node until SIGINT or SIGTERM, then destroys it in order.

    A node that offers `start()` is asked to begin. One that offers `stop()` is asked to leave its
    robot standing still while it can still publish. What the user got wrong is one sentence on
    standard error and exit code 2.

    Args:
        make: makes the node in a context of its own.
        args: the command line, `sys.argv` by default.
        sole_name: of the node, where no second one may run in the same namespace.
    """
    stopping, starting = threading.Event(), threading.Event()
    starting.set()

    def end(*_: Any) -> None:
        stopping.set()
        if starting.is_set():  # it may be compiling, which can take longer than a launch waits
            starting.clear()
            raise SystemExit(0)

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, end)
    context, node, alone = None, None, contextlib.ExitStack()
    try:
        context = open_context(sys.argv if args is None else args)
        if sole_name:
            alone.enter_context(sole(context, sole_name))
        node = make(context)
        if hasattr(node, "start"):
            node.start()
        warn_of_unknown(node)
        starting.clear()
        _spin(node, stopping)
    except (BridgeError, ParameterException) as error:
        sys.stderr.write(f"{' '.join(str(error).split())}\n")
        raise SystemExit(EXIT_BAD_INPUT) from None
    except OSError as error:
        place = f"{error.filename}: " if error.filename else ""
        sys.stderr.write(f"{place}{error.strerror or error}; choose another place.\n")
        raise SystemExit(EXIT_BAD_INPUT) from None
    finally:
        starting.clear()
        if node is not None:
            if node.context.ok() and hasattr(node, "stop"):
                node.stop()
            node.destroy_node()
        if context is not None:
            context.try_shutdown()
        alone.close()


def _spin(node: Node, stopping: threading.Event) -> None:
    """Serves a node until it is asked to end, or its context has been shut down."""
    executor = StandingExecutor(node.context)
    executor.add_node(node)
    with contextlib.suppress(ExternalShutdownException):
        while node.context.ok() and not stopping.is_set():
            executor.spin_once(timeout_sec=SPIN_S)
    executor.shutdown(timeout_sec=1.0)


def declare_model(node: Node) -> SimulatorModel:
    """Declares the parameter `model` and opens what it names."""
    return open_model(declare_model_name(node))


def declare_model_name(node: Node) -> str:
    """Declares the parameter `model`; what it names is opened later."""
    about = "Folder of a SimulatorModel, or a shipped robot."
    return str(declare(node, "model", "ackermann", about, read_only=True))


def declare(node: Node, name: str, default: Any, description: str, **limits: Any) -> Any:
    """Declares a parameter and returns its value.

    Args:
        node: whose parameter it is.
        name: of the parameter.
        default: gives the type too.
        description: for `ros2 param describe`.
        limits: `low` and `high` of a number; `read_only`, which in a managed node
            is so from configure to cleanup.
    """
    fixed = limits.get("read_only", False)
    if fixed and hasattr(node, "fixed"):  # a managed node reads it anew each time it is configured
        node.fixed.add(name)
        fixed = False
    descriptor = ParameterDescriptor(description=description, read_only=fixed)
    if "low" in limits:
        kind, field = RANGES[type(default)]
        span = kind(from_value=limits["low"], to_value=limits["high"])
        setattr(descriptor, field, [span])
    widen(node, name, default)
    return node.declare_parameter(name, default, descriptor).value
