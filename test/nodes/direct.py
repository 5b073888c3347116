"""A node that does not spin: the test calls its callbacks, and reads what it publishes."""

from collections import defaultdict
from typing import Any

from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.serialization import deserialize_message, serialize_message

from nics_drl_bridge.interface import NS_PER_S


class Kept:
    """A publisher that is in the graph, seems to have a subscriber, and keeps its messages."""

    def __init__(self, node: Any, kind: Any, topic: str) -> None:
        self._kind = kind
        self.topic_name = Node.create_publisher(node, kind, topic, 1).topic_name
        kept = vars(node).setdefault("kept", defaultdict(list))
        self._messages = kept[topic]

    def publish(self, message: Any) -> None:
        if isinstance(message, bytes):
            message = deserialize_message(message, self._kind)
        self._messages.append(message)

    def get_subscription_count(self) -> int:
        return 1

    def wait_for_all_acked(self, *_: Any) -> bool:
        return True


class Direct:
    """A node, what it has published on each topic (`sent`), and a way to its callbacks."""

    def __init__(self, node: Any) -> None:
        self.node = node
        self.sent = node.kept

    def give(self, topic: str, message: Any, **info: Any) -> None:
        """Hand a message to the subscription of a topic, as an executor does."""
        name = self.node.resolve_topic_name(topic)
        (heard,) = (s for s in self.node.subscriptions if s.topic_name == name)
        if heard.raw and not isinstance(message, bytes):
            message = serialize_message(message)
        heard.callback(message, *([info] if info else []))

    def call(self, name: str, **fields: Any) -> Any:
        """Return the response of one of its services."""
        (served,) = (s for s in self.node.services if s.srv_name == name)
        kind = served.srv_type
        return served.callback(kind.Request(**fields), kind.Response())

    def fire_timers(self) -> None:
        for timer in list(self.node.timers):
            timer.callback()

    def set_to(self, **values: Any) -> Any:
        """Set parameters together, and return the result."""
        given = [Parameter(name, value=value) for name, value in values.items()]
        return self.node.set_parameters_atomically(given)

    def diagnose(self) -> Any:
        """Return its condition as it is published."""
        condition = self.node._look()
        facts = {key: str(value) for key, value in condition.facts.items()}
        return condition._replace(facts=facts)


class Clock:
    """A module `time` that passes only when the test says so, or somebody sleeps."""

    def __init__(self) -> None:
        self.now_s = 0.0

    def monotonic(self) -> float:
        return self.now_s

    def monotonic_ns(self) -> int:
        return round(self.now_s * NS_PER_S)

    time_ns = monotonic_ns

    def sleep(self, seconds: float) -> None:
        self.now_s += seconds
