"""Makes docs/reference/ from the schemas of files, the commands and the nodes: `make reference`.

A key's meaning is the comment beside its field in the code, so it has one home.
"""

import ast
import inspect
import re
import tokenize
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import yaml
from pydantic import BaseModel
from typer.main import get_command

from nics_drl_bridge.commands.cli import app
from nics_drl_bridge.extras.foreign_policies.mapping import ForeignPolicy
from nics_drl_bridge.gate.limits import LimitsFile
from nics_drl_bridge.lidar.maps import MapFile
from nics_drl_bridge.lidar.spec import LidarSpec
from nics_drl_bridge.nodes.parameters import (
    GREATEST_SEED,
    STAMPED,
    Row,
    describe_node,
    list_nodes,
)
from nics_drl_bridge.policy.train.settings import TrainingSettings
from nics_drl_bridge.recording.mapping import DriveMapping
from nics_drl_bridge.recording.topic_roles import TopicRoles
from nics_drl_bridge.robot.spec import RobotSpec, list_kinds
from nics_drl_bridge.sim.randomisation import Randomisation
from nics_drl_bridge.sim.world import World
from nics_drl_bridge.sim.world_set import SetFile

ROOT = Path(__file__).resolve().parents[2]
FOLDER = ROOT / "docs" / "reference"
LARGE = 1e4  # a bound that only guards against nonsense is not told
BOUNDS = (
    ("minimum", "≥"),
    ("exclusiveMinimum", ">"),
    ("maximum", "≤"),
    ("exclusiveMaximum", "<"),
)


class Kind(NamedTuple):
    """A kind of file: title, schema, an example below config/ or examples/, guide, and a note."""

    title: str
    schema: type[BaseModel]
    example: str
    guide: str
    note: str = ""


SHORT = (
    "\n\nA file that begins with `kind:` needs a `footprint` or a `footprint_radius` and nothing "
    "else: name, commands, state and parameters are those of its kind, unless it gives its own. "
    "`free` needs its commands, too. "
    f"Kinds are {', '.join(f'`{name}`' for name in list_kinds())}."
)
KINDS = {
    "robot": Kind(
        "Robot file", RobotSpec, "config/robots/ackermann.yaml", "robots", SHORT
    ),
    "world": Kind("World file", World, "config/worlds/crowd.yaml", "worlds"),
    "world_set": Kind(
        "World set file", SetFile, "config/world_sets/cellular.yaml", "worlds"
    ),
    "map": Kind("Map file", MapFile, "config/maps/room.yaml", "worlds"),
    "lidar": Kind("Lidar file", LidarSpec, "config/lidars/rplidar_a2.yaml", "lidar"),
    "mapping": Kind(
        "Mapping of a recording",
        DriveMapping,
        "examples/recordings/jetracer_csv.yaml",
        "recordings",
    ),
    "topics": Kind("Topic roles of a bag", TopicRoles, "", "recordings"),
    "training": Kind(
        "Settings of a training",
        TrainingSettings,
        "config/training/demo.yaml",
        "training",
    ),
    "randomisation": Kind(
        "Randomisation file",
        Randomisation,
        "config/randomisation/mild.yaml",
        "randomisation",
    ),
    "limits": Kind(
        "Limits of the gate", LimitsFile, "config/limits/ackermann.yaml", "safety"
    ),
    "foreign_policy": Kind(
        "Foreign policy file", ForeignPolicy, "", "foreign_policies"
    ),
}


@cache
def comments_of(owner: type) -> dict[str, str]:
    """The comments at the fields of a class: above them, and at the end of their lines."""
    lines = [
        line + "\n"
        for line in inspect.cleandoc("\n" + inspect.getsource(owner)).split("\n")
    ]
    tokens = tokenize.generate_tokens(iter(lines).__next__)
    at = {
        t.start[0]: t.string.lstrip("# ") for t in tokens if t.type == tokenize.COMMENT
    }
    fields = [
        n
        for n in ast.parse("".join(lines)).body[0].body
        if isinstance(n, ast.AnnAssign)
    ]  # type: ignore[attr-defined]
    found = {}
    for field in fields:
        first = field.lineno
        last = field.end_lineno or field.lineno
        while first > 1 and lines[first - 2].lstrip().startswith("#"):
            first -= 1
        texts = [at[n] for n in range(first, last + 1) if n in at]
        found[ast.unparse(field.target)] = " ".join(texts)
    return found


