"""Strict configuration: YAML files checked against a schema.

Errors name file, key and the nearest valid name. Unlike with PyYAML alone, `1e-3` is a number, and
a duplicate key is an error. Aliases and merge keys are counted while reading, because a
few lines can expand to gigabytes. Tags are refused, because they construct objects.
"""

import re
import reprlib
from collections.abc import Iterable, Iterator
from dataclasses import is_dataclass
from pathlib import Path
from typing import Annotated, Any, TypeVar, get_type_hints

import yaml
from pydantic import AfterValidator, BaseModel, ConfigDict, ValidationError
from yaml.composer import Composer

from nics_drl_bridge.errors import (
    ConfigError,
    MissingFileError,
    UnknownNameError,
    shorten,
    suggest,
)

PACKAGE = "nics_drl_bridge"
MAX_DEPTH = 32
MAX_BYTES = 2**20  # maximum size of a YAML file
# keys, values and lists; an alias counts as its full content
MAX_VALUES = 50_000
_LONGEST_PROBLEM = 200


def parse_namespace(name: str) -> str:
    """Returns a ROS 2 namespace like `/robot_1`, or "". Raises ConfigError if it is invalid."""
    namespace = name.strip("/")
    if namespace and not re.fullmatch(
        r"[A-Za-z_]\w*(/[A-Za-z_]\w*)*", namespace, re.ASCII
    ):
        needed = "must be words of letters, digits and _, none beginning with a digit, as /robot_1"
        raise ConfigError(f"namespace {name!r}: {needed}.")
    return f"/{namespace}" if namespace else ""


def _within(limit: float, needed: str) -> AfterValidator:
    def check(value: float) -> float:
        if abs(value) > limit:
            raise ValueError(f"must be {needed}")
        return value

    return AfterValidator(check)


Heading = Annotated[
    float, _within(6.3, "in radians, within 2 pi (degrees look like this)")
]
_Near = Annotated[
    float, _within(10.0, "in metres, within 10 (millimetres look like this)")
]
# pose of a sensor in `base_link`: x [m], y [m], heading [rad]
Mount = tuple[_Near, _Near, Heading]


class Schema(BaseModel):
    """Base of all configurations: frozen, no unknown keys, finite numbers only."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


SchemaT = TypeVar("SchemaT", bound=BaseModel)


def validate(
    data: dict[str, Any],
    schema: type[SchemaT],
    source: str,
    missing_fix: str = "add it",
) -> SchemaT:
    """Checks a file's content against a schema. Raises ConfigError with key, value and fix."""
    try:
        validated = schema.model_validate(data)
    except ValidationError as error:
        first = _select_first(error)
        key = _name_key(first)
        reason = _explain_error(first, key, schema, missing_fix)
        raise ConfigError(f"{source}: {reason}", key=key, reason=reason) from None
    for key, value in _find_coerced(data, validated):
        reason = f"key {key!r}: should be a number, not {value!r}."
        raise ConfigError(f"{source}: {reason}", key=key, reason=reason)
    return validated


def _find_coerced(
    raw: Any, validated: Any, place: str = ""
) -> Iterator[tuple[str, Any]]:
    """Yields strings and booleans that pydantic coerced to numbers; `true` is not a length."""
    pairs: list[tuple[Any, Any, Any]] = []
    if isinstance(raw, dict):
        parts = (
            validated
            if isinstance(validated, dict)
            else getattr(validated, "__dict__", {})
        )
        pairs = [(key, value, parts[key]) for key, value in raw.items() if key in parts]
    elif isinstance(validated, (tuple, list)) and isinstance(raw, (tuple, list)):
        pairs = [(k, *pair) for k, pair in enumerate(zip(raw, validated, strict=False))]
    elif isinstance(raw, (str, bool)) and type(validated) in (int, float):
        yield place.removeprefix("."), raw
    for key, value, parsed in pairs:
        yield from _find_coerced(value, parsed, f"{place}.{key}")


