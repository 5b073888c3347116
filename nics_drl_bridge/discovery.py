"""Registers the environments as soon as gymnasium is imported, without importing it.

Gymnasium 1.x does not look for packages that bring environments, and importing it here would
make `import nics_drl_bridge` slow for those who only want the kinematics.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from importlib import import_module
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec, PathFinder
from types import ModuleType

GYMNASIUM = "gymnasium"
REGISTRATION = "nics_drl_bridge.env.registry"


class _Registering(Loader):
    """Loads gymnasium as usual, then registers the environments."""

    def __init__(self, loader: Loader) -> None:
        self._loader = loader

    def create_module(self, spec: ModuleSpec) -> ModuleType | None:
        return self._loader.create_module(spec)

    def exec_module(self, module: ModuleType) -> None:
        if module.__spec__ is not None:
            module.__spec__.loader = self._loader
        self._loader.exec_module(module)
        import_module(REGISTRATION)  # registers as it is imported


class _Finder(MetaPathFinder):
    """Waits for gymnasium, once."""

    def find_spec(
        self, name: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        if name != GYMNASIUM:
            return None
        sys.meta_path.remove(self)
        spec = PathFinder.find_spec(name, path, target)
        if spec is not None and spec.loader is not None:
            spec.loader = _Registering(spec.loader)
        return spec


def register_on_import() -> None:
    """Has the environments registered when gymnasium is imported for the first time."""
    sys.meta_path.insert(0, _Finder())
