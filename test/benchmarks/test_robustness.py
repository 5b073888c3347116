from __future__ import annotations

import json
import math
import subprocess
import sys
from importlib import import_module

import pytest
from PIL import Image

from nics_drl_bridge.generator import builtin_model
from nics_drl_bridge.policy.policies import shipped_policies
from nics_drl_bridge.sim.randomisation import Sampler, load_randomisation

from .runs import BENCHMARKS, asked, fails

ready = "differential" in shipped_policies()
MILD = load_randomisation("mild")
NAMES = ("noise", "drop-out", "latency", "response", "drift", "footprint")


@pytest.fixture
def robustness(monkeypatch):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    return import_module("robustness")


def curves(nothing=0.97, **at):
    """Success without a perturbation, and at a half of, at, and at twice the declared range."""
    return {each: [nothing, nothing, at.get(each, nothing), 0.0] for each in NAMES}


@pytest.mark.parametrize(
    ("success", "bars"),
    [
        (curves(), []),
        (curves(latency=0.92), []),
        (curves(latency=0.91, drift=1.0), ["latency takes 6.0 points, more than 5"]),
        (curves(nothing=0.94), ["94.0% success without a perturbation, less than 95%"]),
        (curves(noise=math.nan), ["noise takes nan points"]),
    ],
)
def test_no_perturbation_may_take_five_points_at_its_declared_range(
    robustness, success, bars
):
    missed = robustness.missed({"mecanum": success})
    assert len(missed) == len(bars)
    assert all(bar in line for bar, line in zip(bars, missed, strict=True))


def test_no_policy_is_no_robustness(robustness):
    assert robustness.missed({}) == ["no policy was driven"]


def test_the_worst_loss_is_that_of_one_policy_to_one_perturbation(robustness):
    lost = robustness.losses(
        {"mecanum": curves(drift=0.95), "ackermann": curves(noise=0.93)}
    )
    assert lost["mecanum"]["drift"] == pytest.approx(2.0)
    assert robustness.worst(lost) == {
        "points": pytest.approx(4.0),
        "robot": "ackermann",
        "perturbation": "noise",
    }


@pytest.mark.parametrize("name", [each for each in NAMES if each != "footprint"])
def test_a_perturbation_alone_has_the_greatest_declared_value(robustness, name):
    model = builtin_model("differential")
    once, twice = (robustness.ranges(MILD, name, times) for times in (1.0, 2.0))
    assert once != twice
    drawn = Sampler(once, model).draw([1, 2, 3])
    whole = Sampler(MILD, model).draw(range(200))
    told = {
        "noise": lambda d: d.faults[..., 0],
        "drop-out": lambda d: d.faults[..., 2],
        "latency": lambda d: d.delay + d.age,
        "response": lambda d: d.response,
        "drift": lambda d: d.noise[..., 2:5],
    }
    assert told[name](drawn).min() >= told[name](whole).max() - 1e-12
    others = [one for other, one in told.items() if other not in (name, "response")]
    plain = Sampler(robustness.ranges(MILD, "footprint", 0.0), model).draw([1, 2, 3])
    assert all((one(drawn) == one(plain)).all() for one in others)


def test_the_ranges_are_those_of_the_training_of_each_policy(robustness):
    for robot in shipped_policies():
        assert set(robustness.declared(robustness.of_training(robot))) == set(NAMES)
    assert robustness.declared(MILD)["noise"] == "20 mm on each range"


def test_time_constants_are_longer_even_where_no_training_drew_them(robustness):
    for times, slow in ((1.0, 1.25), (2.0, 1.5)):
        assert robustness.ranges(MILD, "response", times).kinematics.response == (
            slow,
            slow,
        )
    assert robustness.declared(MILD)["response"].startswith("time constants x 1.25")


def test_a_lidar_keeps_the_noise_that_it_has_anyway(robustness):
    assert robustness.ranges(MILD, "noise", 1.0, 0.03).lidar.noise_std == (0.03, 0.03)


