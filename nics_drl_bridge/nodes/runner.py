"""Start, spinning and end of every node of the package.

Initial parameter values of a node, from the command line and from YAML files.
"""

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
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher

from nics_drl_bridge.errors import BackendError, BridgeError, nearest
from nics_drl_bridge.generator import SimulatorModel, open_model
from nics_drl_bridge.nodes.executor import StandingExecutor
from nics_drl_bridge.nodes.single_instance import sole
from nics_drl_bridge.nodes.transport import OF_THIS_PROCESS

SPIN_S = 0.1
DELIVERY_S = 0.5
EXIT_BAD_INPUT = 2
RANGES = {
    int: (IntegerRange, "integer_range"),
    float: (FloatingPointRange, "floating_point_range"),
}


def open_context(args: Sequence[str] | None = None, domain_id: int | None = None) -> Context:
    """Returns a new context; discovery stays on this machine unless the environment sets a range.

    A robot that others should see sets `ROS_AUTOMATIC_DISCOVERY_RANGE` (on Humble
    `ROS_LOCALHOST_ONLY=0`); by default a simulator in a lab can't move another robot. Fast DDS
    sends by UDP, unless the environment chooses otherwise (`transport`).

    Args:
        args: ROS arguments.
        domain_id: DDS domain; the environment's by default.

    Raises:
        BackendError: the arguments are wrong, no ROS 2 middleware is there, or discovery should
            reach further than that of an earlier context of this process.
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

    A node's `start()`, if any, is called before it spins, and its `stop()` while it can still
    publish, to leave its robot at rest. A user's error becomes one sentence on standard error and
    exit code 2.

    Args:
        make: makes the node in its own context.
        args: the command line, `sys.argv` by default.
        sole_name: of the node, if only a single instance may run in a namespace.
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
    """Spins a node until it is to stop, or its context has been shut down."""
    executor = StandingExecutor(node.context)
    executor.add_node(node)
    with contextlib.suppress(ExternalShutdownException):
        while node.context.ok() and not stopping.is_set():
            executor.spin_once(timeout_sec=SPIN_S)
    executor.shutdown(timeout_sec=1.0)


def declare_model(node: Node) -> SimulatorModel:
    """Declares the parameter `model` and opens the model that it names."""
    return open_model(declare_model_name(node))


def declare_model_name(node: Node) -> str:
    """Declares the parameter `model`; the model itself is opened later."""
    about = "Folder of a SimulatorModel, or a shipped robot."
    return str(declare(node, "model", "ackermann", about, read_only=True))


def declare(node: Node, name: str, default: Any, description: str, **limits: Any) -> Any:
    """Declares a parameter and returns its value.

    Args:
        node: that gets the parameter.
        name: of the parameter.
        default: also determines the type.
        description: for `ros2 param describe`.
        limits: `low` and `high` of a number; `read_only`, which in a managed node applies from
            configure to cleanup.
    """
    fixed = limits.get("read_only", False)
    if fixed and hasattr(node, "fixed"):  # a managed node reads it at each configure
        node.fixed.add(name)
        fixed = False
    descriptor = ParameterDescriptor(description=description, read_only=fixed)
    if "low" in limits:
        kind, field = RANGES[type(default)]
        span = kind(from_value=limits["low"], to_value=limits["high"])
        setattr(descriptor, field, [span])
    widen(node, name, default)
    return node.declare_parameter(name, default, descriptor).value


WIDENED: dict[Parameter.Type, tuple[Parameter.Type, Callable[[Any], Any]]] = {
    Parameter.Type.INTEGER: (Parameter.Type.DOUBLE, float),
    Parameter.Type.INTEGER_ARRAY: (
        Parameter.Type.DOUBLE_ARRAY,
        lambda values: list(map(float, values)),
    ),
}
QOS = "qos_overrides."
"""Names that rclpy reads itself, if a publisher or subscription requests it."""

SHARED = "model"
"""A file sets it for all nodes at once, including those that have no model."""


def widen(node: Node, name: str, default: Any) -> None:
    """Lets `rate:=2` be given for a floating-point parameter: rclpy itself refuses an integer.

    Args:
        node: that gets the parameter; it is not yet declared.
        name: of the parameter.
        default: a float or a list of floats; other types are left alone.
    """
    given = given_values(node)
    first = default[0] if isinstance(default, list) and default else default
    parameter = given.get(name)
    if isinstance(first, float) and parameter is not None and parameter.type_ in WIDENED:
        kind, convert = WIDENED[parameter.type_]
        given[name] = Parameter(name, kind, convert(parameter.value))


def given_values(node: Node) -> dict[str, Parameter]:
    """Returns the initial values given to the node, by name; the node's own dictionary.

    The only public access in rclpy is to accept undeclared parameters, which would accept misspelt
    ones.
    """
    found: dict[str, Parameter] = getattr(node, "_parameter_overrides", {})
    return found


def unknown(node: Node) -> list[str]:
    """Returns a sentence for each value whose parameter the node does not have."""
    known = [name for name in node._parameters if not name.startswith(QOS)]
    return [
        f"there is no parameter {name!r}, its value is ignored; {nearest(name, known)}"
        for name in sorted(given_values(node))
        if name not in (*known, SHARED) and not name.startswith(QOS)
    ]


def warn_of_unknown(node: Node) -> None:
    """Warns of values for parameters that the node does not have; rclpy ignores them silently."""
    for sentence in unknown(node):
        node.get_logger().warning(sentence)
