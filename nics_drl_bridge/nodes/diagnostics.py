"""Findings of a node about itself, published on `/diagnostics`."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.clock import Clock, ClockType
from rclpy.node import Node

from nics_drl_bridge.nodes import qos

PERIOD_S = 1.0


class Condition(NamedTuple):
    """Condition of a node.

    Attributes:
        message: one line.
        warns: whether it needs attention.
        facts: further facts, for people.
        hardware: the hardware concerned, such as the robot's name.
    """

    message: str
    warns: bool
    facts: Mapping[str, object]
    hardware: str = ""


class Diagnostics:
    """Publishes a node's finding about itself once a second, in the format of the aggregator.

    Args:
        node: that is reported on.
        part: of the node, for the name of the status.
        look: returns the finding; called each time.
    """

    def __init__(self, node: Node, part: str, look: Callable[[], Condition]) -> None:
        self._node, self._look = node, look
        self._name = f"{node.get_fully_qualified_name()}: {part}"
        self._topic = node.create_publisher(DiagnosticArray, "/diagnostics", qos.DIAGNOSTICS)
        # Steady: diagnostics matter most when the robot's time stands still.
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        node.create_timer(PERIOD_S, self._tell, clock=steady)

    def _tell(self) -> None:
        found = self._look()
        status = DiagnosticStatus(name=self._name, message=found.message)
        status.level = DiagnosticStatus.WARN if found.warns else DiagnosticStatus.OK
        status.hardware_id = found.hardware
        status.values = [KeyValue(key=key, value=str(value)) for key, value in found.facts.items()]
        message = DiagnosticArray(status=[status])
        message.header.stamp = self._node.get_clock().now().to_msg()
        self._topic.publish(message)
