"""The test's own end of the topics: a node in a context of its own."""

import itertools
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from diagnostic_msgs.srv import SelfTest
from nav_msgs.msg import Odometry
from numpy.typing import ArrayLike
from rcl_interfaces.srv import GetParameters, SetParametersAtomically
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter

from nics_drl_bridge.nodes import conversions, qos
from nics_drl_bridge.nodes.listener import open_context

DEADLINE_S = 90.0
# Fast DDS drops an answer whose client the server has not discovered within 0.1 s.
ANSWERED_S = 15.0
NUMBERS = itertools.count()


class Peer:
    """Listens, speaks and calls; spins in place, only ever until something is the case."""

    def __init__(self, domain_id: int, namespace: str = "") -> None:
        self.context = open_context(domain_id=domain_id)
        self.node = Node(
            f"peer_{next(NUMBERS)}",
            namespace=namespace,
            context=self.context,
            start_parameter_services=False,
        )
        self._executor = SingleThreadedExecutor(context=self.context)
        self._executor.add_node(self.node)

    def until(
        self, condition: Callable[[], Any], what: str, deadline_s: float = DEADLINE_S
    ) -> float:
        """Spins until a condition holds; returns how long that took [s]."""
        began = time.monotonic()
        while not condition():
            assert time.monotonic() - began < deadline_s, (
                f"not within {deadline_s} s: {what}"
            )
            self._executor.spin_once(timeout_sec=0.05)
        return time.monotonic() - began

    def within(self, seconds: float, condition: Callable[[], Any]) -> bool:
        """Spins until a condition holds, or the time is over; returns whether it holds."""
        deadline = time.monotonic() + seconds
        while not condition() and time.monotonic() < deadline:
            self._executor.spin_once(timeout_sec=0.05)
        return bool(condition())

    def another(self, messages: list[Any], what: str) -> Any:
        """The next message in a list that `listen` gave."""
        known = len(messages)
        self.until(lambda: len(messages) > known, f"another {what}")
        return messages[-1]

    def listen(
        self, kind: Any, topic: str, quality: Any = qos.SENSOR_RELIABLE
    ) -> list[Any]:
        """A list that each message of a topic is appended to."""
        received: list[Any] = []
        self.node.create_subscription(kind, topic, received.append, quality)
        return received

    def speak(
        self, kind: Any, topic: str, subscribers: int = 1, quality: Any = qos.COMMAND
    ) -> Any:
        """A publisher that the given number of subscribers have found."""
        publisher = self.node.create_publisher(kind, topic, quality)
        self.until(
            lambda: publisher.get_subscription_count() >= subscribers,
            f"a subscriber of {topic}",
        )
        return publisher

    def call(
        self,
        kind: Any,
        service: str,
        request: Any = None,
        times: int = 6,
        each_s: float = ANSWERED_S,
    ) -> Any:
        """The answer of a service, which is asked again where none comes."""
        client = self.node.create_client(kind, service)
        self.until(client.service_is_ready, f"the service {service}")
        futures: list[Any] = []

        def answered() -> list[Any]:
            return [future.result() for future in futures if future.done()]

        for _ in range(times):
            futures.append(
                client.call_async(kind.Request() if request is None else request)
            )
            if self.within(each_s, answered):
                break
        assert answered(), (
            f"not within {times} times {each_s} s: an answer of {service}"
        )
        self.node.destroy_client(client)
        return answered()[0]

    def read_episode(self, simulator: str = "simulator_node") -> dict[str, str]:
        """What a simulator tells of the present episode."""
        (status,) = self.call(SelfTest, f"{simulator}/self_test").status
        return {pair.key: pair.value for pair in status.values}

    def be_known_to(self, node: str) -> None:
        """Waits until a node knows all that listens here: its answer shows that it does.

        Listeners are announced in order, and the one of the answer is the last.
        """
        self.call(GetParameters, f"{node}/get_parameters")

    def set_parameters(self, node: str, **values: Any) -> Any:
        """What a node says to new values of its parameters."""
        request = SetParametersAtomically.Request()
        request.parameters = [
            Parameter(name, value=value).to_parameter_msg()
            for name, value in values.items()
        ]
        return self.call(
            SetParametersAtomically, f"{node}/set_parameters_atomically", request
        ).result

    def close(self) -> None:
        self._executor.shutdown(timeout_sec=1.0)
        self.node.destroy_node()
        self.context.try_shutdown()


def stamp_ns(message: Any) -> int:
    return conversions.stamp_from_ros(message.header.stamp)


def pose_of(odometry: Odometry) -> np.ndarray:
    """The pose (3,) of an odometry."""
    return conversions.odometry_from_ros(odometry)[0]


def odometry(
    stamp: int, pose: ArrayLike = (0.0, 0.0, 0.0), twist: ArrayLike = (0.0, 0.0, 0.0)
) -> Odometry:
    """An odometry of a robot, at rest at its origin unless said otherwise."""
    frames = ("odom", "base_link")
    return conversions.odometry_to_ros(pose, twist, stamp, frames, (1e-4,) * 4)
