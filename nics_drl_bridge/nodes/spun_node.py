"""A node that its owner spins."""

import time
from collections.abc import Callable
from typing import Any

from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node

from nics_drl_bridge.nodes.listener import open_context


class SpunNode:
    """A node with an executor of its own, and a context of its own unless one is given."""

    def __init__(
        self, name: str, domain_id: int | None = None, context: Context | None = None
    ) -> None:
        self._context = context or open_context(domain_id=domain_id)
        self.node = Node(name, context=self._context, start_parameter_services=False)
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
        self, kind: Any, name: str, patience_s: float, request: Any = None
    ) -> Any:
        """Return the answer of a service. Raises TimeoutError."""
        if name not in self._clients:
            self._clients[name] = self.node.create_client(kind, name)
        client = self._clients[name]
        ready = self.until(client.service_is_ready, patience_s)
        future = client.call_async(kind.Request() if request is None else request)
        if not (ready and self.until(future.done, patience_s)):
            raise TimeoutError(f"service {name}: no answer within {patience_s:g} s")
        return future.result()

    def close(self) -> None:
        """End the node."""
        self._executor.shutdown(timeout_sec=1.0)
        self.node.destroy_node()
        self._context.try_shutdown()