@pytest.mark.parametrize("robot", ["mecanum", "jackal"])
def test_a_larger_footprint_is_the_same_outline_scaled(robustness, robot):
    model = builtin_model(robot)
    larger = robustness.grown(model, 1.1)
    assert larger.robot.footprint_radius == pytest.approx(
        1.1 * model.robot.footprint_radius
    )
    assert (larger.robot.footprint is None) == (model.robot.footprint is None)
    assert larger.kinematics is model.kinematics


def test_the_picture_has_a_panel_for_each_perturbation(robustness, tmp_path):
    if not shipped_policies():
        pytest.skip("no policy is shipped")
    robots = {robot: curves() for robot in shipped_policies()}
    robustness.draw(robots, tmp_path / "new" / "curves.png")
    with Image.open(tmp_path / "new" / "curves.png") as picture:
        assert picture.width == 1100
        assert 550 < picture.height < 700  # two rows of three


@pytest.mark.slow
def test_the_picture_is_drawn_of_runs_robot_by_robot(robustness, tmp_path):
    if not shipped_policies():
        pytest.skip("no policy is shipped")
    names = shipped_policies()[:2]
    kept = {
        each: dict(zip("0123", some, strict=True)) for each, some in curves().items()
    }
    runs = {
        f"robustness_{name}": {"result": {"success": {name: kept}}} for name in names
    }
    runs |= {"robustness_broken": {"result": None}, "parity": {"result": {"steps": 1}}}
    (tmp_path / "results.json").write_text(json.dumps({"runs": runs}))
    assert robustness.measured_in(tmp_path / "results.json") == dict.fromkeys(
        names, curves()
    )
    words = (
        "--of",
        str(tmp_path / "results.json"),
        "--picture",
        str(tmp_path / "curves.png"),
    )
    done = subprocess.run(
        [sys.executable, BENCHMARKS / "robustness.py", *words],
        capture_output=True,
        text=True,
    )
    assert (done.returncode, done.stdout) == (0, ""), done.stderr
    assert (tmp_path / "curves.png").read_bytes().startswith(b"\x89PNG")


ONE = ("--episodes", "2", "--robots", "differential", "--worlds", "circles")


@pytest.mark.campaign
@pytest.mark.skipif(not ready, reason="no policy is shipped")
def test_it_draws_its_curves_and_prints_one_json_object(tmp_path):
    picture = tmp_path / "curves.png"
    code, told = asked(
        "robustness.py", *ONE, "--picture", str(picture), "--only", "drop-out"
    )
    assert set(told["success"]["differential"]) == {"drop-out"}
    assert (
        len(told["success"]["differential"]["drop-out"]) == len(told["multiples"]) == 4
    )
    assert len(told["believed"]["differential"]["drop-out"]) == 4
    assert set(told["declared"]["differential"]) == set(NAMES)
    assert code == bool(told["failures"])
    assert picture.read_bytes().startswith(b"\x89PNG")


@pytest.mark.campaign
@pytest.mark.skipif(not ready, reason="no policy is shipped")
@pytest.mark.parametrize(
    ("control", "bar"), [("tenfold", "drift takes"), ("standing", "0.0% success")]
)
def test_a_perturbation_tenfold_or_a_policy_that_stands_misses_a_bar(control, bar):
    assert any(
        bar in line for line in fails("robustness.py", control, *ONE, "--only", "drift")
    )


@pytest.mark.skipif(
    "jackal" not in shipped_policies(), reason="needs the shipped policy"
)
def test_a_larger_footprint_is_driven_in_the_scenes_of_the_robot_it_is_believed_to_be(
    robustness,
):
    # Of so large a robot there would be no scene: the door's cells are narrower.
    job = robustness.Job("jackal", "doorway", 1, ("footprint",), (2.0,), None)
    assert robustness.reached(job, "footprint", 2.0) == (1, 1)
