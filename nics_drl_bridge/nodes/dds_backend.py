"""DdsBackend: the robot behind ROS 2 topics, as the same synchronous backend."""

from __future__ import annotations

import contextlib
import json
import math
import threading
import time
import weakref
from collections.abc import Callable, Iterator
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
from nics_drl_bridge.nodes.runner import last_word, open_context
from nics_drl_bridge.sim.world import World

Array = NDArray[np.float64]
SCAN, ODOM, TRUTH = "scan", "odom", "ground_truth"
POLL_S = 0.002
RESET_PATIENCE_S = 1.0


class _Mailbox:
    """The newest message of each topic, handed from the executor's thread to the caller's."""

    def __init__(self) -> None:
        self._messages: dict[str, Any] = {}
        self._arrivals: dict[str, float] = {}
        self._changed = threading.Condition()

    def put(self, topic: str, message: Any) -> None:
        with self._changed:
            self._messages[topic], self._arrivals[topic] = message, time.monotonic()
            self._changed.notify_all()

    def stamp_ns(self, topic: str) -> int:
        """Of the newest message; -1 when there is none."""
        message = self._messages.get(topic)
        return -1 if message is None else conversions.stamp_from_ros(message.header.stamp)

    def age_s(self, topic: str) -> float:
        """Seconds since the newest message arrived; inf when there is none."""
        return time.monotonic() - self._arrivals.get(topic, -math.inf)

    def wait(self, topics: tuple[str, ...], stamp_ns: int, timeout_s: float) -> dict[str, Any]:
        """The messages once each is at least as new as a stamp. Raises StaleDataError."""
        deadline = time.monotonic() + timeout_s
        with self._changed:
            for topic in topics:
                if not self._changed.wait_for(
                    lambda topic=topic: self.stamp_ns(topic) >= stamp_ns,  # type: ignore[misc]
                    max(0.0, deadline - time.monotonic()),
                ):
                    raise StaleDataError(topic, self.age_s(topic), timeout_s)
            return dict(self._messages)


