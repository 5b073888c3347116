"""Under what an evaluation is driven, and that it is the same everywhere."""

from __future__ import annotations

import pytest

pytest.importorskip("gymnasium")

from nics_drl_bridge.commands.episodes import NO_CONDITIONS, Conditions
from nics_drl_bridge.generator import builtin_model, load_model


def test_without_conditions_a_model_stays_as_it_is_and_nothing_is_written(tmp_path):
    model, name = NO_CONDITIONS.model("differential", tmp_path)
    assert (model, name) == (builtin_model("differential"), "differential")
    assert NO_CONDITIONS.ranges is None
    assert not list(tmp_path.iterdir())


def test_a_model_with_another_lidar_is_saved_where_a_node_can_read_it(tmp_path):
    model, name = Conditions(lidar="rplidar_a2").model("mecanum", tmp_path)
    assert model.lidar.name == "rplidar_a2"
    assert load_model(name).fingerprint == model.fingerprint
    assert model.table.shapes == builtin_model("mecanum").table.shapes
