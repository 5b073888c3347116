"""Witness: observes the true motion of a simulated robot from outside.

Start of episodes in a simulator behind services.
"""

from __future__ import annotations

import json
import threading
import time
from contextlib import AbstractContextManager
from typing import Any

import numpy as np
from nav_msgs.msg import Odometry
from numpy.typing import ArrayLike, NDArray
from rcl_interfaces.srv import SetParametersAtomically
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from std_srvs.srv import Trigger

from nics_drl_bridge.errors import BackendError, ModelError
from nics_drl_bridge.generator import SimulatorModel
from nics_drl_bridge.interface import Start
from nics_drl_bridge.nodes import conversions, qos
from nics_drl_bridge.nodes.link import Link
from nics_drl_bridge.nodes.runner import open_context
from nics_drl_bridge.sim.world import World

ASK_AGAIN_S = 0.2
ANSWER_S = 2.0


class Witness(AbstractContextManager["Witness", None]):
    """Collects `ground_truth` in its own thread; a context manager.

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
        """All poses so far (T, 3)."""
        with self._changed:
            return np.array(self._poses).reshape(-1, 3)

    def sees(self, timeout_s: float) -> bool:
        """Waits for a first pose; False after the time [s]."""
        with self._changed:
            return self._changed.wait_for(lambda: bool(self._poses), timeout_s)

    def arrives(self, goal: ArrayLike, radius: float, timeout_s: float) -> bool:
        """Waits until the robot is within `radius` of a goal (2,); False after the time [s]."""
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
        """Requests a gate to let commands pass, repeatedly until it does.

        Args:
            gate: name of the node.
            timeout_s: longest time to try [s].

        Returns:
            An empty string, or the gate's last reason to refuse.
        """
        answer = self._asked(f"{gate}/arm", timeout_s)
        return "" if answer.success else str(answer.message)

    def touched(self, simulator: str, timeout_s: float) -> bool:
        """Asks a simulator whether its robot has truly touched something in this episode.

        Args:
            simulator: name of the node.
            timeout_s: longest time to try [s].

        Raises:
            BackendError: it does not answer.
        """
        answer = self._asked(f"{simulator}/touched", timeout_s)
        if not answer.success:
            raise BackendError(f"the episode can't be judged: {answer.message}.")
        return bool(np.any(json.loads(answer.message)))

    def _asked(self, service: str, timeout_s: float) -> Trigger.Response:
        """Returns the first successful answer, otherwise the last one."""
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


LOST_S = 1.0


class EpisodeServices:
    """The services of a simulator node that begin an episode.

    Args:
        link: for the calls.
        simulator: name of the node.
        model: that it must run.
        world: likewise.
    """

    def __init__(self, link: Link, simulator: str, model: SimulatorModel, world: World) -> None:
        self._link = link
        self._identity = {"model": model.fingerprint, "world": world.fingerprint}
        self._parameters = link.node.create_client(
            SetParametersAtomically, f"{simulator}/set_parameters_atomically"
        )
        self._reset = link.node.create_client(Trigger, f"{simulator}/reset")
        self._repeat = link.node.create_client(Trigger, f"{simulator}/repeat")
        self._repeating: Any = None
        self._asked_s = 0.0
        self.clients = [self._reset, self._parameters]

    @property
    def there(self) -> bool:
        """True if a simulator offers them."""
        return all(client.service_is_ready() for client in self.clients)

    def choose(self, start: Start, timeout_s: float) -> None:
        """Chooses the episode for the next `begin`. Raises BackendError if it is refused."""
        request = SetParametersAtomically.Request()
        request.parameters = [
            Parameter("episode_seed", value=int(start.seed)).to_parameter_msg(),
            Parameter("episode_start", value=start.pose.ravel().tolist()).to_parameter_msg(),
            Parameter("episode_start_given", value=True).to_parameter_msg(),
        ]
        result = self._link.call(self._parameters, request, timeout_s).result
        if not result.successful:
            raise BackendError(f"the simulator refused the episode: {result.reason}")

    def repeat(self) -> None:
        """Requests the present data again, without waiting; not while the last request is pending.

        A request that stays unanswered was itself lost, and is dropped.
        """
        now, asked = time.monotonic(), self._repeating
        if asked is not None and not asked.done():
            if now - self._asked_s < LOST_S:
                return
            self._repeat.remove_pending_request(asked)
        if self._repeat.service_is_ready():
            self._repeating, self._asked_s = self._repeat.call_async(Trigger.Request()), now

    def begin(self, timeout_s: float) -> int:
        """Begins the chosen episode; returns the stamp of its first data [ns].

        Raises:
            BackendError: the simulator refuses, or does not answer.
            ModelError: it runs another model or world.
        """
        response = self._link.call(self._reset, Trigger.Request(), timeout_s)
        if not response.success:
            raise BackendError(f"the simulator could not reset: {response.message}")
        answer: dict[str, Any] = json.loads(response.message)
        for key, mine in self._identity.items():
            if answer.get(key) != mine:
                raise ModelError(
                    f"the simulator runs the {key} {answer.get(key)!r}, this env {mine!r}; start "
                    f"both with the same {key}."
                )
        return int(answer["stamp_ns"])
