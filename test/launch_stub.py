"""As much of `launch` and `launch_ros` as tells what a launch file would start.

There is no wheel of them. Substitutions are resolved as upstream does: to text, which a parameter
then reads as YAML unless it names a type.
"""

from __future__ import annotations

import runpy
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import Any

import yaml

ROOT = Path(__file__).resolve().parents[1]


@dataclass
class Launched:
    """What was declared and started; `values` are the launch arguments of this moment."""

    installed: tuple[str, ...] = ("robot_state_publisher",)
    values: dict[str, str] = field(default_factory=dict)
    declared: dict[str, str] = field(default_factory=dict)
    nodes: dict[str, dict[str, Any]] = field(default_factory=dict)

    @property
    def launch_configurations(self) -> dict[str, str]:
        """As of the context that upstream gives to an `OpaqueFunction`."""
        return self.values

    def run(self, file: str) -> Launched:
        """Runs a file of `launch/`."""
        with self._stubs():
            made = runpy.run_path(str(ROOT / "launch" / file))["generate_launch_description"]()
            for entity in made:
                entity(self)
        return self

    def text(self, given: Any) -> str:
        """A substitution, or a list of them, as text."""
        if isinstance(given, list):
            return "".join(self.text(one) for one in given)
        return given if isinstance(given, str) else given(self)

    def parameter(self, given: Any) -> Any:
        if isinstance(given, tuple):  # ParameterValue
            value, kind = given
            read = self.text(value)
            return read if kind is str else kind(yaml.safe_load(read))
        return yaml.safe_load(self.text(given)) if callable(given) else given

    def node(self, options: dict[str, Any]) -> None:
        wanted = options.get("condition")
        if wanted is not None and not wanted(self):
            return
        known = {"package", "executable", "name", "namespace", "parameters", "remappings",
                 "arguments", "output", "condition"}  # fmt: skip
        assert options.keys() <= known, options.keys() - known
        files, values = [], {}
        for one in options["parameters"]:
            if isinstance(one, dict):
                values |= {name: self.parameter(value) for name, value in one.items()}
            else:
                files.append(self.text(one))
        name = self.text(options["name"])
        assert name not in self.nodes
        self.nodes[name] = {
            "package": options["package"],
            "executable": self.text(options["executable"]),
            "namespace": self.text(options["namespace"]),
            "files": files,
            "parameters": values,
            "remappings": dict(options.get("remappings", [])),
            "arguments": [self.text(one) for one in options["arguments"]],
        }

    def _names(self) -> dict[str, dict[str, Any]]:
        def declare(name: str, default_value: Any, description: str, choices: Any = None) -> Any:
            def act(launched: Launched) -> None:
                value = launched.values.setdefault(name, launched.text(default_value))
                assert choices is None or value in choices, f"{value} is none of {choices}"
                assert description
                launched.declared[name] = value

            return act

        def include(source: str, launch_arguments: Any) -> Any:
            def act(launched: Launched) -> None:
                file = launched.text(source)
                given = {name: launched.text(value) for name, value in launch_arguments}
                inner = Launched(launched.installed, launched.values | given)
                inner.run(Path(file).name)
                assert given.keys() <= inner.declared.keys()
                launched.nodes |= inner.nodes

            return act

        def command(words: list[Any]) -> Any:
            def read(launched: Launched) -> str:
                program, _, file = launched.text(words).partition(" ")
                assert program == "cat"
                return Path(file.strip("'")).read_text(encoding="utf-8")

            return read

        return {
            "launch": {"LaunchDescription": list},
            "launch.actions": {
                "DeclareLaunchArgument": declare,
                "IncludeLaunchDescription": include,
                "OpaqueFunction": lambda function: lambda run: [one(run) for one in function(run)],
            },
            "launch.conditions": {
                "IfCondition": lambda given: lambda run: run.text(given).lower() in ("true", "1")
            },
            "launch.launch_description_sources": {"PythonLaunchDescriptionSource": lambda p: p},
            "launch.substitutions": {
                "LaunchConfiguration": lambda name: lambda run: run.values[name],
                "PathJoinSubstitution": lambda parts: lambda run: "/".join(map(run.text, parts)),
                "Command": command,
            },
            "launch_ros": {},
            "launch_ros.actions": {"Node": lambda **options: lambda run: run.node(options)},
            "launch_ros.parameter_descriptions": {
                "ParameterValue": lambda value, value_type: (value, value_type)
            },
            "launch_ros.substitutions": {"FindPackageShare": lambda package: lambda _: str(ROOT)},
            "ament_index_python": {},
            "ament_index_python.packages": {
                "get_packages_with_prefixes": lambda: dict.fromkeys(self.installed, "/")
            },
        }

    @contextmanager
    def _stubs(self) -> Iterator[None]:
        before = dict(sys.modules)
        for name, members in self._names().items():
            module = ModuleType(name)
            vars(module).update(members)
            sys.modules[name] = module
        try:
            yield
        finally:
            for name in self._names():
                sys.modules.pop(name)
            sys.modules.update(before)
