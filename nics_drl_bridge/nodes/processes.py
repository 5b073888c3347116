"""Processes of the package's nodes with a reliable end, and a witness of what they do."""

import os
import random
import time
from collections.abc import Mapping
from contextlib import AbstractContextManager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from diagnostic_msgs.srv import SelfTest
from nav_msgs.msg import Odometry
from numpy.typing import ArrayLike, NDArray

from nics_drl_bridge.config import PACKAGE
from nics_drl_bridge.errors import BackendError, ConfigError
from nics_drl_bridge.nodes import conversions, qos
from nics_drl_bridge.nodes.listener import (
    GREATEST_DOMAIN_ID,
    Listener,
    ask,
    holds,
)
from nics_drl_bridge.nodes.node_process import ChildProcess, make_command
from nics_drl_bridge.nodes.operator import Call, TriggerAnswer, ask_until_granted
from nics_drl_bridge.nodes.starting import NodeStart
from nics_drl_bridge.nodes.transport import find_used_domains

LAST_DOMAIN_ID = 101  # above it DDS ports may collide with Linux's ephemeral ports
LOG_LINES = 5
REPLY_S = 2.0  # longest wait for one answer before asking again [s]
POLL_S = 0.005


def free_domain_id() -> int:
    """Return the environment's domain id, or a random unused one. ConfigError if it is invalid."""
    variable = os.environ.get("ROS_DOMAIN_ID")
    if not variable:
        return unused_domain_id()
    if not variable.isdecimal() or int(variable) > GREATEST_DOMAIN_ID:
        fix = f"it must be a number from 0 to {GREATEST_DOMAIN_ID}, or unset."
        raise ConfigError(
            f"the environment variable ROS_DOMAIN_ID is {variable!r}; {fix}"
        )
    return int(variable)


def unused_domain_id() -> int:
    """Return a random domain id that nobody on this machine uses, unless all are used."""
    every = range(1, LAST_DOMAIN_ID + 1)
    own = {
        int(word) for word in [os.environ.get("ROS_DOMAIN_ID", "0")] if word.isdecimal()
    }
    unused = set(every) - find_used_domains() - own
    return random.SystemRandom().choice(sorted(unused) or every)


class NodeProcess(ChildProcess):
    """One of the package's nodes in its own process, with its output in a file."""

    def __init__(
        self,
        node: str,
        folder: Path,
        parameters: Mapping[str, Any],
        domain_id: int,
        namespace: str = "",
        remap: Mapping[str, str] | None = None,
        discovery: str = "LOCALHOST",
    ) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self.node = node
        self.log = folder / f"{node}.log"
        rules = list((remap or {}).items())
        start = NodeStart(
            PACKAGE, node, namespace.strip("/"), parameters, remappings=rules
        )
        chosen = {
            "ROS_DOMAIN_ID": str(domain_id),
            "ROS_AUTOMATIC_DISCOVERY_RANGE": discovery,
        }
        super().__init__(node, make_command(start, folder), chosen, self.log)

    def check(self) -> None:
        """Raise BackendError with the end of its log if the node has ended by itself."""
        code = self.poll()
        if code is not None:
            lines = (
                self.log.read_text(encoding="utf-8", errors="replace")
                .strip()
                .splitlines()
            )
            shown = [line for line in lines if not line.startswith("[INFO]")] or lines
            last = " | ".join(shown[-LOG_LINES:]) or "no output"
            reason = f"ended with code {code}: {last} (its log is {self.log})."
            raise BackendError(f"{self.node} {reason}")


class Witness(AbstractContextManager["Witness", None]):
    """Context manager that observes a simulated robot's true motion in its own thread."""

    def __init__(self, domain_id: int | None = None) -> None:
        self._poses: list[NDArray[np.float64]] = []
        self._node = Listener("witness", domain_id)
        self._node.create_subscription(
            Odometry, "ground_truth", self._take, qos.SENSOR_RELIABLE
        )
        self._node.start()

    def _take(self, message: Odometry) -> None:
        self._poses.append(conversions.odometry_from_ros(message)[0])

    @property
    def path(self) -> NDArray[np.float64]:
        """All poses so far (T, 3)."""
        return np.array(self._poses).reshape(-1, 3)

    def sees(self, timeout_s: float) -> bool:
        """Wait for a first pose; return False after `timeout_s`."""
        return holds(lambda: self._poses, timeout_s, POLL_S)

    def arrives(self, goal: ArrayLike, radius: float, timeout_s: float) -> bool:
        """Wait until the robot is within `radius` of a goal (2,); False after `timeout_s`."""

        def there() -> bool:
            newest = self._poses[-1:]
            return any(
                np.linalg.norm(pose[:2] - np.asarray(goal)) < radius for pose in newest
            )

        return holds(there, timeout_s, POLL_S)

    def arms(self, gate: str, timeout_s: float) -> str:
        """Ask a gate to arm until it agrees; return its last reason for refusing, or ''."""

        def arm() -> TriggerAnswer:
            return Call(self._node, gate, "arm").wait_for_answer(REPLY_S)

        answer = ask_until_granted(
            arm, time.monotonic() + timeout_s, lambda _: None, gate
        )
        return "" if answer.granted else answer.told

    def touched(self, simulator: str, timeout_s: float) -> bool:
        """True if the simulated robot touched something in this episode. Raises BackendError."""
        client = self._node.create_client(SelfTest, f"{simulator}/self_test")
        wait = partial(holds, poll_s=POLL_S)
        response = ask(client, SelfTest.Request(), timeout_s, wait, REPLY_S)
        self._node.destroy_client(client)
        if response is None:
            reason = f"{simulator} did not answer within {timeout_s:g} s"
            raise BackendError(f"the episode can't be judged: {reason}.")
        return not any(response.passed)

    def __exit__(self, *_: object) -> None:
        self._node.close()
