"""A stand-in for Nav2's behaviour tree: plans on `map`, has `follow_path` drive, and replans."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from diagnostic_msgs.srv import SelfTest
from geometry_msgs.msg import PoseWithCovarianceStamped, Twist, TwistStamped
from nav2_msgs.action import FollowPath
from nav_msgs.msg import OccupancyGrid, Odometry, Path
from rclpy.action import ActionClient

from nics_drl_bridge.extras.nav2.route import route
from nics_drl_bridge.interface import Array
from nics_drl_bridge.nodes import conversions, qos
from nics_drl_bridge.nodes.listener import SpunNode

DEADLINE_S = 300.0
# silence after which the simulator, which waits for commands, is told a zero
STUCK_S = 2.0
REPLAN = 40  # feedbacks after which the path is replanned


class StandIn(SpunNode):
    """Speaks to a simulator in lock-step and to a policy; relays the commands of the latter."""

    def __init__(self, domain_id: int, controller: str) -> None:
        super().__init__("behaviour_tree", domain_id)
        node = self.node
        self.client = ActionClient(node, FollowPath, "follow_path")
        self.maps: list[Any] = []
        self.truths: list[Any] = []
        self._feedback: list[Any] = []
        self._commands = node.create_publisher(Twist, "cmd_vel", qos.COMMAND)
        self.poses = node.create_publisher(
            PoseWithCovarianceStamped, "initialpose", qos.COMMAND
        )
        self._moved_s = time.monotonic()
        self._controller = controller
        for kind, topic, take, quality in (
            (TwistStamped, "cmd_vel_raw", self._relay, qos.COMMAND),
            (OccupancyGrid, "map", self.maps.append, qos.LATCHED),
            (Odometry, "ground_truth", self.truths.append, qos.SENSOR),
        ):
            node.create_subscription(kind, topic, take, quality)

    def _relay(self, message: TwistStamped) -> None:
        self._moved_s = time.monotonic()
        self._commands.publish(message.twist)

    def wait_for(self, done: Callable[[], Any], what: str) -> None:
        """Spins until something is the case. Raises TimeoutError."""

        def is_done() -> Any:
            if time.monotonic() - self._moved_s > STUCK_S:
                self._relay(TwistStamped())  # a message was lost
            return done()

        if not self.until(is_done, DEADLINE_S):
            raise TimeoutError(f"not within {DEADLINE_S:g} s: {what}")

    def call(self, kind: Any, service: str, request: Any = None) -> Any:
        """Returns the answer of a service."""
        return self.call_service(kind, service, DEADLINE_S, request)

    @property
    def pose(self) -> Array:
        """(3,) the robot's true pose."""
        return conversions.odometry_from_ros(self.truths[-1])[0]

    def shows(self, cells: bytes) -> bool:
        """True if the robot has told where it is, and the newest map has these cells."""
        return bool(self.truths and self.maps) and self.maps[-1].data.tobytes() == cells

    def place(self, pose: Array) -> None:
        """Says where the robot is to simulator and policy."""
        message = PoseWithCovarianceStamped()
        placed = conversions.pose_to_ros(pose, 0, "map")
        message.header = placed.header
        message.pose.pose = placed.pose
        self.poses.publish(message)

    def send_path(self, goal: Array, radius: float) -> Any:
        """Sends a path to a goal (2,), planned on the newest map; returns the goal's handle."""
        grid = conversions.map_from_ros(self.maps[-1])
        path = path_to_ros(route(grid, self.pose[:2], goal, radius))
        order = FollowPath.Goal(path=path, controller_id=self._controller)
        future = self.client.send_goal_async(
            order, feedback_callback=self._feedback.append
        )
        self.wait_for(future.done, "an answer to a goal")
        return future.result()

    def drive(self, goal: Array, radius: float) -> Any:
        """Has the robot driven to a goal (2,) and replans now and then; returns the result."""
        handle = self.send_path(goal, radius)
        while True:
            self._feedback.clear()
            result = handle.get_result_async()
            self.wait_for(
                lambda result=result: result.done() or len(self._feedback) >= REPLAN,
                "a result",
            )
            if result.done():
                return result.result()
            if math.dist(self.pose[:2], goal) > 1.0:
                handle = self.send_path(goal, radius)

    def has_touched(self) -> bool:
        """True if the robot has touched something."""
        return not any(self.call(SelfTest, "simulator_node/self_test").passed)


def path_to_ros(points: Array) -> Path:
    """A path (P, 2) in the map, each pose turned to the next one."""
    steps = np.diff(points, axis=0)
    headings = np.arctan2(steps[:, 1], steps[:, 0])
    headings = np.append(headings, headings[-1:] if len(headings) else 0.0)
    path = Path()
    path.header.frame_id = "map"
    path.poses = [
        conversions.pose_to_ros([*point, heading], 0, "map")
        for point, heading in zip(points, headings, strict=True)
    ]
    return path
