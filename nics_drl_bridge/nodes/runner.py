"""What every node needs: parameters, start and end, a single instance, and diagnostics."""

import contextlib
import gc
import hashlib
import signal
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rcl_interfaces.srv import GetParameters
from rclpy.clock import Clock, ClockType
from rclpy.context import Context
from rclpy.duration import Duration
from rclpy.exceptions import ParameterException
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher
from rclpy.timer import Timer
from std_srvs.srv import Trigger

from nics_drl_bridge.errors import BackendError, BridgeError, suggest
from nics_drl_bridge.exit_codes import EXIT_BAD_INPUT
from nics_drl_bridge.generator import SimulatorModel, open_model
from nics_drl_bridge.nodes import qos
from nics_drl_bridge.nodes.ending import at_once, ending_signals
from nics_drl_bridge.nodes.listener import holds, open_context, spin
from nics_drl_bridge.nodes.output import ros_arguments
from nics_drl_bridge.nodes.parameters import MODEL, Row

UNCONFIGURED = "unconfigured"
INACTIVE = "inactive"
ACTIVE = "active"
DELIVERY_S = 0.5
INPUT_ERRORS = (BridgeError, ParameterException, OSError)
# time until the graph shows all nodes [s]
SETTLE_S = 0.3
POLL_S = 0.02
# a node silent for this long counts as dead, though the graph shows it for 20 s more [s]
LIVENESS_S = 1.5
DIAGNOSTICS_S = 1.0
RANGES = {
    int: (IntegerRange, "integer_range"),
    float: (FloatingPointRange, "floating_point_range"),
}
# type of a default, and of a given value that becomes one or more floats
WHOLE_NUMBERS = (
    (float, Parameter.Type.INTEGER),
    (list, Parameter.Type.INTEGER_ARRAY),
)
SHARED = "model"  # a file may also set it for nodes without a model


def last_word(publisher: Publisher, message: Any) -> None:
    """Publish a message that must arrive although the publisher is destroyed next."""
    publisher.publish(message)
    publisher.wait_for_all_acked(Duration(seconds=DELIVERY_S))


def run_node(
    make: Callable[..., Node], args: Sequence[str] | None = None, sole_name: str = ""
) -> Any:
    """Run a node as the main function of its process until a signal (`ENDING`); return it.

    A known error prints one sentence, and ends with exit code 2.
    """
    stopping = threading.Event()
    for number in ending_signals():
        signal.signal(number, lambda *_: stopping.set())
    words = sys.argv if args is None else args
    try:
        with at_once():
            context = open_context([*words, *ros_arguments(words)])
        return live(make, context, stopping, sole_name)
    except INPUT_ERRORS as error:
        sys.stderr.write(f"{explain(error)}\n")
        raise SystemExit(EXIT_BAD_INPUT) from None


def live(
    make: Callable[..., Node],
    context: Context,
    stopping: threading.Event,
    sole_name: str = "",
) -> Any:
    """Make a node by `make(context=...)`, spin it until the end, and destroy it; return it.

    The end is an event, or the end of the context, which belongs to the node.
    """
    with contextlib.ExitStack() as undo:
        undo.callback(context.try_shutdown)
        with at_once():
            if sole_name:
                undo.enter_context(sole(context, sole_name))
            node = make(context=context)
            undo.callback(_end, node)
            if hasattr(node, "start"):
                node.start()
        gc.collect()  # now, because later it may take 0.1 s while the robot moves
        for sentence in unknown(node):  # rclpy ignores them silently
            node.get_logger().warning(sentence)
        if getattr(node, "state", ACTIVE) == ACTIVE:
            node.get_logger().info("running")
        spin(node, stopping)
    return node


def _end(node: Any) -> None:
    if node.context.ok() and hasattr(node, "stop"):
        node.stop()
    node.destroy_node()


def explain(error: Exception) -> str:
    """Return one line for one of `INPUT_ERRORS`."""
    if isinstance(error, OSError):
        place = f"{error.filename}: " if error.filename else ""
        return f"{place}{error.strerror or error}; choose another place."
    return " ".join(str(error).split())


@contextlib.contextmanager
def sole(context: Context, name: str) -> Iterator[None]:
    """Ensure a single instance while a node runs. Raises BackendError if another is running."""
    # The probe resolves its name exactly like the node.
    probe = Node(
        name, context=context, start_parameter_services=False, enable_rosout=False
    )
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as claim:
        try:
            whole = probe.get_fully_qualified_name()
            domain = context.get_domain_id()
            key = hashlib.sha256(f"{domain} {whole}".encode()).hexdigest().encode()
            taken = False
            try:
                if sys.platform == "linux":
                    claim.bind(b"\0nics_drl_bridge " + key)
            except OSError:
                taken = True
            if taken or (_seen(probe, whole) and _lives(probe, whole)):
                fix = "end it, or give this one a namespace: `--ros-args -r __ns:=/robot_2`."
                raise BackendError(
                    f"a node {whole!r} already runs in ROS domain {domain}; {fix}"
                )
        finally:
            probe.destroy_node()
        yield


def _seen(probe: Node, whole: str) -> bool:

    def shows() -> bool:
        nodes = probe.get_node_names_and_namespaces()
        return [f"{space.rstrip('/')}/{name}" for name, space in nodes].count(whole) > 1

    return holds(shows, SETTLE_S, POLL_S)


