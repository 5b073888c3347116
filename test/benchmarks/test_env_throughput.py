from __future__ import annotations

import os
import sys
from dataclasses import replace

import pytest

from .runs import BENCHMARKS, asked, fails

SCRIPT = "env_throughput.py"
FEW = ("--worlds", "64", "--threads", "1", "--repeats", "1", "--without-peers")
pytestmark = pytest.mark.timeout(300)  # a cold start compiles


@pytest.fixture(scope="module")
def benchmark():
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(BENCHMARKS))
        import env_throughput

        yield env_throughput


@pytest.fixture(scope="module")
def peers(benchmark):
    return sys.modules["measuring.peers"]


@pytest.mark.campaign
def test_the_throughput_is_told_with_the_ratio_at_equal_work_first():
    _, found = asked(SCRIPT, *FEW)
    assert list(found)[:2] == [
        "times_as_fast_at_equal_work",
        "times_as_fast_with_ten_scans",
    ]
    assert (
        found["peers"]
        == found["peers_with_one_scan"]
        == {"ir_sim": None, "irsim_x": None}
    )
    for name in ("single_thread", "all_threads"):
        assert found[f"{name}_env_steps_per_s"] > 0.0
    assert found["single_env_gym_steps_per_s"] > 0.0
    assert found["single_env_with_estimator_steps_per_s"] > 0.0
    assert "share_of_usual" not in found
    # Speed is judged where it is measured, not here; that all move, see and end is not speed.
    assert not [line for line in found["failures"] if not line.startswith("share of ")]


@pytest.mark.campaign
def test_robots_that_stand_still_are_no_throughput():
    missed = fails(SCRIPT, "standing", *FEW)
    assert any(line.startswith("motion of our env 'one'") for line in missed)
    assert any(line.startswith("scans of our env 'estimator'") for line in missed)


@pytest.mark.campaign
def test_a_lidar_of_a_few_beams_is_no_throughput():
    missed = fails(SCRIPT, "blind", *FEW)
    assert any(line.startswith("scans of our env 'one'") for line in missed)
    assert not any(line.startswith("motion") for line in missed)


@pytest.mark.campaign
def test_an_env_that_is_ten_times_slower_misses_the_bars_of_speed():
    missed = fails(SCRIPT, "slow", *FEW)
    for bar in ("share of the rate at which observations", "share of CartPole's rate"):
        assert any(line.startswith(bar) for line in missed), missed


def measured(peers, **readings: float):
    """A peer whose scan takes 1 ms, in its step and alone, unless told otherwise."""
    one = {
        "scan_s": 1e-3,
        "agreement": 1.0,
        "moved_m_per_period": 0.05,
        "beams_changed_per_period": 400.0,
        "episodes": 3,
    }
    return peers.Measured({}, {}, {"ir_sim": {**one, **readings}}, {}, {}, {})


@pytest.mark.parametrize(
    ("reading", "value", "named"),
    [
        ("agreement", 1.21, "agreement of ir_sim"),
        ("agreement", 0.79, "agreement of ir_sim"),
        ("agreement", float("nan"), "agreement of ir_sim"),
        ("moved_m_per_period", 0.0, "motion of ir_sim"),
        ("moved_m_per_period", float("nan"), "motion of ir_sim"),
        ("beams_changed_per_period", 0.0, "scans of ir_sim"),
        ("episodes", 0, "episodes of ir_sim"),
    ],
)
def test_a_peer_that_does_not_agree_with_itself_or_does_nothing_misses_a_bar(
    peers, reading, value, named
):
    assert peers.missed_by(measured(peers)) == []
    assert peers.missed_by(measured(peers, agreement=1.19)) == []
    (missed,) = peers.missed_by(measured(peers, **{reading: value}))
    assert missed.startswith(named)


def test_a_peer_that_is_as_fast_as_ours_misses_no_bar_but_the_ratios(benchmark, peers):
    shares = (
        "share_of_write_limit",
        "share_of_cartpole",
        "share_of_cartpole_with_estimator",
    )
    result = {**dict.fromkeys(shares, 1.0), "drove": {}}
    result["times_as_fast_at_equal_work"] = {"ir_sim": 1.0, "irsim_x": float("nan")}
    missed = benchmark.judge(result, measured(peers))
    assert missed == [
        "times as fast as ir_sim at equal work: 1, bar 900",
        "times as fast as irsim_x at equal work: nan, bar 70",
    ]


@pytest.mark.parametrize(
    ("given", "bar"), [({"lidar": "hokuyo_ust_10lx"}, 0.75), ({"obstacles": 260}, 0.65)]
)
def test_another_lidar_or_more_obstacles_have_to_keep_their_share_of_the_usual_rate(
    benchmark, peers, given, bar
):
    case = benchmark.Case(**given)
    for share, enough in ((bar, True), (bar - 0.01, False), (float("nan"), False)):
        result = {
            "share_of_usual": share,
            "drove": {},
            "times_as_fast_at_equal_work": {},
        }
        missed = benchmark.judge(result, measured(peers), case)
        told = f"left of the usual env's speed: {100.0 * share:.3g} %, bar {100.0 * bar:g} %"
        assert missed == ([] if enough else [told])


