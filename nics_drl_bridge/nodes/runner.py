"""What every node needs: parameters, start and end, a life cycle, one instance, diagnostics."""

import contextlib
import gc
import hashlib
import signal
import socket
import sys
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from typing import Any, NamedTuple

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.clock import Clock, ClockType
from rclpy.context import Context
from rclpy.duration import Duration
from rclpy.exceptions import ParameterException
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher
from rclpy.timer import Timer
from std_srvs.srv import Trigger

from nics_drl_bridge import extensions
from nics_drl_bridge.errors import BackendError, BridgeError, ConfigError, suggest
from nics_drl_bridge.exit_codes import EXIT_BAD_INPUT
from nics_drl_bridge.generator import SimulatorModel, open_model
from nics_drl_bridge.interface import Array
from nics_drl_bridge.nodes import qos
from nics_drl_bridge.nodes.listener import open_context, spin
from nics_drl_bridge.nodes.own_process import list_ending_signals, list_log_arguments
from nics_drl_bridge.nodes.parameters import (
    Row,
    find_frame_fault,
    list_rows,
)
from nics_drl_bridge.nodes.qos import BridgeNode, copy_profile, override_qos

UNCONFIGURED = "unconfigured"
INACTIVE = "inactive"
ACTIVE = "active"
DELIVERY_S = 0.5
INPUT_ERRORS = (BridgeError, ParameterException, OSError)
DIAGNOSTICS_S = 1.0
RANGES = {
    int: (IntegerRange, "integer_range"),
    float: (FloatingPointRange, "floating_point_range"),
}
WHOLE = {float: Parameter.Type.INTEGER, list: Parameter.Type.INTEGER_ARRAY}
PARTS = "node_parts"
SHARED = "model"  # a file may also set it for nodes without a model


def publish_last(publisher: Publisher, message: Any) -> None:
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
    words = sys.argv if args is None else args
    try:
        context = open_context([*words, *list_log_arguments(words)])
        with open_node(make, context, sole_name) as node:
            for number in list_ending_signals():
                signal.signal(number, lambda *_: stopping.set())
            spin(node, stopping)
        return node
    except INPUT_ERRORS as error:
        sys.stderr.write(f"{explain(error)}\n")
        raise SystemExit(EXIT_BAD_INPUT) from None


@contextlib.contextmanager
def open_node(
    make: Callable[..., Node], context: Context, sole_name: str = ""
) -> Iterator[Any]:
    """Make a node by `make(context=...)` and start it; in the end, stop and destroy it.

    The context belongs to the node, and is shut down in the end, too.
    """
    with ExitStack() as undo:
        undo.callback(context.try_shutdown)
        if sole_name:
            undo.enter_context(claim_name(context, sole_name))
        node = make(context=context)
        undo.callback(_end, node)
        if hasattr(node, "start"):
            node.start()
        gc.collect()  # now, because later it may take 0.1 s while the robot moves
        for sentence in explain_ignored_values(node):  # rclpy ignores them silently
            node.get_logger().warning(sentence)
        if getattr(node, "state", ACTIVE) == ACTIVE:
            node.get_logger().info("running")
        yield node


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
def claim_name(context: Context, name: str) -> Iterator[None]:
    """Ensure a single instance on this machine while a node runs. Raises BackendError."""
    # The probe resolves its name exactly like the node.
    probe = Node(
        name, context=context, start_parameter_services=False, enable_rosout=False
    )
    whole = probe.get_fully_qualified_name()
    probe.destroy_node()
    domain = context.get_domain_id()
    key = hashlib.sha256(f"{domain} {whole}".encode()).hexdigest()
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as claim:
        try:
            claim.bind(f"\0nics_drl_bridge {key}")
        except OSError:
            raise BackendError(
                f"a node {whole!r} already runs in ROS domain {domain}; end it, or give this "
                "one a namespace: `--ros-args -r __ns:=/robot_2`."
            ) from None
        yield


def call_periodically(node: Node, period_s: float, call: Callable[[], Any]) -> Timer:
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
    model = open_model(declare_rows(node, "model")["model"])
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


