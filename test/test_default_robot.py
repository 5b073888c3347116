"""One robot is the default of every command, env and node."""

from __future__ import annotations

import ast
import inspect
from pathlib import Path

import nics_drl_bridge
from nics_drl_bridge.commands.cli import app
from nics_drl_bridge.commands.episodes import model_name
from nics_drl_bridge.config import list_shipped, parse_yaml, share_folder
from nics_drl_bridge.env.bridge_env import BridgeEnv
from nics_drl_bridge.env.pettingzoo_env import BridgeParallelEnv
from nics_drl_bridge.env.vector_env import BridgeVectorEnv
from nics_drl_bridge.nodes.parameters import NODES
from nics_drl_bridge.policy.training_settings import TrainingSettings, chosen_settings
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


def named_literally(tree):
    """Defaults, alternatives and values of rows that are a shipped robot's name in the code."""
    robots = set(list_shipped("robots"))
    for node in ast.walk(tree):
        held = []
        if isinstance(node, ast.arguments):
            held = [*node.defaults, *node.kw_defaults]
        elif isinstance(node, ast.BoolOp):
            held = node.values
        elif isinstance(node, ast.Assign | ast.AnnAssign):
            parts = (
                node.value.elts if isinstance(node.value, ast.Tuple) else [node.value]
            )
            held = parts
        elif isinstance(node, ast.Call) and ast.unparse(node.func).endswith(
            ("Row", ".get")
        ):
            held = node.args[1:2]
        for each in held:
            if isinstance(each, ast.Constant) and each.value in robots:
                yield each.lineno, each.value


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


def test_the_default_robot_is_shipped_with_all_that_a_first_run_needs():
    for kind in ("robots", "limits"):
        assert DEFAULT_ROBOT in list_shipped(kind)
    assert f"navigation_{DEFAULT_ROBOT}" in list_shipped("training")
    assert (share_folder() / "urdf" / f"{DEFAULT_ROBOT}.urdf").is_file()


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


def test_no_default_in_the_code_names_a_robot_itself():
    package = Path(nics_drl_bridge.__file__).parent
    found = [
        f"{path.relative_to(package)}:{line}: {name}"
        for path in sorted(package.rglob("*.py"))
        if path != package / "robot" / "__init__.py"
        for line, name in named_literally(ast.parse(path.read_text(encoding="utf-8")))
    ]
    assert found == []
