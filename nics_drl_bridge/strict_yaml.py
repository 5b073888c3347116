"""Reads YAML without surprises, and writes it so that it reads back.

PyYAML alone reads `1e-3` as a string, keeps the last of two equal keys, lets a few lines of aliases
and merge keys grow to gigabytes, and builds objects from tags. Here the first is a number, the
second an error, the third is counted while reading, and tags are refused.
"""

from __future__ import annotations

import re
import reprlib
from typing import Any

import yaml
from yaml.composer import Composer
from yaml.constructor import SafeConstructor
from yaml.resolver import Resolver

from nics_drl_bridge.errors import ConfigError, shortened

MAX_DEPTH = 32
MAX_BYTES = 2**20
"""Maximum size of a YAML file."""
MAX_VALUES = 50_000
"""Maximum number of keys, values and lists; an alias counts as everything it stands for."""
_LONGEST_PROBLEM = 200


class _PythonEvents(yaml.reader.Reader, yaml.scanner.Scanner, yaml.parser.Parser):
    """Python substitute for libyaml's parser, four times slower."""

    def __init__(self, text: str) -> None:
        yaml.reader.Reader.__init__(self, text)
        yaml.scanner.Scanner.__init__(self)
        yaml.parser.Parser.__init__(self)


_Events: Any = vars(yaml)["cyaml"].CParser if yaml.__with_libyaml__ else _PythonEvents


class _Loader(Composer, _Events, SafeConstructor, Resolver):  # type: ignore[misc]
    """Loader with YAML 1.2 numbers, no duplicate keys, no tags, and limits on depth and size."""

    def __init__(self, text: str) -> None:
        _Events.__init__(self, text)
        Composer.__init__(self)
        SafeConstructor.__init__(self)
        Resolver.__init__(self)
        self._depth = self._values = 0
        self._sizes: dict[str, int] = {}

    def compose_node(self, parent: Any, index: Any) -> Any:
        """Composes a node as PyYAML does, and counts depth and values."""
        event: Any = self.peek_event()
        before, self._depth = self._values, self._depth + 1
        self._values += self._sizes.get(event.anchor, 1) if _is_alias(event) else 1
        if self._depth > MAX_DEPTH:
            self._refuse(event, f"it is nested more than {MAX_DEPTH} levels deep; flatten it")
        if self._values > MAX_VALUES:
            self._refuse(event, f"it holds more than {MAX_VALUES} values, with all its aliases")
        if getattr(event, "tag", None) is not None:
            tag = reprlib.repr(event.tag.replace("tag:yaml.org,2002:", "!!"))
            self._refuse(event, f"the tag {tag} is not read here; write the value alone")
        if _is_alias(event) and event.anchor in self.anchors and event.anchor not in self._sizes:
            self._refuse(event, f"the alias {reprlib.repr(event.anchor)} stands within itself")
        node = super().compose_node(parent, index)
        if event.anchor is not None:
            self._sizes[event.anchor] = self._values - before
        self._depth -= 1
        return node

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[Any, Any]:
        """Constructs a mapping as PyYAML does, but refuses duplicate keys."""
        if not isinstance(node, yaml.MappingNode):
            self._refuse(node, "`<<` must be followed by the alias of a mapping")
        seen: set[Any] = set()
        for key_node, _ in node.value:
            if not isinstance(key_node, yaml.ScalarNode):
                self._refuse(key_node, "a key must be one word or number")
            key = key_node.value
            if key in seen:
                self._refuse(key_node, f"the key {reprlib.repr(key)} stands twice; keep one")
            seen.add(key)
        return dict(super().construct_mapping(node, deep=deep))

    @staticmethod
    def _refuse(place: Any, problem: str) -> None:
        raise yaml.constructor.ConstructorError(None, None, problem, place.start_mark)


def _is_alias(event: Any) -> bool:
    return isinstance(event, yaml.AliasEvent)


def _whole(loader: _Loader, node: Any) -> int:
    try:
        return int(loader.construct_scalar(node))
    except ValueError:
        loader._refuse(node, f"a number of {len(node.value)} digits is too long")
        raise


_Loader.add_constructor("tag:yaml.org,2002:int", _whole)


class _Dumper(yaml.SafeDumper):
    """Dumper that quotes text that either `_Loader` or YAML 1.1 would take for a number."""


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


def parse_yaml(text: str, source: str) -> dict[str, Any]:
    """Reads a YAML mapping.

    Args:
        text: the YAML.
        source: the file's name, for errors.

    Returns:
        The mapping.

    Raises:
        ConfigError: not YAML, a duplicate key, an empty file, no mapping at the top level, or more
            than `MAX_BYTES`, `MAX_DEPTH` and `MAX_VALUES` allow.
    """
    if len(text) > MAX_BYTES:
        limit = MAX_BYTES // 2**20
        raise ConfigError(f"{source}: is larger than {limit} MB; give a configuration instead.")
    try:
        data = _Loader(text).get_single_data()
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark
        last = text.rstrip().count("\n")  # a mark may lie beyond the end
        line = f", line {min(mark.line, last) + 1}" if mark else ""
        problem = shortened(error.problem or "not YAML", _LONGEST_PROBLEM)
        raise ConfigError(f"{source}{line}: {problem}.") from None
    except (yaml.YAMLError, ValueError) as error:
        problem = shortened(" ".join(str(error).split()), _LONGEST_PROBLEM)
        raise ConfigError(f"{source}: {problem}.") from None
    if data is None:
        raise ConfigError(f"{source}: the file is empty; it must hold `key: value` lines.")
    if not isinstance(data, dict):
        raise ConfigError(f"{source}: the top level must be `key: value` lines.")
    return data


def dump_yaml(data: Any) -> str:
    """Writes plain data as YAML that `parse_yaml` reads back to the same numbers."""
    return str(yaml.dump(data, Dumper=_Dumper, sort_keys=False, allow_unicode=True, width=100))
