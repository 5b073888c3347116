"""One robot is the default of every command, env and node."""

import inspect

from nics_drl_bridge.commands.cli import app
from nics_drl_bridge.commands.episodes import model_name
from nics_drl_bridge.config import parse_yaml, share_folder
from nics_drl_bridge.env.bridge_env import BridgeEnv
from nics_drl_bridge.env.pettingzoo_env import BridgeParallelEnv
from nics_drl_bridge.env.vector_env import BridgeVectorEnv
from nics_drl_bridge.nodes.parameters import describe_node, list_nodes
from nics_drl_bridge.policy.train.settings import TrainingSettings, chosen_settings
from nics_drl_bridge.robot import DEFAULT_ROBOT

NAMES = ("robot", "model")


def commands_of(group):
    """Yields each command of an app and its groups."""
    for command in group.registered_commands:
        yield command.callback
    for each in group.registered_groups:
        yield from commands_of(each.typer_instance)


def defaults_of(function):
    """The defaults of a function's robot, without those that say nothing."""
    given = inspect.signature(function).parameters
    found = [given[name].default for name in NAMES if name in given]
    return [each for each in found if each not in (None, inspect.Parameter.empty)]


def test_every_command_env_and_node_that_has_a_default_robot_has_the_same():
    envs = (BridgeEnv(), BridgeVectorEnv(), BridgeParallelEnv().env)
    kinds = (BridgeEnv, BridgeVectorEnv, BridgeParallelEnv)
    functions = [*commands_of(app), *(kind.__init__ for kind in kinds)]
    found = [default for function in functions for default in defaults_of(function)]
    found += [
        row.default
        for facts in map(describe_node, list_nodes())
        for row in facts.parameters
        if row.name in NAMES
    ]
    found += [env.model.robot.name for env in envs]
    found.append(TrainingSettings().robot)
    found.append(chosen_settings("navigation", None, {}).robot)
    found.append(model_name(None, {}))  # a baseline is evaluated
    assert len(found) > 15
    assert set(found) == {DEFAULT_ROBOT}
    for env in envs:
        env.close()


def test_the_shipped_parameters_of_nodes_name_the_default_robot():
    file = share_folder() / "config" / "nodes" / "bridge.yaml"
    given = parse_yaml(file.read_text(encoding="utf-8"), str(file))
    named = {
        (node, name): each["ros__parameters"][name]
        for node, each in given.items()
        for name in (*NAMES, "limits")
        if name in each["ros__parameters"]
    }
    assert len(named) == 3
    assert set(named.values()) == {DEFAULT_ROBOT}
