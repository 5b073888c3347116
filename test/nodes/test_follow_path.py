"""Nav2's actions without its messages; the campaign `nav2_standards` has them, over DDS."""

import math
import tarfile
from types import SimpleNamespace

import numpy as np
import pytest
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Path
from rclpy.node import Node, NodeNameNonExistentError
from std_msgs.msg import Bool
from std_srvs.srv import Trigger
from test_packaging import ROOT

from nics_drl_bridge import geometry
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.extras.nav2 import follow_path
from nics_drl_bridge.extras.nav2.follow_path import FOLLOW, NAVIGATE, PathActions
from nics_drl_bridge.lidar.maps import GridMap
from nics_drl_bridge.nodes import conversions, policy_node
from nics_drl_bridge.nodes.policy_node import PolicyNode
from nics_drl_bridge.nodes.runner import Wish, explain_ignored_values
from nodes.direct import Clock
from nodes.peer import odometry, scan

pytestmark = pytest.mark.ros
ARCHIVE = ROOT.parent / "shared" / "upstream" / "nav2_interfaces.tar.gz"
CONTROLLER = ("-r", "__node:=controller_server")
FIND = conversions.find_message_type


class Fields:
    """A message of some fields."""

    def __init__(self, *names):
        self.names = names

    def get_fields_and_field_types(self):
        return dict.fromkeys(self.names)


class Kind:
    """An action like those of Nav2, whose codes are their own names."""

    class Result:
        error_code = error_msg = ""

    @staticmethod
    def Feedback():  # noqa: N802 - as in the standard
        made = Fields("distance_remaining", "tracking_feedback")
        made.tracking_feedback = Fields(
            "distance_to_goal", "speed", "remaining_path_length", "robot_pose"
        )
        return made


CODES = (
    "NONE",
    "UNKNOWN",
    "INVALID_PATH",
    "TF_ERROR",
    "INVALID_CONTROLLER",
    "FAILED_TO_MAKE_PROGRESS",
    "CONTROLLER_TIMED_OUT",
    "PATIENCE_EXCEEDED",
    "FAILED_TO_LOAD_BEHAVIOR_TREE",
)
for code in CODES:
    setattr(Kind.Result, code, code)


class Goal:
    """The handle of a goal; `ended` is how it ended, with its code and sentence."""

    def __init__(self, **request):
        self.request = SimpleNamespace(**request)
        self.is_cancel_requested = False
        self.told = []
        self.publish_feedback = self.told.append
        self.ended = None


class Server:
    """Holds goals like `HeldActionServer`."""

    def __init__(self, node, kind, name, is_open, begin):
        self.is_open = is_open
        self.begin = begin
        self.is_destroyed = False

    def finish(self, goal, end, result):
        goal.ended = end, result.error_code, result.error_msg

    def destroy(self):
        self.is_destroyed = True


class Driven:
    """A policy node that drives a robot along its commands, on a field of 8 m by 8 m."""

    def __init__(self, direct):
        given = ("rate:=0.0", "deadline:=5.0", "model:=differential")
        self.robot = direct(*given, kind=PolicyNode)
        self.node = self.robot.node
        (self.actions,) = self.node._leaders
        field = GridMap(np.zeros((80, 80), np.int8), 0.1, (-4.0, -4.0, 0.0))
        self.robot.give("map", conversions.map_to_ros(field, 0, "map"))
        self.pose = np.array([-2.0, -2.0, 0.0])
        self.twist = np.zeros(3)
        self.now_ns = 10**9
        self.node._topics.now_ns = lambda: self.now_ns
        self.look()
        self.put(self.pose)

    def put(self, pose):
        """Tell where the robot is in the map."""
        message = conversions.odometry_to_ros(
            pose, self.twist, 0, ("map", ""), (0.0,) * 4
        )
        placed = FIND("geometry_msgs/msg/PoseWithCovarianceStamped")()
        placed.header.frame_id = "map"
        placed.pose = message.pose
        self.robot.give("initialpose", placed)

    def look(self):
        """Show the robot a scan; return the twist that it drives by from then on."""
        self.now_ns += 10**8
        self.robot.give("odom", odometry(self.now_ns, self.pose, self.twist))
        self.robot.give("scan", scan(self.node._model.lidar, self.now_ns, 3.0))
        self.twist = conversions.twist_from_ros(
            self.robot.sent["cmd_vel_raw"][-1].twist
        )
        self.pose = geometry.compose(self.pose, geometry.exp(0.1 * self.twist))
        return self.twist

    def send(self, goal, name=FOLLOW):
        self.actions._servers[name].begin(goal)
        return goal

    def end(self, goal, name=FOLLOW, looks=400):
        """Drive to a goal; return how it ended."""
        self.send(goal, name)
        for _ in range(looks):
            if goal.ended:
                break
            self.look()
        return goal.ended


