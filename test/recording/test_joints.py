from __future__ import annotations

import numpy as np
import pytest

from nics_drl_bridge.errors import RecordingError
from nics_drl_bridge.recording.bag_reader import JointMessage, gather, state_of, wheels_of
from nics_drl_bridge.recording.topic_roles import TopicRoles
from nics_drl_bridge.robot.spec import load_robot

CAR, CART, MECANUM = (load_robot(name) for name in ("ackermann", "differential", "mecanum"))


def table(*messages):
    """Joints of messages (names, positions, velocities)."""
    made = [JointMessage(k, k, *message) for k, message in enumerate(messages)]
    return gather("/joint_states", made)


def roles(**given) -> TopicRoles:
    return TopicRoles.model_validate(given)


def refused(joints, spec, **given) -> str:
    with pytest.raises(RecordingError) as caught:
        state_of(joints, spec, roles(**given), "drive")
    return str(caught.value)


@pytest.mark.parametrize(
    "names",
    [
        ("left_wheel", "right_wheel"),
        ("wheel_left_joint", "wheel_right_joint"),
        ("base/Left_Wheel", "base/Right_Wheel"),
    ],
)
def test_wheels_are_known_by_the_words_of_their_names(names):
    joints = table((names, (0.0, 0.0), (1.0, 2.0)), (names, (0.1, 0.2), (3.0, 4.0)))
    state = state_of(joints, CART, roles(), "drive")
    assert state.values.tolist() == [[1.0, 2.0], [3.0, 4.0]]
    assert wheels_of(joints, roles(), "drive").values.tolist() == [[1.0, 2.0], [3.0, 4.0]]


def test_wheels_in_another_order_are_put_in_the_robots():
    names = [f"{end}_{side}_wheel" for end in ("rear", "front") for side in ("right", "left")]
    joints = table((names, np.zeros(4), (4.0, 3.0, 2.0, 1.0)))
    assert state_of(joints, MECANUM, roles(), "drive").values.tolist() == [[1.0, 2.0, 3.0, 4.0]]


def test_angles_are_positions_and_speeds_are_velocities_unless_the_mapping_says_otherwise():
    joints = table((("rack", "motor"), (0.3, 7.0), (9.0, 0.5)))
    named = roles(state={"speed": "motor", "steering": "rack"})
    assert state_of(joints, CAR, named, "drive").values.tolist() == [[0.5, 0.3]]
    motor = {"joint": "motor", "field": "position", "scale": 0.1}
    named = roles(state={"speed": motor, "steering": "rack"})
    assert np.allclose(state_of(joints, CAR, named, "drive").values, [[0.7, 0.3]])


def test_messages_about_other_joints_are_left_out():
    arm, both = (("elbow",), (0.0,), (1.0,)), ("left_wheel", "right_wheel")
    joints = table(arm, (both, (), (1.0, 2.0)), arm, (both, (), (np.nan, 2.0)))
    state = state_of(joints, CART, roles(), "drive")
    assert state.values.tolist() == [[1.0, 2.0]]
    assert state.receive_ns.tolist() == [1]


def test_a_state_that_follows_its_command_need_not_be_measured():
    assert state_of(table((("elbow",), (0.0,), (1.0,))), CAR, roles(), "drive") is None


def test_a_state_that_must_be_measured_and_is_not_is_named():
    sentence = refused(table((("elbow",), (0.0,), (1.0,))), CART)
    assert "no joint is known for the state 'left_wheel'" in sentence
    assert "are elbow: name it in the topics file, as in state: {left_wheel: JOINT}." in sentence


def test_joints_that_could_each_be_it_are_not_guessed():
    names = ("front_left_wheel", "rear_left_wheel", "right_wheel")
    assert "'left_wheel'" in refused(table((names, (), (1.0, 1.0, 1.0))), CART)


def test_joints_without_velocity_are_refused():
    names = ("left_wheel", "right_wheel")
    for velocity in ((), (np.nan, np.nan)):
        sentence = refused(table((names, (0.0, 0.0), velocity)), CART)
        assert "no message tells the position or velocity that is needed of left_wheel" in sentence
        assert wheels_of(table((names, (0.0, 0.0), velocity)), roles(), "drive") is None


def test_names_that_are_not_there_come_with_the_nearest():
    joints = table((("wheel_l", "wheel_r"), (), (1.0, 1.0)))
    sentence = refused(joints, CART, state={"left_wheel": "weel_l"})
    assert sentence == (
        "drive: topic '/joint_states' has no joint 'weel_l'; did you mean 'wheel_l'?"
    )
    assert "has no state 'left_weel'" in refused(joints, CART, state={"left_weel": "wheel_l"})
    with pytest.raises(RecordingError, match="has no joint 'left'"):
        wheels_of(joints, roles(wheels=["left", "wheel_r"]), "drive")
