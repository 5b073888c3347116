"""Numba's caches on disk, removed when the code that they were compiled from has changed."""

from __future__ import annotations

import ast
import hashlib
from collections.abc import Iterator
from functools import cache
from pathlib import Path


def remove_stale_caches(package: Path) -> int:
    """Deletes the caches of each module of a package whose code, or whose imports', has changed.

    Numba checks only the file of the cached function itself; when a function that it calls
    changes in another file, the old machine code would run on. What a module's caches were
    compiled from is kept beside them, as a digest of all that the module imports of the package.
    """
    removed = 0
    modules = {_module_of(found) for found in package.rglob("*.nb[ic]")}
    for module in sorted(modules):
        note = module.parent / "__pycache__" / f"{module.stem}.closure"
        files = sorted(_closure(module, package))
        content = [(f"{file.relative_to(package)}", _digest(file)) for file in files]
        told = hashlib.sha256(repr(content).encode()).hexdigest()
        if note.is_file() and note.read_text() == told:
            continue
        newest = max((file.stat().st_mtime_ns for file in files), default=0)
        for found in note.parent.glob(f"{module.stem}.*.nb[ic]"):
            # Without a note, what was compiled after the last change is what is there now.
            if note.is_file() or found.stat().st_mtime_ns < newest or not files:
                found.unlink(missing_ok=True)
                removed += 1
        note.write_text(told)
    return removed


def _module_of(found: Path) -> Path:
    """The source of a cache, `folder/__pycache__/MODULE.function-LINE.pyXY.nbi`."""
    return found.parent.parent / f"{found.name.partition('.')[0]}.py"


def _closure(module: Path, package: Path) -> set[Path]:
    """The files of a package that a module imports, directly or by others, and itself."""
    files, left = set[Path](), [module]
    while left:
        file = left.pop()
        if file not in files and file.is_file():
            files.add(file)
            left += _imports(file, package)
    return files


@cache
def _imports(file: Path, package: Path) -> tuple[Path, ...]:
    return tuple(_found(file, package))


def _found(file: Path, package: Path) -> Iterator[Path]:
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        names = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            names = [node.module, *(f"{node.module}.{alias.name}" for alias in node.names)]
        for name in names:
            first, _, rest = name.partition(".")
            if first == package.name and rest:
                yield package.joinpath(*rest.split(".")).with_suffix(".py")


@cache
def _digest(file: Path) -> str:
    return hashlib.sha256(file.read_bytes()).hexdigest()
