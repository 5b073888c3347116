"""Single instance: a second node of the same name in the same namespace does not start."""

from __future__ import annotations

import contextlib
import hashlib
import socket
import sys
import time
from collections.abc import Iterator

from rcl_interfaces.srv import GetParameters
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node

from nics_drl_bridge.errors import BackendError

SETTLE_S = 0.3
"""Time until the graph shows all nodes [s]."""
POLL_S = 0.02
ANSWER_S = 1.5
"""A node that does not answer within this time is dead; the graph shows it for some 20 s more."""


@contextlib.contextmanager
def sole(context: Context, name: str) -> Iterator[None]:
    """Ensures a single instance while a node runs: if its name is taken, it does not start.

    Two that start at the same moment on one machine are told apart by the name of a socket, which
    only one of them gets, and which ends with its process. Others, and nodes of other packages, are
    found in the graph and asked whether they are alive.

    Args:
        context: of the node; its arguments may set another name or a namespace.
        name: of the node.

    Raises:
        BackendError: another instance is running.
    """
    probe = Node(
        name, context=context, start_parameter_services=False, enable_rosout=False
    )  # resolves its name as the node will
    claim = None
    try:
        whole = probe.get_fully_qualified_name()
        claim = _claimed(f"{context.get_domain_id()} {whole}")
        if claim is None or (_seen(probe, whole) and _lives(probe, whole)):
            raise BackendError(
                f"a node {whole!r} runs already in ROS domain {context.get_domain_id()}; end it, "
                "or give this one another namespace: `--ros-args -r __ns:=/robot_2`."
            )
    except BaseException:
        if claim is not None:
            claim.close()
        raise
    finally:
        probe.destroy_node()
    with claim:
        yield


def _claimed(key: str) -> socket.socket | None:
    """Returns what only one process per machine (and network namespace) can have, or None."""
    claim = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    if sys.platform != "linux":
        return claim
    try:
        claim.bind(b"\0nics_drl_bridge " + hashlib.sha256(key.encode()).hexdigest().encode())
    except OSError:
        claim.close()
        return None
    return claim


def _seen(probe: Node, whole: str) -> bool:
    """True if the graph shows another node of the probe's name within `SETTLE_S`."""
    deadline = time.monotonic() + SETTLE_S
    while True:
        nodes = [
            f"{space.rstrip('/')}/{name}" for name, space in probe.get_node_names_and_namespaces()
        ]
        if nodes.count(whole) > 1:
            return True
        if time.monotonic() > deadline:
            return False
        time.sleep(POLL_S)


def _lives(probe: Node, whole: str) -> bool:
    """True if the other node answers."""
    client = probe.create_client(GetParameters, f"{whole}/get_parameters")
    executor = SingleThreadedExecutor(context=probe.context)
    executor.add_node(probe)
    deadline = time.monotonic() + ANSWER_S
    try:
        while not client.service_is_ready() and time.monotonic() < deadline:
            time.sleep(POLL_S)
        answer = client.call_async(GetParameters.Request())
        executor.spin_until_future_complete(answer, max(0.1, deadline - time.monotonic()))
        return bool(answer.done())
    finally:
        executor.shutdown(timeout_sec=1.0)
