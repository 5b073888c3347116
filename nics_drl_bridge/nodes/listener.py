"""Contexts, and nodes that spin, in this thread or in one of their own.

It imports no simulator, so that commands to a running robot start quickly.
"""

import math
import os
import threading
import time
from collections.abc import Callable, Sequence
from typing import Any

from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node

from nics_drl_bridge.errors import BackendError
from nics_drl_bridge.nodes.transport import GREATEST_DOMAIN_ID

SPIN_S = 0.1
# Longest wait for an event, between two looks at a condition [s]. Always the same, because rclpy
# drops callbacks that are ready when the timeout changes.
POLL_S = 0.01
UNKNOWN = "UnknownROSArgsError"  # of rclpy, which exports it nowhere


def open_context(
    args: Sequence[str] | None = None, domain_id: int | None = None
) -> Context:
    """Return a new context. Raises BackendError."""
    if domain_id is None:
        asked = os.environ.get("ROS_DOMAIN_ID", "0")
    else:
        asked = str(domain_id)
    # otherwise DDS would end the process
    if asked.isdecimal() and int(asked) > GREATEST_DOMAIN_ID:
        raise BackendError(
            f"ROS 2 does not start: domain {asked} is above {GREATEST_DOMAIN_ID}."
        )
    try:
        context = Context()
        context.init(None if args is None else list(args), domain_id=domain_id)
        return context
    except RuntimeError as error:
        if type(error).__name__ == UNKNOWN:
            raise BackendError(
                f"ROS 2 knows no argument {error}; write them as in `--ros-args -p NAME:=VALUE "
                "-r FROM:=TO --params-file FILE`."
            ) from None
        raise BackendError(
            f"ROS 2 does not start: {' '.join(str(error).split())}"
        ) from None


def holds(condition: Callable[[], Any], seconds: float, poll_s: float) -> bool:
    """Wait until a condition holds; return False if it does not within `seconds`."""
    deadline = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > deadline:
            return False
        time.sleep(poll_s)
    return True


def ask(
    client: Any,
    request: Any,
    timeout_s: float,
    wait_until: Callable[[Callable[[], Any], float], bool],
    retry_period_s: float = math.inf,
) -> Any:
    """Call a service, and again each retry period [s]; return the first answer, or None.

    `wait_until` waits for a condition, at most for some seconds, while callbacks run. The
    middleware drops an answer whose client the server has not discovered yet.
    """
    deadline = time.monotonic() + timeout_s
    futures: list[Any] = []

    def find_answered() -> Any:
        return next((future for future in futures if future.done()), None)

    while find_answered() is None and time.monotonic() < deadline:
        # A server that hung for a long time was dropped and must be discovered again.
        wait_until(client.service_is_ready, deadline - time.monotonic())
        futures.append(client.call_async(request))
        wait_until(find_answered, min(retry_period_s, deadline - time.monotonic()))
    for future in futures:
        client.remove_pending_request(future)
    answered = find_answered()
    return None if answered is None else answered.result()


def spin(node: Node, stopping: threading.Event) -> None:
    """Spin a node until `stopping` is set or its context has been shut down."""
    executor = SingleThreadedExecutor(context=node.context)
    executor.add_node(node)
    try:
        while node.context.ok() and not stopping.is_set():
            executor.spin_once(timeout_sec=SPIN_S)
    except Exception:  # another thread may have shut the context down meanwhile
        if node.context.ok():
            raise
    finally:
        executor.shutdown(timeout_sec=1.0)


class SpunNode:
    """A node in a context of its own, spun by its owner's waits, or from `start` on by a thread."""

    def __init__(
        self,
        name: str,
        domain_id: int | None = None,
        namespace: str = "",
        make: Callable[..., Node] = Node,
        **options: Any,
    ) -> None:
        self._context = open_context([], domain_id)
        try:
            self.node = make(
                name,
                context=self._context,
                namespace=namespace,
                start_parameter_services=False,
                **options,
            )
        except BaseException:
            self._context.try_shutdown()
            raise
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)
        self._thread: threading.Thread | None = None
        self._clients: dict[str, Any] = {}

    def start(self) -> None:
        """Let a thread spin the node until `close`; create all subscriptions first."""
        self._thread = threading.Thread(
            target=spin, args=(self.node, threading.Event()), daemon=True
        )
        self._thread.start()

    def until(self, done: Callable[[], object], seconds: float) -> bool:
        """Wait until a condition holds; return False if it does not in time."""
        if self._thread is not None:
            return holds(done, seconds, POLL_S)
        end = time.monotonic() + seconds
        while not done():
            if time.monotonic() > end:
                return False
            self.spin()
        return True

    def spin(self, timeout_s: float = POLL_S) -> None:
        """Handle one event, if one arrives in time."""
        self._executor.spin_once(timeout_sec=timeout_s)

    def call_service(
        self,
        kind: Any,
        name: str,
        patience_s: float,
        request: Any = None,
        retry_period_s: float = math.inf,
    ) -> Any:
        """Return the answer of a service, asked again at a period. Raises TimeoutError."""
        if name not in self._clients:
            self._clients[name] = self.node.create_client(kind, name)
        asked = kind.Request() if request is None else request
        answer = ask(self._clients[name], asked, patience_s, self.until, retry_period_s)
        if answer is None:
            raise TimeoutError(f"service {name}: no answer within {patience_s:g} s")
        return answer

    def close(self) -> None:
        """End the node, and its thread."""
        if self._thread is not None:
            self._context.try_shutdown()
            self._thread.join(timeout=2.0)
        self._executor.shutdown(timeout_sec=1.0)
        self.node.destroy_node()
        self._context.try_shutdown()
