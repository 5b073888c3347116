"""Finds tasks by name or by a user's file, and registers ids with Gymnasium."""

from collections.abc import Iterable
from inspect import Parameter, signature
from typing import Any

import gymnasium

from nics_drl_bridge import defaults, extensions
from nics_drl_bridge.arguments import check_kind, check_options, format_value
from nics_drl_bridge.env.task import Task
from nics_drl_bridge.errors import ConfigError, suggest
from nics_drl_bridge.generator import SimulatorModel
from nics_drl_bridge.lidar.sectors import layout_of

TASKS = {  # name -> module and class
    "navigation": "nics_drl_bridge.env.tasks.navigation:Navigation",
    "cooperative_reaching": "nics_drl_bridge.env.tasks.teams:CooperativeReaching",
    "pursuit_evasion": "nics_drl_bridge.env.tasks.teams:PursuitEvasion",
}


def make_task(
    task: str | type[Task] | Task,
    model: SimulatorModel,
    options: dict[str, Any] | None = None,
) -> Task:
    """Makes a task for a model's robot. Raises ConfigError if it does not fit.

    `task` is a shipped task's name (`navigation`), `path/to/file.py:ClassName`, a class, or a Task.
    Options are arguments of the class: `scan` as in `sectors.layout_of`, `sensors` as names.
    """
    if isinstance(task, Task):
        name = type(task).__name__
        if options:
            raise ConfigError(
                f"task {name} is already made; set {sorted(options)} when you make it."
            )
        if task.robot != model.robot or task.lidar != model.lidar:
            raise ConfigError(
                f"task {name} is for the robot {task.robot.name!r} with {task.lidar.beams} beams, "
                f"the model is {model.robot.name!r} with {model.lidar.beams}; make it with "
                "model.robot and model.lidar."
            )
        task.check_observation_space()
        return task
    check_options("task_options", options)
    options = dict(options or {})
    task_class = find_task_class(task, options)
    if "scan" in options:
        options["scan"] = layout_of(options["scan"], model.lidar)
    if "sensors" in options:
        names = options["sensors"]
        if isinstance(names, str) or not isinstance(names, Iterable):
            raise ConfigError(
                f"task option sensors={format_value(names)}: must be a list of "
                "names of the model's sensors."
            )
        known = {sensor.name: sensor for sensor in model.sensors}
        names = [getattr(name, "name", str(name)) for name in names]
        for name in names:
            if name not in known:
                hint = suggest(name, known)
                raise ConfigError(
                    f"task option sensors: the model has no sensor {name!r}; {hint}"
                )
        options["sensors"] = tuple(known[name] for name in names)
    try:
        # Remove the constructor's name from the error of a missing option.
        signature(task_class).bind(model.robot, model.lidar, **options)
        made = task_class(model.robot, model.lidar, **options)
    except TypeError as error:
        raise ConfigError(
            f"task {task_class.__name__}, task_options {options}: {error}."
        ) from None
    made.check_observation_space()
    return made


def find_task_class(task: Any, options: dict[str, Any]) -> type[Task]:
    """Returns a task's class. Raises ConfigError if it does not exist or lacks an option."""
    task_class = task if isinstance(task, type) else _import_task_class(task)
    if not issubclass(task_class, Task):
        raise ConfigError(
            f"task {task_class.__name__}: is not a subclass of env.task.Task; derive it."
        )
    parameters = signature(task_class).parameters
    kinds = [parameter.kind for parameter in parameters.values()]
    for name, value in options.items():
        if name in parameters:
            check_kind(f"task option {name}", value, parameters[name].annotation)
        elif Parameter.VAR_KEYWORD not in kinds:
            hint = suggest(name, set(parameters) - {"robot", "lidar"})
            raise ConfigError(
                f"task {task_class.__name__}: unknown task option {name!r}; {hint}"
            )
    return task_class


def _import_task_class(name: Any) -> type:
    """Imports a class by the name of a shipped task, or by `path/to/file.py:ClassName`."""
    if not isinstance(name, str):
        raise ConfigError(
            f"task={format_value(name)}: must be a name, path/to/file.py:ClassName, a "
            "subclass of Task, or a Task."
        )
    path, _, attribute = TASKS.get(name, name).rpartition(":")
    if not path and name.endswith(".py"):
        path = name
        attribute = ""
    if not path:
        raise ConfigError(
            f"unknown task {name!r}; {suggest(name, TASKS)} (or give path/to/file.py:ClassName)."
        )
    module = extensions.load_module(path, "task")
    task_class = getattr(module, attribute, None)
    if isinstance(task_class, type):
        return task_class
    own = [
        name
        for name, value in vars(module).items()
        if isinstance(value, type)
        and issubclass(value, Task)
        and value.__module__ == module.__name__
    ]
    if not own:
        raise ConfigError(
            f"task {name!r}: {path} defines no subclass of {Task.__module__}.Task; see "
            "docs/tasks.md."
        )
    hint = (
        suggest(attribute, own)
        if attribute
        else f"name its class, for example {path}:{own[0]}."
    )
    raise ConfigError(f"task {name!r}: {path} has no such Task; {hint}")


NAVIGATION = "NicsBridge/Navigation-v0"
TASK = "NicsBridge/Task-v0"
ENVIRONMENTS = {  # id -> arguments that define the environment
    NAVIGATION: {"task": "navigation"},
    "NicsBridge/CooperativeReaching-v0": {"task": "cooperative_reaching"},
    "NicsBridge/PursuitEvasion-v0": {"task": "pursuit_evasion"},
    TASK: {},
}


def register_envs() -> None:
    """Registers all environments; importing this module does the same."""
    for name, arguments in ENVIRONMENTS.items():
        if name not in gymnasium.registry:
            gymnasium.register(
                name,
                entry_point="nics_drl_bridge.env.bridge_env:BridgeEnv",
                vector_entry_point="nics_drl_bridge.env.vector_env:BridgeVectorEnv",
                max_episode_steps=defaults.EPISODE_STEPS,
                order_enforce=False,  # the env does
                kwargs=dict(arguments),
            )


register_envs()
