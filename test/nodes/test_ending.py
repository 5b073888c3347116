"""Every signal that would end a node's process ends it in order (the gate: `test_output.py`)."""

import os
import signal
import subprocess
import sys

import pytest

from nics_drl_bridge.nodes import own_process

pytestmark = [pytest.mark.ros, pytest.mark.process]

DEADLINE_S = 60.0
NODE = """
import sys
from rclpy.node import Node
from nics_drl_bridge.nodes import own_process, runner

class Left(Node):
    def stop(self):
        print("stopped", flush=True)

def make(context):
    node = Left("left", context=context)
    runner.call_periodically(node, 0.1, lambda: print("runs", flush=True))
    return node

runner.run_node(make)
own_process.leave(0)
"""
FURTHER_ENDS = [
    signal.SIGHUP,
    signal.SIGQUIT,
    signal.SIGINT,
    signal.SIGTERM,
    signal.SIGUSR1,
    signal.SIGUSR2,
    signal.SIGALRM,
    signal.SIGXCPU,
    signal.SIGIO,
    signal.SIGRTMIN,
]


def rarely(number):
    """Mark a signal for the campaign."""
    return pytest.param(number, marks=pytest.mark.campaign)


def usual_signals():
    """Let signals end the process, whatever the shell that started the tests ignores."""
    for number in (signal.SIGRTMAX, *FURTHER_ENDS):
        signal.signal(number, signal.SIG_DFL)


@pytest.fixture
def node(domain_id):
    """A node that prints when it runs, and when it is stopped in order."""
    process = subprocess.Popen(
        [sys.executable, "-c", NODE],
        env=os.environ | {"ROS_DOMAIN_ID": str(domain_id)},
        stdout=subprocess.PIPE,
        text=True,
        preexec_fn=usual_signals,
    )
    assert process.stdout.readline() == "runs\n"
    yield process
    process.kill()
    process.communicate()


@pytest.mark.parametrize("number", [signal.SIGRTMAX, *map(rarely, FURTHER_ENDS)])
def test_a_reader_that_has_gone_does_not_end_it_but_any_other_signal_does_in_order(
    node, number
):
    node.send_signal(signal.SIGPIPE)
    assert [node.stdout.readline() for _ in range(5)] == ["runs\n"] * 5
    assert node.poll() is None
    node.send_signal(number)
    assert "stopped\n" in node.communicate(timeout=DEADLINE_S)[0]
    assert node.returncode == 0


def test_a_lost_terminal_does_not_end_what_was_started_by_nohup():
    assert signal.SIGHUP in own_process.list_ending_signals()
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        assert signal.SIGHUP not in own_process.list_ending_signals()
    finally:
        signal.signal(signal.SIGHUP, before)
