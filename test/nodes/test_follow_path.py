import math
import tarfile
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="needs ROS 2: rclpy is not installed")
pytest.importorskip("nav2_msgs", reason="nav2_msgs is not installed")

from geometry_msgs.msg import (
    PoseStamped,
    PoseWithCovarianceStamped,
    Twist,
    TwistStamped,
)
from nav2_msgs.action import FollowPath, NavigateToPose
from nav2_msgs.msg import SpeedLimit
from nav_msgs.msg import Odometry, Path
from rclpy.action import ActionClient, ActionServer
from rclpy.node import NodeNameNonExistentError
from test_packaging import ROOT

from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.extras.nav2.follow_path import FOLLOW, NAVIGATE, PathActions
from nics_drl_bridge.interface import NS_PER_S
from nics_drl_bridge.nodes import conversions, policy_node, qos
from nics_drl_bridge.nodes.policy_node import PolicyNode
from nics_drl_bridge.nodes.runner import explain_ignored_values
from nodes.peer import pose_of

pytestmark = pytest.mark.ros
SUCCEEDED = 4
CANCELED = 5
ABORTED = 6
ARCHIVE = ROOT.parent / "shared" / "upstream" / "nav2_interfaces.tar.gz"
CODES = FollowPath.Result
CONTROLLER = ("-r", "__node:=controller_server")


class Tree:
    """The test's end of the actions, which relays the commands to a simulator in lock-step."""

    def __init__(self, peer):
        self.peer = peer
        self.feedback = []
        self.truths = peer.listen(Odometry, "ground_truth")
        self.raw = peer.listen(TwistStamped, "cmd_vel_raw", qos.EVERY_COMMAND)
        self.commands = peer.node.create_publisher(Twist, "cmd_vel", qos.COMMAND)
        peer.node.create_subscription(
            TwistStamped,
            "cmd_vel_raw",
            lambda m: self.commands.publish(m.twist),
            qos.EVERY_COMMAND,
        )
        self.clients = {
            kind: ActionClient(peer.node, kind, name)
            for kind, name in (
                (FollowPath, "follow_path"),
                (NavigateToPose, "navigate_to_pose"),
            )
        }

    @property
    def pose(self):
        return pose_of(self.truths[-1])

    def until(self, done, what):
        """Waits; a command of zero makes up for a message that was lost."""
        for _ in range(40):
            if self.peer.within(3.0, done):
                return
            self.commands.publish(Twist())
        raise AssertionError(f"never: {what}")

    def tells_where_it_is(self):
        """Lets the policy know the robot's true pose: odometry has drifted over all the drives."""
        message = PoseWithCovarianceStamped()
        told = "the robot is at"
        message.header.frame_id = "map"
        message.pose.pose = conversions.pose_to_ros(self.pose, 0, "map").pose
        known = self.policy.log.read_text().count(told)
        self.poses.publish(message)
        self.until(
            lambda: self.policy.log.read_text().count(told) > known, "the pose is heard"
        )

    def send(self, goal):
        kind = FollowPath if isinstance(goal, FollowPath.Goal) else NavigateToPose
        client = self.clients[kind]
        self.until(client.server_is_ready, "the action")
        future = client.send_goal_async(goal, feedback_callback=self.feedback.append)
        self.until(future.done, "an answer")
        assert future.result().accepted
        return future.result()

    def end(self, handle):
        future = handle.get_result_async()
        self.until(future.done, "a result")
        return future.result()

    def ended(self, goal):
        return self.end(self.send(goal))


def path(*points, frame="map"):
    made = Path()
    made.header.frame_id = frame
    made.poses = [conversions.pose_to_ros([*p, 0.0], 0, frame) for p in points]
    return FollowPath.Goal(path=made, controller_id="FollowPath")


