"""No press of the e-stop is lost, however the gate is held up while the button is pressed."""

import signal
import threading
import time
from contextlib import contextmanager

import pytest
from diagnostic_msgs.msg import DiagnosticArray
from std_msgs.msg import Bool
from std_srvs.srv import Trigger

from nics_drl_bridge.nodes import qos

pytestmark = [pytest.mark.ros, pytest.mark.process]

HEARTBEAT_S = 0.01
BESIDE_S = 0.001


@contextmanager
def heartbeats(publisher, period_s):
    """Publish "not pressed" at a period, in a thread."""
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

    def __init__(self, gate, peer):
        self.gate = gate
        self.peer = peer
        self.button = peer.speak(Bool, "e_stop", quality=qos.COMMAND)
        self.said = peer.listen(DiagnosticArray, "/diagnostics")

    def finding(self):
        """Return the next message of the gate's diagnostics."""
        return self.peer.another(self.said, "diagnostics").status[0].message

    def stall_gate(self, seconds, press):
        """Freeze the gate for some time, at whose beginning the button may be pressed briefly."""
        self.gate._process.send_signal(signal.SIGSTOP)
        try:
            if press:
                self.button.publish(Bool(data=True))
            with heartbeats(self.button, HEARTBEAT_S):
                time.sleep(seconds)
        finally:
            self.gate._process.send_signal(signal.SIGCONT)

    def release(self):
        """Reset the gate until nothing is latched; a late loss may latch it once more."""

        def is_released():
            self.peer.call(Trigger, "command_gate/reset")
            return self.finding().startswith("disarmed")

        self.peer.until(is_released, "nothing is latched")


@pytest.fixture(scope="module")
def operator(launch_process, meet, module_domain_id):
    given = {"limits": "ackermann", "e_stop_silence": 5.0}
    gate = launch_process("command_gate", module_domain_id, **given)
    yield Operator(gate, meet(module_domain_id))
    gate.check()


@pytest.fixture(params=[False, True], ids=["button_alone", "1_kHz_beside"])
def beside(request, operator):
    """Whether a second publisher reports "not pressed", too."""
    if not request.param:
        yield False
        return
    publisher = operator.peer.node.create_publisher(Bool, "e_stop", qos.COMMAND)
    with heartbeats(publisher, BESIDE_S):
        yield True
    operator.peer.node.destroy_publisher(publisher)


def judge(operator, stall_s, press):
    """Stall a gate on which nothing is latched, and wait for its diagnosis afterwards."""
    with heartbeats(operator.button, HEARTBEAT_S):
        operator.release()
    operator.stall_gate(stall_s, press)
    wanted = "e_stop_pressed" if press else "disarmed"
    with heartbeats(operator.button, HEARTBEAT_S):
        operator.peer.until(lambda: operator.finding().startswith(wanted), wanted, 10.0)


def test_a_short_press_while_the_gate_is_stalled_stops_the_robot(operator, beside):
    for stall_s in (0.15, 2.0):
        judge(operator, stall_s, press=True)
    if not beside:  # and what the queue outlasts is no press
        judge(operator, 0.15, press=False)


@pytest.mark.campaign
@pytest.mark.parametrize("stall_s", [0.15, 0.5])
def test_no_press_is_lost_in_many_stalls(operator, beside, stall_s):
    for _ in range(10):
        judge(operator, stall_s, press=True)