def test_faults_that_make_a_scan_half_as_long_again_are_a_missed_bar(benchmark, peers):
    result = {"share_of_usual": 1.0, "drove": {}, "times_as_fast_at_equal_work": {}}
    for times, enough in ((1.3, True), (1.5, False), (float("nan"), False)):
        found = {**result, "times_as_long_as_clean": times}
        missed = benchmark.judge(
            found, measured(peers), benchmark.Case(lidar="rplidar_a2")
        )
        told = f"times as long as without the lidar's faults: {times:.3f}, bar 1.3"
        assert missed == ([] if enough else [told])


def test_another_case_is_of_another_lidar_or_as_dense_with_more_obstacles(benchmark):
    assert benchmark.USUAL.is_usual
    case = benchmark.Case(lidar="hokuyo_ust_10lx")
    assert (case.is_usual, case.world) == (False, benchmark.peers.WORLD)
    assert case.model.lidar.beams == 1081
    clean = replace(case, clean=True).model.lidar
    assert (clean.beams, clean.noise_std, clean.faults.quantisation) == (1081, 0.0, 0.0)
    case = benchmark.Case(obstacles=40)
    assert not case.is_usual
    assert case.model is benchmark.peers.MODEL
    assert case.world.obstacles[0].counts == (40, 40)
    assert case.world.size == pytest.approx((12.0, 12.0))


@pytest.mark.campaign
@pytest.mark.parametrize(
    "option", [("--lidar", "hokuyo_ust_10lx"), ("--obstacles", "40")]
)
def test_another_case_is_told_beside_the_usual_one_and_one_that_is_slow_misses_its_bar(
    option,
):
    _, found = asked(SCRIPT, *FEW, *option)
    assert found["share_of_usual"] > 0.0
    assert "usual" in found["drove"]
    speed = "share of ", "left of ", "times as long as "
    assert not [line for line in found["failures"] if not line.startswith(speed)]
    missed = fails(SCRIPT, "slow", *FEW, *option)
    assert any(line.startswith("left of the usual env's speed: ") for line in missed), (
        missed
    )


def test_a_peer_that_crashes_is_a_missed_bar_and_no_hang(peers, monkeypatch, tmp_path):
    broken = tmp_path / "irsim_peer.py"
    broken.write_text("import sys\nsys.exit('no lidar')\n")
    monkeypatch.setattr(peers, "SCRIPT", broken)
    monkeypatch.setattr(peers, "python_with", lambda *_: sys.executable)
    found = peers.measure({}, ["ir_sim"], peers.scenes(1), 1)
    assert peers.missed_by(found) == ["ir_sim failed: no lidar"]


def test_a_peer_that_ends_in_between_is_a_missed_bar(peers, monkeypatch, tmp_path):
    broken = tmp_path / "irsim_peer.py"
    broken.write_text("print('{\"ranges\": [[1.0]]}', flush=True)\n")
    monkeypatch.setattr(peers, "SCRIPT", broken)
    monkeypatch.setattr(peers, "python_with", lambda *_: sys.executable)
    found = peers.measure({}, ["ir_sim"], peers.scenes(1), 1)
    (missed,) = peers.missed_by(found)
    assert missed.startswith("ir_sim failed")


FAKE = '''
import numpy as np


class Thing:
    """A robot or a circle: it is where it is put."""

    def __init__(self):
        self.state, self.velocity = np.zeros((3, 1)), np.zeros((2, 1))
        self.collision_flag, self.lidar = False, None

    def set_state(self, state, init):
        self.state = np.array(state, float).reshape(3, 1)

    def reset(self):
        pass

    def step(self, action, sensor_step):
        self.state = self.state + 0.01 * np.array([[action[0, 0]], [0.0], [action[1, 0]]])

    def check_status(self):
        pass


class Lidar:
    def __init__(self):
        self.range_data = np.ones(720)

    def step(self, state):
        self.range_data = np.full(720, 1.0 + abs(float(state[0, 0])))
        for _ in range(3):
            np.sort(np.arange(50_000.0)[::-1])


class Env:
    def __init__(self):
        self.robot, self.obstacle_list = Thing(), [Thing() for _ in range(10)]
        self.robot.lidar = Lidar()

    def _objects_sensor_step(self):
        self.robot.lidar.step(self.robot.state)

    def step(self, action):
        self.robot.step(action, False)
        self._objects_sensor_step()

    def refresh(self):
        self._objects_sensor_step()


def make(file, **options):
    return Env()
'''


def fake_peer(peers, monkeypatch, folder) -> None:
    """A peer that consists of next to nothing but has the functions that are measured."""
    pytest.importorskip("yaml")
    (folder / "irsim.py").write_text(FAKE)
    monkeypatch.setattr(peers, "python_with", lambda *_: sys.executable)
    monkeypatch.setattr(
        peers, "clean", lambda: {**os.environ, "PYTHONPATH": str(folder)}
    )


@pytest.mark.campaign
def test_the_readings_of_a_peer_come_from_one_process_and_its_own_steps(
    peers, monkeypatch, tmp_path
):
    fake_peer(peers, monkeypatch, tmp_path)
    found = peers.measure({}, ["ir_sim"], peers.scenes(3), 2)
    one = found.peers["ir_sim"]
    assert found.failed == {}
    assert {f"{name}_s" for name in peers.READINGS} < set(one)
    assert one["period_with_ten_scans_s"] > 3.0 * one["period_with_one_scan_s"]
    assert found.ranges["ir_sim"].shape == (3, 720)
