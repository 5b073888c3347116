from __future__ import annotations

from importlib.util import find_spec

import pytest
from robots import direct_model

from nics_drl_bridge.commands import demo_run as learning
from nics_drl_bridge.commands.demo_run import DemoPlan, learn, settings_of
from nics_drl_bridge.config import dump_yaml
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.generator import builtin_model
from nics_drl_bridge.robot.spec import load_robot


@pytest.fixture
def without_torch(monkeypatch):
    monkeypatch.setattr(
        learning, "find_spec", lambda name: None if name == "torch" else find_spec(name)
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    "robot", ["differential", *(pytest.param(name, marks=pytest.mark.campaign)
                                for name in ("ackermann", "mecanum"))],
)  # fmt: skip
def test_without_the_extra_the_shipped_policy_of_the_robot_drives(tmp_path, without_torch, robot):
    pytest.importorskip("onnxruntime")
    said: list[str] = []
    learned = learn(DemoPlan(tmp_path, robot), builtin_model(robot), said.append)
    assert learned.policy == robot
    assert learned.curve == ()
    (sentence,) = said
    assert "needs the module 'torch'" in sentence
    assert f"driving with the policy {robot!r} instead" in sentence
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_without_the_extra_a_robot_without_a_shipped_policy_gets_a_baseline(
    tmp_path, without_torch
):
    robot = load_robot("differential").model_dump(mode="json") | {"name": "mine"}
    (tmp_path / "mine.yaml").write_text(dump_yaml(robot))
    model = builtin_model(str(tmp_path / "mine.yaml"))
    learned = learn(DemoPlan(tmp_path, str(tmp_path / "mine.yaml")), model, lambda _: None)
    assert learned.policy == "dynamic_window"


def test_a_named_policy_is_taken_and_a_misspelt_one_refused(tmp_path):
    model = direct_model()
    learned = learn(DemoPlan(tmp_path, policy="straight"), model, pytest.fail)
    assert learned.policy == "straight"
    with pytest.raises(ConfigError, match="unknown policy 'strait'; did you mean 'straight'"):
        learn(DemoPlan(tmp_path, policy="strait"), model, pytest.fail)


def test_it_trains_in_the_world_and_simulator_of_the_plan(tmp_path):
    plan = DemoPlan(tmp_path, world="circles", train_steps=7)
    settings, told = settings_of(plan, direct_model())
    assert told == ()
    assert settings.robot == str(tmp_path / "model")
    assert settings.worlds == {"circles": 512}
    assert settings.steps == 7