def _lives(probe: Node, whole: str) -> bool:
    client = probe.create_client(GetParameters, f"{whole}/get_parameters")
    executor = SingleThreadedExecutor(context=probe.context)
    executor.add_node(probe)
    deadline = time.monotonic() + LIVENESS_S
    try:
        holds(client.service_is_ready, LIVENESS_S, POLL_S)
        answer = client.call_async(GetParameters.Request())
        executor.spin_until_future_complete(
            answer, max(0.1, deadline - time.monotonic())
        )
        return bool(answer.done())
    finally:
        executor.shutdown(timeout_sec=1.0)


def steadily(node: Node, period_s: float, call: Callable[[], Any]) -> Timer:
    """Call a function periodically on the steady clock, even while simulated time stands still."""
    return node.create_timer(
        period_s, call, clock=Clock(clock_type=ClockType.STEADY_TIME)
    )


def serve(node: Node, name: str, answer: Callable[[], tuple[bool, str]]) -> None:
    """Offer a Trigger service whose answer is success and message."""

    def reply(_: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        response.success, response.message = answer()
        return response

    node.create_service(Trigger, name, reply)


def declare_model(node: Node) -> SimulatorModel:
    """Declare the parameter `model` and open it; ConfigError if `cmd_vel` can't drive it."""
    model = open_model(str(declare_row(node, MODEL)))
    model.robot.require_cmd_vel()
    return model


def get_text(node: Node, name: str) -> str:
    """Return the value of a text parameter."""
    return str(node.get_parameter(name).value)


def get_number(node: Node, name: str) -> float:
    """Return the value of a numeric parameter."""
    return float(node.get_parameter(name).value or 0.0)


def get_flag(node: Node, name: str) -> bool:
    """Return the value of a parameter that is true or false."""
    return bool(node.get_parameter(name).value)


def declare_row(node: Node, row: Row) -> Any:
    """Declare a parameter unless the node has it, and return its value."""
    if node.has_parameter(row.name):
        return node.get_parameter(row.name).value
    # a managed node fixes it only from configure to cleanup
    if row.fixed and hasattr(node, "fixed"):
        node.fixed.add(row.name)
        row = row._replace(fixed=False)
    descriptor = ParameterDescriptor(description=row.about, read_only=row.fixed)
    if row.span is not None:
        low, high = row.span
        kind, field = RANGES[type(row.default)]
        setattr(descriptor, field, [kind(from_value=low, to_value=high)])
    # rclpy refuses whole numbers for a floating-point parameter, as in `rate:=2`.
    given = qos.given_values(node).get(row.name)
    value = row.default
    if given is not None and (type(row.default), given.type_) in WHOLE_NUMBERS:
        value = np.asarray(given.value, np.float64).tolist()
    is_whole = value is not row.default
    return node.declare_parameter(row.name, value, descriptor, is_whole).value


def unknown(node: Node) -> list[str]:
    """Return a sentence for each value whose parameter the node does not have."""
    declared = node.get_parameters_by_prefix("")
    names = [name for name in declared if not name.startswith(qos.OVERRIDES)]
    ignores = getattr(node, "ignores", lambda _: False)
    sentences = [
        f"there is no parameter {name!r}, its value is ignored; {suggest(name, names)}"
        for name in sorted(qos.given_values(node))
        if name not in (*names, SHARED)
        and not name.startswith(qos.OVERRIDES)
        and not ignores(name)
    ]
    return sentences + unused_overrides(node)


def unused_overrides(node: Node) -> list[str]:
    """Return a sentence for each quality of service that is given for a topic without such an end.

    A managed node that is not configured has no topics yet.
    """
    if getattr(node, "state", ACTIVE) == UNCONFIGURED:
        return []
    ends = [
        f"{qos.OVERRIDES}{publisher.topic_name}.publisher"
        for publisher in node.publishers
    ]
    ends += [
        f"{qos.OVERRIDES}{subscription.topic_name}.subscription"
        for subscription in node.subscriptions
    ]
    return [
        f"parameter {name!r} is ignored: the node has no such publisher or subscription; "
        f"{suggest(name.rpartition('.')[0], ends)}"
        for name in sorted(qos.given_values(node))
        if name.startswith(qos.OVERRIDES) and not node.has_parameter(name)
    ]


class Condition(NamedTuple):
    """Condition of a node."""

    message: str  # one line
    warns: bool  # it needs attention
    facts: Mapping[str, object]  # further ones, for people
    hardware: str = ""  # concerned, such as the robot's name


def diagnose(node: Node, part: str, look: Callable[[], Condition]) -> None:
    """Publish a node's finding about itself, which `look` returns, once a second."""
    topic = node.create_publisher(DiagnosticArray, "/diagnostics", qos.DIAGNOSTICS)
    name = f"{node.get_fully_qualified_name()}: {part}"

    def publish() -> None:
        condition = look()
        level = DiagnosticStatus.WARN if condition.warns else DiagnosticStatus.OK
        values = [
            KeyValue(key=key, value=str(value))
            for key, value in condition.facts.items()
        ]
        status = DiagnosticStatus(
            level=level, name=name, message=condition.message, values=values
        )
        status.hardware_id = condition.hardware
        message = DiagnosticArray(status=[status])
        message.header.stamp = node.get_clock().now().to_msg()
        topic.publish(message)

    steadily(node, DIAGNOSTICS_S, publish)
