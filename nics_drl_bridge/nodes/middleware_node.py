"""middleware_node: caches a robot's topics and publishes the estimate of its state."""

from __future__ import annotations

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from nav_msgs.msg import Odometry
from rclpy.clock import Clock, ClockType
from rclpy.context import Context
from rclpy.node import Node
from std_srvs.srv import Trigger

from nics_drl_bridge.nodes import conversions, qos
from nics_drl_bridge.nodes.robot_topics import RobotTopics
from nics_drl_bridge.nodes.runner import declare, declare_model, run_node

DIAGNOSTICS_PERIOD_S = 1.0


class MiddlewareNode(Node):
    """Listens to `scan`, `odom` and `cmd_vel`; publishes `odometry/filtered` and `/diagnostics`.

    `~/reset` forgets everything, so that the next odometry fixes `map` anew.

    Args:
        context: to live in.
    """

    def __init__(self, context: Context) -> None:
        super().__init__("middleware_node", context=context)
        model = declare_model(self)
        declare(self, "map_frame", "map", "Frame id of the estimate.")
        declare(self, "base_frame", "base_link", "Frame id of the robot.")
        self._filtered = self.create_publisher(Odometry, "odometry/filtered", qos.SENSOR_RELIABLE)
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self._topics = RobotTopics(self, model, on_odometry=self._publish)
        self.create_service(Trigger, "~/reset", self._on_reset)
        # Steady: diagnostics matter most when the robot's time stands still.
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(DIAGNOSTICS_PERIOD_S, self._diagnose, clock=steady)

    def _publish(self, stamp_ns: int) -> None:
        view = self._topics.middleware.view(stamp_ns)
        covariance = self._topics.middleware.estimator.covariance
        frames = (
            str(self.get_parameter("map_frame").value),
            str(self.get_parameter("base_frame").value),
        )
        variance = (max(covariance[0, 0], covariance[1, 1]), covariance[2, 2], 1e-4, 1e-4)
        self._filtered.publish(
            conversions.odometry_to_ros(view.pose, view.twist, stamp_ns, frames, variance)
        )

    def _on_reset(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self._topics.restart()
        response.success, response.message = True, "the next odometry fixes the map frame"
        return response

    def _diagnose(self) -> None:
        cache = self._topics.middleware.cache
        status = DiagnosticStatus(name=f"{self.get_fully_qualified_name()}: topics")
        missing = [topic for topic in ("scan", "odom") if topic not in cache.newest]
        status.level = DiagnosticStatus.WARN if missing else DiagnosticStatus.OK
        status.message = f"nothing on {', '.join(missing)} yet" if missing else "receiving"
        facts = {f"{topic} received": datum.sequence + 1 for topic, datum in cache.newest.items()}
        facts |= {f"rejected, {reason}": count for reason, count in cache.rejected.items()}
        status.values = [KeyValue(key=key, value=str(value)) for key, value in facts.items()]
        message = DiagnosticArray(status=[status])
        message.header.stamp = self.get_clock().now().to_msg()
        self._diagnostics.publish(message)


def main(args: list[str] | None = None) -> None:
    """Entry point of the executable."""
    run_node(MiddlewareNode, args)


if __name__ == "__main__":
    main()
