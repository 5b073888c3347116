"""Names of the kinds of robots.

A module of this folder that defines `KIND`, a `kinds.RobotKind`, adds a kind of the module's name,
which a robot's YAML file selects by `textbook:`. Other packages add kinds by entry points of the
group `nics_drl_bridge.kinds`.
"""

from __future__ import annotations

from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from pkgutil import iter_modules
from typing import Any

from nics_drl_bridge import extensions


def kind_names() -> list[str]:
    """Names of all kinds."""
    modules = (module.name for module in iter_modules([str(Path(__file__).parent)]))
    own = (name for name in modules if _own_kind(name) is not None)
    return sorted({*own, *extensions.known("kinds")})


def find_kind(name: str) -> Any | None:
    """Returns the `kinds.RobotKind` of a name; None if there is none.

    Raises:
        ConfigError: a library that it needs is missing.
    """
    if name in extensions.known("kinds"):
        return extensions.load("kinds", name)
    return _own_kind(name)


def _own_kind(name: str) -> Any | None:
    place = f"{__package__}.{name}"
    if not name.isidentifier() or find_spec(place) is None:
        return None
    return getattr(import_module(place), "KIND", None)
