"""Witness: watches where a simulated robot really goes, from outside."""

from __future__ import annotations

import json
import threading
import time
from contextlib import AbstractContextManager

import numpy as np
from nav_msgs.msg import Odometry
from numpy.typing import ArrayLike, NDArray
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from std_srvs.srv import Trigger

from nics_drl_bridge.errors import BackendError
from nics_drl_bridge.nodes import conversions, qos
from nics_drl_bridge.nodes.runner import open_context

ASK_AGAIN_S = 0.2
ANSWER_S = 2.0


class Witness(AbstractContextManager["Witness", None]):
    """Collects `ground_truth` in a thread of its own; a context manager.

    Args:
        domain_id: DDS domain.
        topic: of the true poses.
    """

    def __init__(self, domain_id: int | None = None, topic: str = "ground_truth") -> None:
        self._poses: list[NDArray[np.float64]] = []
        self._changed = threading.Condition()
        self._context = open_context(domain_id=domain_id)
        self._node = Node("witness", context=self._context, start_parameter_services=False)
        self._node.create_subscription(Odometry, topic, self._take, qos.SENSOR_RELIABLE)
        self._thread = threading.Thread(target=self._spin, daemon=True, name="witness")
        self._thread.start()

    def _take(self, message: Odometry) -> None:
        with self._changed:
            self._poses.append(conversions.odometry_from_ros(message)[0])
            self._changed.notify_all()

    def _spin(self) -> None:
        executor = SingleThreadedExecutor(context=self._context)
        executor.add_node(self._node)
        try:
            while self._context.ok():
                executor.spin_once(timeout_sec=0.2)
        except ExternalShutdownException:
            pass
        finally:
            executor.shutdown(timeout_sec=1.0)

    @property
    def path(self) -> NDArray[np.float64]:
        """(T, 3) all poses so far."""
        with self._changed:
            return np.array(self._poses).reshape(-1, 3)

    def sees(self, timeout_s: float) -> bool:
        """Waits for a first pose; False after the time."""
        with self._changed:
            return self._changed.wait_for(lambda: bool(self._poses), timeout_s)

    def arrives(self, goal: ArrayLike, radius: float, timeout_s: float) -> bool:
        """Waits until the robot has been within `radius` of a goal (2,); False after the time."""
        deadline = time.monotonic() + timeout_s
        goal = np.asarray(goal)
        with self._changed:
            while True:
                if self._poses and np.linalg.norm(self._poses[-1][:2] - goal) < radius:
                    return True
                if time.monotonic() > deadline:
                    return False
                self._changed.wait(0.2)

    def arms(self, gate: str, timeout_s: float) -> str:
        """Asks a gate to let commands pass, again and again until it does.

        Args:
            gate: name of the node.
            timeout_s: for how long [s].

        Returns:
            Nothing, or the gate's last reason not to.
        """
        answer = self._asked(f"{gate}/arm", timeout_s)
        return "" if answer.success else str(answer.message)

    def touched(self, simulator: str, timeout_s: float) -> bool:
        """Asks a simulator whether its robot has truly touched something in this episode.

        Args:
            simulator: name of the node.
            timeout_s: for how long [s].

        Raises:
            BackendError: it does not answer.
        """
        answer = self._asked(f"{simulator}/touched", timeout_s)
        if not answer.success:
            raise BackendError(f"the episode can't be judged: {answer.message}.")
        return bool(np.any(json.loads(answer.message)))

    def _asked(self, service: str, timeout_s: float) -> Trigger.Response:
        """The first answer that is a success, else the last one."""
        client = self._node.create_client(Trigger, service)
        answer = Trigger.Response(success=False, message=f"{service} does not answer")
        deadline = time.monotonic() + timeout_s
        while time.monotonic() < deadline:
            if client.wait_for_service(timeout_sec=ASK_AGAIN_S):
                answered = threading.Event()
                future = client.call_async(Trigger.Request())
                future.add_done_callback(lambda _, answered=answered: answered.set())
                if answered.wait(ANSWER_S):
                    answer = future.result()
                    if answer.success:
                        break
            threading.Event().wait(ASK_AGAIN_S)
        self._node.destroy_client(client)
        return answer

    def __exit__(self, *_: object) -> None:
        self._context.try_shutdown()
        self._thread.join(timeout=2.0)
        self._node.destroy_node()
