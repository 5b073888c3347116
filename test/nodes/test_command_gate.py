from __future__ import annotations

import math
import signal
import subprocess
import sys
import time
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from nics_drl_bridge.interface import NS_PER_S

pytest.importorskip("rclpy", reason="needs ROS 2: rclpy is not installed")

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import Twist, TwistStamped
from nav_msgs.msg import Odometry
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import LaserScan
from std_msgs.msg import Bool
from std_srvs.srv import Trigger

from nics_drl_bridge.gate.black_box import replay
from nics_drl_bridge.gate.inputs import Press, Tick
from nics_drl_bridge.generator import save_model
from nics_drl_bridge.nodes import command_gate, conversions, qos
from nics_drl_bridge.nodes.listener import open_context
from nics_drl_bridge.nodes.wire import stamped_twist_of
from nodes.peer import DEADLINE_S

pytestmark = pytest.mark.ros

GIVEN = [
    "gate",
    "--ros-args",
    "-p",
    "model:=ackermann",
    "-p",
    "limits:=ackermann",
    "-p",
]
"""The last one is followed by a parameter."""

SOON_S = 0.5  # what the gate is made for, on a machine with time
LATE_S = 5.0
PERIOD_S = 0.1
START_NS = 10**18
MOST_S = 1.0
MOST_ARMINGS = 3
CORRIDOR_M = 1.5  # from the middle of it, on which the robot drives, to either wall
WRITTEN_S = 5.0
PATIENT = {
    "scan_age": 1.0,
    "odom_age": 0.6,
    "command_age": 1.0,
    "rate_tolerance": 0.6,
    "e_stop_silence": 1.0,
}
"""This machine may be busy with other tests. Odometry that is silent for 0.75 s is `no_motion`."""


class Robot:
    """A robot with its policy around a gate; it does what it is told."""

    kind = TwistStamped

    def __init__(self, peer, lidar):
        self.peer = peer
        self.lidar = lidar
        self.stamp_ns = START_NS
        self.x = 0.0
        self.silent = set()
        self.wish = (0.5, 0.0, 0.0)
        self.stamped = None
        # Along a corridor without an end nothing moves, however late a pose or a scan may be.
        bearings = lidar.angles + lidar.mount[2]
        self.walls = CORRIDOR_M / np.maximum(np.abs(np.sin(bearings)), 1e-9)
        self.distance = math.inf  # of an obstacle all around it
        self.passed = peer.listen(Twist, "cmd_vel", qos.COMMAND)
        self.topics = {
            "scan": peer.speak(LaserScan, "scan"),
            "odom": peer.speak(Odometry, "odom"),
            "filtered": peer.speak(Odometry, "odometry/filtered"),
            "cmd_vel_raw": peer.speak(self.kind, "cmd_vel_raw"),
            "e_stop": peer.speak(Bool, "e_stop", quality=qos.EVERY_COMMAND),
        }
        peer.node.create_timer(PERIOD_S, self.sends)

    def sends(self):
        """What arrives in a period."""
        speed = self.passed[-1].linear.x if self.passed else 0.0
        before = self.stamp_ns
        self.stamp_ns = START_NS + time.monotonic_ns()
        # A busy machine leaves out some periods; the robot drives on all the same.
        self.x += speed * min((self.stamp_ns - before) / NS_PER_S, MOST_S)
        odometry = conversions.odometry_to_ros(
            [self.x, 0.0, 0.0],
            [speed, 0.0, 0.0],
            self.stamp_ns,
            ("odom", "base_link"),
            (1e-4,) * 4,
        )
        # No two scans are the same; this is less than what counts as a motion.
        noise = self.stamp_ns % 7_000_000_000 * 1e-12
        ranges = (np.minimum(self.walls, self.distance) + noise).astype(np.float32)
        said = {
            "odom": odometry,
            "filtered": odometry,
            "scan": conversions.scan_to_ros(self.lidar, ranges, self.stamp_ns, "laser"),
            "e_stop": Bool(data=False),
            "cmd_vel_raw": self.command(),
        }
        for topic in said.keys() - self.silent:
            self.topics[topic].publish(said[topic])

    def command(self):
        message = TwistStamped(twist=conversions.twist_to_ros(self.wish))
        stamp_ns = self.stamp_ns if self.stamped is None else self.stamped
        message.header.stamp = conversions.stamp_to_ros(stamp_ns)
        return message

    def call(self, service):
        return self.peer.call(Trigger, f"command_gate/{service}")

    def gets(self, *wanted):
        """Waits for a command to come out."""
        assert self.comes(wanted, DEADLINE_S), (
            f"{wanted} never came, but {self.passed[-1]}"
        )

    def comes(self, wanted, patience_s):
        """Whether a command comes out within a time."""
        wanted = conversions.twist_to_ros(wanted)
        deadline = time.monotonic() + patience_s
        self.passed.clear()
        while time.monotonic() < deadline:
            if self.peer.another(self.passed, "command") == wanted:
                return True
        return False

    def stops(self):
        self.gets(0.0, 0.0, 0.0)

    def drives(self, *wish):
        """Everything is well, the gate is armed, and the robot drives.

        A busy machine may let the gate stop in between, and stay so; once is enough.
        """
        self.silent = set()
        self.stamped = None
        wish = wish or (0.5, 0.0, 0.0)
        deadline = time.monotonic() + DEADLINE_S
        for _ in range(MOST_ARMINGS):
            self.is_armed(deadline)
            self.wish = wish
            if self.comes(wish, DEADLINE_S / MOST_ARMINGS):
                return
        raise AssertionError(f"{wish} never came, but {self.passed[-1]}")

    def is_armed(self, deadline):
        """Arms the gate unless it is."""
        while self.diagnosed()["armed"] != "True":
            self.wish = (0.0, 0.0, 0.0)
            self.call("reset")
            answer = self.call("arm")
            assert answer.success or time.monotonic() < deadline, answer.message

    def says(self, cause):
        """Waits until the gate names what stops it; a busy machine may stop it before."""
        self.peer.until(lambda: self.diagnosed()[""].startswith(cause), cause)

    def diagnosed(self):
        """What the gate says next about itself."""
        said = self.peer.listen(DiagnosticArray, "/diagnostics")
        status = self.peer.another(said, "diagnostics").status[0]
        return {value.key: value.value for value in status.values} | {
            "": status.message
        }


