from __future__ import annotations

import re
from importlib.util import find_spec

import numpy as np
import pytest
from robots import direct_model

from nics_drl_bridge import extensions
from nics_drl_bridge.commands import demo_run
from nics_drl_bridge.commands.demo_report import (
    DemoPlan,
    DemoResults,
    Learned,
    format_episodes,
    make_sections,
    make_verdict,
)
from nics_drl_bridge.commands.demo_run import FAST, Demo
from nics_drl_bridge.confidence import ConfidenceInterval, estimate_rate
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.generator import builtin_model, generate, mount_lidar
from nics_drl_bridge.policy.evaluation import Episode, Summary
from nics_drl_bridge.recording.textbook import record
from nics_drl_bridge.report.pictures import Point
from nics_drl_bridge.robot.spec import load_robot


@pytest.fixture
def without_tensorboard(monkeypatch):
    monkeypatch.setattr(
        extensions,
        "find_spec",
        lambda name: None if name == "tensorboard" else find_spec(name),
    )


@pytest.mark.slow
def test_without_the_extra_the_shipped_policy_of_the_robot_drives(
    tmp_path, without_tensorboard
):
    robot = "differential"
    pytest.importorskip("onnxruntime")
    said: list[str] = []
    learned = Demo(DemoPlan(tmp_path, robot), said.append).learn(builtin_model(robot))
    assert learned.policy == robot
    assert learned.curve == ()
    (sentence,) = said
    assert "needs the module 'tensorboard'" in sentence
    assert f"driving with the policy {robot!r} instead" in sentence
    assert list(tmp_path.iterdir()) == []


def test_a_named_policy_is_taken_and_a_misspelt_one_refused(tmp_path):
    model = direct_model()
    learned = Demo(DemoPlan(tmp_path, policy="straight"), pytest.fail).learn(model)
    assert learned.policy == "straight"
    with pytest.raises(
        ConfigError, match="unknown policy 'strait'; did you mean 'straight'"
    ):
        Demo(DemoPlan(tmp_path, policy="strait"), pytest.fail).learn(model)


def episode(seed, result="success"):
    t = np.linspace(0.0, 2.0, 40)
    path = np.stack([t, np.sin(t + seed), t], axis=1)
    return Episode(seed, result, path, path, path[-1, :2], np.zeros((0, 7)), 1.0)


@pytest.fixture(scope="module")
def generated():
    """A model and the report on how it was identified."""
    robot = load_robot("differential")
    drive = record(robot, np.random.default_rng(0), 10.0)
    return generate(drive, robot, mount_lidar(robot), ())


def results(generated, folder, share, arrived):
    """A demo that succeeds with a fraction of its episodes."""
    arrivals = int(500 * share)
    rates = [
        estimate_rate(count, 500) for count in (arrivals, 500 - arrivals, 0, arrivals)
    ]
    length = ConfidenceInterval(3.0, 2.9, 3.1)
    summary = Summary(500, *rates, length, length)
    points = [Point(8192, 0.1, 0.8), Point(80_000, 0.9, 0.1)]
    episodes = [episode(0), episode(1)]
    return DemoResults(
        DemoPlan(folder),
        *generated,
        Learned("policy.onnx", "PPO learned it.", points),
        {"as it is": summary, "lidar": summary},
        episodes,
        episodes,
        episode(0, "success" if arrived else "time-out"),
    )


@pytest.mark.parametrize(
    ("share", "arrived", "end", "warnings"),
    [(0.986, True, "arrived", 0), (0.42, False, "did not arrive", 2)],
)
def test_the_verdict_tells_the_success_in_three_worlds(
    generated, tmp_path, share, arrived, end, warnings
):
    verdict = "".join(make_verdict(results(generated, tmp_path, share, arrived)))
    for words in (f"{100 * share:.1f} %", "2 of 2", end):
        assert words in verdict
    assert verdict.count("⚠") == warnings


@pytest.mark.slow
def test_the_report_begins_with_its_verdict_and_folds_the_figures(generated, tmp_path):
    sections = dict(make_sections(results(generated, tmp_path, 0.986, True)))
    assert next(iter(sections)) == "Verdict"
    assert "".join(sections["Paths in the world"]).count("<img") == 1
    everything = "".join("".join(blocks) for blocks in sections.values())
    assert "Cross-validated" in everything
    assert "Cross-validated" not in re.sub("(?s)<details>.*?</details>", "", everything)


def test_it_trains_in_the_world_and_simulator_of_the_plan(tmp_path):
    plan = DemoPlan(tmp_path, world="circles", train_steps=7)
    settings, told, _ = Demo(plan, print).derive_settings(direct_model())
    assert told == ()
    assert settings.robot == str(tmp_path / "model")
    assert settings.worlds == {"circles": 512}
    assert settings.steps == 7


def test_without_ros_it_drives_in_process_alone_and_says_so(tmp_path, monkeypatch):
    def drive_here(self, place, policy):
        assert place == FAST
        return [episode(0)]

    shown = []
    learned = Learned("straight", "None was.")
    monkeypatch.setattr(demo_run, "find_spec", lambda name: None)
    monkeypatch.setattr(Demo, "_generate", lambda self: (direct_model(), None))
    monkeypatch.setattr(Demo, "learn", lambda self, model: learned)
    monkeypatch.setattr(Demo, "_evaluate", lambda self, model, name: None)
    monkeypatch.setattr(Demo, "_drive", drive_here)
    monkeypatch.setattr(
        demo_run, "make_sections", lambda results: shown.append(results) or []
    )
    said = list[str]()
    line = Demo(DemoPlan(tmp_path, episodes=1), said.append).run()
    assert line == f"demo: in process 1/1, report {tmp_path / 'report.html'}"
    assert said[0].startswith("only in process: ")
    assert "needs the module 'rclpy'" in said[0]
    assert (shown[0].there, shown[0].live) == ([], None)
    paths = "".join(format_episodes(shown[0]))
    assert "1 of 1 episodes reached the goal in process." in paths
    assert "DDS" not in paths