@pytest.fixture
def driven(direct, monkeypatch):
    kinds = dict.fromkeys(follow_path.KINDS.values(), Kind)
    kinds[follow_path.SPEED_LIMIT] = Bool
    monkeypatch.setattr(
        conversions, "find_message_type", lambda kind: kinds.get(kind) or FIND(kind)
    )
    monkeypatch.setattr(follow_path, "HeldActionServer", Server)
    return Driven(direct)


def follow(*points, frame="map", **names):
    path = Path()
    path.header.frame_id = frame
    path.poses = [conversions.pose_to_ros([*p, 0.0], 0, frame) for p in points]
    return Goal(path=path, **{"controller_id": "FollowPath"} | names)


def navigate(x, y, tree=""):
    pose = conversions.pose_to_ros([x, y, 0.0], 0, "map")
    return Goal(pose=pose, behavior_tree=tree)


def test_a_path_is_followed_to_its_end_with_feedback(driven):
    goal = follow((-2.0, -2.0), (0.0, -2.0), (0.5, -1.5))
    assert driven.end(goal) == ("succeed", "NONE", "")
    assert math.dist(driven.pose[:2], (0.5, -1.5)) < 0.35
    told = [each.tracking_feedback for each in goal.told]
    assert told[0].distance_to_goal > 2.0 > 0.5 > told[-1].distance_to_goal
    assert told[0].remaining_path_length > told[-1].remaining_path_length
    assert max(each.speed for each in told) > 0.1
    assert told[-1].robot_pose.header.frame_id == "map"
    assert driven.look().tolist() == [0.0, 0.0, 0.0]


@pytest.mark.parametrize(
    ("goal", "code", "sentence"),
    [
        (follow(), "INVALID_PATH", "the path is empty"),
        (follow((math.nan, 0.0)), "INVALID_PATH", "not a number"),
        (follow((0.0, 0.0), frame="kitchen"), "TF_ERROR", "the frame is not known"),
        (
            follow((0.0, 0.0), controller_id="DWB"),
            "INVALID_CONTROLLER",
            "'DWB'; name one of 'FollowPath'",
        ),
        (follow((0.0, 0.0), goal_checker_id="x"), "UNKNOWN", "no goal checker 'x'"),
        (follow((0.0, 0.0), path_handler_id="x"), "UNKNOWN", "no path handler 'x'"),
    ],
)
def test_a_path_that_can_not_be_followed_ends_with_the_standards_code_and_a_sentence(
    driven, goal, code, sentence
):
    end, *told = driven.send(goal).ended
    assert (end, told[0]) == ("abort", code)
    assert sentence in told[1]
    assert told[1].startswith("follow_path: ")


def test_a_path_ahead_of_the_robot_is_where_it_looks(driven):
    assert driven.end(follow((0.0, 0.0), (0.8, 0.0), frame="base_link"))[0] == "succeed"
    assert math.dist(driven.pose[:2], (-1.2, -2.0)) < 0.4


def test_a_cancelled_path_stops_the_robot(driven):
    goal = driven.send(follow((-2.0, -2.0), (2.0, -2.0)))
    for _ in range(10):
        driven.look()
    assert driven.twist[0] > 0.1
    goal.is_cancel_requested = True
    assert driven.look().tolist() == [0.0, 0.0, 0.0]
    assert goal.ended == ("canceled", "NONE", "")


def test_a_newer_path_takes_the_place_of_the_one_before_and_no_goal_pose_does(
    driven, logged, monkeypatch
):
    begun = []
    monkeypatch.setattr(policy_node, "begin", begun.append)
    first = driven.send(follow((-2.0, -2.0), (-2.0, 2.0)))
    again = driven.send(follow((-2.0, -2.0), (-1.0, 0.0), (-2.0, 2.0)))
    assert len(begun) == 1  # another way to the same goal
    for replaced, goal in ((first, again), (again, follow((-2.0, -2.0), (-1.0, -2.0)))):
        if goal is not again:
            driven.send(goal)
        assert replaced.ended[:2] == ("abort", "UNKNOWN")
        assert "a newer goal" in replaced.ended[2]
    assert len(begun) == 2
    driven.robot.give("goal_pose", PoseStamped())
    assert "a goal_pose is ignored while an action leads the robot" in logged
    for _ in range(100):
        driven.look()
    assert goal.ended[0] == "succeed"