@pytest.fixture(scope="module")
def tree(launch, meet, module_domain_id):
    start = {"episode_start": [-2.0, -2.0, 0.0]}
    simulator = launch(
        "simulator_node", module_domain_id, mode="lockstep", world="empty", **start
    )
    policy = launch(
        "policy_node",
        module_domain_id,
        rate=0.0,
        deadline=30.0,
        costmap_update_timeout=60.0,
    )
    made = Tree(meet(module_domain_id))
    made.goals = made.peer.speak(PoseStamped, "goal_pose")
    made.limits = made.peer.speak(SpeedLimit, "speed_limit")
    made.poses = made.peer.speak(PoseWithCovarianceStamped, "initialpose")
    made.policy = policy
    made.until(lambda: made.truths and made.raw, "the robot")
    yield made
    simulator.check()
    policy.check()


def test_a_path_is_followed_to_its_end_with_feedback(tree):
    tree.feedback.clear()
    result = tree.ended(path((-2.0, -2.0), (0.0, -2.0), (0.5, -1.5)))
    assert (result.status, result.result.error_code) == (SUCCEEDED, CODES.NONE)
    assert math.dist(tree.pose[:2], (0.5, -1.5)) < 0.35
    told = [each.feedback.tracking_feedback for each in tree.feedback]
    assert told[0].distance_to_goal > 2.0 > 0.5 > told[-1].distance_to_goal
    assert told[0].remaining_path_length > told[-1].remaining_path_length
    assert max(each.speed for each in told) > 0.1
    assert told[-1].robot_pose.header.frame_id == "map"
    assert np.abs([each.position_tracking_error for each in told]).max() < 0.5
    tree.until(lambda: tree.raw[-1].twist == Twist(), "rest")


def by(**names):
    return FollowPath.Goal(path=path((0.0, 0.0)).path, **names)


REFUSED = [
    (path(), CODES.INVALID_PATH, "the path is empty"),
    (path((math.nan, 0.0)), CODES.INVALID_PATH, "not a number"),
    (
        path((0.0, 0.0), (9.0, 0.0)),
        CODES.INVALID_PATH,
        "(9.00, 0.00) m, is off the map",
    ),
    (
        path((0.0, 0.0), frame="kitchen"),
        CODES.TF_ERROR,
        "'kitchen' is refused: the frame is not known",
    ),
    (
        by(controller_id="DWB"),
        CODES.INVALID_CONTROLLER,
        "'DWB'; name one of 'FollowPath'",
    ),
    (by(goal_checker_id="exact"), CODES.UNKNOWN, "no goal checker 'exact'"),
    (by(path_handler_id="exact"), CODES.UNKNOWN, "no path handler 'exact'"),
    (path((1e5, 0.0), frame="base_link"), CODES.INVALID_PATH, "pose 0 of the path"),
]


@pytest.mark.parametrize(("goal", "code", "sentence"), REFUSED)
def test_a_path_that_can_not_be_followed_ends_with_the_standards_code_and_a_sentence(
    tree, goal, code, sentence
):
    result = tree.ended(goal)
    assert (result.status, result.result.error_code) == (ABORTED, code)
    assert sentence in result.result.error_msg
    assert result.result.error_msg.startswith("follow_path: ")


def test_a_path_ahead_of_the_robot_is_where_it_looks(tree):
    before = tree.pose
    result = tree.ended(path((0.0, 0.0), (0.8, 0.0), frame="base_link"))
    assert result.status == SUCCEEDED
    ahead = before[:2] + 0.8 * np.array([math.cos(before[2]), math.sin(before[2])])
    assert math.dist(tree.pose[:2], ahead) < 0.4


def test_a_cancelled_path_stops_the_robot(tree):
    handle = tree.send(path(tree.pose[:2].tolist(), (0.0, 0.0), (2.0, 2.0)))
    tree.until(lambda: tree.raw[-1].twist.linear.x > 0.1, "driving")
    future = handle.cancel_goal_async()
    tree.until(future.done, "cancelling")
    assert tree.end(handle).status == CANCELED
    tree.until(lambda: tree.raw[-1].twist == Twist(), "rest")


def test_a_newer_path_takes_the_place_of_the_one_before_and_no_goal_pose_does(tree):
    first = tree.send(path(tree.pose[:2].tolist(), (-2.0, 2.0)))
    second = tree.send(path(tree.pose[:2].tolist(), (0.0, 0.5)))
    ended = tree.end(first)
    assert ended.status == ABORTED
    assert "a newer goal" in ended.result.error_msg
    tree.goals.publish(PoseStamped())
    log = tree.policy.log
    tree.until(lambda: "goal_pose is ignored" in log.read_text(), "a sentence")
    assert tree.end(second).status == SUCCEEDED


