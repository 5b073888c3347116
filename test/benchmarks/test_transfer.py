from __future__ import annotations

import math
from importlib import import_module
from importlib.util import find_spec

import pytest

from nics_drl_bridge.config import list_shipped
from nics_drl_bridge.policy.policies import shipped_policies

from .runs import BENCHMARKS, asked, fails

missing = [name for name in ("rclpy", "mujoco") if find_spec(name) is None]
ready = not missing and "differential" in shipped_policies()


@pytest.fixture
def transfer(monkeypatch):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    return import_module("transfer")


def places(fast, dds, mujoco, believed=0.0, length=5.0):
    """Figures of one robot in one world; `believed` more than truly arrived."""
    return {
        place: {
            "success": [share, 0.0, 1.0],
            "collision": [0.01, 0.0, 1.0],
            "believed": [share + believed, 0.0, 1.0],
            "length": [length, 0.0, 9.0],
        }
        for place, share in zip(
            ("fast", "dds", "mujoco_dds"), (fast, dds, mujoco), strict=True
        )
    }


@pytest.mark.parametrize(
    ("world", "figures", "bars"),
    [
        ("circles", places(0.97, 0.95, 0.93), []),
        ("clutter", places(0.95, 0.95, 0.95), []),
        (
            "circles",
            places(0.95, 0.95, 0.95),
            ["95.0% success in process, less than 97%"],
        ),
        ("doorway", places(0.97, 0.94, 0.97), ["success over DDS is 3.0 points off"]),
        (
            "room",
            places(0.97, 0.97, 0.92),
            ["success MuJoCo over DDS is 5.0 points off"],
        ),
        ("room", places(0.97, 0.97, 1.0), []),
        ("crowd", places(0.1, 0.1, 0.1), ["10.0% success in process"]),
        (
            "room",
            places(0.97, 0.97, 0.97, believed=0.06),
            ["successes to the robot alone"] * 3,
        ),
        ("room", places(0.97, 0.97, 0.97, length=None), ["no successful way"] * 3),
        ("room", places(math.nan, 0.97, 0.97), ["nan", "nan", "nan", "nan"]),
    ],
)
def test_success_has_a_floor_in_each_world_and_may_be_two_and_four_points_off(
    transfer, world, figures, bars
):
    missed = transfer.missed({"differential": {world: figures}})
    assert len(missed) == len(bars)
    assert all(bar in line for bar, line in zip(bars, missed, strict=True))
    assert all(line.startswith(f"differential in {world}") for line in missed)


def test_every_world_that_comes_with_the_package_is_driven(transfer):
    assert set(transfer.FLOORS) == set(list_shipped("worlds"))


def test_no_robot_is_no_transfer(transfer):
    assert transfer.missed({}) == ["no robot was driven"]


def test_a_part_of_the_places_is_judged_alone(transfer):
    some = {place: places(0.97, 0.9, 0.9)[place] for place in ("dds", "mujoco_dds")}
    assert transfer.missed({"differential": {"circles": some}}) == []
    assert transfer.apart({"differential": {"circles": some}}) == {
        "differential": {"circles": {}}
    }


def test_shares_and_their_distance_are_told_of_each_robot_world_and_place(transfer):
    found = {"mecanum": {"room": places(0.9, 0.88, 0.95, believed=0.02)}}
    assert transfer.shares(found, "success")["mecanum"]["room"] == {
        "fast": 0.9,
        "dds": 0.88,
        "mujoco_dds": 0.95,
    }
    assert transfer.shares(found, "believed")["mecanum"]["room"][
        "fast"
    ] == pytest.approx(0.92)
    assert transfer.apart(found)["mecanum"]["room"] == {"dds": -2.0, "mujoco_dds": 5.0}


def test_a_robot_drives_with_its_own_lidar_or_a_real_one_behind_its_own_gate(transfer):
    assert transfer.conditions("jackal").lidar is None
    given = transfer.conditions("mecanum")
    assert (given.lidar, given.randomisation, given.gate) == (
        "rplidar_a2",
        "mild",
        "mecanum",
    )


ONE = ("--episodes", "1", "--robots", "differential", "--worlds", "circles")


@pytest.mark.campaign
@pytest.mark.ros
@pytest.mark.skipif(not ready, reason="needs ROS 2, MuJoCo and the shipped policies")
def test_it_prints_one_json_object_with_all_places():
    code, told = asked("transfer.py", *ONE)
    for key in ("success", "collision", "believed"):
        shares = told[key]["differential"]["circles"]
        assert set(shares) == {"fast", "dds", "mujoco_dds"}
        assert set(shares.values()) <= {0.0, 1.0}
    assert set(told["points_from_fast"]["differential"]["circles"]) == {
        "dds",
        "mujoco_dds",
    }
    assert code == bool(told["failures"])


@pytest.mark.campaign
@pytest.mark.ros
@pytest.mark.skipif(not ready, reason="needs ROS 2, MuJoCo and the shipped policies")
@pytest.mark.parametrize(
    ("control", "bar"),
    [
        ("lying", "100% of the episodes were successes to the robot alone"),
        ("standing", "no successful way"),
    ],
)
def test_a_robot_that_lies_or_stands_misses_a_bar_in_each_place(control, bar):
    missed = fails("transfer.py", control, *ONE)
    for place in ("in process", "MuJoCo over DDS", "circles over DDS"):
        assert any(bar in line and place in line for line in missed)
