from __future__ import annotations

from dataclasses import replace

import pytest

from nics_drl_bridge.identify.acceptance import list_doubts_of_commands
from nics_drl_bridge.identify.calibration import Calibration
from nics_drl_bridge.robot.taylor import EndErrors, HorizonErrors


def doubts(error: float, without: float = 1.0, latency: float = 0.1) -> list[str]:
    ends = EndErrors(error, 0.1), EndErrors(without, 0.1)
    judgement = (HorizonErrors(5.0, 9, 2.0, *ends),)
    return list(
        list_doubts_of_commands(
            judgement, replace(Calibration(), command_latency_s=latency)
        )
    )


def test_commands_that_hardly_help_are_said():
    (doubt,) = doubts(0.9)
    assert doubt.startswith(
        "The commands hardly help: predictions by them end 0.9 m off after 5 s"
    )


@pytest.mark.parametrize("latency", [1.4, -0.5])
def test_an_implausible_latency_is_said(latency):
    (doubt,) = doubts(0.1, latency=latency)
    assert f"A latency of {latency:.2f} s" in doubt


def test_commands_that_help_at_once_raise_no_doubt():
    assert doubts(0.3) == []
