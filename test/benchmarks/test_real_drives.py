"""Drives of others in small, and the robots of other simulators beside them."""

from __future__ import annotations

import importlib
from dataclasses import replace

import numpy as np
import pytest

from nics_drl_bridge.recording.readers import read_recording
from nics_drl_bridge.robot.taylor import TaylorModel

from .runs import BENCHMARKS, asked, fails

REAL = "real_drives.py"
NAMES = ("skid_steer", "throttle_car", "tricycle", "omni", "ticks")
XTARK = "xtark_random_drive_45s"
DRIVES = BENCHMARKS.parents[1] / "shared" / "recordings"
real = pytest.mark.skipif(
    not DRIVES.is_dir(), reason=f"no recordings of others at {DRIVES}"
)
GOOD = {
    "error_m": 0.02,
    "share_of_path": 0.02,
    "yardstick_share": 0.03,
    "constant_twist_share": 0.5,
    "coverage_95": 0.95,
    "truths": {},
}


@pytest.fixture
def module(monkeypatch):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    return importlib.import_module


@pytest.fixture
def foreign(module):
    return module("measuring.foreign_robots")


@pytest.mark.parametrize("name", NAMES)
def test_the_csv_of_a_foreign_robot_reads_as_its_recording(foreign, tmp_path, name):
    drive = foreign.foreign_drive(foreign.ROBOTS[name], seed=1, duration_s=30.0)
    read = read_recording(tmp_path / name, mapping=drive.write(tmp_path / name))
    own = drive.recording()
    assert read.pose.values == pytest.approx(own.pose.values)
    assert read.command.values == pytest.approx(own.command.values)
    assert read.command.t == pytest.approx(own.command.t)


def test_a_seed_is_a_drive(foreign):
    robot = foreign.ROBOTS["omni"]
    first, again, other = (
        foreign.foreign_drive(robot, seed, 5.0) for seed in (1, 1, 2)
    )
    assert np.array_equal(first.pose.values, again.pose.values)
    assert not np.allclose(first.pose.values, other.pose.values, atol=0.01)


@pytest.mark.parametrize(("share", "moves"), [(0.95, False), (1.1, True)])
def test_a_throttle_car_stands_below_its_dead_zone(foreign, share, moves):
    car = foreign.ROBOTS["throttle_car"]
    reach = share * car.dead_zone
    held = replace(
        car, commands={"throttle": (reach, 1.0001 * reach), "steering": (0.0, 0.0)}
    )
    way = np.ptp(foreign.foreign_drive(held, 1, 20.0).pose.values[:, 0])
    assert (way > 0.1) == moves


def test_a_command_acts_after_its_latency(foreign):
    robot = replace(foreign.ROBOTS["omni"], latency_s=0.3)
    drive = foreign.foreign_drive(robot, 1, 5.0)
    told = drive.command.t[np.abs(drive.command.values).max(axis=1) > 0.2][0]
    moved = np.hypot(*(drive.pose.values - drive.pose.values[0])[:, :2].T) > 0.005
    assert 0.3 < drive.pose.t[moved][0] - told < 0.5


def test_a_skid_steer_turns_less_than_it_is_told(foreign):
    told = {"forward_command": (0.5, 0.5001), "turn_command": (1.0, 1.0001)}
    drive = foreign.foreign_drive(
        replace(foreign.ROBOTS["skid_steer"], commands=told), 3, 20.0
    )
    rate = np.gradient(np.unwrap(drive.pose.values[:, 2]), drive.pose.t).mean()
    assert 0.2 < rate < 0.8


def test_encoders_overflow(foreign, tmp_path):
    drive = foreign.foreign_drive(foreign.ROBOTS["ticks"], 1, 60.0)
    drive.write(tmp_path / "drive")
    counts = np.loadtxt(tmp_path / "drive" / "commands.csv", delimiter=",", skiprows=1)[
        :, 1:
    ]
    assert counts.min() >= 0
    assert counts.max() < 2**16
    assert np.abs(np.diff(counts, axis=0)).max() > 2**15


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (
            {"share_of_path": 0.04, "yardstick_share": 0.1},
            "0.040 of the path, bar 0.03",
        ),
        ({"yardstick_share": 0.01}, "the fitted textbook's bar 1 of its 0.010"),
        ({"constant_twist_share": 0.01}, "a robot that keeps its twist by 0.010"),
        ({"error_m": float("nan")}, "off by nan m"),
        ({"coverage_95": 0.8}, "the 95 % band holds 80.0% of the ends, bar 90% to 99%"),
        ({"coverage_95": float("nan")}, "the 95 % band holds nan%"),
        (
            {"truths": {"dead_zone": {"true": 0.1, "found": 0.2, "near": False}}},
            "dead_zone 0.2000",
        ),
        ({"refused": "too short."}, "was refused: too short."),
        ({"crashed": "ValueError: x"}, "crashed: ValueError: x"),
    ],
)
def test_a_bar_that_is_missed_is_told(module, change, told):
    bars = module("measuring.drive_bars")
    limits = bars.Bars(share=0.03, error_m=0.03)
    assert list(bars.missed_by("one", GOOD, limits)) == []
    missed = list(bars.missed_by("one", GOOD | change, limits))
    assert len(missed) == 1
    assert told in missed[0]


def test_every_drive_has_its_mapping(module):
    bars = module("measuring.drive_bars")
    mappings = {drive.mapping for drive in bars.DRIVES.values()}
    found = [*bars.EXAMPLES.glob("*.yaml"), *bars.SHIPPED.glob("*.yaml")]
    assert mappings == {
        path.resolve() for path in found
    }  # one is a link to a shipped one


def test_wheels_are_found_in_a_model_that_moves_by_them(module):
    left = 0.1
    right = 0.11
    base = 0.4
    lag = 0.2
    powers = np.eye(4, dtype=np.int64)  # vx, wz, left, right
    coefficients = np.zeros((5, 4))
    coefficients[0, 0] = coefficients[2, 1] = 1.0
    coefficients[3] = np.array([-1.0, 0.0, left / 2.0, right / 2.0]) / lag
    coefficients[4] = np.array([0.0, -1.0, -left / base, right / base]) / lag
    model = TaylorModel(
        ("vx", "wz", "left", "right"),
        ("vx", "vy", "wz", "d_vx", "d_wz"),
        ("",) * 5,
        powers,
        coefficients,
        0.01,
        -np.ones(4),
        np.ones(4),
    )
    found = module("measuring.truths").wheels_of(model)
    assert found == pytest.approx(
        {"left_m": left, "right_m": right, "base_m": base}, rel=1e-3
    )


@pytest.mark.campaign
@real
def test_a_model_beats_its_yardsticks_on_a_real_drive():
    _, result = asked(REAL, "--only", XTARK)
    told = result["drives"][XTARK]
    assert told["share_of_path"] < min(
        told["yardstick_share"], told["constant_twist_share"]
    )
    assert result["left_out"][XTARK]["error_m"] < 0.026


@pytest.mark.campaign
@real
@pytest.mark.parametrize("control", ["standing", "shuffled"])
def test_no_other_model_passes(control):
    missed = fails(REAL, control, "--only", XTARK)
    assert any("m on segments left out" in line for line in missed)
    assert any("of the path, the fitted textbook's" in line for line in missed)
