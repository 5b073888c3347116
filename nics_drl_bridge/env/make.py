"""Makes environments of a task."""

from typing import Any

import gymnasium

from nics_drl_bridge import defaults
from nics_drl_bridge.arguments import (
    check_count,
    format_value,
    list_keywords,
    refuse_unknown,
    rename_robot_argument,
)
from nics_drl_bridge.env.bridge_env import BridgeEnv, check_render_mode
from nics_drl_bridge.env.registry import TASK
from nics_drl_bridge.env.task import Task
from nics_drl_bridge.env.vector_env import BridgeVectorEnv
from nics_drl_bridge.errors import ConfigError

# arguments of `gymnasium.make`
GYMNASIUM_ARGUMENTS = (
    "max_episode_steps",
    "disable_env_checker",
)


def make(
    task: str | type[Task] | Task = defaults.TASK, **arguments: Any
) -> gymnasium.Env[Any, Any]:
    """Makes an env of a task, with Gymnasium's own wrappers and the arguments of `BridgeEnv`."""
    rename_robot_argument("make", "model", arguments)
    known = {*list_keywords(BridgeEnv), "robot", *GYMNASIUM_ARGUMENTS}
    refuse_unknown("make", arguments, known)
    check_render_mode(arguments.get("render_mode"), BridgeEnv.metadata)
    most_steps = arguments.get("max_episode_steps")
    if most_steps is not None:
        check_count("make: max_episode_steps", most_steps)
    return gymnasium.make(TASK, task=task, **arguments)


def make_vec(
    task: str | type[Task] | Task = defaults.TASK, num_envs: int = 1, **arguments: Any
) -> Any:
    """Makes a `BridgeVectorEnv`: a task in many worlds at once, for training."""
    first: object = task
    if isinstance(first, int) and not isinstance(first, bool):
        raise ConfigError(
            f"make_vec: task={first}: the first argument is the task; give num_envs={first}."
        )
    if "vectorization_mode" in arguments:
        mode = format_value(arguments["vectorization_mode"])
        raise ConfigError(
            f"make_vec: vectorization_mode={mode}: one process steps all worlds "
            "together; remove the argument, and set threads=2 to use two cores."
        )
    return BridgeVectorEnv(num_envs, task=task, **arguments)
