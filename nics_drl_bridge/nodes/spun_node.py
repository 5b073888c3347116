"""A node that its owner spins."""

import math
import time
from collections.abc import Callable
from typing import Any

from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node

from nics_drl_bridge.nodes.listener import ask, open_context


class SpunNode:
    """A node with an executor and a context of its own."""

    def __init__(
        self, name: str, domain_id: int | None = None, namespace: str = ""
    ) -> None:
        self._context = open_context(domain_id=domain_id)
        self.node = Node(
            name,
            context=self._context,
            namespace=namespace,
            start_parameter_services=False,
        )
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)
        self._clients: dict[str, Any] = {}

    def spin(self, timeout_s: float = 0.01) -> None:
        """Handle one event, if one arrives in time."""
        self._executor.spin_once(timeout_sec=timeout_s)

    def until(self, done: Callable[[], object], seconds: float) -> bool:
        """Spin until a condition holds; return False if it does not in time."""
        end = time.monotonic() + seconds
        while not done():
            if time.monotonic() > end:
                return False
            self.spin()
        return True

    def call_service(
        self,
        kind: Any,
        name: str,
        patience_s: float,
        request: Any = None,
        again_s: float = math.inf,
    ) -> Any:
        """Return the answer of a service, asked again at a period. Raises TimeoutError."""
        if name not in self._clients:
            self._clients[name] = self.node.create_client(kind, name)
        asked = kind.Request() if request is None else request
        answer = ask(self._clients[name], asked, patience_s, self.until, again_s)
        if answer is None:
            raise TimeoutError(f"service {name}: no answer within {patience_s:g} s")
        return answer

    def close(self) -> None:
        """End the node."""
        self._executor.shutdown(timeout_sec=1.0)
        self.node.destroy_node()
        self._context.try_shutdown()
