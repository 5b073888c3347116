"""Nav2's actions `follow_path` and `navigate_to_pose`, served by a policy."""

import contextlib
import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from nav_msgs.msg import OccupancyGrid
from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.duration import Duration
from rclpy.node import Node, NodeNameNonExistentError

from nics_drl_bridge import geometry
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.extras.nav2.follow import (
    GoalChecker,
    Place,
    PlannedPath,
    ProgressChecker,
)
from nics_drl_bridge.extras.nav2.nav2_parameters import (
    ControllerParameters,
    choose_plugin,
)
from nics_drl_bridge.extras.nav2.route import route, warm_up
from nics_drl_bridge.generator import SimulatorModel
from nics_drl_bridge.interface import S_PER_NS, Array
from nics_drl_bridge.lidar.maps import GridMap
from nics_drl_bridge.middleware.measurement import ODOM, SCAN
from nics_drl_bridge.nodes import conversions, qos, runner
from nics_drl_bridge.nodes.frames import GoalFrames
from nics_drl_bridge.nodes.robot_topics import RobotTopics
from nics_drl_bridge.recording.messages import read_pose

FOLLOW = "follow_path"
NAVIGATE = "navigate_to_pose"
KINDS = {
    FOLLOW: "nav2_msgs/action/FollowPath",
    NAVIGATE: "nav2_msgs/action/NavigateToPose",
}
SUCCEED = "succeed"
ABORT = "abort"
CANCELED = "canceled"
SPEED_LIMIT = "nav2_msgs/msg/SpeedLimit"
LOOK_S = 2.0  # time between two looks for another server of `navigate_to_pose` [s]
PATIENT_PERIODS = 10  # control periods for which data may always be silent
TURNING = 1.5  # turn rate at the goal per remaining angle [1/s]
# [rad/s], and for the time that is left [m/s]
LEAST_TURN = 0.3
SLOWEST = 0.1


class Refusal(Exception):  # noqa: N818  (an outcome, by the standard's code)
    """The end of a goal, with a code of its action's result and a sentence."""

    def __init__(self, code: str, sentence: str) -> None:
        super().__init__(sentence)
        self.code = code


class HeldActionServer(ActionServer):
    """Accepts goals while `open_` is true; hands each to `begin` and holds it until `finish`.

    No callback waits for a goal, because rclpy polls waiting callbacks in each turn of an executor.
    """

    def __init__(
        self,
        node: Node,
        kind: Any,
        name: str,
        open_: Callable[[], bool],
        begin: Callable[[Any], None],
    ) -> None:
        self._begin = begin
        accept = GoalResponse.ACCEPT
        reject = GoalResponse.REJECT
        super().__init__(
            node,
            kind,
            name,
            lambda _: None,
            goal_callback=lambda _: accept if open_() else reject,
            cancel_callback=lambda _: CancelResponse.ACCEPT,
        )

    def notify_execute(self, goal_handle: Any, execute_callback: Any) -> None:
        """Hold an accepted goal, which now counts as executing; see rclpy."""
        self._begin(goal_handle)

    def finish(self, goal_handle: Any, end: str, result: Any) -> None:
        """End a goal with a result; `end` names the goal handle's method."""
        getattr(goal_handle, end)()
        super().notify_execute(goal_handle, lambda _: result)


class Goal(NamedTuple):
    """A goal that was accepted."""

    name: str  # of its action
    kind: Any  # its type
    server: HeldActionServer
    handle: Any

    @property
    def code(self) -> str:
        """Result code for a path that can't be driven."""
        return "INVALID_PATH" if self.name == FOLLOW else "UNKNOWN"


@dataclass
class Run:
    """An accepted goal to which the robot is driving."""

    goal: Goal
    frame: str  # of the path
    path: PlannedPath
    arrival: GoalChecker
    progress: ProgressChecker
    started_s: float
    valid_s: float  # last time at which a command was valid


@contextlib.contextmanager
def refuse_config_errors(goal: Goal, code: str) -> Iterator[None]:
    """Within this context, what is wrong with a goal raises Refusal with a code."""
    try:
        yield
    except ConfigError as error:
        raise Refusal(code, f"{goal.name}: {error}") from None


