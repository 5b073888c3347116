"""The message type of a command topic: Twist for some robots, TwistStamped for others.

ROS 2 does not connect topics that have the same name but different types, and reports nothing.
"""

from collections.abc import Mapping
from typing import Any

from geometry_msgs.msg import Twist, TwistStamped
from rclpy.node import Node

from nics_drl_bridge.nodes import qos, runner
from nics_drl_bridge.nodes.parameters import STAMPED

TWIST = "geometry_msgs/msg/Twist"
TWIST_STAMPED = "geometry_msgs/msg/TwistStamped"
KINDS: dict[str, Any] = {TWIST: Twist, TWIST_STAMPED: TwistStamped}
# The setting that selects the type.
SETTINGS = {TWIST: f"{STAMPED}:=false", TWIST_STAMPED: f"{STAMPED}:=true"}
LOOK_S = 1.0  # between two looks at who publishes


def name_of(stamped: bool) -> str:
    """Return the name of the type of commands."""
    return TWIST_STAMPED if stamped else TWIST


def expect_stamped(node: Node, topic: str) -> bool | None:
    """True if the subscribers of a command topic expect TwistStamped; None if none, or mixed."""
    ends = node.get_subscriptions_info_by_topic(node.resolve_topic_name(topic))
    kinds = {end.topic_type for end in ends} & KINDS.keys()
    return kinds == {TWIST_STAMPED} if len(kinds) == 1 else None


class TypeWatch:
    """Warns once about each node that publishes a type to which nobody here subscribes.

    `heard` is the type that this node expects, and `settings` holds, for each type, the setting
    that selects it.
    """

    def __init__(
        self,
        node: Node,
        topic: str,
        heard: str,
        settings: Mapping[str, str] = SETTINGS,
    ) -> None:
        self._node = node
        self._topic = node.resolve_topic_name(topic)
        self._heard = heard
        self._settings = settings
        self._warned: set[tuple[str, str]] = set()
        self._timer = runner.call_periodically(node, LOOK_S, self._look)

    def _look(self) -> None:
        for end in self._node.get_publishers_info_by_topic(self._topic):
            kind = end.topic_type
            who = qos.find_owner(end)
            if who is None or kind == self._heard or (who, kind) in self._warned:
                continue
            self._warned.add((who, kind))
            known = kind in self._settings
            fix = f"set {self._settings[kind]}" if known else "another type there"
            self._node.get_logger().warning(
                f"{self._topic}: {who} publishes {kind}, but {self._heard} is expected here, so "
                f"its commands are not received; make it publish that, or {fix}."
            )

    def close(self) -> None:
        """Stop looking."""
        self._node.destroy_timer(self._timer)
