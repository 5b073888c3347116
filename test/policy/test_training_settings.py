from __future__ import annotations

import pytest

from nics_drl_bridge.config import share_folder, validate
from nics_drl_bridge.env.registry import make_task
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.gate.limits import Stopping
from nics_drl_bridge.generator import open_model
from nics_drl_bridge.policy.train.settings import (
    TrainingSettings,
    chosen_settings,
    load_training,
)
from nics_drl_bridge.sim import world_set
from nics_drl_bridge.sim.world import load_world
from nics_drl_bridge.sim.world_set import load_worlds

PARTS = {
    "jackal": 96,
    "f1tenth": 60,
}  # of an observation, where it sees less than a circle
SHIPPED = sorted(
    path.stem for path in (share_folder() / "config" / "training").glob("*.yaml")
)


@pytest.mark.slow
@pytest.mark.parametrize("name", SHIPPED)
def test_shipped_settings_name_worlds_and_a_task_that_there_are(name, monkeypatch):
    # Thousands of worlds of a set are otherwise generated, which takes seconds.
    monkeypatch.setattr(world_set, "grow", lambda *_: load_world("empty"))
    settings = load_training(name)
    model = open_model(settings.robot, settings.lidar)
    task = make_task(settings.task, model, settings.task_options)
    assert task.observation_space.shape == (PARTS.get(settings.robot, 78),)
    assert all(load_worlds(world).members for world in settings.worlds)
    assert settings.ppo.rollout * settings.num_envs >= settings.ppo.batch


@pytest.mark.parametrize("name", [n for n in SHIPPED if n.startswith("own_")])
def test_own_robots_learn_to_keep_the_clearance_of_the_shield(name):
    assert (
        load_training(name).teaching.margin == Stopping.model_fields["margin"].default
    )


def test_settings_are_those_of_task_and_robot_and_a_user_changes_them():
    settings = chosen_settings("navigation", None, {"robot": "mecanum", "steps": 99})
    assert (settings.robot, settings.steps) == ("mecanum", 99)
    assert settings.hidden == load_training("navigation_mecanum").hidden
    assert settings.title == "navigation_mecanum_ppo"


def test_an_engine_that_is_named_replaces_that_of_the_settings_and_nothing_else():
    shipped = load_training("navigation_mecanum")
    named = chosen_settings("navigation", None, {"robot": "mecanum", "engine": "sb3"})
    assert (shipped.lean, named.lean) == (True, False)
    assert named.ppo == shipped.ppo.model_copy(update={"engine": "sb3"})
    assert not chosen_settings("navigation", None, {"algorithm": "sac"}).lean


def test_worlds_that_are_named_share_the_copies_among_them():
    settings = chosen_settings("navigation", None, {"world": ["arena", "crowd"]})
    assert settings.worlds == {"arena": 512, "crowd": 512}


def test_a_robot_or_task_without_settings_gets_the_defaults():
    settings = chosen_settings("my_task.py:Reach", None, {"robot": "runs/model"})
    assert settings.task_options == {}
    assert settings.title == "Reach_model_ppo"


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("ppo: {rolout: 3}", r"unknown key 'ppo.rolout'; did you mean 'rollout'"),
        (
            "algorithm: dqn",
            r"key 'algorithm': input should be 'ppo' or 'sac', not 'dqn'",
        ),
        ("worlds: {}", r"key 'worlds'"),
        (
            "worlds: {arena: 0}",
            r"key 'worlds.arena': .* greater than or equal to 1, not 0",
        ),
        ("stop: {every: 10}", r"the key 'stop.success' is missing"),
        (
            "stop: {success: 1.1}",
            r"key 'stop.success': .* less than or equal to 1, not 1.1",
        ),
        (
            "task_options: {robot: x}",
            r"task_options can't hold 'robot', which the model defines",
        ),
    ],
)
def test_wrong_settings_are_refused_with_the_key(tmp_path, text, sentence):
    file = tmp_path / "wrong.yaml"
    file.write_text(text)
    with pytest.raises(ConfigError, match=sentence):
        load_training(str(file))
    with pytest.raises(
        ConfigError, match="unknown settings 'navigation_mecanun'; did you mean"
    ):
        load_training("navigation_mecanun")


@pytest.mark.parametrize(
    ("changes", "key"),
    [
        ({"worlds": {"circles": 10**9}}, "65536 copies"),
        ({"hidden": [10**9]}, "hidden.0"),
        ({"ppo": {"rollout": 10**9}}, "transitions"),
        ({"algorithm": "sac", "sac": {"buffer": 10**11}}, "transitions"),
        ({"steps": 10**400}, "steps"),
    ],
)
def test_settings_that_no_machine_could_hold_are_refused(changes, key):
    with pytest.raises(ConfigError, match=key):
        validate(changes, TrainingSettings, "settings.yaml")
