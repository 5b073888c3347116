"""Strict configuration: YAML files checked against a schema.

Every error names file, key and the nearest valid name.
"""

from __future__ import annotations

import re
import reprlib
from collections.abc import Iterator
from dataclasses import is_dataclass
from pathlib import Path
from typing import Any, TypeVar, get_type_hints

from pydantic import BaseModel, ConfigDict, ValidationError

from nics_drl_bridge.errors import ConfigError, nearest
from nics_drl_bridge.strict_yaml import MAX_BYTES, dump_yaml, parse_yaml

__all__ = [
    "MAX_BYTES", "PACKAGE", "Schema", "dump_yaml", "find_config", "load_yaml", "no_device",
    "parse_yaml", "read_text", "share_folder", "validate",
]  # fmt: skip

PACKAGE = "nics_drl_bridge"


class Schema(BaseModel):
    """Base of all configurations: frozen, no unknown keys, finite numbers only."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


SchemaT = TypeVar("SchemaT", bound=BaseModel)


def validate(data: dict[str, Any], schema: type[SchemaT], source: str) -> SchemaT:
    """Checks a mapping against a schema.

    Args:
        data: content of the file.
        schema: a pydantic model.
        source: the file's name, for errors.

    Returns:
        The checked configuration.

    Raises:
        ConfigError: the first error, with file, key, value and fix.
    """
    try:
        found = schema.model_validate(data)
    except ValidationError as error:
        raise ConfigError(f"{source}: {_sentence(error, schema)}") from None
    for place, given in _taken_for_numbers(data, found):
        raise ConfigError(f"{source}: key {place!r}: should be a number, not {given!r}.")
    return found


def _taken_for_numbers(given: Any, found: Any, place: str = "") -> Iterator[tuple[str, Any]]:
    """Yields strings and booleans that pydantic coerced to numbers: `true` is no length."""
    pairs: list[tuple[Any, Any, Any]] = []
    if isinstance(given, dict):
        parts = found if isinstance(found, dict) else getattr(found, "__dict__", {})
        pairs = [(key, value, parts[key]) for key, value in given.items() if key in parts]
    elif isinstance(found, (tuple, list)) and isinstance(given, (tuple, list)):
        pairs = [(k, *both) for k, both in enumerate(zip(given, found, strict=False))]
    elif isinstance(given, (str, bool)) and type(found) in (int, float):
        yield place.removeprefix("."), given
    for key, value, made in pairs:
        yield from _taken_for_numbers(value, made, f"{place}.{key}")


_UNKNOWN = ("extra_forbidden", "unexpected_keyword_argument")
"""Errors of pydantic about an unknown key, of a model and of a dataclass."""
_SHORT = reprlib.Repr()
"""Shortens a wrong value: one made of YAML aliases may not fit into memory in full."""
_SHORT.maxstring = _SHORT.maxother = 80


def _sentence(error: ValidationError, schema: type[BaseModel]) -> str:
    details = error.errors(include_url=False)
    first = next((d for d in details if d["type"] in _UNKNOWN), details[0])
    key = ".".join(str(part) for part in first["loc"])
    if first["type"] in _UNKNOWN:
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
    if not key:  # an error of several keys, which the message names
        return f"{message}."
    return f"key {key!r}: {message}, not {_SHORT.repr(first['input'])}."


def _fields_at(schema: type[BaseModel], location: tuple[int | str, ...]) -> list[str]:
    """Field names of the model at `location` inside `schema`.

    In a union of models, the location names the `kind` of the one that is present.
    """
    current: Any = schema
    candidates: list[type] = []
    for part in location:
        fields = _annotations_of(current)
        if part in fields:
            candidates = _inner_models(fields[part])
            current = candidates[0] if candidates else None
        else:
            kinds = [c for c in candidates if _kind_of(c) == part]
            current = kinds[0] if kinds else current
    return list(_annotations_of(current))


def _annotations_of(model: Any) -> dict[Any, Any]:
    """Types of the fields of a model or dataclass; empty for any other type."""
    if is_dataclass(model):
        return dict(get_type_hints(model))
    fields: dict[str, Any] = getattr(model, "model_fields", {})
    return {name: field.annotation for name, field in fields.items()}


def _kind_of(model: type) -> Any:
    kind = getattr(model, "model_fields", {}).get("kind")
    return None if kind is None else kind.default


def _inner_models(annotation: Any) -> list[type]:
    if _annotations_of(annotation):
        return [annotation]
    return [
        model
        for argument in getattr(annotation, "__args__", ())
        for model in _inner_models(argument)
    ]


def no_device(path: Path) -> Path:
    """Returns the path unless it is a device or a pipe, which may never end.

    Raises:
        ConfigError: the path is a device or a pipe.
    """
    if path.exists() and not (path.is_file() or path.is_dir()):
        raise ConfigError(f"{path}: is a device or a pipe, not a file; copy it to one.")
    return path


def read_text(path: str | Path, most: int = MAX_BYTES) -> str:
    """Reads a UTF-8 file of at most `most` bytes. Raises ConfigError if that fails."""
    path = Path(path)
    try:
        size = no_device(path).stat().st_size
        if size > most and path.is_file():
            raise ConfigError(
                f"{path}: is larger than {most // 2**20} MB, which no such file is; give another."
            )
        return path.read_text(encoding="utf-8")
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
    return validate(parse_yaml(read_text(path), str(path)), schema, str(path))


def share_folder() -> Path:
    """The folder that contains `config` and `launch`: the checkout, or `share/nics_drl_bridge`."""
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
        ConfigError: no such configuration; names the nearest valid one.
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
