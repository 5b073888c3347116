"""The robot and its gate on both ends of a network that loses packets, in small."""

from __future__ import annotations

import os
import shutil

import pytest

from .runs import asked, fails

pytest.importorskip("rclpy", reason="needs ROS 2: rclpy is not installed")

pytestmark = [
    pytest.mark.ros,
    pytest.mark.timeout(300),
    pytest.mark.skipif(
        os.geteuid() != 0 or None in map(shutil.which, ("ip", "nft")),
        reason="packet loss needs root and the tools ip and nft",
    ),
]
SCRIPT = "packet_loss.py"
SHORT = ("--seconds", "6", "--loss", "20")


@pytest.mark.campaign
def test_no_command_moves_a_robot_on_old_data_when_packets_are_lost():
    code, result = asked(SCRIPT, "--seconds", "8", "--loss", "20")
    assert (code, result["failures"]) == (0, [])
    assert result["loss_20"]["moving_commands"] > 0
    assert result["loss_20"]["scans_arrived"] < result["loss_20"]["scans_sent"]
    assert result["unsafe_commands"] == 0


@pytest.mark.campaign
def test_without_the_gate_the_robot_drives_on_old_scans():
    missed = fails(SCRIPT, "no_gate", "--seconds", "6", "--loss", "40")
    assert any("unsafe commands, bar 0" in line for line in missed)
    assert any("s old, bar 0.40 s" in line for line in missed)


@pytest.mark.campaign
def test_a_robot_that_stands_still_shows_nothing():
    missed = fails(SCRIPT, "standing", *SHORT)
    assert "loss_20: invalid: nothing moved" in missed
    assert any("nan s old" in line for line in missed)


@pytest.mark.campaign
def test_a_network_that_loses_nothing_shows_nothing():
    missed = fails(SCRIPT, "no_loss", *SHORT)
    assert any("none was lost" in line for line in missed)


@pytest.mark.campaign
def test_a_robot_that_is_too_slow_to_send_shows_nothing():
    missed = fails(SCRIPT, "slow_robot", *SHORT)
    assert any("invalid: the robot sent " in line for line in missed)
