"""middleware_node: caches a robot's topics and publishes an estimate of its state."""

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

from nav_msgs.msg import Odometry

from nics_drl_bridge.errors import LONGEST, shorten
from nics_drl_bridge.gate import inputs
from nics_drl_bridge.generator import open_model
from nics_drl_bridge.middleware.measurement import Health, Rejection
from nics_drl_bridge.middleware.middleware import rehearse
from nics_drl_bridge.nodes import conversions, qos, runner
from nics_drl_bridge.nodes.frames import MapToOdom, compute_odom_in_map
from nics_drl_bridge.nodes.parameters import BASE_FRAME, MAP_FRAME
from nics_drl_bridge.nodes.robot_topics import SILENCE_S, RobotTopics
from nics_drl_bridge.nodes.runner import (
    ACTIVE,
    ERROR,
    OK,
    STALE,
    UNCONFIGURED,
    ManagedNode,
)


class MiddlewareNode(ManagedNode):
    """Listens to a robot's topics; publishes `odometry/filtered` and `/diagnostics`."""

    def __init__(self, **options: Any) -> None:
        super().__init__("middleware_node", "middleware", **options)
        self._rejected: dict[Rejection, int] = {}  # counts at the last look
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
        new = sorted(health.rejected.keys() - self._rejected.keys())
        if new:
            listed = shorten("; ".join(map(str, new)), LONGEST)
            self.get_logger().warning(
                f"rejected data, counted in /diagnostics: {listed}"
            )
        awaited = dict.fromkeys((*self._topics.expected, *health.topics))
        missing = ""
        if self._topics.lacks_gyro:
            missing = "nobody publishes one, though the model was made with it: the wheels turn"
            self.get_logger().warning(f"imu: {missing}", once=True)
        level, trouble = judge_topics(health, tuple(awaited), self._rejected)
        self._rejected = health.rejected
        message = trouble or ("receiving" if self.state == ACTIVE else self.state)
        shown = health.describe() | ({"imu": missing} if missing else {})
        return runner.Condition(message, level, shown, self._hardware)


def judge_topics(
    health: Health, expected: Sequence[str], before: Mapping[Rejection, int]
) -> tuple[bytes, str]:
    """Return the level of a diagnosis, and a sentence about expected topics without usable data.

    Silent topics are stale, and those whose data are refused an error. The sentence is empty if
    there are none. `before` holds earlier counts of `health.rejected`: a topic whose count grew is
    not silent.
    """
    unusable = [topic for topic in expected if topic not in health.topics]
    since = "yet"
    if not unusable:
        since = f"for {SILENCE_S:g} s"
        unusable = [
            topic for topic in expected if health.topics[topic].age_s > SILENCE_S
        ]
    silent = []
    refused = []
    for topic in unusable:
        count = 0
        reason = ""  # the last one whose count grew
        for rejection, number in health.rejected.items():
            if rejection.topic == topic:
                count += number
                if number > before.get(rejection, 0):
                    reason = rejection.reason
        if reason:
            refused.append(f"{topic}: {count} refused, the last: {reason}")
        else:
            silent.append(topic)
    clauses = [f"nothing on {', '.join(silent)} {since}"] if silent else []
    level = OK
    if unusable:
        level = ERROR if refused else STALE
    return level, "; ".join([*clauses, *refused])


main = partial(runner.run_node, MiddlewareNode, sole_name="middleware_node")