class DdsBackend:
    """One robot behind `cmd_vel`, `scan` and `odom`, in lock-step with a simulator node.

    Each step publishes one command and returns exactly the data that are stamped one control
    period later. A node of its own in a context of its own listens in one executor thread;
    nothing spins inside `step`. `close`, an error in `step` and garbage collection leave a zero
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
        self._robot, self._lidar = model.robot, model.lidar
        self._identity = {"model": model.fingerprint, "world": world.fingerprint}
        self._middleware = Middleware(model)
        self._period_ns = round(model.control_period * conversions.NANO)
        self._timeout_s, self._topics = timeout_s, (ODOM, SCAN, *((TRUTH,) if truth else ()))
        self._now_ns, self._mail = 0, _Mailbox()
        context = open_context(domain_id=domain_id)
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
        self._closing = weakref.finalize(self, _shut_down, context, self._commands, thread)
        try:
            self._wait_for_peers()
        except BaseException:
            self.close()
            raise

    def _wait_for_peers(self) -> None:
        """Waits until every end is matched. Raises BackendError with what is missing."""
        resolve, service = self._node.resolve_topic_name, self._node.resolve_service_name
        needed: dict[str, Callable[[], bool]] = {
            f"subscriber of {resolve('cmd_vel')}": lambda: (
                self._commands.get_subscription_count() > 0
            ),
            **{
                f"publisher of {resolve(topic)}": lambda topic=topic: (  # type: ignore[misc]
                    self._node.count_publishers(resolve(topic)) > 0
                )
                for topic in self._topics
            },
            f"service {service(self._reset.srv_name)}": self._reset.service_is_ready,
            f"service {service(self._parameters.srv_name)}": self._parameters.service_is_ready,
        }
        deadline = time.monotonic() + self._timeout_s
        while missing := [name for name, there in needed.items() if not there()]:
            if time.monotonic() > deadline:
                raise BackendError(
                    f"after {self._timeout_s:g} s there is still no {', no '.join(missing)}; "
                    "start `simulator_node` with mode:=lockstep in the same ROS_DOMAIN_ID and "
                    "namespace."
                )
            time.sleep(POLL_S)
        # Somebody who was killed stays in the graph for a while.
        while self._others_command() and time.monotonic() < deadline:
            time.sleep(POLL_S)
        self._check_alone()

    def reset(self, start: Start) -> RobotView:
        """Begins the episode of a seed in the simulator; see `interface.Backend`.

        Raises:
            BackendError: the simulator refuses, or does not answer.
            ModelError: it runs another model or world.
            StaleDataError: its data do not arrive.
        """
        self._check_open()
        request = SetParametersAtomically.Request()
        request.parameters = [
            Parameter("episode_seed", value=int(start.seed)).to_parameter_msg(),
            Parameter("episode_start", value=[float(v) for v in start.pose]).to_parameter_msg(),
            Parameter("episode_start_given", value=True).to_parameter_msg(),
        ]
        result = self._call(self._parameters, request).result
        if not result.successful:
            raise BackendError(f"the simulator refused the episode: {result.reason}")
        deadline = time.monotonic() + self._timeout_s
        while True:
            patience_s = min(RESET_PATIENCE_S, max(0.0, deadline - time.monotonic()))
            self._begin(start)
            try:
                return self._measure(patience_s)[0]
            except StaleDataError as error:
                # The simulator may not have discovered our subscription yet, and what it sends
                # before that is lost: begin the same episode again.
                if time.monotonic() >= deadline:
                    raise StaleDataError(error.topic, error.age_s, self._timeout_s) from None

    def _begin(self, start: Start) -> None:
        response = self._call(self._reset, Trigger.Request())
        if not response.success:
            raise BackendError(f"the simulator could not reset: {response.message}")
        answer = json.loads(response.message)
        self._check_identity(answer)
        self._now_ns = int(answer["stamp_ns"])
        self._middleware.reset(self._now_ns, start.pose)

    def _check_open(self) -> None:
        if not self._closing.alive:
            raise BackendError("this backend is closed; make another one.")

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
        """Publishes a command and waits for the data after it; see `interface.Backend`.

        Raises:
            BackendError: somebody else moved the simulator, or it is not in lock-step.
            StaleDataError: the data do not arrive.
        """
        self.send(command)
        return self.receive()

    def send(self, command: Array) -> None:
        """The first half of a step: checks and publishes a command (C,)."""
        self._check_open()
        with self._zero_after_an_error():
            self._check_alone()
            # Data that are there before the command would be taken for its answer.
            self._check_stamps({topic: self._mail.stamp_ns(topic) for topic in self._topics})
            twist = self._robot.to_cmd_vel(command)
            self._middleware.command(self._now_ns, self._robot.from_cmd_vel(twist))
            self._commands.publish(conversions.twist_to_ros(twist))
            self._now_ns += self._period_ns

    def receive(self) -> tuple[RobotView, dict[str, Any]]:
        """The second half: waits for the data after the command, and for `info` about them."""
        with self._zero_after_an_error():
            return self._measure(self._timeout_s)

    @contextlib.contextmanager
    def _zero_after_an_error(self) -> Iterator[None]:
        try:
            yield
        except BaseException:
            self._commands.publish(Twist())
            raise

    def _check_stamps(self, stamps: dict[str, int]) -> None:
        """Raises BackendError when data are not stamped with the present step."""
        for topic, stamp in stamps.items():
            if stamp != self._now_ns:
                off_s = (stamp - self._now_ns) / conversions.NANO
                raise BackendError(
                    f"topic {topic!r}: stamped {off_s:+.3f} s off the step; start the simulator "
                    "with mode:=lockstep, and move it from here alone."
                )

    def _others_command(self) -> bool:
        return bool(self._node.count_publishers(self._commands.topic_name) > 1)

    def _check_alone(self) -> None:
        """Raises BackendError when somebody else publishes commands too.

        Each of theirs would move the simulator, and every answer after it would be to an older
        command than ours.
        """
        if self._others_command():
            topic = self._commands.topic_name
            ends = self._node.get_publishers_info_by_topic(topic)
            names = sorted(f"{end.node_namespace.rstrip('/')}/{end.node_name}" for end in ends)
            with contextlib.suppress(ValueError):
                names.remove(self._node.get_fully_qualified_name())
            # A node's name travels apart from its publishers, and may not be here yet.
            known = [name for name in names if "_UNKNOWN_" not in name]
            who = ", ".join(known) or "somebody"
            raise BackendError(f"{who} publishes {topic} too; stop it.")

    def _measure(self, timeout_s: float) -> tuple[RobotView, dict[str, Any]]:
        """The view at the present stamp. Raises BackendError when the data are of another one."""
        now = self._now_ns
        messages = self._mail.wait(self._topics, now, timeout_s)
        self._check_alone()
        self._check_stamps(
            {t: conversions.stamp_from_ros(messages[t].header.stamp) for t in self._topics}
        )
        arrival = time.monotonic_ns()
        pose, twist = conversions.odometry_from_ros(messages[ODOM])
        self._middleware.odometry(now, arrival, pose, twist)
        self._middleware.scan(now, arrival, conversions.scan_from_ros(self._lidar, messages[SCAN]))
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
        node.destroy_node()


def _shut_down(context: Context, commands: Any, thread: threading.Thread) -> None:
    """Leaves a zero command behind and ends the thread; knows nothing of the backend object."""
    if context.ok():
        last_word(commands, Twist())
        context.try_shutdown()
    # Garbage may be collected in any thread, also in that one.
    if thread is not threading.current_thread():
        thread.join(timeout=2.0)