def meaning(schema: type[BaseModel], name: str) -> str:
    """The comment at a field, of the class or of one that it inherits from."""
    owners = (
        one for one in schema.__mro__ if name in vars(one).get("__annotations__", {})
    )
    return comments_of(next(owners)).get(name, "")


def schemas_of(schema: type[BaseModel]) -> dict[str, type[BaseModel]]:
    """All schemas that a file's schema holds, by name."""
    found = {schema.__name__: schema}

    def visit(annotation: Any) -> None:
        is_schema = isinstance(annotation, type) and issubclass(annotation, BaseModel)
        if is_schema and annotation.__name__ not in found:
            found[annotation.__name__] = annotation
            inside(annotation)
        for part in getattr(annotation, "__args__", ()):
            visit(part)

    def inside(model: type[BaseModel]) -> None:
        for field in model.model_fields.values():
            visit(field.annotation)

    inside(schema)
    return found


def shown(value: Any) -> str:
    """A value as YAML writes it."""
    text = (
        yaml.safe_dump(value, default_flow_style=True, width=1000)
        .removesuffix("...\n")
        .strip()
    )
    return f"`{text}`"


def type_of(part: dict[str, Any]) -> str:
    """A JSON schema's type in words."""
    if "$ref" in part:
        name = part["$ref"].rpartition("/")[2]
        return f"[{name}](#{name.lower()})"
    if options := part.get("anyOf", part.get("oneOf")):
        return " or ".join(dict.fromkeys(type_of(one) for one in options))
    if "enum" in part:
        return " or ".join(shown(one) for one in part["enum"])
    if "const" in part:
        return shown(part["const"])
    if part.get("type") == "array":
        return array_type(part)
    if part.get("type") == "object":
        inner = part.get("additionalProperties", {})
        return (
            f"map of {type_of(inner)}" if isinstance(inner, dict) and inner else "map"
        )
    return {
        "string": "text",
        "boolean": "true or false",
        "integer": "whole number",
    }.get(part.get("type", "any"), part.get("type", "any"))


def array_type(part: dict[str, Any]) -> str:
    """The type of a list: of so many, or of any number."""
    if "prefixItems" in part:
        return f"[{', '.join(type_of(one) for one in part['prefixItems'])}]".replace(
            "[[", "[ ["
        )
    return f"list of {type_of(part.get('items', {}))}"


def range_of(part: dict[str, Any]) -> str:
    """The bounds of a number, but for those that only guard against nonsense."""
    for one in (part, *part.get("anyOf", ())):
        told = [
            f"{sign} {one[key]:g}"
            for key, sign in BOUNDS
            if key in one and abs(one[key]) < LARGE and one[key] != -LARGE
        ]
        if told:
            return ", ".join(told)
    return ""


def rows(
    schema: type[BaseModel], properties: dict[str, Any], required: list[str]
) -> Iterator[str]:
    """A line of a table for each key of a schema."""
    names = {field.alias or name: name for name, field in schema.model_fields.items()}
    for key, part in properties.items():
        default = "required" if key in required else ""
        if (
            "default" in part and "$ref" not in part
        ):  # a schema's is that of its own keys
            default = shown(part["default"])
        cells = (
            f"`{key}`",
            type_of(part),
            default,
            range_of(part),
            meaning(schema, names[key]),
        )
        yield (
            "|"
            + "|".join(f" {re.sub(r'[|]', '&#124;', cell)} " for cell in cells)
            + "|"
        )


def section(schema: type[BaseModel], part: dict[str, Any], title: str) -> str:
    """Heading, description and table of a schema."""
    text = "\n".join(
        line.rstrip() for line in inspect.cleandoc(schema.__doc__ or "").split("\n")
    ).split("\nAttributes:")[0]
    head = "| key | type | default | range | meaning |\n|---|---|---|---|---|"
    table = "\n".join(
        rows(schema, part.get("properties", {}), part.get("required", []))
    )
    return f"{title}\n\n{text.strip()}\n\n{head}\n{table}\n"


