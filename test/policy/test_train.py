from __future__ import annotations

import io
import json
import zipfile

import numpy as np
import pytest
from robots import direct_model, field

from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.files import seal
from nics_drl_bridge.policy.train import run as training
from nics_drl_bridge.policy.train.checkpoint import CONTENT, FORMAT, read_checkpoint
from nics_drl_bridge.policy.train.networks import Actor
from nics_drl_bridge.policy.train.run import CHECKPOINT, TrainOrder, evaluate, run
from nics_drl_bridge.policy.train.settings import TrainingSettings

MODEL = direct_model(odometry=(0.02, 0.02))
WORLD = field(count=2)


class BrokenOffError(Exception):
    """As a user's Ctrl-C."""


def train(settings, *rest, **more):
    """Trains a robot of few beams in a small field, whatever names the settings hold."""
    worlds = dict.fromkeys(settings.worlds, WORLD)
    return training.train(MODEL, worlds, settings, *rest, **more)


def test_a_policy_of_a_shipped_robot_does_not_name_a_folder_of_that_name(
    tmp_path, monkeypatch
):
    told = []
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(training, "export_policy", lambda *given: told.append(given[5]))
    for robot in ("differential", "./differential"):
        (tmp_path / "differential").mkdir(exist_ok=True)
        result = training.SeedResult(0, training.Trained(None, None, 0, 0.0, 0.0), {})
        training.export(MODEL, settings(robot=robot), result, "", tmp_path / "p.onnx")
    assert [one.get("model") for one in told] == [None, str(tmp_path / "differential")]


ENGINES = {
    "lean": {"algorithm": "ppo"},
    "sb3": {
        "algorithm": "ppo",
        "ppo": {"rollout": 16, "batch": 64, "epochs": 2, "engine": "sb3"},
    },
    "sac": {"algorithm": "sac"},
}


def settings(algorithm="ppo", **changes):
    data = {
        "worlds": {"one": 5, "another": 3},
        "steps": 960,
        "max_episode_steps": 40,
        "algorithm": algorithm,
        "hidden": [16],
        "checkpoint_every": 320,
        "randomisation": "mild",
        "ppo": {"rollout": 16, "batch": 64, "epochs": 2},
        "sac": {"batch": 32, "updates": 1, "begin_after": 240, "buffer": 480},
    }
    return TrainingSettings.model_validate(data | changes)


def weights(algorithm):
    """Copies all weights of an algorithm of Stable-Baselines3, or of an actor."""
    if isinstance(algorithm, Actor):
        return {"actor": algorithm.network.weights.copy()}
    states = algorithm.policy.state_dict().items()
    return {name: value.numpy().copy() for name, value in states}


def test_robots_are_larger_while_they_learn_and_only_then():
    learning = settings(teaching={"margin": 0.07}, randomisation=None)
    worlds = dict.fromkeys(learning.worlds, WORLD)
    env = training.make_training_worlds(MODEL, worlds, learning)
    grown = env.envs[0].model.robot.footprint_radius
    assert grown == pytest.approx(MODEL.robot.footprint_radius + 0.07)
    judged = training._make_env(MODEL, WORLD, learning, 2)
    assert judged.model.robot.footprint_radius == MODEL.robot.footprint_radius


def steps_in(path):
    state = read_checkpoint(path)["state"]
    return state["counters"]["num_timesteps"] if "counters" in state else state["steps"]


TEACHING = {"path": 1.0, "contact": -10.0, "retries": 1}
# A random robot arrives now and then, so the training stops soon.
EARLY = {
    "steps": 16_000,
    "stop": {"success": 0.01, "every": 320, "episodes": 40},
}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("engine", "actions", "changes"),
    [
        ("lean", "continuous", {"teaching": TEACHING}),
        ("lean", "discrete", EARLY),
        ("sb3", "continuous", EARLY),
        ("sac", "continuous", {"teaching": TEACHING}),
    ],
)
def test_an_interrupted_training_comes_to_the_same_weights(
    engine, actions, changes, tmp_path, monkeypatch
):
    options = {"actions": actions}
    chosen = settings(task_options=options, **ENGINES[engine], **changes)
    whole = train(chosen, 1, tmp_path / "whole")
    assert whole.steps == 960 or 640 <= whole.steps < 16_000

    def interrupt(progress):
        if progress.steps > 680 or not np.isnan(progress.held_out):
            raise BrokenOffError

    # Told of every rollout, whatever the clock says.
    monkeypatch.setattr("nics_drl_bridge.policy.train.progress.TOLD_S", 0.0)
    with pytest.raises(BrokenOffError):
        train(chosen, 1, tmp_path / "broken", interrupt)
    assert 0 < steps_in(tmp_path / "broken" / CHECKPOINT) < 680
    if engine != "lean":
        import torch

        torch.manual_seed(99)
    np.random.seed(99)  # noqa: NPY002 - what another program may have done meanwhile
    for _ in range(2):  # what has ended does not go on
        again = train(chosen, 1, tmp_path / "broken", resumed=True)
        assert again.steps == whole.steps
        for name, value in weights(whole.algorithm).items():
            assert np.array_equal(value, weights(again.algorithm)[name]), name


