"""The message type of a command topic: Twist for some robots, TwistStamped for others.

ROS 2 does not connect topics that have the same name but different types, and reports nothing.
"""

import contextlib
from collections.abc import Callable, Mapping
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
LOOK_S = 0.5  # between two looks at who publishes


def name_of(stamped: bool) -> str:
    """Return the name of the type of commands."""
    return TWIST_STAMPED if stamped else TWIST


def heard_stamped(node: Node, topic: str) -> bool | None:
    """True if the subscribers of a command topic expect TwistStamped; None if none, or mixed."""
    ends = node.get_subscriptions_info_by_topic(node.resolve_topic_name(topic))
    kinds = {end.topic_type for end in ends} & KINDS.keys()
    return kinds == {TWIST_STAMPED} if len(kinds) == 1 else None


def deaf_subscribers(node: Node, topic: str, stamped: bool) -> str:
    """Return a clause about subscribers that expect another type; empty if there are none."""
    ends = node.get_subscriptions_info_by_topic(node.resolve_topic_name(topic))
    kinds = sorted({end.topic_type for end in ends} - {name_of(stamped)})
    if not kinds:
        return ""
    names = sorted(
        {qos.owner(end) or "somebody" for end in ends if end.topic_type in kinds}
    )
    return f"{', '.join(names)} expects {' and '.join(kinds)} there, not {name_of(stamped)}"


class TypeWatch:
    """Warns once about each node that publishes a type to which nobody here subscribes.

    `settings` holds, for each type, the setting that selects it.
    """

    def __init__(
        self, node: Node, topic: str, settings: Mapping[str, str] = SETTINGS
    ) -> None:
        self._node = node
        self._topic = node.resolve_topic_name(topic)
        self._settings = settings
        self._warned: set[tuple[str, str]] = set()

    def look(self, heard: str) -> None:
        """Warn about publishers of a type other than the one that is heard."""
        for end in self._node.get_publishers_info_by_topic(self._topic):
            kind = end.topic_type
            who = qos.owner(end)
            if who is None or kind == heard or (who, kind) in self._warned:
                continue
            self._warned.add((who, kind))
            known = kind in self._settings
            fix = f"set {self._settings[kind]}" if known else "another type there"
            self._node.get_logger().warning(
                f"{self._topic}: {who} publishes {kind}, but {heard} is expected here, so its "
                f"commands are not received; make it publish that, or {fix}."
            )


class CommandListener:
    """Subscribes to commands of the type that is published, even if the parameter differs.

    The parameter selects the type until a node publishes. If both types are published at once, the
    present subscription stays, and a warning names the publishers of the other type.
    """

    def __init__(
        self, node: Node, topic: str, stamped: bool, take: Callable[[Any], None]
    ) -> None:
        self._node = node
        self._topic = topic
        self._take = take
        self._watch = TypeWatch(node, topic)
        self.kind = name_of(stamped)
        self._subscription: Any = None
        self._subscribe()
        self._timer = runner.steadily(node, LOOK_S, self.look)

    def _subscribe(self) -> None:
        made = self._node.create_subscription(
            KINDS[self.kind], self._topic, self._take, qos.COMMAND
        )
        self._subscription = made

    def look(self) -> None:
        """Subscribe to the type that is published now."""
        if self._subscription is None:
            # if the old subscription is not gone yet, the next look tries again
            with contextlib.suppress(RuntimeError):
                self._subscribe()
            return
        ends = self._node.get_publishers_info_by_topic(
            self._node.resolve_topic_name(self._topic)
        )
        published = {end.topic_type for end in ends}
        others = sorted((published & KINDS.keys()) - {self.kind})
        if self.kind in published or not others:
            self._watch.look(self.kind)
            return
        expected = self.kind
        self.kind = others[0]
        names = {
            qos.owner(end) or "somebody" for end in ends if end.topic_type == self.kind
        }
        self._node.get_logger().warning(
            f"{self._node.resolve_topic_name(self._topic)}: {', '.join(sorted(names))} publishes "
            f"{self.kind}, not {expected}, and is heard from now on; to hear its first commands "
            f"too, set {SETTINGS[self.kind]}."
        )
        # A process can use a topic with one type only, and the executor still holds the old one.
        self._unsubscribe()

    def _unsubscribe(self) -> None:
        if self._subscription is not None:
            self._node.destroy_subscription(self._subscription)
            self._subscription = None

    def close(self) -> None:
        """End the subscription."""
        self._node.destroy_timer(self._timer)
        self._unsubscribe()
