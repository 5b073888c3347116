"""middleware_node: caches a robot's topics and publishes an estimate of its state."""

from functools import partial
from typing import Any

from nav_msgs.msg import Odometry

from nics_drl_bridge.errors import LONGEST, shorten
from nics_drl_bridge.gate import inputs
from nics_drl_bridge.generator import open_model
from nics_drl_bridge.middleware.measurement import Rejection
from nics_drl_bridge.middleware.middleware import rehearse
from nics_drl_bridge.nodes import conversions, qos, runner
from nics_drl_bridge.nodes.frames import MapToOdom, compute_odom_in_map
from nics_drl_bridge.nodes.parameters import BASE_FRAME, MAP_FRAME
from nics_drl_bridge.nodes.robot_topics import SILENCE_S, RobotTopics
from nics_drl_bridge.nodes.runner import (
    ACTIVE,
    OK,
    STALE,
    UNCONFIGURED,
    ManagedNode,
)


class MiddlewareNode(ManagedNode):
    """Listens to a robot's topics; publishes `odometry/filtered` and `/diagnostics`."""

    def __init__(self, **options: Any) -> None:
        super().__init__("middleware_node", "middleware", **options)
        self._rejected: set[Rejection] = set()  # at the last look
        runner.serve(self, "~/reset", self._reset)
        runner.diagnose(self, "topics", self._look)

    def configure(self) -> None:
        """Open the model and subscribe."""
        model = open_model(runner.get_text(self, "model"))
        self._hardware = model.robot.name
        rehearse(model)
        self._filtered = self.create_lifecycle_publisher(
            Odometry, inputs.ESTIMATE, qos.SENSOR_RELIABLE
        )
        self._topics = RobotTopics(self, model, on_odometry=self._publish)
        self.undo.callback(self._topics.close)
        self._topics.subscribe_initial_pose()
        self._map_to_odom: MapToOdom | None = None
        if self.get_parameter("publish_map_to_odom").value:
            tolerance = runner.get_number(self, "transform_tolerance")
            self._map_to_odom = MapToOdom(self, tolerance)
            self.undo.callback(self._map_to_odom.close)

    def _publish(self, stamp_ns: int) -> None:
        if self.state != ACTIVE:
            return
        estimator = self._topics.middleware.estimator
        # a pose or a yaw rate may be newer
        stamp_ns = max(stamp_ns, estimator.time_ns)
        view = self._topics.middleware.view(stamp_ns)
        map_frame = runner.get_text(self, MAP_FRAME)
        base_frame = runner.get_text(self, BASE_FRAME)
        message = conversions.odometry_to_ros(
            view.pose, view.twist, stamp_ns, (map_frame, base_frame), (0.0,) * 4
        )
        message.pose.covariance = conversions.covariance_to_ros(
            estimator.covariance[:3, :3]
        )
        message.twist.covariance = conversions.covariance_to_ros(
            estimator.twist_covariance
        )
        self._filtered.publish(message)
        reported = self._topics.locate_in_odom()
        if self._map_to_odom is not None and reported is not None:
            home = compute_odom_in_map(self._topics.view().pose, reported)
            self._map_to_odom.publish(
                home, stamp_ns, (map_frame, self._topics.frames[0])
            )

    def _reset(self) -> tuple[bool, str]:
        if self.state == UNCONFIGURED:
            return False, "the node is not configured, so there is nothing to reset"
        self._topics.restart()
        return True, "the next odometry defines the map frame"

    def _look(self) -> runner.Condition:
        if self.state == UNCONFIGURED:
            return runner.Condition(self.state, OK, facts={})
        health = self._topics.middleware.health(self._topics.now_ns())
        new = sorted(health.rejected.keys() - self._rejected)
        self._rejected = set(health.rejected)
        if new:
            listed = shorten("; ".join(map(str, new)), LONGEST)
            self.get_logger().warning(
                f"rejected data, counted in /diagnostics: {listed}"
            )
        awaited = dict.fromkeys((*self._topics.expected, *health.topics))
        silent = self._topics.list_silent(awaited, SILENCE_S)
        level = STALE if silent else OK
        message = "receiving" if self.state == ACTIVE else self.state
        if silent:
            message = f"nothing usable on {', '.join(silent)}"
        return runner.Condition(message, level, health.describe(), self._hardware)


main = partial(runner.run_node, MiddlewareNode, sole_name="middleware_node")