def page(kind: Kind) -> str:
    """The page of a kind of file."""
    whole = kind.schema.model_json_schema()
    schemas = schemas_of(kind.schema)
    opening = (
        f"Every key of the file; [the guide](../{kind.guide}.md) says what they are for. A key "
        "that is not known, stands twice or is out of range is refused by its name."
    )
    parts = [section(kind.schema, whole, f"# {kind.title}\n\n{opening}{kind.note}")]
    inner = whole.get("$defs", {})
    parts += [section(schemas[name], inner[name], f"## {name}") for name in inner]
    if kind.example:
        text = (ROOT / kind.example).read_text(encoding="utf-8")
        parts.append(f"## Example\n\n`{kind.example}`:\n\n```yaml\n{text}```\n")
    return "\n".join(parts)


def commands(command: Any, path: str) -> Iterator[tuple[str, Any]]:
    """The commands below a command, with what a user types."""
    if hasattr(command, "commands"):
        for name, inner in command.commands.items():
            yield from commands(inner, f"{path} {name}")
    else:
        yield path, command


def command_section(path: str, command: Any) -> str:
    """What a command does, and a table of what it takes."""
    lines = [f"## {path}\n", inspect.cleandoc(command.help or "").replace("\b", ""), ""]
    lines += ["| argument | default | meaning |", "|---|---|---|"]
    for one in (each for each in command.params if not getattr(each, "hidden", False)):
        if one.name == "help":
            continue
        names = (
            [*one.opts, *one.secondary_opts]
            if one.param_type_name == "option"
            else [one.name]
        )
        usual = "required" if one.required else ""
        if isinstance(one.default, bool):
            usual = f"`{names[not one.default]}`" if one.secondary_opts else ""
        elif isinstance(one.default, str | int | float | Path):
            usual = shown(
                one.default if not isinstance(one.default, Path) else str(one.default)
            )
        told = " ".join((getattr(one, "help", "") or "").split())
        lines.append(
            f"| {', '.join(f'`{name}`' for name in names)} | {usual} | {cell(told)} |"
        )
    return "\n".join([*lines, ""])


def cell(text: str) -> str:
    """A text as it stands in a table; a browser would hide `<robot>`."""
    return text.replace("|", "&#124;").replace("<", "&lt;")


def parameter_row(row: Row) -> str:
    """What a node's parameter means, its default and its range."""
    usual = row.shown or shown(row.default)
    if row.name == STAMPED:
        usual = "true since Kilted"
    span = ""
    if row.span is not None:
        low, high = row.span
        span = f"{low:g} or more" if high == GREATEST_SEED else f"{low:g} to {high:g}"
    told = row.about if row.fixed else f"{row.about} May be set while it runs."
    return f"| `{row.name}` | {cell(usual)} | {span} | {cell(told)} |"


def node_section(node: str) -> str:
    """What a node does, its topics, services and parameters, and an example."""
    facts = describe_node(node)
    heads = ("subscribes to", "publishes", "services")
    lines = [f"## {node}\n", facts.about, "", "| | |", "|---|---|"]
    for head in heads:
        if names := getattr(facts, head.split()[0]):
            lines.append(f"| {head} | {', '.join(names)} |")
    lines += ["", "| parameter | default | range | meaning |", "|---|---|---|---|"]
    lines += map(parameter_row, facts.parameters)
    command = f"ros2 run nics_drl_bridge {node} --ros-args {facts.example}"
    return "\n".join([*lines, "", f"```bash\n{command}\n```", ""])


def pages() -> dict[str, str]:
    """All pages of the reference by file name."""
    found = {f"{name}.md": page(kind) for name, kind in KINDS.items()}
    every = [command_section(*one) for one in commands(get_command(app), "nics")]
    head = "# Commands\n\nEvery command of `nics`, as shown by `nics COMMAND --help`.\n"
    found["commands.md"] = "\n".join([head, *every])
    head = (
        "# Nodes\n\nEvery node, as shown by `ros2 run nics_drl_bridge NODE --help`.\n"
    )
    found["nodes.md"] = "\n".join([head, *map(node_section, list_nodes())])
    return found


if __name__ == "__main__":
    for name, text in pages().items():
        (FOLDER / name).write_text(text, encoding="utf-8")