class Foreign(Robot):
    """The same with a controller that knows nothing of scans' stamps, as Nav2's."""

    kind = Twist

    def command(self):
        return conversions.twist_to_ros(self.wish)


@pytest.fixture(scope="module")
def black_box(tmp_path_factory):
    return tmp_path_factory.mktemp("black_box")


@pytest.fixture(scope="module")
def robot(launch, meet, module_domain_id, model, black_box):
    gate = launch(
        "command_gate",
        module_domain_id,
        limits="ackermann",
        black_box=str(black_box),
        **PATIENT,
    )
    yield Robot(meet(module_domain_id), model.lidar)
    gate.check()


@pytest.mark.process
def test_it_imports_nothing_that_learns_or_infers():
    code = (
        "import sys\nfrom nics_drl_bridge.nodes import command_gate\n"
        "print(*{name.partition('.')[0] for name in sys.modules})"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    loaded = set(done.stdout.split())
    assert "rclpy" in loaded
    assert not loaded & {
        "torch",
        "onnxruntime",
        "onnx",
        "stable_baselines3",
        "gymnasium",
    }


@pytest.mark.process
def test_it_does_not_listen_before_its_shield_is_compiled(domain_id):
    code = f"""
from nics_drl_bridge.nodes.command_gate import CommandGate
from nics_drl_bridge.nodes.listener import open_context
from nics_drl_bridge.gate.shield_kernels import is_free
CommandGate._listen = lambda _: print(len(is_free.signatures))
node = CommandGate(open_context([], domain_id={domain_id}))
node.destroy_node()
node.context.try_shutdown()
"""
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert done.stdout.split() == ["1"]


def test_a_motion_that_was_decided_on_before_a_freeze_is_never_published(
    domain_id, tmp_path, monkeypatch
):
    given = ["node", "--ros-args", "-p", f"black_box:={tmp_path}"]
    node = command_gate.CommandGate(open_context(given, domain_id))
    said = []
    clock = [100.0]
    decide = command_gate.decide

    def frozen(config, state, event, now):
        """Moves the robot, and is frozen for half a second the first time."""
        state, decision = decide(config, state, event, now)
        if now > 100.0:
            return state, decision
        clock[0] += 0.5
        return state, replace(decision, publish=True, cause=None, twist=np.ones(3))

    monkeypatch.setattr(command_gate, "decide", frozen)
    monkeypatch.setattr(command_gate.time, "monotonic", lambda: clock[0])
    monkeypatch.setattr(node, "_out", SimpleNamespace(publish=said.append))
    node._decide(Tick())
    monkeypatch.undo()
    node.destroy_node()
    node.context.try_shutdown()
    assert [deserialize_message(one, TwistStamped).twist for one in said] == [Twist()]


def test_a_decision_that_is_no_number_leaves_as_zero_and_latches(
    domain_id, tmp_path, monkeypatch
):
    """Whatever `safety` decides: here it is made to decide on NaN."""
    sent = []
    wrong = np.array([0.5, math.nan, 0.1])
    context = open_context([*GIVEN, f"black_box:={tmp_path}"], domain_id)
    node = command_gate.CommandGate(context)
    try:
        monkeypatch.setattr(
            node, "_out", SimpleNamespace(publish=sent.append, topic_name="/cmd_vel")
        )
        decide = command_gate.decide

        def mad(config, state, given, now):
            state, decision = decide(config, state, given, now)
            return state, decision if given == Press() else replace(
                decision, twist=wrong, publish=True
            )

        monkeypatch.setattr(command_gate, "decide", mad)
        node._decide(Tick())
        assert list(map(stamped_twist_of, sent)) == [(0.0, 0.0, 0.0)]
        found = node._look()
        assert found.message.startswith("e_stop_pressed")
        assert found.facts["not finite, sent as zero"] == 1
        wrong[:] = math.inf
        node._decide(Tick())
        assert set(map(stamped_twist_of, sent)) == {(0.0, 0.0, 0.0)}
    finally:
        monkeypatch.undo()
        node.stop()
        node.destroy_node()
        context.try_shutdown()


def test_bytes_that_are_no_message_are_refused_and_counted(domain_id, tmp_path):
    context = open_context([*GIVEN, f"black_box:={tmp_path}"], domain_id)
    node = command_gate.CommandGate(context)
    try:
        for subscription in node.subscriptions:
            if subscription.raw:
                takes_info = subscription.topic_name == "/cmd_vel_raw"
                subscription.callback(
                    b"\x00\x01\x00\x00\x01", *([{}] if takes_info else [])
                )
        facts = node._look().facts
        for topic in ("scan", "odom", "odometry/filtered", "cmd_vel_raw"):
            assert facts[f"refused, {topic}"] == 1
    finally:
        node.destroy_node()
        context.try_shutdown()


def test_it_starts_disarmed_and_refuses_by_name_to_be_armed(robot):
    robot.silent = {"scan", "filtered"}
    robot.stops()
    answer = robot.call("arm")
    assert not answer.success
    for check in ("scan_fresh", "scan_rate", "estimator_converged"):
        assert f"{check}: " in answer.message
    robot.silent = set()
    robot.stops()
    assert robot.diagnosed()["armed"] == "False"


def test_a_command_with_a_fresh_scan_behind_it_passes(robot):
    robot.drives(0.5, 0.0, -0.25)


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_a_command_that_is_no_number_becomes_zero(robot, bad):
    robot.drives()
    robot.wish = (0.5, 0.0, bad)
    robot.stops()


def test_a_command_is_limited_to_what_the_robot_may_do(robot):
    robot.drives()
    robot.wish = (9.0, 0.0, 4.0)
    robot.gets(1.0, 0.0, 0.5)
    robot.wish = (-9.0, 0.0, -4.0)
    robot.gets(-0.5, 0.0, -0.5)


def test_a_command_that_is_far_out_of_range_becomes_zero(robot):
    robot.drives()
    robot.wish = (99.0, 0.0, 99.0)
    robot.stops()


def test_a_component_that_the_robot_has_no_use_for_becomes_zero(robot):
    robot.drives()
    robot.wish = (0.5, 0.7, 0.1)
    robot.gets(0.5, 0.0, 0.1)


@pytest.mark.parametrize("off_ns", [1_000_000, 3600 * NS_PER_S])
def test_a_command_stamped_with_an_unknown_scan_becomes_zero(robot, off_ns):
    robot.drives()
    # In the future too: a stamp alone proves nothing.
    robot.stamped = robot.stamp_ns + off_ns
    robot.stops()


def test_a_command_repeated_without_new_scans_runs_out(robot):
    robot.drives()
    robot.stamped, began = robot.stamp_ns, time.monotonic()
    robot.stops()
    assert 0.1 < time.monotonic() - began < LATE_S


@pytest.mark.parametrize("silent", ["scan", "odom", "cmd_vel_raw"])
def test_a_topic_that_falls_silent_stops_the_robot_until_it_speaks_again(robot, silent):
    robot.drives()
    robot.silent = {silent}
    robot.stops()
    robot.silent = set()
    robot.gets(*robot.wish)


def test_another_controllers_twists_pass_until_scans_fall_silent(
    launch, meet, domain_id, model, tmp_path
):
    given = {"limits": "ackermann", "black_box": str(tmp_path), **PATIENT}
    gate = launch("command_gate", domain_id, foreign_commands="Twist", **given)
    robot = Foreign(meet(domain_id), model.lidar)
    robot.drives()
    robot.silent = {"scan"}
    robot.stops()
    robot.says("scan")
    gate.check()


def test_another_publisher_of_commands_is_told_of_as_long_as_it_is_there(robot):
    robot.drives()
    other = robot.peer.node.create_publisher(Twist, "cmd_vel", qos.COMMAND)
    robot.peer.until(
        lambda: "others publish on cmd_vel too (1)" in robot.diagnosed()[""],
        "the warning",
    )
    robot.peer.node.destroy_publisher(other)
    robot.peer.until(lambda: "others publish" not in robot.diagnosed()[""], "its end")


def test_a_second_policy_that_joins_while_the_robot_drives_stops_it_and_is_named(robot):
    robot.drives()
    node = robot.peer.node
    commands = node.create_publisher(TwistStamped, "cmd_vel_raw", qos.COMMAND)
    others = node.create_timer(PERIOD_S, lambda: commands.publish(robot.command()))
    try:
        robot.says("two_policies: topic=cmd_vel_raw")
        said = robot.diagnosed()[""]
        assert said.count(f"/{node.get_name()} (publisher ") == 2
        assert "both publish on cmd_vel_raw" in said
        robot.stops()
        assert robot.call("reset").success
        assert "one_policy" in robot.call("arm").message
    finally:
        node.destroy_timer(others)
        node.destroy_publisher(commands)
    robot.drives()


def test_a_body_that_is_held_while_odometry_moves_is_stopped(robot):
    robot.drives()
    # Walls all around that stay where they are, however far odometry says that the robot went.
    bearings = robot.lidar.angles
    across = np.abs(np.sin(bearings)) / 1.2
    along = np.abs(np.cos(bearings)) / 2.0
    free = robot.walls
    robot.walls = 1.0 / np.maximum(across, along)
    try:
        robot.says("body_held: topic=scan")
        robot.stops()
    finally:
        robot.walls = free
    robot.drives()


def test_an_e_stop_that_falls_silent_stops_the_robot_by_default_and_stays(robot):
    robot.drives()
    robot.silent = {"e_stop"}
    robot.says("e_stop_silent: topic=e_stop")
    robot.stops()
    assert robot.call("reset").success
    assert "e_stop_silent" in robot.call("arm").message
    robot.drives()


def test_the_e_stop_by_topic_stops_and_a_reset_alone_does_not_move(robot):
    robot.drives()
    robot.topics["e_stop"].publish(Bool(data=True))
    robot.stops()
    assert not robot.call("arm").success
    robot.peer.until(
        lambda: robot.call("reset").success, "the e-stop is heard to be released"
    )
    known = len(robot.passed)
    robot.peer.until(lambda: len(robot.passed) > known + 20, "20 more commands")
    assert set(map(str, robot.passed[known:])) == {str(Twist())}
    robot.drives()


def test_the_e_stop_by_service_stops_and_its_cause_is_diagnosed(robot):
    robot.drives()
    assert robot.call("e_stop").success
    robot.stops()
    facts = robot.diagnosed()
    assert facts[""].startswith("e_stop_pressed: topic=e_stop")
    assert int(facts["stopped, e_stop_pressed"]) >= 1
    assert facts["armed"] == "False"


def test_every_stop_is_in_the_black_box_and_replays(robot, black_box):
    deadline = time.monotonic() + DEADLINE_S
    while not (files := sorted(black_box.glob("*scan_silent.jsonl"))):
        # A busy machine may freeze the gate; then that is the stop which is written.
        assert time.monotonic() < deadline, "no file"
        robot.drives()
        robot.silent = {"scan"}
        robot.stamped = robot.stamp_ns
        robot.stops()
        robot.peer.within(WRITTEN_S, lambda: list(black_box.glob("*scan_silent.jsonl")))
    again = replay(files[-1])
    assert again.differing == ()
    assert again.entries[-1].decision.cause.rule == "scan_silent"


@pytest.mark.process
@pytest.mark.campaign
def test_after_a_burst_of_stops_it_ends_at_once_and_the_first_of_them_is_in_the_black_box(
    launch_process, meet, domain_id, model, tmp_path
):
    given = {"limits": "ackermann", "black_box": str(tmp_path), **PATIENT}
    gate = launch_process("command_gate", domain_id, **given)
    robot = Robot(meet(domain_id), model.lidar)
    robot.drives()
    began = robot.peer.node.get_clock().now().nanoseconds
    for _ in range(8):
        robot.wish = (math.nan, 0.0, 0.0)
        robot.stops()
        robot.wish = (0.5, 0.0, 0.0)
        robot.gets(0.5, 0.0, 0.0)
    stops = int(robot.diagnosed()["stopped, command_malformed"])
    robot.wish = (math.nan, 0.0, 0.0)
    robot.stops()
    assert (
        gate.close() == 0
    )  # by itself: who needs longer than NodeProcess waits is killed
    named = {path.name for path in tmp_path.iterdir()}
    (first,) = [name for name in named if name.endswith("_command_malformed.jsonl")]
    again = replay(tmp_path / first)
    assert again.differing == ()
    assert again.entries[-1].decision.cause.rule == "command_malformed"
    assert [one.decision.cause for one in again.entries[-20:-1]] == [None] * 19
    assert stops >= 4  # a busy machine may stop the robot before, by other rules
    assert (tmp_path / first).stat().st_mtime_ns - began < 10 * NS_PER_S
    assert all(name.endswith(".jsonl") for name in named)


def test_as_shipped_it_stops_before_an_obstacle_and_counts_it(
    launch, meet, domain_id, model, tmp_path
):
    gate = launch(
        "command_gate",
        domain_id,
        limits="ackermann",
        black_box=str(tmp_path),
        **PATIENT,
    )
    robot = Robot(meet(domain_id), model.lidar)
    robot.drives(0.2, 0.0, 0.0)
    cut = int(robot.diagnosed().get("cut by the shield", 0))
    robot.distance = 0.19
    robot.peer.until(
        lambda: int(robot.diagnosed().get("cut by the shield", 0)) > cut,
        "the shield cuts",
    )
    robot.says("commands pass")
    robot.stops()
    said = gate.log.read_text(encoding="utf-8")
    assert (
        "the shield is on: latency 0.2, deceleration 2, margin 0.05, obstacle_speed 1"
        in said
    )
    assert "config/limits/ackermann.yaml" in said


def test_without_its_shield_it_says_so_and_stops_before_nothing(
    launch, meet, domain_id, model, tmp_path
):
    gate = launch(
        "command_gate",
        domain_id,
        limits="ackermann",
        black_box=str(tmp_path),
        shield=False,
        **PATIENT,
    )
    robot = Robot(meet(domain_id), model.lidar)
    robot.distance = 0.3
    robot.drives(0.2, 0.0, 0.0)
    assert "the shield is off" in gate.log.read_text(encoding="utf-8")


def test_a_car_that_does_not_tell_its_wheelbase_ends_it_with_one_sentence(
    launch, meet, domain_id, model, tmp_path
):
    robot = model.robot.model_copy(update={"parameters": {}})
    save_model(replace(model, robot=robot), tmp_path / "model")
    gate = launch("command_gate", domain_id, model=str(tmp_path / "model"))
    meet(domain_id).until(lambda: gate._process.poll() is not None, "its end")
    last = gate.log.read_text(encoding="utf-8").strip().splitlines()[-1]
    assert "the shield needs the parameter 'wheelbase' of a car" in last
    assert gate._process.returncode == 2


def test_without_limits_it_can_not_be_armed(launch, meet, domain_id, model):
    launch("command_gate", domain_id)
    robot = Robot(meet(domain_id), model.lidar)
    robot.stops()
    assert "limits_set: " in robot.call("arm").message


def test_limits_of_another_robot_end_it_with_one_sentence(launch, meet, domain_id):
    gate = launch("command_gate", domain_id, limits="mecanum")
    meet(domain_id).until(lambda: gate._process.poll() is not None, "its end")
    last = gate.log.read_text(encoding="utf-8").strip().splitlines()[-1]
    assert "the limits are for 'mecanum', not for 'ackermann'" in last
    assert gate._process.returncode == 2


@pytest.mark.process
@pytest.mark.parametrize(
    "how", [signal.SIGKILL, pytest.param(signal.SIGSTOP, marks=pytest.mark.campaign)]
)
def test_a_policy_that_dies_or_hangs_stops_the_robot(
    launch, launch_process, meet, domain_id, how, tmp_path
):
    launch("simulator_node", domain_id, world="empty")
    launch("middleware_node", domain_id)
    launch(
        "command_gate",
        domain_id,
        limits="ackermann",
        black_box=str(tmp_path),
        use_sim_time=True,
        e_stop_required=False,
    )
    peer = meet(domain_id)
    passed = peer.listen(Twist, "cmd_vel", qos.COMMAND)
    # As far as the field goes, so that it does not arrive in between.
    policy = launch_process("policy_node", domain_id, goal=[100.0, 0.0])
    deadline = time.monotonic() + DEADLINE_S
    # A simulator that catches up makes its stamps jump, and the gate stops before it drives, too.
    while not peer.within(1.0, lambda: passed and passed[-1].linear.x > 0.0):
        answer = peer.call(Trigger, "command_gate/arm")
        assert time.monotonic() < deadline, answer.message
        if "nothing_latched" in answer.message:
            peer.call(Trigger, "command_gate/reset")
    policy._process.send_signal(how)
    began = time.monotonic()
    peer.until(lambda: passed[-1] == Twist(), "zero", LATE_S)
    print(
        f"zero {time.monotonic() - began:.2f} s after the {how.name}, wanted within {SOON_S} s"
    )
    passed.clear()
    peer.until(lambda: len(passed) >= 5, "more commands")
    assert passed == [Twist()] * len(passed)
    if how == signal.SIGSTOP:
        policy._process.send_signal(signal.SIGCONT)
        peer.until(
            lambda: passed[-1].linear.x > 0.0, "the robot drives on once it wakes"
        )


def test_it_leaves_a_zero_command_behind(launch, meet, domain_id, model, tmp_path):
    gate = launch(
        "command_gate",
        domain_id,
        limits="ackermann",
        black_box=str(tmp_path),
        **PATIENT,
    )
    robot = Robot(meet(domain_id), model.lidar)
    robot.drives()
    assert gate.close() == 0
    robot.peer.until(lambda: robot.passed[-1] == Twist(), "zero")
