"""What a person does with a running robot: arm its gate, stop it, give it a goal.

It imports no simulator and no kernels: an emergency stop must not wait for seconds of imports.
"""

import math
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple, TypeVar

import numpy as np
from builtin_interfaces.msg import Time as TimeMessage
from diagnostic_msgs.msg import DiagnosticArray
from diagnostic_msgs.srv import SelfTest
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry
from numpy.typing import NDArray
from rclpy.node import Node
from rclpy.publisher import Publisher
from std_msgs.msg import Header
from std_srvs.srv import Trigger

from nics_drl_bridge.config import parse_namespace
from nics_drl_bridge.errors import BackendError
from nics_drl_bridge.interface import NS_PER_S
from nics_drl_bridge.nodes import qos
from nics_drl_bridge.nodes.listener import SpunNode, holds
from nics_drl_bridge.recording.messages import read_whole_pose

GATE = "command_gate"
POLICY = ": policy"  # how the name of a policy node's status ends
POLL_S = 0.01
REPLY_S = 2.0  # longest wait for one answer before asking a simulator again [s]
ASK_AGAIN_S = 1.0  # between two requests that are refused [s]
GATE_ANSWER_S = 5.0  # that a gate may take to answer [s]
CALL_S = 10.0  # the same with the time to find its service [s]
SETTLE_S = 1.0  # in which all gates are seen, once one of them is [s]
Tell = Callable[[str], None]
# keys of a policy node's diagnostics
STAMP = "stamp of the newest goal [ns]"
TAKEN = "newest goal taken"
TOLD = "newest goal"


class TriggerAnswer(NamedTuple):
    """Answer of a node's service."""

    node: str  # its name
    granted: bool
    told: str


@dataclass(frozen=True)
class GoalAnswer:
    """The answer to a goal: accepted or refused."""

    stamp_ns: int  # of the goal's message
    granted: bool
    told: str  # where the goal is, or why it was refused

    def to_facts(self) -> dict[str, object]:
        """Return the answer as facts of a node's diagnostics."""
        return {STAMP: self.stamp_ns, TAKEN: self.granted, TOLD: self.told}


def answer_from_values(values: Mapping[str, str]) -> GoalAnswer | None:
    """Return the answer among the values of a node's diagnostics, or None."""
    stamp = values.get(STAMP, "")
    if not stamp.isdecimal():
        return None
    return GoalAnswer(int(stamp), values.get(TAKEN) == str(True), values.get(TOLD, ""))


class GoalRequest(NamedTuple):
    """A goal as a person asks for it."""

    x: float  # [m]
    y: float
    yaw: float = 0.0  # [rad]
    frame: str = ""  # empty: the map, whatever the policy node calls it


Answer = TypeVar("Answer", TriggerAnswer, GoalAnswer)
OperatorT = TypeVar("OperatorT", bound="Operator")


def ask_until_granted(
    ask: Callable[[], Answer], deadline: float, tell: Tell, what: str
) -> Answer:
    """Ask until the answer is granted or a time comes; tell once that it is refused."""
    answer = ask()
    left_s = deadline - time.monotonic()
    if not answer.granted and left_s > ASK_AGAIN_S:
        tell(f"{what} yet ({answer.told}); asking again for {left_s:.0f} s")
    while not answer.granted and time.monotonic() + ASK_AGAIN_S < deadline:
        time.sleep(ASK_AGAIN_S)
        answer = ask()
    return answer


class Call:
    """A request to a service of a node, which is sent once the service is there."""

    def __init__(self, node: Node, server: str, service: str) -> None:
        self._node = node
        self._server = server
        self._client = node.create_client(Trigger, f"{server}/{service}")
        self._future: Any = None

    def wait_for_answer(self, seconds: float) -> TriggerAnswer:
        """Return the answer, or why there is none after so long; end the call."""
        is_answered = holds(self.is_answered, max(seconds, 0.0), POLL_S)
        self._node.destroy_client(self._client)
        if is_answered:
            answer = self._future.result()
            return TriggerAnswer(
                self._server, bool(answer.success), str(answer.message)
            )
        why = "it did not answer in time; the request may still take effect"
        if self._future is None:
            why = "it has ended"
        return TriggerAnswer(self._server, False, why)

    def is_answered(self) -> bool:
        """Send the request once the service is there; return whether the answer has come."""
        if self._future is None and self._client.service_is_ready():
            self._future = self._client.call_async(Trigger.Request())
        return self._future is not None and bool(self._future.done())


