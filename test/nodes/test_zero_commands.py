"""Whatever ends a process that drives a robot, its last command is zero."""

import os
import signal
import subprocess
import sys

import pytest

pytest.importorskip("rclpy", reason="needs ROS 2: rclpy is not installed")

from geometry_msgs.msg import Twist, TwistStamped

from nics_drl_bridge.nodes import qos
from nodes.peer import PlayedRobot

pytestmark = [pytest.mark.ros, pytest.mark.process]

DRIVER = """
import gc, sys
import gymnasium
import numpy as np
from nics_drl_bridge.env.registry import NAVIGATION, register_envs

what = sys.argv[1]
register_envs()

def say(sentence):
    print(sentence, flush=True)
    if what == "error_in_reset" and "off its start" in sentence:
        raise ValueError(what)

wait = what in ("reset", "error_in_reset")
options = {
    "mode": "realtime", "vehicle": True, "stale_after_s": 1e6, "timeout_s": 60.0, "say": say,
    "start": "wait" if wait else "present",
}
env = gymnasium.make(NAVIGATION, backend="dds", model="ackermann", backend_options=options)
env.reset(seed=3)
action = np.array([1.0, 0.0], np.float32)
task = env.unwrapped.task
while True:
    env.step(action)
    print("stepped", flush=True)
    if what == "error_in_step":
        task.step_into = None
    if what == "garbage":
        env = task = None
        gc.collect()
        print("collected", flush=True)
        sys.stdin.read()
    if what == "exit":
        sys.exit(0)
"""


def many(*given):
    return pytest.param(*given, marks=pytest.mark.campaign)


@pytest.fixture
def robot(meet, domain_id, model):
    """A robot that stands at (5, 5), and `send`, which publishes its data."""
    peer = meet(domain_id)
    played = PlayedRobot(peer, model.lidar)
    return peer, lambda: played.send([5.0, 5.0, 0.0]) < 0