def test_a_speed_limit_is_kept_and_a_robot_that_does_not_get_on_is_given_up(tree):
    most = max(raw.twist.linear.x for raw in tree.raw)
    tree.limits.publish(SpeedLimit(percentage=True, speed_limit=1.0))
    tree.peer.within(0.5, lambda: False)
    known = len(tree.raw)
    handle = tree.send(path(tree.pose[:2].tolist(), (-2.0, -2.0)))
    result = tree.end(handle)
    assert result.result.error_code == CODES.FAILED_TO_MAKE_PROGRESS
    fastest = max(abs(raw.twist.linear.x) for raw in tree.raw[known + 2 :])
    assert 0.0 < fastest < 0.05 < most
    tree.limits.publish(SpeedLimit())


def test_a_robot_that_stands_is_given_up_although_its_path_is_planned_again(tree):
    def now_s():
        return conversions.stamp_from_ros(tree.truths[-1].header.stamp) / NS_PER_S

    tree.limits.publish(SpeedLimit(percentage=True, speed_limit=1.0))
    tree.peer.within(0.5, lambda: False)
    way = path(tree.pose[:2].tolist(), (-2.0, 2.0))
    since_s = now_s()
    codes = []
    while not codes and now_s() - since_s < 30.0:
        future, sent_s = tree.send(way).get_result_async(), now_s()
        tree.until(
            lambda f=future, s=sent_s: f.done() or now_s() - s > 3.0, "3 s, or an end"
        )
        if future.done():
            codes.append(future.result().result.error_code)
    assert codes == [CODES.FAILED_TO_MAKE_PROGRESS]
    tree.limits.publish(SpeedLimit())


def test_navigate_to_pose_drives_to_a_goal_and_knows_no_trees(tree):
    goal = NavigateToPose.Goal()
    goal.pose.header.frame_id, goal.behavior_tree = "map", "mine.xml"
    result = tree.ended(goal)
    assert (
        result.result.error_code == NavigateToPose.Result.FAILED_TO_LOAD_BEHAVIOR_TREE
    )
    goal.behavior_tree = ""
    goal.pose.pose.position.x = -1.5
    tree.feedback.clear()
    tree.tells_where_it_is()
    result = tree.ended(goal)
    assert (result.status, result.result.error_code) == (SUCCEEDED, 0)
    assert math.dist(tree.pose[:2], (-1.5, 0.0)) < 0.35
    assert (
        tree.feedback[0].feedback.distance_remaining
        > tree.feedback[-1].feedback.distance_remaining
    )


def test_navigate_to_pose_is_left_to_another_node_that_serves_it(tree):
    other = ActionServer(
        tree.peer.node, NavigateToPose, "navigate_to_pose", lambda _: None
    )
    log = tree.policy.log
    tree.until(
        lambda: "another node serves navigate_to_pose" in log.read_text(), "a sentence"
    )
    other.destroy()


@pytest.mark.parametrize("driven", [NAVIGATE, FOLLOW])
def test_a_goal_that_is_driven_to_keeps_its_server_until_its_end(driven):
    dropped, run = [], SimpleNamespace(goal=SimpleNamespace(name=driven))
    server = SimpleNamespace(destroy=lambda: dropped.append(1))
    logger = SimpleNamespace(info=str)
    actions = SimpleNamespace(
        _servers={NAVIGATE: server},
        led=True,
        _run=run,
        _node=SimpleNamespace(get_logger=lambda: logger),
    )
    PathActions._look(actions)
    assert bool(dropped) == (driven == FOLLOW)


def test_a_node_that_ends_while_others_are_asked_is_none_that_leads():
    def ended(*_):
        raise NodeNameNonExistentError("it has ended")

    node = SimpleNamespace(
        resolve_topic_name=str,
        get_name=lambda: "policy_node",
        get_namespace=lambda: "/",
        get_node_names_and_namespaces=lambda: [("echo", "/")],
        get_service_names_and_types_by_node=ended,
    )
    assert not PathActions.led.fget(SimpleNamespace(_node=node))


