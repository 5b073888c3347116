"""What a person does with a running robot: arm its gate, stop it, give it a goal.

It imports no simulator and no kernels: an emergency stop must not wait for seconds of imports.
"""

import math
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Any, NamedTuple

from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from rclpy.node import Node
from rclpy.publisher import Publisher
from std_msgs.msg import Header
from std_srvs.srv import Trigger

from nics_drl_bridge.config import parse_namespace
from nics_drl_bridge.errors import BackendError
from nics_drl_bridge.interface import NS_PER_S
from nics_drl_bridge.nodes import qos
from nics_drl_bridge.nodes.goal_answer import GoalAnswer, answer_from_values
from nics_drl_bridge.nodes.listener import Listener, holds

GATE = "command_gate"
POLICY = ": policy"  # how the name of a policy node's status ends
POLL_S = 0.02
ASK_AGAIN_S = 1.0  # between two requests to a gate that refuses [s]
SEND_AGAIN_S = 1.0  # between two goals to a policy node that refuses [s]
GATE_ANSWER_S = 5.0  # that a gate may take to answer [s]
CALL_S = 10.0  # the same with the time to find its service [s]
SETTLE_S = 1.0  # in which all gates are seen, once one of them is [s]
Tell = Callable[[str], None]


class GateAnswer(NamedTuple):
    """Answer of one gate."""

    gate: str  # its name
    granted: bool
    told: str


