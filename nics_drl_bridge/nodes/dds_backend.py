"""DdsBackend: the robot behind ROS 2 topics, as the same synchronous backend."""

from __future__ import annotations

import json
import math
import threading
import time
import weakref
from collections.abc import Callable
from typing import Any

import numpy as np
from geometry_msgs.msg import Twist
from nav_msgs.msg import Odometry
from numpy.typing import NDArray
from rcl_interfaces.srv import SetParametersAtomically
from rclpy.context import Context
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from sensor_msgs.msg import LaserScan
from std_srvs.srv import Trigger

from nics_drl_bridge.errors import BackendError, ModelError, StaleDataError
from nics_drl_bridge.generator import SimulatorModel
from nics_drl_bridge.interface import RobotView, Start
from nics_drl_bridge.middleware.view import Middleware
from nics_drl_bridge.nodes import conversions, qos
from nics_drl_bridge.sim.world import World

Array = NDArray[np.float64]
SCAN, ODOM, TRUTH = "scan", "odom", "ground_truth"
POLL_S = 0.002


class _Mailbox:
    """The newest message of each topic, handed from the executor's thread to the caller's."""

    def __init__(self) -> None:
        self._messages: dict[str, Any] = {}
        self._changed = threading.Condition()

    def put(self, topic: str, message: Any) -> None:
        with self._changed:
            self._messages[topic] = message
            self._changed.notify_all()

    def stamp_ns(self, topic: str) -> int:
        """Of the newest message; -1 when there is none. Called with the lock held."""
        message = self._messages.get(topic)
        return -1 if message is None else conversions.stamp_from_ros(message.header.stamp)

    def wait(self, topics: tuple[str, ...], stamp_ns: int, timeout_s: float) -> dict[str, Any]:
        """The messages once each is at least as new as a stamp. Raises StaleDataError."""
        deadline = time.monotonic() + timeout_s
        with self._changed:
            for topic in topics:
                while self.stamp_ns(topic) < stamp_ns:
                    if not self._changed.wait(max(0.0, deadline - time.monotonic())) and (
                        time.monotonic() >= deadline
                    ):
                        newest = self.stamp_ns(topic)
                        age = math.inf if newest < 0 else (stamp_ns - newest) / conversions.NANO
                        raise StaleDataError(topic, age, timeout_s)
            return dict(self._messages)


