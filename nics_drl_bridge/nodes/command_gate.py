"""command_gate: passes the policy's commands on while there is reason to trust them."""

from __future__ import annotations

import time

import numpy as np
from geometry_msgs.msg import Twist, TwistStamped
from nav_msgs.msg import Odometry as OdometryMessage
from rclpy.clock import Clock, ClockType
from rclpy.context import Context
from sensor_msgs.msg import LaserScan
from std_msgs.msg import Bool
from std_srvs.srv import Trigger

from nics_drl_bridge.nodes import conversions, qos
from nics_drl_bridge.nodes.diagnostics import Diagnostics, Finding
from nics_drl_bridge.nodes.gate_log import GateLog
from nics_drl_bridge.nodes.gate_parameters import declare_gate
from nics_drl_bridge.nodes.qos_watch import QosWatch
from nics_drl_bridge.nodes.runner import last_word, run_node
from nics_drl_bridge.safety import shield
from nics_drl_bridge.safety.black_box import Entry
from nics_drl_bridge.safety.gate import decide
from nics_drl_bridge.safety.inputs import (
    Arm,
    Command,
    Estimate,
    EStop,
    Input,
    Odometry,
    Press,
    Reset,
    Scan,
    Tick,
)
from nics_drl_bridge.safety.state import Decision, begin

PERIOD_S = 0.02


class CommandGate(QosWatch):
    """Stands between `cmd_vel_raw` and `cmd_vel`, in a process of its own.

    It starts disarmed. `~/arm` lets commands pass if nothing speaks against it, `~/e_stop`
    presses the emergency stop, `~/reset` clears a latched stop and leaves the gate disarmed. All
    that it decides is in `safety`, on the steady clock.

    Args:
        context: to live in.
    """

    def __init__(self, context: Context) -> None:
        super().__init__("command_gate", context=context)
        parameters = declare_gate(self)
        self._config, self._lidar = parameters.config, parameters.lidar
        self._state = begin(self._config)
        self._log = GateLog(parameters, self.get_logger())
        if not self._config.e_stop_required:
            self.get_logger().warning(
                "e_stop_required is false: an e_stop that was never heard does not stop the robot. "
                "That is for simulations; set it on a vehicle."
            )
        if self._config.shield is not None:
            self.get_logger().info(parameters.shield_said)
            shield.rehearse()
        else:
            self.get_logger().warning(parameters.shield_said)
        self._out = self.create_publisher(Twist, "cmd_vel", qos.COMMAND)
        self._listen()
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(PERIOD_S, lambda: self._decide(Tick()), clock=steady)
        Diagnostics(self, "gate", self._look)

    def _listen(self) -> None:
        self.create_subscription(LaserScan, "scan", self._on_scan, qos.SENSOR)
        self.create_subscription(OdometryMessage, "odom", self._on_odometry, qos.SENSOR)
        self.create_subscription(
            OdometryMessage, "odometry/filtered", self._on_estimate, qos.SENSOR
        )
        self.create_subscription(TwistStamped, "cmd_vel_raw", self._on_command, qos.COMMAND)
        self.create_subscription(Bool, "e_stop", self._on_e_stop, qos.EVERY_COMMAND)
        self.create_service(Trigger, "~/arm", self._on_arm)
        self.create_service(Trigger, "~/reset", self._on_reset)
        self.create_service(Trigger, "~/e_stop", self._on_e_stop_call)

    def _on_scan(self, message: LaserScan) -> None:
        stamp = conversions.stamp_from_ros(message.header.stamp)
        ranges = conversions.scan_from_ros(self._lidar, message)
        self._decide(Scan(stamp, ranges, (message.angle_min, message.angle_increment)))

    def _on_odometry(self, message: OdometryMessage) -> None:
        stamp = conversions.stamp_from_ros(message.header.stamp)
        pose, twist = conversions.odometry_from_ros(message)
        if not conversions.is_rotation(message.pose.pose.orientation):
            pose = np.full(3, np.nan)
        self._decide(Odometry(stamp, pose, twist))

    def _on_estimate(self, message: OdometryMessage) -> None:
        variance = np.reshape(message.pose.covariance, (6, 6)).diagonal()
        std = np.sqrt([max(variance[0], variance[1]), variance[5]])
        self._decide(Estimate(conversions.twist_from_ros(message.twist.twist), std))

    def _on_command(self, message: TwistStamped) -> None:
        stamp = conversions.stamp_from_ros(message.header.stamp)
        self._decide(Command(stamp, conversions.twist_from_ros(message.twist)))

    def _on_e_stop(self, message: Bool) -> None:
        self._decide(EStop(bool(message.data)))

    def _on_arm(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        return self._answer(Arm(self.count_publishers(self._out.topic_name)), response)

    def _on_reset(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        return self._answer(Reset(), response)

    def _on_e_stop_call(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self._decide(Press())
        response.success, response.message = True, "the e-stop is pressed; ~/reset releases it"
        return response

    def _answer(self, given: Input, response: Trigger.Response) -> Trigger.Response:
        decision = self._decide(given)
        response.success, response.message = decision.granted, decision.answer
        self.get_logger().info(f"{type(given).__name__.lower()}: {decision.answer}")
        return response

    def _decide(self, given: Input) -> Decision:
        now, before = time.monotonic(), self._state
        self._state, decision = decide(self._config, before, given, now)
        if decision.publish:  # first of all: what follows may take its time
            self._out.publish(conversions.twist_to_ros(decision.twist))
        self._log.note(Entry(now, given, before, decision))
        return decision

    def _look(self) -> Finding:
        """What `/diagnostics` tells; also who else moves the robot, which no gate can prevent."""
        found = self._log.finding(self._state)
        others = self.count_publishers(self._out.topic_name) - 1
        if others < 1:
            return found
        told = f"others publish on cmd_vel, too ({others}), and move the robot past this gate"
        self.get_logger().warning(told, throttle_duration_sec=10.0)
        return found._replace(message=f"{found.message}; {told}", warns=True)

    def stop(self) -> None:
        """Leaves a zero command behind."""
        last_word(self._out, conversions.twist_to_ros(np.zeros(3)))
        self._log.close()


def main(args: list[str] | None = None) -> None:
    """Entry point of the executable."""
    run_node(CommandGate, args, "command_gate")


if __name__ == "__main__":
    main()