def get_choice(node: Node, name: str, valid: tuple[str, ...]) -> str:
    """Return a parameter that must be one of `valid`. Raises ConfigError with the nearest word."""
    value = get_text(node, name)
    if value not in valid:
        raise ConfigError(
            f"parameter {name!r}: unknown value {value!r}; {suggest(value, valid)}"
        )
    return value


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
    given = qos.get_given_values(node).get(row.name)
    value = row.default
    if given is not None:
        floats = row.default if isinstance(row.default, list) else [row.default]
        is_float = all(isinstance(each, float) for each in floats)
        if is_float and given.type_ == WHOLE.get(type(row.default)):
            value = np.asarray(given.value, np.float64).tolist()
    is_whole = value is not row.default
    return node.declare_parameter(row.name, value, descriptor, is_whole).value


def declare_rows(node: Node, *groups: str, **known: Any) -> dict[str, Any]:
    """Declare groups of parameters, see `list_rows`; return their values by their names."""
    return {row.name: declare_row(node, row) for row in list_rows(*groups, **known)}


def explain_ignored_values(node: Node) -> list[str]:
    """Return a sentence for each value whose parameter the node does not have.

    A managed node that is not configured has no topics yet, whose quality of service it could set.
    """
    names = [
        name
        for name in node.get_parameters_by_prefix("")
        if not name.startswith(qos.OVERRIDES)
    ]
    ignores = getattr(node, "ignores", lambda _: False)
    has_topics = getattr(node, "state", ACTIVE) != UNCONFIGURED
    sentences = []
    for name in sorted(qos.get_given_values(node)):
        if name == SHARED or node.has_parameter(name) or ignores(name):
            continue
        if not name.startswith(qos.OVERRIDES):
            sentences.append(
                f"there is no parameter {name!r}, its value is ignored; {suggest(name, names)}"
            )
        elif has_topics:
            sentences.append(
                f"parameter {name!r} is ignored: the node has no such publisher or "
                "subscription."
            )
    return sentences


OK = DiagnosticStatus.OK
WARN = DiagnosticStatus.WARN  # it needs attention
ERROR = DiagnosticStatus.ERROR  # a fault stops the robot
STALE = DiagnosticStatus.STALE  # data have stopped to arrive


class Wish(NamedTuple):
    """Motion that a policy requests on the way to a goal."""

    twist: Array  # (3,) for `cmd_vel`
    touched: bool


def open_parts(kind: str, node: Node) -> list[Any]:
    """Return the parts that extensions add to a kind of node, `device` or `policy`.

    They are the entry points `nics_drl_bridge.node_parts`. An entry `device.NAME` is called with a
    simulator's node, and `policy.NAME` with a policy node. It declares its parameters then, and
    returns an object, or None if it has nothing to offer there. A part of a policy node is a
    leader, which may drive the robot to goals of its own; its methods are those of
    `extras.nav2.follow_path.PathActions`. Raises BridgeError.
    """
    names = extensions.find_extensions(PARTS)
    chosen = [name for name in names if name.startswith(f"{kind}.")]
    parts = [extensions.load(PARTS, name)(node) for name in chosen]
    return [part for part in parts if part is not None]


class Condition(NamedTuple):
    """Condition of a node."""

    message: str  # one line
    level: bytes  # `OK`, `WARN`, `ERROR` or `STALE`
    facts: Mapping[str, object]  # further ones
    hardware: str = ""  # concerned, such as the robot's name


def status_to_ros(node: Node, part: str, condition: Condition) -> DiagnosticStatus:
    """Return the condition of a node, or of a part of it, as it is diagnosed."""
    return DiagnosticStatus(
        level=condition.level,
        name=f"{node.get_fully_qualified_name()}: {part}",
        message=condition.message,
        hardware_id=condition.hardware,
        values=[
            KeyValue(key=key, value=str(value))
            for key, value in condition.facts.items()
        ],
    )


def diagnose(node: Node, part: str, look: Callable[[], Condition]) -> None:
    """Publish a node's finding about itself, which `look` returns, once a second."""
    topic = node.create_publisher(DiagnosticArray, "/diagnostics", qos.DIAGNOSTICS)

    def publish() -> None:
        message = DiagnosticArray(status=[status_to_ros(node, part, look())])
        message.header.stamp = node.get_clock().now().to_msg()
        topic.publish(message)

    call_periodically(node, DIAGNOSTICS_S, publish)


SUCCESS = TransitionCallbackReturn.SUCCESS
FAILURE = TransitionCallbackReturn.FAILURE


