from __future__ import annotations

import pytest

from gate.rig import Rig, config
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.gate.stopping import doubtful, require_possible


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"scan_age_s": 0.05}, "'scan_age': 0.05 s: scan comes every 0.1 s .* could never move"),
        ({"scan_age_s": 0.09}, "give more than 0.1"),
        ({"odom_age_s": 0.05}, "'odom_age': 0.05 s"),
        ({"scan_rate": 2.0}, "scan comes every 0.5 s"),
        ({"odom_rate": 1.5, "odom_age_s": 2.0}, "too seldom to be judged within 1 s"),
    ],
)
def test_a_setting_with_which_the_gate_is_never_armed_is_one_sentence(changes, sentence):
    given = config(**changes)
    with pytest.raises(ConfigError, match=sentence):
        require_possible(given)
    rig = Rig(given)
    rig.run(3.0)
    assert not rig.arm().granted


def test_the_settings_of_a_robot_that_drives_are_possible():
    require_possible(config())
    assert doubtful(config(), 0.1) == ""


def test_commands_that_are_too_old_before_the_next_one_comes_are_warned_of():
    assert "give more than 0.1" in doubtful(config(command_age_s=0.05), 0.1)
