"""Parts that extensions add to nodes: the entry points `nics_drl_bridge.node_parts`.

An entry `device.NAME` is called with a simulator's node, and `policy.NAME` with a policy node. It
declares its parameters then, and returns an object, or None if it has nothing to offer there.

A part of a policy node is a leader, which may drive the robot to goals of its own. Its methods are
those of `extras.nav2.follow_path.PathActions`.
"""

from typing import Any, NamedTuple

from rclpy.node import Node

from nics_drl_bridge import extensions
from nics_drl_bridge.interface import Array

GROUP = "node_parts"
REINSTALL = "install nics_drl_bridge again."


class Wish(NamedTuple):
    """Motion that a policy requests on the way to a goal."""

    twist: Array  # (3,) for `cmd_vel`
    touched: bool


def open_parts(kind: str, node: Node) -> list[Any]:
    """Return the parts of a kind of node, `device` or `policy`. Raises BridgeError."""
    installed = extensions.find_extensions(GROUP)
    names = [name for name in installed if name.startswith(f"{kind}.")]
    if not names:  # of an environment that was made before this package had parts
        node.get_logger().warning(f"no parts of a {kind} are installed; {REINSTALL}")
    parts = [extensions.load(GROUP, name)(node) for name in names]
    return [part for part in parts if part is not None]