@pytest.mark.skipif(
    not ARCHIVE.is_file(), reason="the sources of Nav2 do not lie there"
)
def test_nav2s_own_parameter_file_is_taken_under_the_name_of_its_controller_server(
    make_node, tmp_path
):
    name = "navigation2/nav2_bringup/params/nav2_params.yaml"
    with tarfile.open(ARCHIVE) as archive:
        archive.extract(name, tmp_path, filter="data")
    words = ("--params-file", str(tmp_path / name), *CONTROLLER)
    node = make_node(words=words, kind=PolicyNode)
    assert explain_ignored_values(node) == []
    goal, progress = node._leaders[0].parameters.checks(
        "general_goal_checker", "progress_checker"
    )
    assert goal.xy_goal_tolerance == 0.25
    assert progress.movement_time_allowance == 10.0


def test_the_progress_checker_of_humble_is_taken_by_its_own_name(make_node, tmp_path):
    file = tmp_path / "humble.yaml"
    file.write_text(
        "controller_server:\n  ros__parameters:\n    progress_checker_plugin: progress\n"
        "    goal_checker_plugins: [general_goal_checker]\n    progress:\n"
        "      plugin: nav2_controller::SimpleProgressChecker\n"
        "      movement_time_allowance: 7.0\n",
        encoding="utf-8",
    )
    words = ("--params-file", str(file), *CONTROLLER)
    node = make_node(words=words, kind=PolicyNode)
    assert explain_ignored_values(node) == []
    assert node._leaders[0].parameters.names["progress_checker"] == ("progress",)
    _, progress = node._leaders[0].parameters.checks("general_goal_checker", "progress")
    assert progress.movement_time_allowance == 7.0


def test_checkers_go_by_their_plugins_and_unknown_headings_do_not_count(make_node):
    words = [
        "goal_checker_plugins:=[exact,near]",
        "near.plugin:=nav2_controller::PositionGoalChecker",
        "progress_checker_plugins:=[slow,turning]",
        "slow.required_movement_angle:=0.1",
        "turning.plugin:=nav2_controller::PoseProgressChecker",
        "turning.required_movement_angle:=0.1",
        "action_server_result_timeout:=10.0",
    ]
    node = make_node(*words, kind=PolicyNode)
    assert explain_ignored_values(node) == []
    found = [
        node._leaders[0].parameters.checks(*names)
        for names in (("exact", "slow"), ("near", "turning"))
    ]
    assert [goal.yaw_goal_tolerance for goal, _ in found] == [0.25, math.inf]
    angles = [progress.required_movement_angle for _, progress in found]
    assert angles == [math.inf, 0.1]


@pytest.mark.parametrize(
    "kind", ["controller", "goal_checker", "progress_checker", "path_handler"]
)
def test_an_empty_list_of_plugins_is_one_sentence(make_node, kind):
    with pytest.raises(ConfigError, match=f"parameter '{kind}_plugins' is empty"):
        make_node(f"{kind}_plugins:=[]", kind=PolicyNode)


def test_a_policy_begins_anew_with_another_goal_and_not_with_another_way_to_it(
    tree, monkeypatch
):
    begun = []
    monkeypatch.setattr(policy_node, "begin", begun.append)
    first = tree.send(path((-2.0, -2.0), (1.0, 1.0)))
    second = tree.send(path((-2.0, -2.0), (-1.0, 0.0), (1.0, 1.0)))
    assert tree.end(first).status == ABORTED
    assert len(begun) == 1
    third = tree.send(path((-2.0, -2.0), (1.5, 1.0)))
    assert tree.end(second).status == ABORTED
    assert len(begun) == 2
    tree.until(third.cancel_goal_async().done, "it is cancelled")


def test_results_of_distributions_without_codes_are_filled_as_far_as_they_go():
    from nics_drl_bridge.extras.nav2.follow_path import make_result

    class Bare:
        class Result:
            pass

    assert vars(make_result(Bare, "TF_ERROR", "why")) == {}
    told = make_result(FollowPath, "TF_ERROR", "why")
    assert (told.error_code, told.error_msg) == (CODES.TF_ERROR, "why")