class PathActions:
    """Serves both actions while a node is active; a new goal replaces the present one.

    Without nav2_msgs nothing is served. If another node, such as Nav2's
    bt_navigator, serves `navigate_to_pose`, this one does not.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self.parameters = ControllerParameters(node)
        self.ignores = self.parameters.ignores
        self._run: Run | None = None
        self._undo: list[Callable[[], Any]] = []
        self._servers: dict[str, HeldActionServer] = {}

    def open(
        self,
        topics: RobotTopics,
        frames: GoalFrames,
        model: SimulatorModel,
        drive: Callable[[Array], runner.Wish],
        reset_policy: Callable[[], None],
    ) -> None:
        """Serve the actions until `close`.

        `drive` asks the policy to drive to a goal (2,) in the map of the estimate, and
        `reset_policy` empties its memory.
        """
        node = self._node
        self._topics = topics
        self._frames = frames
        self._robot = model.robot
        self._drive = drive
        self._reset_policy = reset_policy
        self._map: tuple[str, GridMap] | None = None  # and its frame
        self._limit = math.inf  # of the speed [m/s]
        self._period_s = model.control_period
        self._kinds = {
            name: conversions.find_message_type(kind) for name, kind in KINDS.items()
        }
        if None in self._kinds.values():
            node.get_logger().info(
                "the package nav2_msgs is not installed, so its actions are not served; "
                "install it with your ROS 2 distribution."
            )
            return
        self._serve(FOLLOW, self._follow)
        if node.get_parameter(NAVIGATE).value:
            warm_up()
            self._serve(NAVIGATE, self._navigate)
            timer = runner.call_periodically(node, LOOK_S, self._look)
            self._undo.append(partial(node.destroy_timer, timer))
        topic = runner.get_text(node, "speed_limit_topic")
        limit_type = conversions.find_message_type(SPEED_LIMIT)
        for heard in (
            node.create_subscription(OccupancyGrid, "map", self._take_map, qos.LATCHED),
            node.create_subscription(limit_type, topic, self._take_limit, qos.COMMAND),
        ):
            self._undo.append(partial(node.destroy_subscription, heard))

    def _serve(self, name: str, begin: Callable[[Goal], Run]) -> None:
        kind = self._kinds[name]

        def take(handle: Any) -> None:
            self._accept(Goal(name, kind, self._servers[name], handle), begin)

        self._servers[name] = HeldActionServer(self._node, kind, name, self._open, take)

    def close(self) -> None:
        """End all goals and topics."""
        self.stop("the node is being cleaned up")
        while self._undo:
            self._undo.pop()()
        while self._servers:
            self._servers.popitem()[1].destroy()

    def _open(self) -> bool:
        return getattr(self._node, "state", runner.ACTIVE) == runner.ACTIVE

    @property
    def active(self) -> bool:
        """True while the robot is driving to a goal."""
        return self._run is not None

    @property
    def led(self) -> bool:
        """True if another node serves `navigate_to_pose` and thereby handles `goal_pose`."""
        wanted = f"{self._node.resolve_topic_name(NAVIGATE)}/_action/send_goal"
        this_node = self._node.get_name(), self._node.get_namespace()
        for name, space in self._node.get_node_names_and_namespaces():
            if (name, space) != this_node:
                with contextlib.suppress(NodeNameNonExistentError):  # it has just ended
                    served = self._node.get_service_names_and_types_by_node(name, space)
                    if any(service == wanted for service, _ in served):
                        return True
        return False

    def _look(self) -> None:
        may_give_way = NAVIGATE in self._servers and (
            self._run is None or self._run.goal.name == FOLLOW
        )
        if may_give_way and self.led:
            reason = f"another node serves {NAVIGATE}, so this one no longer does"
            self._node.get_logger().info(reason)
            self._servers.pop(NAVIGATE).destroy()

    def _take_map(self, message: OccupancyGrid) -> None:
        try:
            grid = conversions.map_from_ros(message)
        except ConfigError as error:
            self._node.get_logger().error(f"{error} It is not used.")
        else:
            self._map = message.header.frame_id.strip("/"), grid

    def _take_limit(self, message: Any) -> None:
        limit = float(message.speed_limit)
        if not (math.isfinite(limit) and limit >= 0.0):
            self._node.get_logger().error(
                f"speed limit {limit:g}: must be 0, for none, or more."
            )
            return
        if message.percentage:
            limit *= 0.01 * float(self._robot.to_fields(self._robot.command_high)[0])
        self._limit = limit or math.inf

    # A goal begins.

    def _accept(self, goal: Goal, begin: Callable[[Goal], Run]) -> None:
        before = self._run
        self._run = None
        try:
            run = self._run = begin(goal)
            if before is not None and before.frame == run.frame:
                # a replanned path is no progress
                run.valid_s = before.valid_s
                if before.progress.check == run.progress.check:
                    run.progress = before.progress
            if before is None or not np.array_equal(before.path.end, run.path.end):
                self._reset_policy()  # not if the same path was replanned
        except Refusal as refusal:
            self._end(goal, ABORT, refusal.code, str(refusal))
        if before is not None:
            self._end(before.goal, ABORT, "UNKNOWN", "a newer goal has replaced it.")

    def _follow(self, goal: Goal) -> Run:
        asked = goal.handle.request
        names = []
        for kind, names_of_kind in self.parameters.names.items():
            code = "INVALID_CONTROLLER" if kind == "controller" else "UNKNOWN"
            with refuse_config_errors(goal, code):
                name = getattr(asked, f"{kind}_id", "")
                names.append(choose_plugin(kind, name, names_of_kind))
        poses = np.array([read_pose(pose) for pose in asked.path.poses]).reshape(-1, 3)
        headers = [asked.path.header, *(pose.header for pose in asked.path.poses[:1])]
        frame = next((header.frame_id for header in headers if header.frame_id), "")
        return self._begin(goal, frame, poses, names[1:3])

    def _navigate(self, goal: Goal) -> Run:
        asked = goal.handle.request
        if asked.behavior_tree:
            raise Refusal(
                "FAILED_TO_LOAD_BEHAVIOR_TREE",
                f"{NAVIGATE}: behaviour trees such as {asked.behavior_tree!r} are not "
                "supported; leave it empty, or let Nav2 serve the action.",
            )
        end = np.array([read_pose(asked.pose)])
        with refuse_config_errors(goal, "TF_ERROR"):
            frame, end = self._frames.fixed(asked.pose.header.frame_id, end)
        with refuse_config_errors(goal, goal.code):
            PlannedPath(end)
        # on the map if there is one, else straight
        points = np.stack([self._robot_in(NAVIGATE, frame)[:2], end[0, :2]])
        if self._map is not None and frame in ("", self._map[0]):
            with refuse_config_errors(goal, goal.code):
                radius = self._robot.footprint_radius
                points = route(self._map[1], points[0], points[1], radius)
        way = np.column_stack([points, np.full(len(points), end[0, 2])])
        checks = [
            self.parameters.names[f"{kind}_checker"][0] for kind in ("goal", "progress")
        ]
        return self._begin(goal, frame, way, checks)

    def _robot_in(self, name: str, frame: str) -> Array:
        robot = self._frames.locate_robot(frame)
        if robot is None:
            raise Refusal(
                "TF_ERROR",
                f"{name}: the robot's pose is not known yet; send the goal again once odometry "
                "and pose have arrived.",
            )
        return robot

    def _begin(
        self, goal: Goal, frame: str, poses: Array, checks: Sequence[str]
    ) -> Run:
        with refuse_config_errors(goal, "TF_ERROR"):
            frame, poses = self._frames.fixed(frame, poses)
        with refuse_config_errors(goal, goal.code):
            path = PlannedPath(poses)
        self._robot_in(goal.name, frame)
        arrival, progress = self.parameters.checks(*checks)
        goal_checker = GoalChecker(arrival, not self._robot.steers)
        progress_checker = ProgressChecker(progress)
        now_s = time.monotonic()
        return Run(goal, frame, path, goal_checker, progress_checker, now_s, now_s)

    # The robot drives to a goal.

    def tick(self) -> bool:
        """End a goal that was cancelled or whose data are silent; return True if one was ended."""
        run = self._run
        if run is None:
            return False
        if run.goal.handle.is_cancel_requested:
            self._run = None
            self._end(run.goal, CANCELED, "NONE")
            return True
        longest = runner.get_number(self._node, "costmap_update_timeout")
        longest = max(longest, PATIENT_PERIODS * self._period_s)
        silent = self._topics.list_silent((SCAN, ODOM), longest)
        if silent and time.monotonic() - run.valid_s > longest:
            self._run = None
            sentence = f"nothing on {' and '.join(silent)} for {longest:g} s."
            self._end(run.goal, ABORT, "CONTROLLER_TIMED_OUT", sentence)
            return True
        return False

    def twist(self) -> Array:
        """Return the twist (3,) towards the end of the path; report, and end the goal there."""
        run = self._run
        assert run is not None  # noqa: S101
        try:
            return self._steer(run)
        except Refusal as refusal:
            self._run = None
            self._end(run.goal, ABORT, refusal.code, str(refusal))
            return np.zeros(3)

    def _steer(self, run: Run) -> Array:
        robot = self._robot_in("the path", run.frame)
        place = run.path.locate(robot, runner.get_number(self._node, "lookahead"))
        turn = run.arrival.turn_left(place, robot, run.path.end)
        if turn == 0.0:
            self._run = None
            self._end(run.goal, SUCCEED, "NONE")
            return np.zeros(3)
        now_s = self._topics.newest_ns * S_PER_NS
        if run.progress.stuck(now_s, robot):
            raise Refusal(
                "FAILED_TO_MAKE_PROGRESS",
                "the robot has made no progress for too long.",
            )
        estimate = self._topics.view()
        ahead = geometry.compose(
            estimate.pose, geometry.between(robot, [*place.ahead, 0.0])
        )
        drive = self._drive(ahead[:2])
        if drive.touched:
            patience = runner.get_number(self._node, "failure_tolerance")
            # the robot has waited long enough
            if 0.0 <= patience < time.monotonic() - run.valid_s:
                code = "PATIENCE_EXCEEDED" if patience else "NO_VALID_CONTROL"
                raise Refusal(
                    code, "the robot touches something, so no command is valid."
                )
        else:
            run.valid_s = time.monotonic()
        twist: Array = np.zeros(3) if drive.touched else drive.twist
        if turn is not None:  # on the spot
            most = float(self._robot.to_fields(self._robot.command_high)[2])
            rate = min(max(TURNING * abs(turn), LEAST_TURN), most)
            twist = np.array([0.0, 0.0, math.copysign(rate, turn)])
        self._report(run, robot, place, estimate.twist)
        return self._limit_speed(twist)

    def _limit_speed(self, twist: Array) -> Array:
        """Scale the speed down to the limit without changing the robot's path."""
        share = min(1.0, self._limit / max(float(np.hypot(*twist[:2])), 1e-9))
        steers = self._robot.steers and not self._robot.takes_turn_rate
        limited: Array = twist * np.array([share, share, 1.0 if steers else share])
        return limited

    def _report(self, run: Run, robot: Array, place: Place, twist: Array) -> None:
        speed = float(np.hypot(*twist[:2]))
        pose = conversions.pose_to_ros(robot, self._topics.newest_ns, run.frame)
        driven_s = time.monotonic() - run.started_s
        remaining_s = place.remaining / max(speed, SLOWEST)
        values = {
            "distance_to_goal": place.distance,
            "speed": speed,
            "robot_pose": pose,
            "position_tracking_error": place.left,
            "heading_tracking_error": place.turned,
            "current_path_index": place.nearest,
            "remaining_path_length": place.remaining,
            "current_pose": pose,
            "distance_remaining": place.remaining,
            "header": pose.header,
            "navigation_time": Duration(seconds=driven_s).to_msg(),
            "estimated_time_remaining": Duration(seconds=remaining_s).to_msg(),
        }
        feedback = run.goal.kind.Feedback()
        for part in (feedback, getattr(feedback, "tracking_feedback", None)):
            for name in (
                values.keys()
                & getattr(part, "get_fields_and_field_types", dict)().keys()
            ):
                setattr(part, name, values[name])
        run.goal.handle.publish_feedback(feedback)

    def stop(self, why: str) -> None:
        """Abort the goal, if there is one."""
        run = self._run
        self._run = None
        if run is not None:
            self._end(run.goal, ABORT, "UNKNOWN", f"{why}.")

    def _end(self, goal: Goal, end: str, code: str, sentence: str = "") -> None:
        if goal.handle.is_cancel_requested:
            end = CANCELED
        if end == ABORT:
            self._node.get_logger().warning(f"goal aborted: {sentence}")
        else:
            self._node.get_logger().info(
                "goal reached" if end == SUCCEED else "goal cancelled"
            )
        result = make_result(goal.kind, code, sentence)
        goal.server.finish(goal.handle, end, result)


def make_result(kind: Any, code: str, sentence: str = "") -> Any:
    """Return an action's result; by distribution it has no fields, a code, or code and sentence."""
    result = kind.Result()
    if hasattr(result, "error_code"):
        result.error_code = getattr(
            kind.Result, code, getattr(kind.Result, "UNKNOWN", 0)
        )
    if hasattr(result, "error_msg"):
        result.error_msg = sentence
    return result
