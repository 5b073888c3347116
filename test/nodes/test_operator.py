"""What a person asks of a running robot keeps to the time that was given."""

from types import SimpleNamespace

import pytest

pytest.importorskip("rclpy", reason="needs ROS 2: rclpy is not installed")

from nics_drl_bridge.nodes import listener
from nics_drl_bridge.nodes import operator as module
from nics_drl_bridge.nodes.goal_answer import GoalAnswer
from nics_drl_bridge.nodes.operator import GoalRequest, Operator, TriggerAnswer
from nodes.direct import Clock

pytestmark = pytest.mark.ros


@pytest.fixture
def clock(monkeypatch):
    monkeypatch.setattr(module, "time", clock := Clock())
    return clock


def test_a_node_that_can_not_be_made_leaves_no_context(monkeypatch):
    ended = []
    context = SimpleNamespace(try_shutdown=lambda: ended.append(True))

    def fail(*_, **__):
        raise RuntimeError("no node")

    monkeypatch.setattr(listener, "open_context", lambda *_: context)
    monkeypatch.setattr(listener.Node, "__init__", fail)
    with pytest.raises(RuntimeError, match="no node"):
        Operator()
    assert ended == [True]


def test_the_time_left_to_arm_is_told_and_kept(clock, monkeypatch):
    operator = Operator.__new__(Operator)

    class Call:
        def __init__(self, node, gate, service):
            self.wait_for_answer = lambda _: TriggerAnswer(gate, False, "x")

    def wait_for(*_):
        clock.sleep(7.0)
        return "/command_gate"

    operator._node = None
    monkeypatch.setattr(operator, "_wait_for", wait_for)
    monkeypatch.setattr(module, "Call", Call)
    told = []
    answer = operator.arm("", 10.0, False, told.append)
    assert told == ["/command_gate does not arm yet (x); asking again for 3 s"]
    assert not answer.granted
    assert 7.0 + module.ASK_AGAIN_S < clock.now_s <= 10.0


@pytest.mark.parametrize("seconds", [0.0, 3.0])
def test_a_gate_that_hangs_holds_up_the_arming_no_longer_than_was_given(
    clock, monkeypatch, seconds
):
    class Call:
        def __init__(self, node, gate, service):
            self.gate = gate

        def wait_for_answer(self, left_s):
            clock.sleep(left_s)
            return TriggerAnswer(self.gate, False, "it did not answer in time")

    operator = Operator.__new__(Operator)
    operator._node = None
    monkeypatch.setattr(operator, "_wait_for", lambda *_: "/command_gate")
    monkeypatch.setattr(module, "Call", Call)
    answer = operator.arm("", seconds, True, lambda _: None)
    assert answer == TriggerAnswer("/command_gate", False, "it did not answer in time")
    assert clock.now_s == seconds


def test_a_goal_without_an_answer_takes_no_longer_than_was_given(clock, monkeypatch):
    operator = Operator.__new__(Operator)
    operator._policies = {"/policy_node": ("active", {})}
    operator._node = SimpleNamespace(create_publisher=lambda *_: topic)
    topic = SimpleNamespace(publish=lambda _: None, get_subscription_count=lambda: 1)

    def holds(condition, seconds, _):
        if not condition():
            clock.sleep(seconds)
        return condition()

    monkeypatch.setattr(module, "holds", holds)
    answer = operator.send_goal("", GoalRequest(1.0, 0.0), 2.0, lambda _: None)
    assert answer == GoalAnswer(0, False, "no answer within 2.0 s, active")
    assert clock.now_s == 2.0


def test_a_stopped_robot_is_told_at_once_and_one_seen_later_is_stopped_too(
    clock, monkeypatch
):
    appearing = {"/ant/command_gate": 0.0, "/bee/command_gate": 0.5}
    hanging = "/cat/command_gate"

    class Call:
        def __init__(self, node, gate, service):
            self.gate = gate

        def is_answered(self):
            return self.gate != hanging

        def wait_for_answer(self, left_s):
            clock.sleep(left_s)
            return TriggerAnswer(self.gate, self.gate != hanging, "")

    def find_gates():
        return {hanging} | {gate for gate, s in appearing.items() if s <= clock.now_s}

    operator = Operator.__new__(Operator)
    operator._node = None
    monkeypatch.setattr(operator, "_gates", find_gates)
    monkeypatch.setattr(module, "Call", Call)
    told = [
        (answer.node, answer.granted, round(clock.now_s, 1))
        for answer in operator.stop(None, 5.0)
    ]
    assert told == [
        ("/ant/command_gate", True, 0.0),
        ("/bee/command_gate", True, 0.5),
        (hanging, False, module.SETTLE_S + module.GATE_ANSWER_S),
    ]