@pytest.fixture
def drive(domain_id):
    """Start a process that drives, `drive(what)`."""
    started = []

    def start(what, driver=DRIVER):
        process = subprocess.Popen(
            [sys.executable, "-u", "-c", driver, what],
            env=os.environ | {"ROS_DOMAIN_ID": str(domain_id)},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        os.set_blocking(process.stdout.fileno(), False)
        started.append(process)
        return process

    yield start
    for process in started:
        process.kill()
        process.communicate()


def said(process, text):
    """Return whether a process has just said something."""
    try:
        return text in (process.stdout.read() or "")
    except (BlockingIOError, TypeError):
        return False


@pytest.mark.parametrize(
    ("what", "until", "signals", "code"),
    [
        ("step", "stepped", [signal.SIGINT] * 5, -signal.SIGINT),
        many("step", "stepped", [signal.SIGTERM], 128 + signal.SIGTERM),
        many("step", "stepped", [signal.SIGHUP], 128 + signal.SIGHUP),
        many("exit", "stepped", [], 0),
        many("reset", "off its start", [signal.SIGINT] * 5, -signal.SIGINT),
        many("error_in_step", "stepped", [], 1),
        many("error_in_reset", "off its start", [], 1),
        many("garbage", "collected", [], None),
    ],
)
def test_the_last_command_of_a_process_is_zero(
    robot, drive, what, until, signals, code
):
    peer, send = robot
    heard = peer.listen(Twist, "cmd_vel", qos.EVERY_COMMAND)
    process = drive(what)
    peer.until(lambda: send() or said(process, until), f"{what}: {until}", 60.0)
    for number in signals:
        process.send_signal(number)
        peer.until(lambda: True, "a moment")
    if code is not None:
        peer.until(lambda: process.poll() is not None, "its end")
        error = process.communicate()[1]
        assert process.returncode in {code, abs(code), 130}, error
        assert "FATAL" not in error
        assert "terminate called" not in error
    if until == "stepped":
        assert any(command.linear.x > 0.0 for command in heard)
    peer.until(lambda: heard and heard[-1] == Twist(), "a zero command")


LOCK_STEP = """
import select, sys, time
import gymnasium
import numpy as np
from nics_drl_bridge.env.registry import NAVIGATION, register_envs

what = sys.argv[1]
register_envs()
options = {"timeout_s": 60.0}
env = gymnasium.make(
    NAVIGATION, backend="dds", model="ackermann", world="empty", backend_options=options
)
env.reset(seed=3)
try:
    while not select.select([sys.stdin], [], [], 0.0)[0]:
        env.step(np.array([1.0, 0.0], np.float32))
    print("between two steps", flush=True)
    if what == "error":
        raise ValueError(what)
    if what == "exit":
        sys.exit(0)
    time.sleep(600.0)
except KeyboardInterrupt:
    if what != "lives_on":
        raise
    print("lives on", flush=True)
    time.sleep(600.0)
"""


@pytest.mark.timeout(300)
@pytest.mark.parametrize(
    ("what", "signals", "code"),
    [
        ("lives_on", [signal.SIGINT], None),
        many("interrupted", [signal.SIGINT] * 3, -signal.SIGINT),
        many("terminated", [signal.SIGTERM], 128 + signal.SIGTERM),
        many("error", [], 1),
        many("exit", [], 0),
    ],
)
def test_the_last_command_of_a_process_is_zero_in_lock_step_too(
    launch, meet, domain_id, drive, what, signals, code
):
    simulator = launch("simulator_node", domain_id, mode="lockstep", world="empty")
    peer = meet(domain_id)
    peer.until(lambda: "running" in simulator.read_text(), "its start")
    heard = peer.listen(Twist, "cmd_vel", qos.EVERY_COMMAND)
    process = drive(what, LOCK_STEP)
    moving = lambda: any(command.linear.x > 0.0 for command in heard)  # noqa: E731
    peer.until(lambda: moving() or process.poll() is not None, "its command")
    process.stdin.write("\n")
    process.stdin.flush()
    peer.until(lambda: said(process, "between two steps"), "the end of its steps", 30.0)
    for number in signals:
        process.send_signal(number)
        peer.until(lambda: True, "a moment")
    peer.until(lambda: heard[-1] == Twist(), "a zero command", 30.0)
    if code is None:
        assert process.poll() is None, process.communicate()[1]
    else:
        peer.until(lambda: process.poll() is not None, "its end")
        assert process.returncode in {code, abs(code), 130}, process.communicate()[1]


POLICY = """
import sys
from types import SimpleNamespace
from nics_drl_bridge.nodes import policy_node

open_policy, acted = policy_node.open_policy, []

def opened(*given):
    policy, task = open_policy(*given)

    def act(observation):
        acted.append(observation)
        if len(acted) > 6:  # the first is that of its start
            raise eval(sys.argv[1])
        return policy.act(observation)

    return SimpleNamespace(act=act), task

policy_node.open_policy = opened
policy_node.main([sys.argv[0], "--ros-args", "-p", "goal:=[8.0, 5.0]", "-p", "model:=ackermann"])
"""


@pytest.mark.timeout(300)
@pytest.mark.parametrize(
    "error",
    ["ValueError('of the policy')", many("SystemExit(3)"), many("MemoryError()")],
)
def test_a_policy_that_raises_leaves_a_zero_command_behind(robot, domain_id, error):
    peer, send = robot
    raw = peer.listen(TwistStamped, "cmd_vel_raw", qos.EVERY_COMMAND)
    process = subprocess.Popen(
        [sys.executable, "-c", POLICY, error],
        env=os.environ | {"ROS_DOMAIN_ID": str(domain_id)},
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        peer.until(lambda: send() or process.poll() is not None, "its end", 200.0)
        peer.until(lambda: raw and raw[-1].twist == Twist(), "a zero command")
        said = process.communicate()[1]
        assert process.returncode != 0
        assert any(each.twist.linear.x > 0.0 for each in raw)
        if not error.startswith("SystemExit"):
            assert process.returncode == 2
            assert "Traceback" not in said
            name = error.partition("(")[0]
            assert said.count(f"'dynamic_window' raised {name}") == 1
    finally:
        process.kill()
        process.wait()
