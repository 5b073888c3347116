"""Direct steps: the same as those through the task's and the backend's own methods."""

from functools import cache

import gymnasium
import numpy as np
import pytest
from robots import direct_model, field

from nics_drl_bridge.env.bridge_env import BridgeEnv
from nics_drl_bridge.env.registry import NAVIGATION
from nics_drl_bridge.env.tasks.navigation import Navigation
from nics_drl_bridge.errors import ConfigError


class Driving(Navigation):
    """Navigation that drives by a method of its own."""

    def drive(self, actions, ended):
        return super().drive(actions, ended)


ACTION = [0.3, -2.0, 0.1]
INTEGERS = [1, 0, 1]
SAID = {
    "a list": (ACTION, ACTION),
    "doubles": (ACTION, np.array(ACTION)),
    "every second number": (ACTION, np.repeat(ACTION, 2)[::2]),
    "half floats": (INTEGERS, np.array(INTEGERS, np.float16)),
    "bytes": (INTEGERS, np.array(INTEGERS, np.int8)),
    "unsigned": (INTEGERS, np.array(INTEGERS, np.uint64)),
    "flags": (INTEGERS, np.array(INTEGERS, np.bool_)),
    "a list of integers": (INTEGERS, INTEGERS),
}
NUMBERS = {"an int": 2, "an int64": np.int64(2), "an array": np.array(2)}


@cache
def env_of(task, actions):
    env = BridgeEnv("sim", direct_model(), field(), task, {"actions": actions})
    assert env._direct is not None
    return env


def take_step(task, actions, action):
    env = env_of(task, actions)
    env.reset(seed=0)
    return env.step(action)


@pytest.mark.parametrize("name", [*SAID, *NUMBERS])
def test_an_action_of_any_type_is_driven_as_by_the_task(name):
    numbers, action = SAID.get(name, (2, NUMBERS.get(name)))
    actions = "continuous" if name in SAID else "discrete"
    plain = np.array(numbers, np.float64) if name in SAID else numbers
    expected = take_step(Driving, actions, plain)
    for task in (Navigation, Driving):
        np.testing.assert_equal(take_step(task, actions, action), expected)


@pytest.mark.parametrize(
    ("actions", "action"),
    [
        ("continuous", np.array([0.0, np.nan, 0.0], np.float32)),
        ("continuous", np.array([0.0, np.inf, 0.0])),
        ("continuous", np.zeros(1, np.float32)),
        ("continuous", 1.0),
        ("discrete", -1),
        ("discrete", 9),
        ("discrete", True),
        ("discrete", 1.0),
    ],
)
def test_an_action_that_is_none_is_refused_and_ends_the_episode(actions, action):
    env = gymnasium.make(
        NAVIGATION,
        model=direct_model(),
        world=field(),
        task_options={"actions": actions},
    )
    env.reset(seed=0)
    with pytest.raises(gymnasium.error.InvalidAction):
        env.step(action)
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.step(env.action_space.sample())


@pytest.mark.parametrize("mode", [None, "rgb_array"])
def test_a_made_env_neither_steps_nor_draws_before_its_first_reset(mode):
    env = gymnasium.make(
        NAVIGATION, model=direct_model(), world=field(), render_mode=mode
    )
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.step(env.action_space.sample())
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.render()


def test_commands_beyond_what_was_fitted_are_told_of(recwarn):
    """Direct steps do not pass the simulator's own check."""
    env = BridgeEnv()
    env._backend.simulator._command_range._low[:] = np.inf
    env.reset(seed=0)
    env.step(env.action_space.sample())
    assert any("was fitted to" in str(warning.message) for warning in recwarn)


@pytest.mark.parametrize("shape", [(1, 1, 1), (3,), (1, 1, 2)])
def test_commands_of_another_shape_are_refused(shape):
    class Wrong(Navigation):
        def drive(self, actions, ended):
            return np.zeros(shape)

    with pytest.raises(ConfigError, match=r"drive must be .* \(1, 1, 3\)"):
        take_step(Wrong, "continuous", np.array(ACTION))


def test_a_table_of_commands_of_another_size_is_refused():
    class Wrong(Navigation):
        @property
        def discrete_commands(self):
            return np.zeros((9, 1))

    with pytest.raises(ConfigError):
        take_step(Wrong, "discrete", 2)
