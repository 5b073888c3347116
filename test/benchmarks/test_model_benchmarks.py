"""The benchmarks of the kinematics in small: they pass, and without what they measure they fail."""

from __future__ import annotations

import pytest

from .runs import asked, fails

TABLE1 = "table1_kinematics.py"
MUJOCO = "generate_from_mujoco.py"
SHORT = ("--robots", "differential", "--train", "40", "--unseen", "10", "--drives", "1")
pytestmark = pytest.mark.timeout(300)  # a cold start compiles


@pytest.mark.campaign
def test_the_fitted_models_err_no_more_than_the_papers():
    _, result = asked(TABLE1)
    assert set(result["robots"]) == {"ackermann", "differential", "mecanum"}
    assert not [
        line for line in result["failures"] if "rmse" in line or "float32" in line
    ]


@pytest.mark.campaign
@pytest.mark.parametrize(
    ("control", "bar"),
    [("rounded", "rmse_x_m"), ("nan", "nan"), ("slow", "times plain Python's")],
)
def test_table1_fails_without_exact_or_fast_models(control, bar):
    assert any(bar in line for line in fails(TABLE1, control))


@pytest.mark.campaign
def test_a_model_of_a_robot_in_mujoco_predicts_what_it_has_not_seen():
    pytest.importorskip("mujoco")
    _, result = asked(MUJOCO, *SHORT)
    assert not [line for line in result["failures"] if "error" in line]


@pytest.mark.campaign
@pytest.mark.parametrize(
    ("control", "bar"),
    [
        ("standing", "error_over_path"),
        ("slow", "MuJoCo's speed"),
        ("nan", "error_over_path nan"),
    ],
)
def test_a_model_that_stands_is_slow_or_is_none_does_not_predict_mujoco(control, bar):
    pytest.importorskip("mujoco")
    assert any(bar in line for line in fails(MUJOCO, control, *SHORT))
