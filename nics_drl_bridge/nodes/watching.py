"""A live robot for the page of `nics watch`; it listens to topics and sends only goals."""

from dataclasses import replace
from functools import partial

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry

from nics_drl_bridge.config import parse_namespace
from nics_drl_bridge.env.snapshot import Snapshot
from nics_drl_bridge.gate import inputs
from nics_drl_bridge.generator import SimulatorModel
from nics_drl_bridge.interface import Array
from nics_drl_bridge.lidar.shapes import BODY
from nics_drl_bridge.lidar.spec import LidarSpec
from nics_drl_bridge.nodes import conversions, qos
from nics_drl_bridge.nodes.listener import SpunNode
from nics_drl_bridge.nodes.robot_topics import RobotTopics
from nics_drl_bridge.nodes.runner import declare_rows
from nics_drl_bridge.sim.world import World, check_place
from nics_drl_bridge.sim.world_set import AnyWorld
from nics_drl_bridge.watch.frame import Frame, Stage, Track, WorldFrame
from nics_drl_bridge.watch.server import Request

NAME = "nics_watch"
GATE = ": gate"
PERIOD_S = 1.0 / 30.0
SIDE_M = 10.0  # side of the field shown if no world is given [m]


class RosSource:
    """Shows the topics of a robot, with the estimate of its own middleware.

    A goal that is set on the page is published on `goal_pose`; nothing else is sent. Raises
    ConfigError, BackendError.
    """

    def __init__(
        self,
        model: SimulatorModel,
        world: AnyWorld | None,
        namespace: str = "",
        domain_id: int | None = None,
        model_name: str = "",
    ) -> None:
        half = SIDE_M / 2.0
        bounds = (-half, -half, half, half)
        self._world = world or World(
            name="map", bounds=bounds, goal_distance=(0.0, 1.0)
        )
        # the world that is shown
        self._within = None if world is None else world.members[0]
        self._model = model
        self.period_s = PERIOD_S
        self._title = namespace or "live topics"
        self._model_name = model_name
        self._trail = Track()
        self._goal: PoseStamped | None = None
        self._gate: str | None = None
        self._truth: Array | None = None
        # frame of goals, as named by the estimate or the simulator
        self._map_frame = "map"
        self._new_lidar: LidarSpec | None = None
        self._drawn_ns = 0
        self._spun = SpunNode(NAME, domain_id, parse_namespace(namespace))
        self._node = self._spun.node
        declare_rows(self._node, "sensors", "stamped")
        self._topics = RobotTopics(
            self._node, model, on_lidar=partial(setattr, self, "_new_lidar")
        )
        self._goals = self._node.create_publisher(PoseStamped, "goal_pose", qos.COMMAND)
        for kind, topic, take, quality in (
            (PoseStamped, "goal_pose", partial(setattr, self, "_goal"), qos.COMMAND),
            (Odometry, "ground_truth", self._take_truth, qos.SENSOR),
            (Odometry, inputs.ESTIMATE, self._take_map_frame, qos.SENSOR),
            (DiagnosticArray, "/diagnostics", self._take_diagnostics, qos.DIAGNOSTICS),
        ):
            self._node.create_subscription(kind, topic, take, quality)
        self._spun.start()

    def _take_truth(self, message: Odometry) -> None:
        pose = conversions.odometry_from_ros(message)[0]
        self._truth = pose if np.isfinite(pose).all() else None

    def _take_map_frame(self, message: Odometry) -> None:
        self._map_frame = message.header.frame_id or self._map_frame

    def _take_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            if status.name.endswith(GATE):
                if status.level in (DiagnosticStatus.OK, 0):
                    self._gate = ""
                else:
                    self._gate = status.message

    def stage(self) -> Stage:
        """See `show.FrameSource`."""
        can = frozenset({"goal"})
        return Stage(
            self._title, self._model, (self._world,), can, model_name=self._model_name
        )

    def frame(self) -> Frame:
        """See `show.FrameSource`."""
        with self._topics.lock:
            middleware = self._topics.middleware
            view = self._topics.view()
            command = middleware.commanded
            covariance = middleware.estimator.covariance[None, :3, :3].copy()
            heard = sorted(middleware.cache.newest)
        pose = view.pose if self._truth is None else self._truth
        goals = []
        if self._goal is not None:
            position = self._goal.pose.position
            goals = [(position.x, position.y)]
        shot = Snapshot(
            pose[None],
            view.ranges[None],
            np.zeros((0, BODY)),
            np.reshape(goals, (-1, 2)),
            estimates=view.pose[None],
            covariance=covariance,
            commands=command[None],
            gate=self._gate,
        )
        state = "" if heard else "waiting for topics"
        world = WorldFrame(shot, self._title, 0, self._trail.paths, state)
        return Frame(
            view.stamp_s, (world,), f"hears {', '.join(heard)}" if heard else ""
        )

    def advance(self) -> bool:
        """Extend the robot's path if it has moved; return True after scans of another lidar."""
        with self._topics.lock:
            lidar = self._new_lidar
            self._new_lidar = None
            newest = self._topics.newest_ns
            pose = self._topics.view().pose if newest else None
        if pose is not None and newest != self._drawn_ns:
            self._trail.add(pose[None], 0 if newest < self._drawn_ns else 1)
            self._drawn_ns = newest
        if lidar is not None:
            self._model = replace(self._model, lidar=lidar)
        return lidar is not None

    def take(self, request: Request) -> bool:
        """Send a goal and ignore other requests. Raises ConfigError for a goal off the field."""
        if request.kind == "goal":
            if self._within is not None:
                check_place("goal", self._within, request.x, request.y)
            goal = (request.x, request.y, 0.0)
            now_ns = self._topics.now_ns()
            self._goals.publish(conversions.pose_to_ros(goal, now_ns, self._map_frame))
        return False

    def close(self) -> None:
        """Close the node and its context."""
        self._spun.close()