@pytest.mark.parametrize("replans", [False, True])
def test_a_robot_that_does_not_get_on_is_given_up_although_its_path_is_planned_again(
    driven, replans, logged
):
    driven.actions._take_limit(SimpleNamespace(percentage=False, speed_limit=math.nan))
    assert "speed limit nan: must be 0, for none, or more." in logged
    driven.actions._take_limit(SimpleNamespace(percentage=True, speed_limit=1.0))
    speeds = []
    goal = driven.send(follow((-2.0, -2.0), (2.0, -2.0)))
    for k in range(120):
        speeds.append(driven.look()[0])
        if goal.ended:
            break
        if replans and k % 30 == 29:
            goal = driven.send(follow((-2.0, -2.0), (2.0, -2.0)))
    assert goal.ended[:2] == ("abort", "FAILED_TO_MAKE_PROGRESS")
    assert 0.0 < max(speeds) < 0.05


def test_navigate_to_pose_drives_to_a_goal_and_knows_no_trees(driven):
    refused = driven.send(navigate(0.0, 0.0, "mine.xml"), NAVIGATE)
    assert refused.ended[:2] == ("abort", "FAILED_TO_LOAD_BEHAVIOR_TREE")
    goal = navigate(-0.5, -1.0)
    assert driven.end(goal, NAVIGATE) == ("succeed", "NONE", "")
    assert math.dist(driven.pose[:2], (-0.5, -1.0)) < 0.35
    assert goal.told[0].distance_remaining > goal.told[-1].distance_remaining


def test_no_goal_waits_for_the_libraries_of_the_route(monkeypatch, request):
    loads = []
    monkeypatch.setattr(follow_path, "warm_up", lambda: loads.append("route"))
    request.getfixturevalue("driven")
    assert loads == ["route"]


def test_navigate_to_pose_is_left_to_another_node_that_serves_it(driven, logged):
    server = driven.actions._servers[NAVIGATE]
    other = Node("bt_navigator", context=driven.node.context)
    other.create_service(Trigger, "navigate_to_pose/_action/send_goal", lambda *_: _)
    driven.actions._look()
    assert server.is_destroyed
    assert "another node serves navigate_to_pose, so this one no longer does" in logged
    other.destroy_node()


def test_a_goal_ends_when_scans_fall_silent_and_when_the_robot_touches_something(
    driven, monkeypatch
):
    monkeypatch.setattr(follow_path, "time", clock := Clock())
    silent = driven.send(follow((-2.0, -2.0), (2.0, -2.0)))
    driven.look()
    driven.now_ns += 5 * 10**9
    clock.now_s += 5.0
    driven.node._act()
    assert silent.ended[1:] == (
        "CONTROLLER_TIMED_OUT",
        "nothing on scan and odom for 1 s.",
    )
    touching = driven.send(follow((-2.0, -2.0), (2.0, -2.0)))
    driven.actions._drive = lambda _: Wish(np.ones(3), True)
    assert driven.look().tolist() == [0.0, 0.0, 0.0]
    assert touching.ended is None
    clock.now_s += 0.5
    driven.look()
    assert touching.ended[:2] == ("abort", "PATIENCE_EXCEEDED")


def test_goals_are_taken_while_the_node_is_active(driven):
    server = driven.actions._servers[FOLLOW]
    assert server.is_open()
    goal = driven.send(follow((-2.0, -2.0), (2.0, -2.0)))
    driven.node.trigger_deactivate()
    assert not server.is_open()
    assert goal.ended == ("abort", "UNKNOWN", "the node is deactivated.")
    driven.node.trigger_cleanup()
    assert server.is_destroyed


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


def test_results_of_distributions_without_codes_are_filled_as_far_as_they_go():
    class Bare:
        class Result:
            pass

    assert vars(follow_path.make_result(Bare, "TF_ERROR", "why")) == {}
    told = follow_path.make_result(Kind, "TF_ERROR", "why")
    assert (told.error_code, told.error_msg) == ("TF_ERROR", "why")
