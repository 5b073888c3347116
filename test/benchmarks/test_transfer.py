from __future__ import annotations

import math
from importlib import import_module
from importlib.util import find_spec

import pytest

from nics_drl_bridge.policy.policies import shipped_policies

from .runs import BENCHMARKS, asked, fails

missing = [name for name in ("rclpy", "mujoco") if find_spec(name) is None]
ready = not missing and "differential" in shipped_policies()


@pytest.fixture
def transfer(monkeypatch):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    return import_module("transfer")


def places(fast, dds, mujoco, believed=0.0, length=5.0):
    """Figures of one robot in three worlds; `believed` more than truly arrived."""
    return {
        place: {
            "success": [share, 0.0, 1.0],
            "believed": [share + believed, 0.0, 1.0],
            "length": [length, 0.0, 9.0],
        }
        for place, share in zip(("fast", "dds", "mujoco_dds"), (fast, dds, mujoco), strict=True)
    }


@pytest.mark.parametrize(
    ("figures", "bars"),
    [
        (places(0.97, 0.95, 0.92), []),
        (places(0.97, 0.94, 0.97), ["success over DDS is 3% off"]),
        (places(0.97, 0.97, 0.91), ["success MuJoCo over DDS is 6% off"]),
        (places(0.1, 0.1, 0.1), ["10% success in process"]),
        (places(0.97, 0.97, 0.97, believed=0.06), ["successes to the robot alone"] * 3),
        (places(0.97, 0.97, 0.97, length=None), ["no successful way"] * 3),
        (places(math.nan, 0.97, 0.97), ["nan", "nan", "nan", "nan"]),
    ],
)
def test_success_may_be_two_points_off_over_dds_and_five_in_mujoco(transfer, figures, bars):
    missed = transfer.missed({"differential": figures})
    assert len(missed) == len(bars)
    assert all(bar in line for bar, line in zip(bars, missed, strict=True))


def test_no_robot_is_no_transfer(transfer):
    assert transfer.missed({}) == ["no robot was driven"]


def test_rates_are_the_success_of_each_world(transfer):
    found = {place: {"success": [share, 0.0, 1.0]} for place, share in zip(
        ("fast", "dds", "mujoco_dds"), (0.9, 0.8, 0.7), strict=True
    )}  # fmt: skip
    told = transfer.rates({"robots": {"mecanum": found}})
    assert told == {"robots": {"mecanum": {"fast": 0.9, "dds": 0.8, "mujoco_dds": 0.7}}}


ONE = ("--episodes", "1", "--robots", "differential")


@pytest.mark.campaign
@pytest.mark.ros
@pytest.mark.skipif(not ready, reason="needs ROS 2, MuJoCo and the shipped policies")
def test_it_prints_one_json_object_with_all_worlds():
    code, told = asked("transfer.py", *ONE)
    assert set(told) == {"robots", "without_randomisation", "believed", "failures"}
    for key in ("robots", "without_randomisation", "believed"):
        assert set(told[key]["differential"]) == {"fast", "dds", "mujoco_dds"}
        assert set(told[key]["differential"].values()) <= {0.0, 1.0}
    assert code == bool(told["failures"])


@pytest.mark.campaign
@pytest.mark.ros
@pytest.mark.skipif(not ready, reason="needs ROS 2, MuJoCo and the shipped policies")
@pytest.mark.parametrize(
    ("control", "bar"),
    [
        ("lying", "100% of the episodes were successes to the robot alone"),
        ("standing", "0% success in process"),
    ],
)
def test_a_robot_that_lies_or_stands_misses_a_bar(control, bar):
    assert any(bar in line for line in fails("transfer.py", control, *ONE))
