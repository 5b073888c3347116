"""Who is at the other end of a topic."""

from __future__ import annotations

from typing import Any

UNKNOWN = "_UNKNOWN_"


def owner(end: Any) -> str | None:
    """Full name of the node of a `TopicEndpointInfo`; None while only the end itself is known.

    A node's name travels apart from its ends.
    """
    name = f"{end.node_namespace.rstrip('/')}/{end.node_name}"
    return None if UNKNOWN in name else name
