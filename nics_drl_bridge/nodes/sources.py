"""Names of a topic's publishers, for each message."""

from collections.abc import Mapping
from typing import Any

from rclpy.node import Node

from nics_drl_bridge.nodes import qos

SHOWN = 4  # displayed bytes of a publisher's id


class Sources:
    """Names the publishers of a topic by their nodes, as far as the middleware reports them."""

    def __init__(self, node: Node, topic: str) -> None:
        self._node = node
        self._topic = topic
        self._names: dict[bytes, str] = {}
        # number of publishers in the graph, used if messages do not identify theirs
        self.publishers = 1
        self._tells_publisher = True

    def name_of(self, info: Mapping[str, Any]) -> str:
        """Return the publisher's name for a message; empty if the middleware does not report it."""
        publisher = info.get("publisher_gid")
        if not publisher:
            self._tells_publisher = False
            return ""
        gid = bytes(publisher["data"])
        if gid not in self._names:  # named once: a name stands for its publisher
            self._names[gid] = f"{self._node_of(gid)} (publisher {gid[-SHOWN:].hex()})"
        return self._names[gid]

    def count_publishers(self) -> None:
        """Count the publishers in the graph, if messages do not identify theirs."""
        if not self._tells_publisher:
            self.publishers = max(1, self._node.count_publishers(self._topic))

    def _node_of(self, gid: bytes) -> str:
        for endpoint in self._node.get_publishers_info_by_topic(self._topic):
            if bytes(endpoint.endpoint_gid) == gid:
                return qos.owner(endpoint) or "a node"
        return "a node"