@dataclass(frozen=True)
class GoalRequest:
    """A goal as a person asks for it."""

    x: float  # [m]
    y: float
    yaw: float = 0.0  # [rad]
    frame: str = ""  # empty: the map, whatever the policy node calls it

    def to_ros(self, stamp_ns: int) -> PoseStamped:
        """Return the goal as a message."""
        stamp = Time(sec=stamp_ns // NS_PER_S, nanosec=stamp_ns % NS_PER_S)
        message = PoseStamped(header=Header(stamp=stamp, frame_id=self.frame))
        message.pose.position.x = self.x
        message.pose.position.y = self.y
        message.pose.orientation.z = math.sin(self.yaw / 2.0)
        message.pose.orientation.w = math.cos(self.yaw / 2.0)
        return message


class _Call:
    """A request to a service of a gate, which is sent once the service is there."""

    def __init__(self, node: Node, gate: str, service: str) -> None:
        self._node = node
        self._gate = gate
        self._client = node.create_client(Trigger, f"{gate}/{service}")
        self._future: Any = None

    def wait_for_answer(self, seconds: float) -> GateAnswer:
        """Return the answer, or why there is none after so long; end the call."""
        try:
            holds(self.is_answered, max(seconds, 0.0), POLL_S)
            if self._future is None:
                return GateAnswer(self._gate, False, "it has ended")
            if not self._future.done():
                reason = "it did not answer in time; the request may still take effect"
                return GateAnswer(self._gate, False, reason)
            answer = self._future.result()
            return GateAnswer(self._gate, bool(answer.success), str(answer.message))
        finally:
            self._node.destroy_client(self._client)

    def is_answered(self) -> bool:
        """Send the request once the service is there; return whether the answer has come."""
        if self._future is None and self._client.service_is_ready():
            self._future = self._client.call_async(Trigger.Request())
        return self._future is not None and bool(self._future.done())


class Operator(AbstractContextManager["Operator", None]):
    """A node that calls gates and sends goals; a context manager. Raises BackendError."""

    def __init__(self, domain_id: int | None = None) -> None:
        # policy node -> its condition, and the values of its diagnostics; written by the thread
        self._policies: dict[str, tuple[str, dict[str, str]]] = {}
        self._node = Listener("nics_operator", domain_id)
        self._node.create_subscription(
            DiagnosticArray, "/diagnostics", self._take_diagnostics, qos.DIAGNOSTICS
        )
        self._node.start()

    def arm(
        self, namespace: str, seconds: float, reset: bool, tell: Tell
    ) -> GateAnswer:
        """Arm a gate, and ask again while it refuses; a reset before that releases its stop."""
        deadline = time.monotonic() + seconds
        gate = self._wait_for_gate(namespace, seconds)
        if reset:
            self._call(gate, "reset", deadline)
        answer = self._call(gate, "arm", deadline)
        left_s = deadline - time.monotonic()
        if not answer.granted and left_s > ASK_AGAIN_S:
            tell(
                f"{gate} does not arm yet ({answer.told}); asking again for {left_s:.0f} s"
            )
        while not answer.granted and time.monotonic() + ASK_AGAIN_S < deadline:
            time.sleep(ASK_AGAIN_S)
            answer = self._call(gate, "arm", deadline)
        return answer

    def stop(self, namespace: str | None, seconds: float) -> Iterator[GateAnswer]:
        """Press the e-stop of one gate, or of all if no namespace is given; yield each answer.

        An answer is yielded as soon as it comes, so that nobody waits for gates that may follow.
        """
        if namespace is not None:
            gate = self._wait_for_gate(namespace, seconds)
            yield self._call(gate, "e_stop", time.monotonic() + CALL_S)
            return
        waiting: dict[str, _Call] = {}
        seen = set[str]()
        deadline = time.monotonic() + seconds
        while time.monotonic() < deadline:
            for gate in self._gates() - seen:
                if not seen:
                    deadline = time.monotonic() + SETTLE_S
                seen.add(gate)
                waiting[gate] = _Call(self._node, gate, "e_stop")
            # a gate that hangs holds up no other
            for gate in [gate for gate, call in waiting.items() if call.is_answered()]:
                yield waiting.pop(gate).wait_for_answer(0.0)
            time.sleep(POLL_S)
        if not seen:
            raise BackendError(f"{self._nobody(GATE, seconds)}; nothing was stopped.")
        deadline = time.monotonic() + GATE_ANSWER_S
        for call in waiting.values():
            yield call.wait_for_answer(deadline - time.monotonic())

    def send_goal(
        self, namespace: str, goal: GoalRequest, seconds: float, tell: Tell
    ) -> GoalAnswer:
        """Send a goal, again while it is refused; return the last answer of the policy node."""
        space = parse_namespace(namespace)
        deadline = time.monotonic() + seconds
        topic = self._node.create_publisher(
            PoseStamped, f"{space}/goal_pose", qos.COMMAND
        )
        name = self._wait_for_policy(topic, space, seconds)
        answer = self._send(topic, goal, name, deadline)
        if not answer.taken and time.monotonic() < deadline:
            tell(f"{name} does not take the goal yet ({answer.told}), sending it again")
        while not answer.taken and time.monotonic() + SEND_AGAIN_S < deadline:
            time.sleep(SEND_AGAIN_S)
            answer = self._send(topic, goal, name, deadline)
        return answer

    def _send(
        self, topic: Publisher, goal: GoalRequest, name: str, deadline: float
    ) -> GoalAnswer:
        stamp_ns = time.time_ns()
        wait_s = max(deadline - time.monotonic(), 0.0)
        topic.publish(goal.to_ros(stamp_ns))

        def answered() -> bool:
            answer = answer_from_values(self._policies[name][1])
            return answer is not None and answer.stamp_ns == stamp_ns

        if holds(answered, wait_s, POLL_S):
            answer = answer_from_values(self._policies[name][1])
            if answer is not None:
                return answer
        condition = self._policies[name][0]
        return GoalAnswer(
            stamp_ns, False, f"no answer within {wait_s:.1f} s, {condition}"
        )

    def _wait_for_policy(self, topic: Publisher, space: str, seconds: float) -> str:
        """Wait for the policy node of a namespace, and return its name."""

        def found() -> list[str]:
            names = list(self._policies)
            return [name for name in names if name.rpartition("/")[0] == space]

        holds(lambda: topic.get_subscription_count() and found(), seconds, POLL_S)
        names = found()
        if not names:
            spaces = {name.rpartition("/")[0] for name in list(self._policies)}
            raise BackendError(
                f"{self._nobody('policy_node', seconds, space, spaces)}."
            )
        if not topic.get_subscription_count():
            condition = self._policies[names[0]][0]
            raise BackendError(
                f"{names[0]} hears no goals, its state is {condition!r}; see its log."
            )
        return names[0]

    def _wait_for_gate(self, namespace: str, seconds: float) -> str:
        """Wait for the gate of a namespace, and return its name."""
        space = parse_namespace(namespace)
        gate = f"{space}/{GATE}"
        if not holds(lambda: gate in self._gates(), seconds, POLL_S):
            spaces = {gate.rpartition("/")[0] for gate in self._gates()}
            raise BackendError(f"{self._nobody(GATE, seconds, space, spaces)}.")
        return gate

    def _gates(self) -> set[str]:
        """Return the names of all gates that are seen."""
        services = self._node.get_service_names_and_types()
        ends = [
            name.removesuffix("/arm")
            for name, _ in services
            if name.endswith(f"/{GATE}/arm")
        ]
        return set(ends)

    def _nobody(
        self, what: str, seconds: float, space: str = "", spaces: set[str] | None = None
    ) -> str:
        """Return a clause that says where nobody answers, and where somebody does."""
        where = f"in namespace {space or '/'} of ROS domain {self._node.context.get_domain_id()}"
        fault = f"no {what} was seen {where} within {seconds:g} s"
        if not spaces:
            return f"{fault}; start one, as by `nics up simulation`, in the same ROS_DOMAIN_ID"
        names = sorted(space.strip("/") for space in spaces)
        fix = f"say --namespace {names[0]}" if names[0] else "leave --namespace out"
        return (
            f"{fault}; there is one in {', '.join(f'/{name}' for name in names)}: {fix}"
        )

    def _call(self, gate: str, service: str, deadline: float) -> GateAnswer:
        """Call a service of a gate; wait for its answer until a deadline, at most `CALL_S`."""
        wait_s = min(deadline - time.monotonic(), CALL_S)
        return _Call(self._node, gate, service).wait_for_answer(wait_s)

    def _take_diagnostics(self, message: Any) -> None:
        for status in message.status:
            if status.name.endswith(POLICY):
                values = {pair.key: pair.value for pair in status.values}
                self._policies[status.name.removesuffix(POLICY)] = (
                    status.message,
                    values,
                )

    def __exit__(self, *_: object) -> None:
        self._node.close()
