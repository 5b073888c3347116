"""Mistakes in the arguments of the environments end in one sentence, and none is accepted."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import pytest

import nics_drl_bridge
from nics_drl_bridge.env.bridge_env import BridgeEnv
from nics_drl_bridge.env.pettingzoo_env import BridgeParallelEnv
from nics_drl_bridge.env.registry import NAVIGATION
from nics_drl_bridge.env.tasks.navigation import Navigation
from nics_drl_bridge.errors import BridgeError

NAN = float("nan")
NO_NAMES = (3, -1, 1.5, NAN, True, {}, object(), "no such name")
NO_DICTS = (3, True, "x", ["x"], NAN)
NO_FLAGS = (None, "yes", 1, 0.0, [], {})
NO_COUNTS = (0, -1, 1.5, NAN, True, "3", [], {})
NO_LENGTHS = (0.0, -1, NAN, float("inf"), True, "far", None, [1.0])
WRONG: dict[str, tuple[Any, ...]] = {
    "model": (*NO_NAMES, []),
    "robot": (*NO_NAMES, []),
    "world": (*NO_NAMES, [], [3]),
    "task": (*NO_NAMES, int, []),
    "task_options": NO_DICTS,
    "randomisation": (*NO_NAMES, []),
    "render_mode": (*NO_NAMES, []),
    "bogus": (1,),
}
OF_ONE: dict[str, tuple[Any, ...]] = {
    "backend": (*NO_NAMES, None, []),
    "backend_options": NO_DICTS,
    "estimator": NO_FLAGS[1:],
    "simulator": ("gazebo", 3),
}
OF_MANY: dict[str, tuple[Any, ...]] = {
    "num_envs": (*NO_COUNTS, None),
    "max_episode_steps": (*NO_COUNTS, None),
    "copy": NO_FLAGS,
    "autoreset_mode": (*NO_NAMES, None, []),
    "renderer": (*NO_NAMES, None, []),
    "threads": (*NO_COUNTS, None),
    "longest_delay": (-1, 1.5, "3", True),
    "worlds": (2,),
    "longest_age": (-1, 1.5, None, True),
    "vectorization_mode": ("async", 3),
    "robots": (2,),
}
OPTIONS: dict[str, tuple[Any, ...]] = {
    "goal_radius": NO_LENGTHS,
    "contact_margin": NO_LENGTHS[2:],
    "top_speed": (0.0, -1.0),
    "success_reward": (NAN, "x", None, True),
    "scan": (0, -3, 1.5, "x", [1]),
    "robot": ("x",),
    "actions": (3, None, "x", []),
    "sensors": ("x", 3, [3]),
    "goal_radios": (1.0,),
}
Maker = Callable[..., Any]


def single(**given: Any) -> Any:
    """Makes the env of one world and begins an episode."""
    return nics_drl_bridge.make(**given).reset(seed=0)


def several(**given: Any) -> Any:
    """Makes an env of two worlds and begins episodes."""
    return nics_drl_bridge.make_vec(**{"num_envs": 2, **given}).reset(seed=0)


def cases(maker: Maker, *tables: dict[str, tuple[Any, ...]]) -> list[Any]:
    """Lists maker, keyword and value of every mistake in some tables."""
    return [
        pytest.param(maker, name, value, id=f"{maker.__name__}-{name}={value!r:.20}")
        for table in tables
        for name, values in table.items()
        for value in values
    ]


OF_MAKE = {"max_episode_steps": NO_COUNTS}


def first(count: int, *tables: dict[str, tuple[Any, ...]]) -> dict[str, Any]:
    """Some mistakes with each name, where the same code judges them."""
    return {name: each[name][:count] for each in tables for name in each}


@pytest.mark.parametrize(
    ("maker", "name", "value"),
    [
        *cases(single, WRONG, OF_ONE, OF_MAKE),
        *cases(several, WRONG, OF_MANY),
        *cases(BridgeParallelEnv, first(2, WRONG, OF_MAKE)),
        *cases(BridgeEnv, first(1, WRONG, OF_ONE)),
    ],
)
def test_a_mistaken_argument_is_refused_in_one_sentence(
    maker: Maker, name: str, value: Any
) -> None:
    with pytest.raises(BridgeError) as caught:
        maker(**{name: value})
    sentence = str(caught.value)
    assert "\n" not in sentence
    word = {"worlds": "world", "robot": "model"}.get(name, name.split("_")[0])
    assert word in sentence or str(value) in sentence


@pytest.mark.parametrize(
    ("name", "value"),
    [(name, value) for name, values in OPTIONS.items() for value in values],
)
def test_a_mistaken_task_option_is_refused_in_one_sentence(
    name: str, value: Any
) -> None:
    with pytest.raises(
        BridgeError, match=name.replace("radios", "radius").split("_")[0]
    ):
        single(task_options={name: value})


@pytest.mark.parametrize("word", ["robot", "model"])
@pytest.mark.parametrize(
    "make",
    [
        nics_drl_bridge.make,
        nics_drl_bridge.make_vec,
        BridgeParallelEnv,
        lambda **given: gymnasium.make(NAVIGATION, **given),
        lambda **given: gymnasium.make_vec(NAVIGATION, **given),
    ],
)
def test_every_env_takes_either_word_for_its_robot(make: Maker, word: str) -> None:
    env = make(**{word: "differential"})
    inner = env.env if isinstance(env, BridgeParallelEnv) else env.unwrapped
    assert inner.model.robot.name == "differential"


def test_make_and_make_vec_take_the_task_first() -> None:
    assert nics_drl_bridge.make("pursuit_evasion").unwrapped.robots == 3
    assert nics_drl_bridge.make_vec("pursuit_evasion", 2).num_envs == 2
    with pytest.raises(
        BridgeError, match="the first argument is the task; give num_envs=8"
    ):
        nics_drl_bridge.make_vec(8)


@pytest.mark.parametrize("make", [nics_drl_bridge.make, nics_drl_bridge.make_vec])
@pytest.mark.parametrize("method", ["reset", "step", "render"])
def test_a_closed_env_refuses_what_is_called_after_close(
    make: Maker, method: str
) -> None:
    env = make()
    env.reset(seed=0)
    env.close()
    given = (env.action_space.sample(),) if method == "step" else ()
    with pytest.raises(
        BridgeError, match=rf"{method}\(\) after close\(\).*make a new one"
    ):
        getattr(env, method)(*given)
    env.close()  # a second time does nothing


def test_a_space_that_is_a_method_is_refused() -> None:
    methods = {"observation_space": lambda self: None}
    with pytest.raises(BridgeError, match="observation_space must be a property"):
        nics_drl_bridge.make(type("Own", (Navigation,), methods))


def test_a_field_of_800_metres_is_refused_with_the_limit(tmp_path: Path) -> None:
    file = tmp_path / "large.yaml"
    file.write_text("name: large\nsize: [800, 800]\ngoal_distance: [2, 700]\n")
    with pytest.raises(BridgeError, match=r"800 m x 800 m is 1131 m across.*1000 m"):
        nics_drl_bridge.make(world=str(file))
