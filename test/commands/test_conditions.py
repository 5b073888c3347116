"""Under what an evaluation is driven, and that it is the same everywhere."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("gymnasium")

from nics_drl_bridge.commands.conditions import NO_CONDITIONS, Conditions
from nics_drl_bridge.commands.episodes import open_env
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.generator import builtin_model, load_model
from nics_drl_bridge.policy.evaluation import drive


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


@pytest.mark.parametrize(
    ("conditions", "said"),
    [
        (Conditions(lidar="rplidar_a9"), "rplidar_a9"),
        (Conditions(randomisation="milt"), "mild"),
    ],
)
def test_an_unknown_condition_is_one_sentence(conditions, said, tmp_path):
    with pytest.raises(ConfigError, match=said):
        _ = conditions.model("differential", tmp_path), conditions.ranges


@pytest.mark.slow
def test_an_episode_is_driven_through_the_gate_and_with_what_was_drawn():
    model = builtin_model("differential")
    told = []
    for gate in (None, "differential"):
        given = {
            "estimator": True,
            "randomisation": Conditions(randomisation="mild").ranges,
        }
        env, policy = open_env(
            "dynamic_window", model, "circles", "sim", Conditions(gate=gate), **given
        )
        episode = drive(env, policy, 5)
        told.append((episode, env.reset(seed=5)[1]["randomisation"]))
    (bare, drawn), (behind, again) = told
    assert drawn == again
    speeds = [
        np.linalg.norm(np.diff(one.path[:3, :2], axis=0), axis=1) for one, _ in told
    ]
    assert speeds[1][-1] < speeds[0][-1]  # the gate lets no robot start at once
    assert bare.goal.tolist() == behind.goal.tolist()
