from __future__ import annotations

import numpy as np
import pytest
from robots import DIRECT

from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.recording.excite import expected_motion
from nics_drl_bridge.recording.textbook import integrate
from nics_drl_bridge.robot.kinds import textbook
from nics_drl_bridge.robot.spec import load_robot

PERIOD_S = 0.05


@pytest.mark.parametrize("name", ["ackermann", "differential", "mecanum"])
def test_it_is_the_textbook_but_for_a_centimetre(name):
    spec = load_robot(name)
    rng = np.random.default_rng(0)
    held = rng.uniform(spec.command_low, spec.command_high, (3, 10, len(spec.command)))
    command = np.repeat(held, 8, axis=1)
    pose, state = np.zeros((3, 3)), np.zeros((3, len(spec.state)))
    poses, states = expected_motion(spec).roll(pose, state, command, PERIOD_S)
    assert poses.shape == (3, 81, 3)
    for n in range(80):
        pose, state = integrate(textbook(spec), pose, state, command[:, n], PERIOD_S)
        assert states[:, n + 1] == pytest.approx(state)
    assert np.hypot(*(poses[:, -1] - pose)[:, :2].T).max() < 0.01


def test_without_a_textbook_cmd_vel_is_the_twist():
    poses, states = expected_motion(DIRECT).roll(
        np.zeros((1, 3)), np.zeros((1, 0)), np.tile([1.0, -0.5, 0.0], (1, 20, 1)), PERIOD_S
    )
    assert poses[0, -1] == pytest.approx([1.0, -0.5, 0.0])
    assert states.shape == (1, 21, 0)


def test_a_steering_angle_without_a_textbook_can_not_be_predicted():
    car = load_robot("ackermann").model_copy(update={"textbook": None})
    with pytest.raises(ConfigError, match=r"'steering_command' in rad.*add `textbook:`"):
        expected_motion(car)
