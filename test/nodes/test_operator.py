"""What a person asks of a running robot keeps to the time that was given."""

from functools import partial
from types import SimpleNamespace

import pytest

from nics_drl_bridge.nodes import listener
from nics_drl_bridge.nodes import operator as module
from nics_drl_bridge.nodes.operator import (
    GoalAnswer,
    GoalRequest,
    Operator,
    TriggerAnswer,
)
from nodes.direct import Clock

pytestmark = pytest.mark.ros


GATE = "/command_gate"


@pytest.fixture
def clock(monkeypatch):
    monkeypatch.setattr(module, "time", clock := Clock())
    return clock


@pytest.fixture
def operator(clock, monkeypatch):
    """Makes an operator whose gates answer by their names and the time left."""

    def make(answer, is_answered=lambda gate: True):
        class Call:
            def __init__(self, node, gate, service):
                self.wait_for_answer = partial(answer, gate)
                self.is_answered = partial(is_answered, gate)

        made = Operator.__new__(Operator)
        made._node = None
        made._spun = SimpleNamespace(close=lambda: None)
        monkeypatch.setattr(made, "_wait_for", lambda *_: GATE)
        monkeypatch.setattr(module, "Call", Call)
        return made

    return make


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


def test_the_time_left_to_arm_is_told_and_kept(clock, operator, monkeypatch):
    made = operator(lambda gate, _: TriggerAnswer(gate, False, "x"))
    monkeypatch.setattr(made, "_wait_for", lambda *_: clock.sleep(7.0) or GATE)
    told = []
    assert not made.arm("", 10.0, False, told.append).granted
    assert told == ["/command_gate does not arm yet (x); asking again for 3 s"]
    assert 7.0 + module.ASK_AGAIN_S < clock.now_s <= 10.0


@pytest.mark.parametrize("seconds", [0.0, 3.0])
def test_a_gate_that_hangs_holds_up_the_arming_no_longer_than_was_given(
    clock, operator, seconds
):
    late = TriggerAnswer(GATE, False, "it did not answer in time")
    made = operator(lambda _, left_s: clock.sleep(left_s) or late)
    assert made.arm("", seconds, True, lambda _: None) == late
    assert clock.now_s == seconds


def test_a_goal_without_an_answer_takes_no_longer_than_was_given(
    clock, operator, monkeypatch
):
    def holds(condition, seconds, _):
        if not condition():
            clock.sleep(seconds)
        return condition()

    monkeypatch.setattr(module, "holds", holds)
    topic = SimpleNamespace(publish=lambda _: None, get_subscription_count=lambda: 1)
    made = operator(None)
    made._node = SimpleNamespace(create_publisher=lambda *_: topic)
    made._policies = {GATE: ("active", {})}
    answer = made.send_goal("", GoalRequest(1.0, 0.0), 2.0, lambda _: None)
    assert answer == GoalAnswer(0, False, "no answer within 2.0 s, active")
    assert clock.now_s == 2.0


def test_a_stopped_robot_is_told_at_once_and_one_seen_later_is_stopped_too(
    clock, operator, monkeypatch
):
    appearing = {"/ant": 0.0, "/bee": 0.5, "/hangs": 0.0}
    made = operator(
        lambda gate, left_s: (
            clock.sleep(left_s) or TriggerAnswer(gate, gate != "/hangs", "")
        ),
        is_answered=lambda gate: gate != "/hangs",
    )
    monkeypatch.setattr(
        made, "_gates", lambda: {g for g, s in appearing.items() if s <= clock.now_s}
    )
    told = [
        (answer.node, answer.granted, round(clock.now_s, 1))
        for answer in made.stop(None, 5.0)
    ]
    assert told == [
        ("/ant", True, 0.0),
        ("/bee", True, 0.5),
        ("/hangs", False, module.SETTLE_S + module.GATE_ANSWER_S),
    ]