def get_namespace_of(name: str) -> str:
    """Return the namespace of a node by its full name; empty for the root."""
    return name.rpartition("/")[0]


class Operator:
    """A node that calls gates and sends goals; a context manager. Raises BackendError."""

    def __init__(self, domain_id: int | None = None) -> None:
        # policy node -> its condition, and the values of its diagnostics; written by the thread
        self._policies: dict[str, tuple[str, dict[str, str]]] = {}
        self._spun = SpunNode("nics_operator", domain_id)
        self._node = self._spun.node
        self._subscribe()
        self._spun.start()

    def _subscribe(self) -> None:
        self._node.create_subscription(
            DiagnosticArray, "/diagnostics", self._take_diagnostics, qos.DIAGNOSTICS
        )

    def arm(
        self, namespace: str, seconds: float, reset: bool, tell: Tell
    ) -> TriggerAnswer:
        """Arm a gate, and ask again while it refuses; a reset before that releases its stop."""
        deadline = time.monotonic() + seconds
        gate = self._wait_for(self._gates, GATE, namespace, seconds)

        def call(service: str) -> TriggerAnswer:
            wait_s = min(deadline - time.monotonic(), CALL_S)
            return Call(self._node, gate, service).wait_for_answer(wait_s)

        if reset:
            call("reset")
        return ask_until_granted(
            partial(call, "arm"), deadline, tell, f"{gate} does not arm"
        )

    def stop(self, namespace: str | None, seconds: float) -> Iterator[TriggerAnswer]:
        """Press the e-stop of one gate, or of all if no namespace is given; yield each answer.

        An answer is yielded as soon as it comes, so that nobody waits for gates that may follow.
        """
        if namespace is not None:
            gate = self._wait_for(self._gates, GATE, namespace, seconds)
            yield Call(self._node, gate, "e_stop").wait_for_answer(CALL_S)
            return
        waiting: dict[str, Call] = {}
        seen = set[str]()
        deadline = time.monotonic() + seconds
        while time.monotonic() < deadline:
            for gate in self._gates() - seen:
                if not seen:
                    deadline = time.monotonic() + SETTLE_S
                seen.add(gate)
                waiting[gate] = Call(self._node, gate, "e_stop")
            # a gate that hangs holds up no other
            for gate in [gate for gate, call in waiting.items() if call.is_answered()]:
                yield waiting.pop(gate).wait_for_answer(0.0)
            time.sleep(POLL_S)
        if not seen:
            raise BackendError(self._explain_absence(GATE, seconds, "", []))
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
        name = self._wait_for(
            lambda: list(self._policies), "policy_node", namespace, seconds
        )
        left_s = deadline - time.monotonic()
        if not holds(topic.get_subscription_count, left_s, POLL_S):
            condition = self._policies[name][0]
            raise BackendError(
                f"{name} does not listen to goals; its state is {condition!r}; see its log."
            )
        send = partial(self._send, topic, goal, name, deadline)
        return ask_until_granted(send, deadline, tell, f"{name} does not take the goal")

    def _send(
        self, topic: Publisher, goal: GoalRequest, name: str, deadline: float
    ) -> GoalAnswer:
        stamp_ns = time.time_ns()
        wait_s = max(deadline - time.monotonic(), 0.0)
        message = PoseStamped(header=Header(frame_id=goal.frame))
        message.header.stamp = TimeMessage(
            sec=stamp_ns // NS_PER_S, nanosec=stamp_ns % NS_PER_S
        )
        message.pose.position.x, message.pose.position.y = goal.x, goal.y
        message.pose.orientation.z = math.sin(goal.yaw / 2.0)
        message.pose.orientation.w = math.cos(goal.yaw / 2.0)
        topic.publish(message)

        def find_answer() -> GoalAnswer | None:
            answer = answer_from_values(self._policies[name][1])
            return answer if answer and answer.stamp_ns == stamp_ns else None

        holds(find_answer, wait_s, POLL_S)
        why = f"no answer within {wait_s:.1f} s, {self._policies[name][0]}"
        return find_answer() or GoalAnswer(stamp_ns, False, why)

    def _wait_for(
        self,
        names: Callable[[], Iterable[str]],
        what: str,
        namespace: str,
        seconds: float,
    ) -> str:
        """Wait for a node of a namespace among `names`, and return its name."""
        space = parse_namespace(namespace)

        def find() -> str | None:
            return next(
                (name for name in names() if get_namespace_of(name) == space), None
            )

        holds(find, seconds, POLL_S)
        name = find()
        if name is None:
            raise BackendError(
                self._explain_absence(what, seconds, space, sorted(names()))
            )
        return name

    def _gates(self) -> set[str]:
        """Return the names of all gates that are seen."""
        services = self._node.get_service_names_and_types()
        return {
            name.removesuffix("/arm")
            for name, _ in services
            if name.endswith(f"/{GATE}/arm")
        }

    def _explain_absence(
        self, what: str, seconds: float, space: str, others: Sequence[str]
    ) -> str:
        """Return a sentence that says where nobody is, and which others there are."""
        domain = self._node.context.get_domain_id()
        fault = (
            f"no {what} was seen in namespace {space or '/'} of ROS domain {domain} within "
            f"{seconds:g} s"
        )
        if not others:
            return f"{fault}; start one, as by `nics up simulation`, in the same ROS_DOMAIN_ID."
        first = get_namespace_of(others[0]).strip("/")
        fix = f"say --namespace {first}" if first else "leave --namespace out"
        return f"{fault}; there is {', '.join(others)}: {fix}."

    def _take_diagnostics(self, message: Any) -> None:
        for status in message.status:
            if status.name.endswith(POLICY):
                values = {pair.key: pair.value for pair in status.values}
                self._policies[status.name.removesuffix(POLICY)] = (
                    status.message,
                    values,
                )

    def __enter__(self: OperatorT) -> OperatorT:
        return self

    def __exit__(self, *_: object) -> None:
        self._spun.close()