# pydantic's error types for unknown keys, of a model and of a dataclass
_UNKNOWN = ("extra_forbidden", "unexpected_keyword_argument")
_NO_KEYS = ("model_type", "model_attributes_type", "dict_type", "dataclass_type")
_NO_LIST = ("tuple_type", "list_type")
_COUNT = ("too_short", "too_long")
_SHORT = reprlib.Repr()  # a value made of YAML aliases may not fit into memory in full
_SHORT.maxstring = _SHORT.maxother = 80


def _select_first(error: ValidationError) -> Any:
    """Returns the details of the error to report: unknown keys come first, missing ones last."""
    details = error.errors(include_url=False)
    problems = [d for d in details if d["type"] != "missing"] or details
    return next((d for d in problems if d["type"] in _UNKNOWN), problems[0])


def _name_key(first: Any) -> str:
    parts = list(map(str, first["loc"]))
    if first["type"] == "union_tag_not_found":
        parts.append("kind")
    elif first["type"] == "missing" and isinstance(first["loc"][-1], int):
        parts.pop()  # the key of the list that is too short
    return ".".join(parts)


def _explain_error(
    first: Any, key: str, schema: type[BaseModel], missing_fix: str
) -> str:
    if first["type"] in _UNKNOWN:
        names = _locate_fields(schema, first["loc"][:-1])
        hint = suggest(str(first["loc"][-1]), names) if names else "remove it"
        return f"unknown key {key!r}; {hint}"
    if first["type"] == "union_tag_invalid":
        tag = first["ctx"]["tag"]
        names = re.findall("'([^']*)'", first["ctx"]["expected_tags"])
        return f"key {key!r}: unknown kind {tag!r}; {suggest(tag, names)}"
    if first["type"] == "missing" and isinstance(first["loc"][-1], int):
        count = first["loc"][-1]
        return f"key {key!r}: number of entries must be more than {count}."
    if first["type"] in ("missing", "union_tag_not_found"):
        return f"the key {key!r} is missing; {missing_fix}."
    if first["type"] in _NO_KEYS:
        return f"key {key!r}: must contain `key: value` pairs, not {_SHORT.repr(first['input'])}."
    if first["type"] in _NO_LIST:
        return f"key {key!r}: must be a list such as [a, b], not {_SHORT.repr(first['input'])}."
    if first["type"] in _COUNT:
        limits = first["ctx"]
        if "min_length" in limits:
            bounds = f"at least {limits['min_length']}"
        else:
            bounds = f"at most {limits['max_length']}"
        count = limits["actual_length"]
        return f"key {key!r}: number of entries must be {bounds}, not {count}."
    message = first["msg"]
    if first["type"] == "value_error":  # raised by this package
        message = str(first["ctx"]["error"])
    message = message.rstrip(".")
    message = message[0].lower() + message[1:]
    if not key:  # an error about several keys; the message names them
        return f"{message}."
    return f"key {key!r}: {message}, not {_SHORT.repr(first['input'])}."


def _locate_fields(
    schema: type[BaseModel], location: tuple[int | str, ...]
) -> list[str]:
    """Returns the field names at a location, in which the `kind` selects a model of a union."""
    current: Any = schema
    candidates: list[type] = []
    for part in location:
        fields = _get_annotations(current)
        if part in fields:
            candidates = _find_inner_models(fields[part])
            current = candidates[0] if candidates else None
        else:
            for candidate in candidates:
                kind = getattr(candidate, "model_fields", {}).get("kind")
                if kind and kind.default == part:
                    current = candidate
                    break
    return list(_get_annotations(current))


def _get_annotations(model: Any) -> dict[Any, Any]:
    if is_dataclass(model):
        return dict(get_type_hints(model))
    fields: dict[str, Any] = getattr(model, "model_fields", {})
    return {field.alias or name: field.annotation for name, field in fields.items()}


def _find_inner_models(annotation: Any) -> list[type]:
    if _get_annotations(annotation):
        return [annotation]
    models = []
    for argument in getattr(annotation, "__args__", ()):
        models += _find_inner_models(argument)
    return models


