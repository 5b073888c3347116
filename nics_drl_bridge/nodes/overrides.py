"""The values that a node was started with, from the command line and from YAML files."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rclpy.node import Node
from rclpy.parameter import Parameter

from nics_drl_bridge.errors import nearest

WIDENED: dict[Parameter.Type, tuple[Parameter.Type, Callable[[Any], Any]]] = {
    Parameter.Type.INTEGER: (Parameter.Type.DOUBLE, float),
    Parameter.Type.INTEGER_ARRAY: (
        Parameter.Type.DOUBLE_ARRAY,
        lambda values: list(map(float, values)),
    ),
}
QOS = "qos_overrides."
"""Names that rclpy reads itself, where a publisher or subscription asks for it."""


def widen(node: Node, name: str, default: Any) -> None:
    """Lets `rate:=2` be given for a floating-point parameter: rclpy itself refuses an integer.

    Args:
        node: whose parameter it is; not yet declared.
        name: of the parameter.
        default: a float or a list of floats; others are left alone.
    """
    given = given_values(node)
    first = default[0] if isinstance(default, list) and default else default
    parameter = given.get(name)
    if isinstance(first, float) and parameter is not None and parameter.type_ in WIDENED:
        kind, convert = WIDENED[parameter.type_]
        given[name] = Parameter(name, kind, convert(parameter.value))


def given_values(node: Node) -> dict[str, Parameter]:
    """What the node was started with, by name; the node's own dictionary.

    rclpy has no public way to it but to accept undeclared parameters, which would accept misspelt
    ones for ever.
    """
    found: dict[str, Parameter] = getattr(node, "_parameter_overrides", {})
    return found


def warn_of_unknown(node: Node) -> None:
    """Warns of values for parameters that the node does not have: rclpy ignores them silently."""
    known = [name for name in node._parameters if not name.startswith(QOS)]
    for name in sorted(given_values(node)):
        if name not in known and not name.startswith(QOS):
            node.get_logger().warning(
                f"there is no parameter {name!r}, its value is ignored; {nearest(name, known)}"
            )