class DdsBackend:
    """One robot behind `cmd_vel`, `scan` and `odom`, in lock-step with a simulator node.

    Each step publishes one command and returns exactly the data that are stamped one control
    period later. A node of its own in a context of its own listens in one executor thread;
    nothing spins inside `step`. `close`, an exception and garbage collection leave a zero
    command behind.

    Args:
        model: must be the one that the simulator node runs.
        world: likewise.
        namespace: of the robot.
        simulator: name of the simulator's node in that namespace.
        timeout_s: how long to wait for a peer or an answer [s].
        truth: whether to wait for `ground_truth` too, and put the true pose into `info`.
        domain_id: DDS domain; the environment's by default.

    Raises:
        BackendError: no simulator is there.
    """

    def __init__(
        self,
        model: SimulatorModel,
        world: World,
        namespace: str = "",
        simulator: str = "simulator_node",
        timeout_s: float = 30.0,
        truth: bool = False,
        domain_id: int | None = None,
    ) -> None:
        self._robot, self._identity = model.robot, {"model": model.fingerprint, "world": world.name}
        self._middleware = Middleware(model)
        self._period_ns = round(model.control_period * conversions.NANO)
        self._timeout_s, self._topics = timeout_s, (ODOM, SCAN, *((TRUTH,) if truth else ()))
        self._now_ns, self._mail = 0, _Mailbox()
        context = Context()
        context.init(domain_id=domain_id)
        node = Node(
            "bridge_env", namespace=namespace, context=context, start_parameter_services=False
        )
        self._node = node
        types = {SCAN: LaserScan, ODOM: Odometry, TRUTH: Odometry}
        for topic in self._topics:
            node.create_subscription(
                types[topic], topic, _putter(self._mail, topic), qos.SENSOR_RELIABLE
            )
        self._commands = node.create_publisher(Twist, "cmd_vel", qos.COMMAND)
        self._reset = node.create_client(Trigger, f"{simulator}/reset")
        self._parameters = node.create_client(
            SetParametersAtomically, f"{simulator}/set_parameters_atomically"
        )
        thread = threading.Thread(
            target=_spin, args=(context, node), daemon=True, name="dds_backend"
        )
        thread.start()
        self._closing = weakref.finalize(self, _shut_down, context, node, self._commands, thread)
        self._wait_for_peers()

    def _wait_for_peers(self) -> None:
        """Waits until every end is matched. Raises BackendError with what is missing."""
        resolve = self._node.resolve_topic_name
        needed: dict[str, Callable[[], bool]] = {
            f"a subscriber of {resolve('cmd_vel')}": lambda: (
                self._commands.get_subscription_count() > 0
            ),
            **{
                f"a publisher of {resolve(topic)}": lambda topic=topic: (  # type: ignore[misc]
                    self._node.count_publishers(resolve(topic)) > 0
                )
                for topic in self._topics
            },
            f"the service {self._reset.srv_name}": self._reset.service_is_ready,
            f"the service {self._parameters.srv_name}": self._parameters.service_is_ready,
        }
        deadline = time.monotonic() + self._timeout_s
        while missing := [name for name, there in needed.items() if not there()]:
            if time.monotonic() > deadline:
                raise BackendError(
                    f"after {self._timeout_s:g} s there is still no {' and no '.join(missing)}; "
                    "start `simulator_node` with mode:=lockstep in the same ROS_DOMAIN_ID and "
                    "namespace."
                )
            time.sleep(POLL_S)

    def reset(self, start: Start) -> RobotView:
        """Begins the episode of a seed in the simulator; see `interface.Backend`."""
        request = SetParametersAtomically.Request()
        request.parameters = [
            Parameter("episode_seed", value=int(start.seed)).to_parameter_msg(),
            Parameter("episode_start", value=[float(v) for v in start.pose]).to_parameter_msg(),
            Parameter("episode_start_given", value=True).to_parameter_msg(),
        ]
        result = self._call(self._parameters, request).result
        if not result.successful:
            raise BackendError(f"the simulator refused the episode: {result.reason}")
        response = self._call(self._reset, Trigger.Request())
        if not response.success:
            raise BackendError(f"the simulator could not reset: {response.message}")
        answer = json.loads(response.message)
        self._check_identity(answer)
        self._now_ns = int(answer["stamp_ns"])
        self._middleware.reset(self._now_ns, start.pose)
        return self._measure()[0]

    def _check_identity(self, answer: dict[str, Any]) -> None:
        for key, mine in self._identity.items():
            if answer.get(key) != mine:
                raise ModelError(
                    f"the simulator runs the {key} {answer.get(key)!r}, this env {mine!r}; start "
                    f"both with the same {key}."
                )

    def _call(self, client: Any, request: Any) -> Any:
        """Calls a service; the executor's thread completes the future."""
        done = threading.Event()
        future = client.call_async(request)
        future.add_done_callback(lambda _: done.set())
        if not done.wait(self._timeout_s):
            client.remove_pending_request(future)
            raise BackendError(
                f"service {client.srv_name}: no answer within {self._timeout_s:g} s; look at the "
                "simulator node's log."
            )
        return future.result()

    def step(self, command: Array) -> tuple[RobotView, dict[str, Any]]:
        """Publishes a command and waits for the data after it; see `interface.Backend`."""
        twist = self._robot.to_cmd_vel(command)
        self._middleware.command(self._now_ns, self._robot.from_cmd_vel(twist))
        self._commands.publish(conversions.twist_to_ros(twist))
        self._now_ns += self._period_ns
        return self._measure()

    def _measure(self) -> tuple[RobotView, dict[str, Any]]:
        """The view at the present stamp. Raises BackendError when the data are of another one."""
        now = self._now_ns
        messages = self._mail.wait(self._topics, now, self._timeout_s)
        for topic in self._topics:
            off_ns = conversions.stamp_from_ros(messages[topic].header.stamp) - now
            if off_ns != 0:
                raise BackendError(
                    f"topic {topic!r}: stamped {off_ns / conversions.NANO:+.3f} s off the step; is "
                    "somebody else publishing cmd_vel, or the simulator not in lock-step?"
                )
        arrival = time.monotonic_ns()
        pose, twist = conversions.odometry_from_ros(messages[ODOM])
        self._middleware.odometry(now, arrival, pose, twist)
        self._middleware.scan(now, arrival, conversions.scan_from_ros(messages[SCAN]))
        facts: dict[str, Any] = {"stamp_ns": now}
        if TRUTH in self._topics:
            facts["true_pose"] = conversions.odometry_from_ros(messages[TRUTH])[0]
        return self._middleware.view(now), facts

    def close(self) -> None:
        """Publishes a zero command and ends the node."""
        self._closing()


def _putter(mail: _Mailbox, topic: str) -> Callable[[Any], None]:
    return lambda message: mail.put(topic, message)


def _spin(context: Context, node: Node) -> None:
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    try:
        while context.ok():
            executor.spin_once(timeout_sec=0.2)
    except ExternalShutdownException:
        pass
    finally:
        executor.shutdown(timeout_sec=1.0)


def _shut_down(context: Context, node: Node, commands: Any, thread: threading.Thread) -> None:
    """Leaves a zero command behind and frees the node; knows nothing of the backend object."""
    if context.ok():
        commands.publish(Twist())
        context.shutdown()
    thread.join(timeout=2.0)
    node.destroy_node()
