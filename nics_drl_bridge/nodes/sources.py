"""Who publishes on a topic: the publisher of each message, in words."""

from collections.abc import Mapping
from typing import Any

from rclpy.node import Node

SHOWN = 4  # bytes of a publisher's id that are shown


class Sources:
    """Names the publishers of a topic by their node, as far as the middleware tells them."""

    def __init__(self, node: Node, topic: str) -> None:
        self._node = node
        self._topic = topic
        self._names: dict[bytes, str] = {}
        # that the graph shows, where no message tells its publisher
        self.publishers = 1
        self._tells_publisher = True

    def name_of(self, info: Mapping[str, Any]) -> str:
        """Return the publisher of a message in words; empty if the middleware does not tell it."""
        publisher = info.get("publisher_gid")
        if not publisher:
            self._tells_publisher = False
            return ""
        gid = bytes(publisher["data"])
        if gid not in self._names:  # and never renamed: a name stands for its publisher
            self._names[gid] = f"{self._node_of(gid)} (publisher {gid[-SHOWN:].hex()})"
        return self._names[gid]

    def count_publishers(self) -> None:
        """Look at the graph for the number of publishers, where messages do not tell theirs."""
        if not self._tells_publisher:
            self.publishers = max(1, self._node.count_publishers(self._topic))

    def _node_of(self, gid: bytes) -> str:
        for endpoint in self._node.get_publishers_info_by_topic(self._topic):
            if bytes(endpoint.endpoint_gid) == gid:
                return f"{endpoint.node_namespace.rstrip('/')}/{endpoint.node_name}"
        return "a node"