def check_no_device(path: Path) -> Path:
    """Returns the path. Raises ConfigError for a device or a pipe: reading it might never end."""
    if path.exists() and not (path.is_file() or path.is_dir()):
        raise ConfigError(
            f"{path}: is a device or a pipe, not a file; copy its content to a file."
        )
    return path


def read_text(path: str | Path, limit: int = MAX_BYTES) -> str:
    """Reads a UTF-8 file of at most `limit` bytes. Raises ConfigError if that fails."""
    path = Path(path)
    try:
        size = check_no_device(path).stat().st_size
        if size > limit and path.is_file():
            reason = f"is larger than {limit // 2**20} MB"
            raise ConfigError(f"{path}: {reason}; give another.")
        return path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise MissingFileError(f"{path}: no such file; check the path.") from None
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
    """Returns the folder with `config` and `launch`: the checkout, or `share/nics_drl_bridge`."""
    checkout, *parents = Path(__file__).resolve().parents[1:]
    for folder in (checkout, *(parent / "share" / PACKAGE for parent in parents)):
        if (folder / "config" / "robots").is_dir():
            return folder
    raise ConfigError(
        "the package's config folder was not found; install it with pip or colcon."
    )


def list_shipped(kind: str) -> list[str]:
    """Returns the names of the YAML files, or policies, in `config/KIND`, sorted."""
    files = (share_folder() / "config" / kind).glob("*.*")
    return sorted(file.stem for file in files if file.suffix in (".yaml", ".onnx"))


def find_config(name: str | Path, kind: str, extra_names: Iterable[str] = ()) -> Path:
    """Returns the path of a name in `config/KIND`, or of a YAML file. Raises ConfigError."""
    name = str(name)
    if name.endswith((".yaml", ".yml")):
        return Path(name)
    path = share_folder() / "config" / kind / f"{name}.yaml"
    if path.is_file():
        return path
    hint = suggest(name, (*list_shipped(kind), *extra_names))
    words = {"training": "settings", "limits": "limits", "entities": "entity"}
    unknown = f"unknown {words.get(kind, kind.removesuffix('s'))} {name!r}"
    raise UnknownNameError(
        f"{unknown}; {hint} (or give the path of a YAML file).", kind
    )


# libyaml's parser is four times as fast; nodes are composed in Python either way.
_BASES: Any = (
    (Composer, yaml.CSafeLoader) if yaml.__with_libyaml__ else (yaml.SafeLoader,)
)


class _Loader(*_BASES):  # type: ignore[misc]
    """Loader with YAML 1.2 numbers, no duplicate keys, no tags, and limits on depth and size."""

    def __init__(self, text: str) -> None:
        _BASES[-1].__init__(self, text)
        Composer.__init__(self)
        self._depth = self._values = 0
        self._sizes: dict[str, int] = {}

    def compose_node(self, parent: Any, index: Any) -> Any:
        event: Any = self.peek_event()
        is_alias = isinstance(event, yaml.AliasEvent)
        before = self._values
        self._depth = self._depth + 1
        self._values += self._sizes.get(event.anchor, 1) if is_alias else 1
        if self._depth > MAX_DEPTH:
            self._refuse(
                event, f"it is nested more than {MAX_DEPTH} levels deep; flatten it"
            )
        if self._values > MAX_VALUES:
            self._refuse(
                event, f"it contains more than {MAX_VALUES} values, including aliases"
            )
        if getattr(event, "tag", None) is not None:
            tag = reprlib.repr(event.tag.replace("tag:yaml.org,2002:", "!!"))
            self._refuse(event, f"the tag {tag} is not supported; write only the value")
        if (
            is_alias
            and event.anchor in self.anchors
            and event.anchor not in self._sizes
        ):
            self._refuse(
                event, f"the alias {reprlib.repr(event.anchor)} contains itself"
            )
        node = super().compose_node(parent, index)
        if event.anchor is not None:
            self._sizes[event.anchor] = self._values - before
        self._depth -= 1
        return node

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[Any, Any]:
        if not isinstance(node, yaml.MappingNode):
            self._refuse(node, "`<<` must be followed by the alias of a mapping")
        keys: set[Any] = set()
        for key, _ in node.value:
            if not isinstance(key, yaml.ScalarNode):
                self._refuse(key, "a key must be one word or number")
            if key.value in keys:
                self._refuse(
                    key, f"the key {reprlib.repr(key.value)} occurs twice; keep one"
                )
            keys.add(key.value)
        return dict(super().construct_mapping(node, deep=deep))

    @staticmethod
    def _refuse(place: Any, problem: str) -> None:
        raise yaml.constructor.ConstructorError(None, None, problem, place.start_mark)


