"""One robot is the default of every command, env and node."""

from __future__ import annotations

import inspect

from nics_drl_bridge.commands.cli import app
from nics_drl_bridge.commands.episodes import model_name
from nics_drl_bridge.config import parse_yaml, share_folder
from nics_drl_bridge.env.bridge_env import BridgeEnv
from nics_drl_bridge.env.pettingzoo_env import BridgeParallelEnv
from nics_drl_bridge.env.vector_env import BridgeVectorEnv
from nics_drl_bridge.nodes.parameters import NODES
from nics_drl_bridge.policy.train.settings import TrainingSettings, chosen_settings
from nics_drl_bridge.robot import DEFAULT_ROBOT

NAMES = ("robot", "model")


def commands_of(group, path=""):
    """Yields name and function of each command of an app and its groups."""
    for command in group.registered_commands:
        yield (
            f"{path} {command.name or command.callback.__name__}".strip(),
            command.callback,
        )
    for each in group.registered_groups:
        yield from commands_of(each.typer_instance, f"{path} {each.name}".strip())


def defaults_of(function):
    """The defaults of a function's robot, without those that say nothing."""
    given = inspect.signature(function).parameters
    found = {name: given[name].default for name in NAMES if name in given}
    return {n: d for n, d in found.items() if d not in (None, inspect.Parameter.empty)}


def node_rows():
    return [
        (node, row.name, row.default)
        for node, facts in NODES.items()
        for row in facts().parameters
        if row.name in NAMES
    ]


def test_every_command_env_and_node_that_has_a_default_robot_has_the_same():
    functions = dict(commands_of(app)) | {
        each.__name__: each.__init__
        for each in (BridgeEnv, BridgeVectorEnv, BridgeParallelEnv)
    }
    found = {
        (where, name): default
        for where, function in functions.items()
        for name, default in defaults_of(function).items()
    }
    found |= {(node, name): default for node, name, default in node_rows()}
    found["settings", "robot"] = TrainingSettings().robot
    found["train", "robot"] = chosen_settings("navigation", None, {}).robot
    found["evaluate, of a baseline", "model"] = model_name(None, {})
    for env in (BridgeEnv(), BridgeVectorEnv(), BridgeParallelEnv().env):
        found[repr(env), "model"] = env.model.robot.name
        env.close()
    told = {
        "record",
        "drive",
        "world draw",
        "bag replay",
        "record_node",
        "simulator_node",
    }
    assert told <= {where for where, _ in found}
    assert {key: value for key, value in found.items() if value != DEFAULT_ROBOT} == {}


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
