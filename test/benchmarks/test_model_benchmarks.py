"""The benchmarks of the kinematics in small: they pass, and without what they measure they fail."""

from __future__ import annotations

import pytest

from .runs import BENCHMARKS, asked, fails

TABLE1 = "table1_kinematics.py"
REAL = "real_robot.py"
MUJOCO = "generate_from_mujoco.py"
SHORT = ("--robots", "differential", "--train", "40", "--unseen", "10", "--drives", "1")
DRIVE = (
    BENCHMARKS.parents[1]
    / "shared"
    / "recordings"
    / "xtark_ackermann"
    / "random_drive_45s"
)
real = pytest.mark.skipif(
    not DRIVE.is_dir(), reason=f"no recording of the real car at {DRIVE}"
)
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
    assert control in {"rounded", "nan", "slow"}
    assert any(bar in line for line in fails(TABLE1, control))


@pytest.mark.campaign
@real
def test_the_real_cars_model_predicts_what_it_has_not_seen():
    code, result = asked(REAL)
    assert (code, result["failures"]) == (0, [])


@pytest.mark.campaign
@real
@pytest.mark.parametrize("control", ["standing", "shuffled"])
def test_another_model_does_not_predict_the_real_car(control):
    assert any("the pose is off by" in line for line in fails(REAL, control))


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