def _parse_whole(loader: _Loader, node: Any) -> int:
    try:
        return int(loader.construct_scalar(node))
    except ValueError:
        loader._refuse(node, f"a number of {len(node.value)} digits is too long")
        raise


_Loader.add_constructor("tag:yaml.org,2002:int", _parse_whole)


class _Dumper(yaml.SafeDumper):
    """Dumper that quotes strings that `_Loader` or YAML 1.1 would read as numbers."""


_TAG = "tag:yaml.org,2002:"
_FLOAT = re.compile(
    r"^(?:[-+]?(?:\.[0-9]+|[0-9]+(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?"
    r"|[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN))$"
)
_KEPT_TAGS = (f"{_TAG}null", f"{_TAG}merge")
_Loader.yaml_implicit_resolvers = {}
for _first, _resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items():
    _Loader.yaml_implicit_resolvers[_first] = [
        (tag, pattern) for tag, pattern in _resolvers if tag in _KEPT_TAGS
    ]
for _kind, _type, _pattern, _first in (
    (_Loader, "bool", re.compile(r"^(?:true|True|TRUE|false|False|FALSE)$"), "tTfF"),
    (_Loader, "int", re.compile(r"^[-+]?(?:0|[1-9][0-9]*)$"), "-+0123456789"),
    (_Loader, "float", _FLOAT, "-+0123456789."),
    (_Dumper, "float", _FLOAT, "-+0123456789."),
):
    _kind.add_implicit_resolver(_TAG + _type, _pattern, list(_first))


def parse_yaml(text: str, source: str) -> dict[str, Any]:
    """Reads a YAML mapping from the text of `source`. Raises ConfigError if it is not one."""
    if len(text) > MAX_BYTES:
        reason = (
            f"is larger than {MAX_BYTES // 2**20} MB; give a configuration instead."
        )
        raise ConfigError(f"{source}: {reason}")
    try:
        data = _Loader(text).get_single_data()
    except (yaml.YAMLError, ValueError) as error:
        mark = getattr(error, "problem_mark", None)
        last = text.rstrip().count("\n")  # the mark may be past the end
        line = f", line {min(mark.line, last) + 1}" if mark else ""
        problem = getattr(error, "problem", None) or " ".join(str(error).split())
        raise ConfigError(
            f"{source}{line}: {shorten(problem, _LONGEST_PROBLEM)}."
        ) from None
    if data is None:
        raise ConfigError(
            f"{source}: the file is empty; it must contain `key: value` lines."
        )
    if not isinstance(data, dict):
        raise ConfigError(f"{source}: the top level must be `key: value` lines.")
    return data


class _QuotingDumper(_Dumper):
    """Dumper that quotes every string, for parsers that would read some strings as numbers."""


def _quote(dumper: _QuotingDumper, text: str) -> Any:
    return dumper.represent_scalar("tag:yaml.org,2002:str", text, style='"')


_QuotingDumper.add_representer(str, _quote)


def dump_yaml(data: Any, quote_text: bool = False, one_line_rows: bool = False) -> str:
    """Writes plain data as YAML that `parse_yaml` reads back to the same numbers.

    `one_line_rows` writes lists and mappings of numbers and words on one line each.
    """
    return str(
        yaml.dump(
            data,
            Dumper=_QuotingDumper if quote_text else _Dumper,
            sort_keys=False,
            allow_unicode=True,
            width=100,
            default_flow_style=None if one_line_rows else False,
        )
    )
