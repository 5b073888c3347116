"""Whatever ends a process that drives a robot, its last command is zero: see `test_link.py`."""

import os
import signal
import subprocess
import sys
import time

import pytest
from geometry_msgs.msg import Twist

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
def drive(domain_id):
    """Start a process that drives, `drive(what)`."""
    started = []

    def start(what):
        process = subprocess.Popen(
            [sys.executable, "-u", "-c", DRIVER, what],
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
    meet, domain_id, model, drive, what, until, signals, code
):
    peer = meet(domain_id)
    robot = PlayedRobot(peer, model.lidar)

    sent_s = 0.0

    def is_far_away():
        nonlocal sent_s
        if time.monotonic() - sent_s > 0.05:
            sent_s = time.monotonic()
            robot.send([5.0, 5.0, 0.0])
        return said(process, until)

    heard = peer.listen(Twist, "cmd_vel", qos.EVERY_COMMAND)
    process = drive(what)
    peer.until(is_far_away, f"{what}: {until}", 60.0)
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