class Witness(Operator):
    """An operator who also sees a simulated robot's true motion."""

    def _subscribe(self) -> None:
        super()._subscribe()
        self._poses: list[tuple[float, float, float]] = []
        self._node.create_subscription(
            Odometry,
            "ground_truth",
            lambda message: self._poses.append(read_whole_pose(message)),
            qos.SENSOR_RELIABLE,
        )

    @property
    def path(self) -> NDArray[np.float64]:
        """All poses so far (T, 3)."""
        return np.array(self._poses).reshape(-1, 3)

    def sees(self, timeout_s: float) -> bool:
        """Wait for a first pose; return False after `timeout_s`."""
        return holds(lambda: self._poses, timeout_s, POLL_S)

    def arrives(self, goal: Sequence[float], radius: float, timeout_s: float) -> bool:
        """Wait until the robot is within `radius` of a goal (2,); False after `timeout_s`."""

        def is_there() -> bool:
            return bool(self._poses) and math.dist(self._poses[-1][:2], goal) < radius

        return holds(is_there, timeout_s, POLL_S)

    def touched(self, simulator: str, timeout_s: float) -> bool:
        """True if the simulated robot touched something in this episode. Raises BackendError."""
        service = f"{simulator}/self_test"
        try:
            response = self._spun.call_service(
                SelfTest, service, timeout_s, retry_period_s=REPLY_S
            )
        except TimeoutError as error:
            raise BackendError(f"the episode can't be judged: {error}.") from None
        return not any(response.passed)
