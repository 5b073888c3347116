"""No press of the e-stop is lost, however the gate is held up while the button is pressed."""

import signal
import threading
import time
from contextlib import contextmanager

import pytest

pytest.importorskip("rclpy", reason="needs ROS 2: rclpy is not installed")

from diagnostic_msgs.msg import DiagnosticArray
from std_msgs.msg import Bool
from std_srvs.srv import Trigger

from nics_drl_bridge.nodes import qos

pytestmark = [pytest.mark.ros, pytest.mark.process]

HEARTBEAT_S = 0.01
BESIDE_S = 0.001


@contextmanager
def heartbeats(publisher, period_s):
    """Publishes "not pressed" at a period, in a thread of its own."""
    over = threading.Event()

    def beat():
        while not over.wait(period_s):
            publisher.publish(Bool(data=False))

    thread = threading.Thread(target=beat)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()


class Operator:
    """A gate in a process of its own, and a button that the test presses."""

    def __init__(self, gate, peer, beside):
        self.gate = gate
        self.peer = peer
        self.button = peer.speak(Bool, "e_stop", quality=qos.COMMAND)
        self.beside = (
            peer.speak(Bool, "e_stop", quality=qos.COMMAND) if beside else None
        )
        self.said = peer.listen(DiagnosticArray, "/diagnostics")

    def finding(self):
        """What the gate says next about itself."""
        return self.peer.another(self.said, "diagnostics").status[0].message

    def beat(self, seconds):
        """Reports "not pressed" at 100 Hz for a while."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            self.button.publish(Bool(data=False))
            time.sleep(HEARTBEAT_S)

    def stall_gate(self, seconds, press):
        """Freezes the gate for some time, at whose beginning the button may be pressed briefly."""
        self.gate._process.send_signal(signal.SIGSTOP)
        try:
            self.beat(seconds / 10)
            if press:
                self.button.publish(Bool(data=True))
            self.beat(seconds)
        finally:
            self.gate._process.send_signal(signal.SIGCONT)

    def release(self):
        """Resets the gate until nothing is latched; a late loss may latch it once more."""

        def released():
            self.peer.call(Trigger, "command_gate/reset")
            return self.finding().startswith("disarmed")

        self.peer.until(released, "nothing is latched")


@pytest.fixture(
    params=[
        pytest.param(False, id="button_alone"),
        pytest.param(True, id="1_kHz_beside"),
    ]
)
def operator(request, launch_process, meet, domain_id):
    gate = launch_process(
        "command_gate", domain_id, limits="ackermann", e_stop_silence=5.0
    )
    made = Operator(gate, meet(domain_id), beside=request.param)
    yield made
    gate.check()


@contextmanager
def beating(operator):
    """Both publishers report "not pressed"."""
    with heartbeats(operator.button, HEARTBEAT_S), beside(operator):
        yield


@contextmanager
def beside(operator):
    """The second publisher reports "not pressed", if there is one."""
    if operator.beside is None:
        yield
        return
    with heartbeats(operator.beside, BESIDE_S):
        yield


def judge(operator, stall_s, press):
    """Stalls a gate on which nothing is latched, and waits for what it says afterwards."""
    with beating(operator):
        operator.release()
    with beside(operator):
        operator.stall_gate(stall_s, press)
    said = "e_stop_pressed" if press else "disarmed"
    with beating(operator):
        operator.peer.until(lambda: operator.finding().startswith(said), said, 10.0)


def test_a_short_press_while_the_gate_is_stalled_stops_the_robot(operator):
    for stall_s in (0.15, 2.0):
        judge(operator, stall_s, press=True)
    if operator.beside is None:  # and what the queue outlasts is no press
        judge(operator, 0.15, press=False)


@pytest.mark.campaign
@pytest.mark.parametrize("stall_s", [0.15, 0.5])
def test_no_press_is_lost_in_many_stalls(operator, stall_s):
    for _ in range(10):
        judge(operator, stall_s, press=True)