class ManagedNode(BridgeNode, LifecycleNode):
    """A lifecycle node; `configure` creates its resources and puts their clean-up on `undo`.

    It declares the parameters of a group, in addition to those of managed nodes and of sensors.
    """

    def __init__(self, name: str, group: str, **options: Any) -> None:
        super().__init__(name, **options)
        self.fixed: set[str] = set()
        self.undo = ExitStack()
        shared = ("managed", "model", "sensors", "stamped", "frames")
        values = declare_rows(self, *shared, group)
        fault = find_frame_fault(self.get_parameters_by_prefix("").values())
        if fault:
            raise ConfigError(fault)
        self._autostart = bool(values["autostart"])
        # the last primary state
        self.state = UNCONFIGURED
        self._starting = False
        self._failure: Exception | None = None
        self.add_on_set_parameters_callback(self._check_fixed)

    def create_lifecycle_publisher(self, kind: Any, topic: str, qos: Any) -> Publisher:
        """Create a publisher, until clean-up, that is silent unless the node is active."""
        with override_qos(self, topic, "publisher") as options:
            made = super().create_lifecycle_publisher(
                kind, topic, copy_profile(qos), **options
            )
        self.undo.callback(self.destroy_lifecycle_publisher, made)
        return made

    def configure(self) -> None:
        """Create what the parameters request. Raises BridgeError if one can't be used."""

    def activate(self) -> None:
        """Start to act."""

    def deactivate(self) -> None:
        """Leave the robot at rest; publish nothing afterwards."""

    def start(self) -> None:
        """Configure and activate the node, if `autostart` is set. Raises BridgeError."""
        if not self._autostart:
            self.get_logger().info(
                "unconfigured: waiting for `ros2 lifecycle set` (autostart is false)"
            )
            return
        self._starting = True
        for trigger in (self.trigger_configure, self.trigger_activate):
            if trigger() != SUCCESS:
                raise self._failure or BridgeError(
                    f"{self.get_name()} could not be started."
                )
        self._starting = False

    def stop(self) -> None:
        """Leave the robot at rest, from any state."""
        if self.state == ACTIVE:
            self.deactivate()

    def _check_fixed(self, parameters: list[Parameter]) -> SetParametersResult:
        late = sorted(self.fixed & {parameter.name for parameter in parameters})
        reason = find_frame_fault(
            (*self.get_parameters_by_prefix("").values(), *parameters)
        )
        if late and self.state != UNCONFIGURED:
            reason = (
                f"parameter {late[0]!r} is read when the node is configured; return it to "
                f"unconfigured by `ros2 lifecycle set {self.get_fully_qualified_name()} "
                "deactivate`, then `cleanup`."
            )
        return SetParametersResult(successful=not reason, reason=reason)

    def on_configure(self, _: LifecycleState) -> TransitionCallbackReturn:
        """Configure the node; a failure leaves it unconfigured."""
        done = self._attempt(self.configure, INACTIVE)
        if done == FAILURE:
            self.undo.close()
        return done

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Transition of the state machine."""
        super().on_activate(state)  # the publishers
        return self._attempt(self.activate, ACTIVE)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Transition of the state machine."""
        done = self._attempt(self.deactivate, INACTIVE)
        super().on_deactivate(state)
        return done

    def on_cleanup(self, _: LifecycleState) -> TransitionCallbackReturn:
        """Transition of the state machine."""
        return self._attempt(self.undo.close, UNCONFIGURED)

    def on_shutdown(self, _: LifecycleState) -> TransitionCallbackReturn:
        """Leave the robot at rest, from any state; after an error it can be configured again."""
        self.stop()
        return self._attempt(self.undo.close, UNCONFIGURED)

    def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Act as at a shutdown; the failure is kept for `start`."""
        failure = self._failure
        done = self.on_shutdown(state)
        self._failure = failure
        return done

    def _attempt(
        self, do: Callable[[], None], reached: str
    ) -> TransitionCallbackReturn:
        """Do the work of a transition and report a failure, which rclpy does not."""
        self._failure = None
        try:
            do()
        except Exception as error:
            self._failure = error
            expected = isinstance(error, BridgeError)
            if not self._starting:
                kind = "" if expected else f"{type(error).__name__}: "
                self.get_logger().error(f"{kind}{error}")
            if not expected:
                raise
            return FAILURE
        self.state = reached
        if not self._starting:
            self.get_logger().info("running" if reached == ACTIVE else reached)
        return SUCCESS