@pytest.mark.slow
def test_a_little_training_reaches_more_goals_than_none(tmp_path):
    def successes(steps):
        chosen = settings(
            worlds={"one": 32},
            steps=steps,
            hidden=[32, 32],
            randomisation=None,
            ppo={"rollout": 32, "batch": 256, "learning_rate": 2e-3},
        )
        act = train(chosen, 0, tmp_path / str(steps)).act
        return evaluate(act, MODEL, WORLD, chosen, 100).success.mean()

    assert successes(40_000) > successes(1024) + 0.2


@pytest.mark.slow
def test_a_checkpoint_of_another_training_is_refused(tmp_path):
    train(settings(steps=128), 0, tmp_path)
    with pytest.raises(ConfigError, match=r"was trained with hidden \[16\], not \[8\]"):
        train(settings(steps=128, hidden=[8]), 0, tmp_path, resumed=True)
    with pytest.raises(ConfigError, match="has seed 0, not 4"):
        train(settings(steps=128), 4, tmp_path, resumed=True)


@pytest.mark.parametrize("resumed", [False, True])
def test_a_folder_with_a_checkpoint_of_an_earlier_version_is_refused(tmp_path, resumed):
    old = tmp_path / "seed_3" / "checkpoint.pt"
    old.parent.mkdir()
    old.write_bytes(b"old")
    order = TrainOrder(settings(), [3], tmp_path, episodes=1, resumed=resumed)
    with pytest.raises(ConfigError, match="is a checkpoint of an earlier version"):
        run(order)


def pack(text="{}", save=np.savez, **arrays):
    """The bytes of a file that holds a text as a checkpoint does, and other arrays."""
    buffer = io.BytesIO()
    content = np.frombuffer(text.encode(), np.uint8)
    save(buffer, **{CONTENT: content, **arrays})
    return buffer.getvalue()


def enlarge():
    """A file whose array says that it is larger than any memory."""
    buffer = io.BytesIO()
    described = {"descr": "<f4", "fortran_order": False, "shape": (2**45,)}
    np.lib.format.write_array_header_1_0(buffer, described)
    text = json.dumps({"items": [["format", FORMAT], ["x", {"array": "x"}]]})
    whole = io.BytesIO(pack(text))
    with zipfile.ZipFile(whole, "a") as archive:
        archive.writestr("x.npy", buffer.getvalue())
    return whole.getvalue()


WRONG_CONTENTS = {
    "no text": lambda: pack(content=np.zeros(3)),
    "a list": lambda: pack(json.dumps([FORMAT])),
    "an array": lambda: pack(json.dumps({"array": "content"})),
    "an array that is not there": lambda: pack(
        json.dumps({"items": [["format", FORMAT], ["x", {"array": "x"}]]})
    ),
    "an array without its numbers": enlarge,
    "deep words": lambda: pack("[" * 100_000),
    "packed": lambda: pack(save=np.savez_compressed),
}


@pytest.mark.parametrize("name", WRONG_CONTENTS)
def test_a_checkpoint_that_holds_something_else_is_refused(tmp_path, name):
    path = tmp_path / CHECKPOINT
    path.write_bytes(seal(WRONG_CONTENTS[name]()))
    with pytest.raises(ConfigError, match="is not a training checkpoint"):
        read_checkpoint(path)


def test_sac_is_refused_for_discrete_actions_and_a_batch_that_no_rollout_fills(
    tmp_path,
):
    with pytest.raises(ConfigError, match="'sac' needs continuous actions; use 'ppo'"):
        train(settings("sac", task_options={"actions": "discrete"}), 0, tmp_path)
    with pytest.raises(
        ConfigError, match=r"ppo\.batch 999: exceeds the 128 transitions"
    ):
        train(settings(ppo={"rollout": 16, "batch": 999}), 0, tmp_path)


@pytest.mark.parametrize("seed", [2**32, 2**63, 10**30, -1])
def test_a_seed_that_the_generators_do_not_take_is_refused(tmp_path, seed):
    order = TrainOrder(
        settings(steps=128), [0, seed], tmp_path / "run", 1, False, "test"
    )
    with pytest.raises(
        ConfigError, match="must be a whole number from 0 to 4294967295"
    ):
        run(order)
    assert not (tmp_path / "run").exists()
