"""The row of stages."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from identify.drives import drive, slipping_car
from nics_drl_bridge.identify import clocks
from nics_drl_bridge.identify import identify as stages
from nics_drl_bridge.identify.calibration import Response, Settings
from nics_drl_bridge.identify.clocks import make_nominal_timing
from nics_drl_bridge.identify.drive import Drive
from nics_drl_bridge.identify.findings import (
    StageOrderError,
    describe_responses,
    is_worse,
)
from nics_drl_bridge.identify.identify import (
    STAGES,
    run,
)
from nics_drl_bridge.robot.spec import RobotSpec


def test_a_follower_beside_a_motion_has_the_lag_and_the_error_of_its_own_command(
    monkeypatch,
):
    spec, recording = slipping_car(duration=4.0)
    data = spec.model_dump()
    angle = {"name": "angle", "unit": "rad", "min": -1.0, "max": 1.0}
    data["state"] = [data["state"][0], angle | {"follows": "steering"}]
    data["textbook"] = None
    followed = RobotSpec.model_validate(data)
    timing = replace(
        make_nominal_timing(Drive(recording, spec)),
        lags=np.array([0.3, 0.1]),  # of throttle and steering
        lag_sigma=np.array([0.03, 0.01]),
    )
    monkeypatch.setattr(clocks, "measure_timing", lambda drive: timing)
    driven = Drive(recording, followed)
    found = run(STAGES[: STAGES.index(stages.find_mounting)], driven)
    assert found.calibration.responses == (Response("angle", "steering", 0.1),)
    (sentence,) = describe_responses(driven, found.calibration, found.timing)
    assert "follow steering with a lag of 0.1000 s (+- 0.0100 s)" in sentence


@pytest.mark.parametrize(
    ("error", "worse"), [(1.2, False), (1.3, True), (np.nan, True)]
)
def test_a_refit_is_worse_if_it_predicts_clearly_worse_or_not_at_all(error, worse):
    assert is_worse(error, 1.0) == worse


def test_a_stage_in_the_wrong_place_says_which_it_needs(car):
    driven = Drive(drive(car, duration=6.0), car, Settings(train_until_s=4.0))
    with pytest.raises(StageOrderError, match="put the stage 'fit_terms' before"):
        run((stages.prune_terms,), driven)
