"""Strict configuration: YAML read without surprises, checked against a schema.

PyYAML alone reads `1e-3` as a string and keeps the last of two equal keys; here the first
is a number and the second an error. Every error names file, key and the nearest valid name.
"""

from __future__ import annotations

import re
import reprlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, TypeVar

import yaml
from pydantic import BaseModel, ConfigDict, ValidationError

from nics_drl_bridge.errors import ConfigError, nearest

PACKAGE = "nics_drl_bridge"
MAX_DEPTH = 32
MAX_BYTES = 8 * 2**20
"""Of a YAML file; it is read at about 0.5 MB a second."""


class Schema(BaseModel):
    """Base of all configurations: frozen, no unknown keys, finite numbers only."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


SchemaT = TypeVar("SchemaT", bound=BaseModel)


class _Loader(yaml.SafeLoader):
    """YAML 1.2 numbers, and no duplicate keys."""


class _Dumper(yaml.SafeDumper):
    """Quotes text that either `_Loader` or YAML 1.1 would take for a number."""


_Loader.yaml_implicit_resolvers = {
    first: [
        (tag, pattern) for tag, pattern in resolvers if tag.rsplit(":", 1)[-1] in ("null", "merge")
    ]
    for first, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items()
}
_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:bool", re.compile(r"^(?:true|True|TRUE|false|False|FALSE)$"), list("tTfF")
)
_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:int", re.compile(r"^[-+]?(?:0|[1-9][0-9]*)$"), list("-+0123456789")
)
for _kind in (_Loader, _Dumper):
    _kind.add_implicit_resolver(
        "tag:yaml.org,2002:float",
        re.compile(
            r"^(?:[-+]?(?:\.[0-9]+|[0-9]+(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?"
            r"|[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN))$"
        ),
        list("-+0123456789."),
    )


def _mapping(loader: _Loader, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
    seen: set[Any] = set()
    for key_node, _ in node.value:
        if not isinstance(key_node, yaml.ScalarNode):
            raise yaml.constructor.ConstructorError(
                None, None, "a key must be one word or number", key_node.start_mark
            )
        key = key_node.value
        if key in seen:
            raise yaml.constructor.ConstructorError(
                None, None, f"the key {key!r} stands twice; keep one", key_node.start_mark
            )
        seen.add(key)
    return yaml.SafeLoader.construct_mapping(loader, node, deep=deep)


_Loader.add_constructor(yaml.resolver.BaseResolver.DEFAULT_MAPPING_TAG, _mapping)


def _check_depth(text: str) -> None:
    depth = 0
    for event in yaml.parse(text, Loader=_Loader):
        if isinstance(event, (yaml.MappingStartEvent, yaml.SequenceStartEvent)):
            depth += 1
            if depth > MAX_DEPTH:
                raise ValueError(f"it is nested more than {MAX_DEPTH} levels deep; flatten it")
        elif isinstance(event, (yaml.MappingEndEvent, yaml.SequenceEndEvent)):
            depth -= 1


def parse_yaml(text: str, source: str) -> dict[str, Any]:
    """Reads a YAML mapping.

    Args:
        text: the YAML.
        source: the file's name, for errors.

    Returns:
        The mapping.

    Raises:
        ConfigError: no YAML, a duplicate key, nothing in it, or no mapping at the top.
    """
    try:
        _check_depth(text)
        data = yaml.load(text, Loader=_Loader)  # noqa: S506 - _Loader derives from SafeLoader
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark
        line = f", line {mark.line + 1}" if mark else ""
        raise ConfigError(f"{source}{line}: {error.problem or 'not YAML'}.") from None
    except (yaml.YAMLError, ValueError) as error:
        raise ConfigError(f"{source}: {' '.join(str(error).split())}.") from None
    if data is None:
        raise ConfigError(f"{source}: the file is empty; it must hold `key: value` lines.")
    if not isinstance(data, dict):
        raise ConfigError(f"{source}: the top level must be `key: value` lines.")
    return data


def validate(data: dict[str, Any], schema: type[SchemaT], source: str) -> SchemaT:
    """Checks a mapping against a schema.

    Args:
        data: what the file holds.
        schema: a pydantic model.
        source: the file's name, for errors.

    Returns:
        The checked configuration.

    Raises:
        ConfigError: the first thing that is wrong, with file, key, value and fix.
    """
    try:
        found = schema.model_validate(data)
    except ValidationError as error:
        raise ConfigError(f"{source}: {_sentence(error, schema)}") from None
    for place, given in _taken_for_numbers(data, found):
        raise ConfigError(f"{source}: key {place!r}: should be a number, not {given!r}.")
    return found


def _taken_for_numbers(given: Any, found: Any, place: str = "") -> Iterator[tuple[str, Any]]:
    """Texts and truth values that pydantic made a number of: `true` is no length."""
    pairs: list[tuple[Any, Any, Any]] = []
    if isinstance(found, BaseModel) and isinstance(given, dict):
        pairs = [(k, v, getattr(found, k)) for k, v in given.items() if hasattr(found, str(k))]
    elif isinstance(found, dict) and isinstance(given, dict):
        pairs = [(key, value, found[key]) for key, value in given.items() if key in found]
    elif isinstance(found, (tuple, list)) and isinstance(given, (tuple, list)):
        pairs = [(k, *both) for k, both in enumerate(zip(given, found, strict=False))]
    elif isinstance(given, (str, bool)) and type(found) in (int, float):
        yield place.removeprefix("."), given
    for key, value, made in pairs:
        yield from _taken_for_numbers(value, made, f"{place}.{key}")


_SHORT = reprlib.Repr()
"""Shows a wrong value; the whole of one made of YAML aliases may not fit into memory."""
_SHORT.maxstring = _SHORT.maxother = 80


def _sentence(error: ValidationError, schema: type[BaseModel]) -> str:
    details = error.errors(include_url=False)
    first = next((d for d in details if d["type"] == "extra_forbidden"), details[0])
    key = ".".join(str(part) for part in first["loc"])
    if first["type"] == "extra_forbidden":
        known = _fields_at(schema, first["loc"][:-1])
        hint = nearest(str(first["loc"][-1]), known) if known else "remove it"
        return f"unknown key {key!r}; {hint}"
    if first["type"] == "union_tag_invalid":
        tag, known = first["ctx"]["tag"], re.findall("'([^']*)'", first["ctx"]["expected_tags"])
        return f"key {key!r}: unknown kind {tag!r}; {nearest(tag, known)}"
    if first["type"] == "union_tag_not_found":
        return f"the key '{key}.kind' is missing; add it."
    if first["type"] == "missing":
        return f"the key {key!r} is missing; add it."
    message = first["msg"].removeprefix("Value error, ").rstrip(".")
    message = message[0].lower() + message[1:]
    if not key:  # of several keys, which the message names
        return f"{message}."
    return f"key {key!r}: {message}, not {_SHORT.repr(first['input'])}."


def _fields_at(schema: type[BaseModel], location: tuple[int | str, ...]) -> list[str]:
    """The field names of the model that lies at `location` inside `schema`.

    Where one of several models may stand, the location names the `kind` of the one that does.
    """
    current: Any = schema
    candidates: list[type[BaseModel]] = []
    for part in location:
        fields = getattr(current, "model_fields", {})
        if part in fields:
            candidates = _inner_models(fields[part].annotation)
            current = candidates[0] if candidates else None
        else:
            kinds = [c for c in candidates if _kind_of(c) == part]
            current = kinds[0] if kinds else current
    return list(getattr(current, "model_fields", {}))


def _kind_of(model: type[BaseModel]) -> Any:
    kind = model.model_fields.get("kind")
    return None if kind is None else kind.default


def _inner_models(annotation: Any) -> list[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [
        model
        for argument in getattr(annotation, "__args__", ())
        for model in _inner_models(argument)
    ]


def no_device(path: Path) -> Path:
    """The path itself, unless what lies there is a device or a pipe: reading it may never end.

    Raises:
        ConfigError: it is one.
    """
    if path.exists() and not (path.is_file() or path.is_dir()):
        raise ConfigError(f"{path}: is a device or a pipe, not a file; copy it to one.")
    return path


def read_text(path: str | Path) -> str:
    """Reads a UTF-8 file, with one sentence when that fails."""
    path = Path(path)
    try:
        return no_device(path).read_text(encoding="utf-8")
    except FileNotFoundError:
        raise ConfigError(f"{path}: no such file; check the path.") from None
    except IsADirectoryError:
        raise ConfigError(f"{path}: is a folder, not a file.") from None
    except UnicodeDecodeError:
        raise ConfigError(f"{path}: is not UTF-8 text; save it as UTF-8.") from None
    except OSError as error:
        raise ConfigError(f"{path}: can't be read ({error.strerror}).") from None


def load_yaml(path: str | Path, schema: type[SchemaT]) -> SchemaT:
    """Reads and checks a YAML file. Raises ConfigError with file, key and fix."""
    path = Path(path)
    if path.is_file() and path.stat().st_size > MAX_BYTES:
        limit = MAX_BYTES // 2**20
        raise ConfigError(f"{path}: is larger than {limit} MB; give a configuration instead.")
    return validate(parse_yaml(read_text(path), str(path)), schema, str(path))


def dump_yaml(data: Any) -> str:
    """Writes plain data as YAML that `load_yaml` reads back to the same numbers."""
    return str(yaml.dump(data, Dumper=_Dumper, sort_keys=False, allow_unicode=True, width=100))


def share_folder() -> Path:
    """The folder that holds `config` and `launch`: the checkout, or `share/nics_drl_bridge`."""
    checkout, *others = Path(__file__).resolve().parents[1:]
    if (checkout / "config" / "robots").is_dir():
        return checkout
    for parent in others:
        installed = parent / "share" / PACKAGE
        if (installed / "config").is_dir():
            return installed
    raise ConfigError(
        "the package's config folder was not found; install the package with pip or colcon."
    )


def find_config(name: str | Path, kind: str) -> Path:
    """Finds a configuration by the name of a shipped one, or by path.

    Args:
        name: `arena` for `config/KIND/arena.yaml`, or the path of a YAML file.
        kind: the folder below `config`: `robots`, `worlds` or `nodes`.

    Returns:
        The file's path.

    Raises:
        ConfigError: there is none, with the nearest valid name.
    """
    name = str(name)
    if name.endswith((".yaml", ".yml")):
        return Path(name)
    folder = share_folder() / "config" / kind
    path = folder / f"{name}.yaml"
    if not path.is_file():
        known = [file.stem for file in folder.glob("*.yaml")]
        raise ConfigError(
            f"unknown {kind.removesuffix('s')} {name!r}; {nearest(name, known)} "
            "(or give the path of a YAML file)."
        )
    return path
