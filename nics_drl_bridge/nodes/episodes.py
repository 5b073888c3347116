"""Beginning an episode in a simulator behind services."""

from __future__ import annotations

import json
import time
from typing import Any

from rcl_interfaces.srv import SetParametersAtomically
from rclpy.parameter import Parameter
from std_srvs.srv import Trigger

from nics_drl_bridge.errors import BackendError, ModelError
from nics_drl_bridge.generator import SimulatorModel
from nics_drl_bridge.interface import Start
from nics_drl_bridge.nodes.link import Link
from nics_drl_bridge.sim.world import World

LOST_S = 1.0


class Episodes:
    """The services of a simulator node by which an episode begins.

    Args:
        link: to call by.
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
        """Whether a simulator offers them."""
        return all(client.service_is_ready() for client in self.clients)

    def choose(self, start: Start, timeout_s: float) -> None:
        """Says which episode the next `begin` begins. Raises BackendError if it is refused."""
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
        """Asks for the present data again, without waiting; not while the last asking goes on.

        An asking that gets no answer for long was lost itself, and is given up.
        """
        now, asked = time.monotonic(), self._repeating
        if asked is not None and not asked.done():
            if now - self._asked_s < LOST_S:
                return
            self._repeat.remove_pending_request(asked)
        if self._repeat.service_is_ready():
            self._repeating, self._asked_s = self._repeat.call_async(Trigger.Request()), now

    def begin(self, timeout_s: float) -> int:
        """Begins the chosen episode; the stamp of its first data [ns].

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
