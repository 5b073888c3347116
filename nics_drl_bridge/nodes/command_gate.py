"""command_gate: passes the policy's commands on while there is reason to trust them."""

from __future__ import annotations

import time
from collections import OrderedDict

import numpy as np
from geometry_msgs.msg import Twist, TwistStamped
from rclpy.clock import Clock, ClockType
from rclpy.context import Context
from rclpy.node import Node
from sensor_msgs.msg import LaserScan

from nics_drl_bridge.nodes import conversions, qos
from nics_drl_bridge.nodes.runner import declare, declare_model, last_word, run_node
from nics_drl_bridge.safety.gate import Decision, Limits, Request, decide

PERIOD_S = 0.05
SCANS_KEPT = 50


class CommandGate(Node):
    """Stands between `cmd_vel_raw` and `cmd_vel`, in a process of its own.

    It judges the age of the scan behind each command by its own steady clock: a policy that
    hangs while something repeats its last command is stopped too.

    Args:
        context: to live in.
    """

    def __init__(self, context: Context) -> None:
        super().__init__("command_gate", context=context)
        robot = declare_model(self).robot
        age = declare(
            self,
            "scan_age",
            0.35,
            "Oldest scan behind a command [s].",
            low=0.01,
            high=10.0,
            read_only=True,
        )
        self._limits = Limits(
            robot.to_cmd_vel(robot.command_low), robot.to_cmd_vel(robot.command_high), float(age)
        )
        self._request: Request | None = None
        self._arrivals: OrderedDict[int, float] = OrderedDict()
        self._cause = ""
        self._out = self.create_publisher(Twist, "cmd_vel", qos.COMMAND)
        self.create_subscription(LaserScan, "scan", self._on_scan, qos.SENSOR)
        self.create_subscription(TwistStamped, "cmd_vel_raw", self._on_command, qos.COMMAND)
        self.create_timer(PERIOD_S, self._on_time, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def _on_scan(self, message: LaserScan) -> None:
        self._arrivals.setdefault(
            conversions.stamp_from_ros(message.header.stamp), time.monotonic()
        )
        while len(self._arrivals) > SCANS_KEPT:
            self._arrivals.popitem(last=False)

    def _on_command(self, message: TwistStamped) -> None:
        arrival = self._arrivals.get(conversions.stamp_from_ros(message.header.stamp))
        self._request = Request(conversions.twist_from_ros(message.twist), arrival)
        self._publish(decide(time.monotonic(), self._request, self._limits))

    def _on_time(self) -> None:
        decision = decide(time.monotonic(), self._request, self._limits)
        if decision.cause:
            self._publish(decision)

    def _publish(self, decision: Decision) -> None:
        if decision.cause and not self._cause:
            self.get_logger().warning(f"stopped: {decision.cause}")
        self._cause = decision.cause
        self._out.publish(conversions.twist_to_ros(decision.twist))

    def stop(self) -> None:
        """Leaves a zero command behind."""
        last_word(self._out, conversions.twist_to_ros(np.zeros(3)))


def main(args: list[str] | None = None) -> None:
    """Entry point of the executable."""
    run_node(CommandGate, args)


if __name__ == "__main__":
    main()
