"""`@kernel`: the one decorator by which functions are compiled, kept on disk, and kept up to date.

numba keeps machine code beside the source and checks the file of the function itself. A kernel
calls others and uses constants of others, so here the code is kept as long as nothing changed in
any module of the package that its own module imports, directly or not. This is decided by content:
an edit, an update and another branch compile what they must, and nothing else.

When compiling takes longer than `PATIENCE_S`, a line on standard error says how many kernels are
compiled, and about how long that takes.
"""

from __future__ import annotations

import hashlib
import os
import re
import sys
import threading
import time
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, overload

import numba
from numba.core import event
from numba.core.caching import FunctionCache, IndexDataCacheFile

PACKAGE = Path(__file__).parent
PATIENCE_S = 2.0
KERNELS: list[Any] = []
"""Every kernel that was imported so far, as numba's dispatchers."""
_IMPORT = re.compile(
    rf"^[ \t]*(?:from[ \t]+({PACKAGE.name}[.\w]*)[ \t]+import[ \t]+(\([^)]*\)|[^\n]*)"
    rf"|import[ \t]+({PACKAGE.name}[.\w]*))",
    re.MULTILINE,
)
_ALIAS = re.compile(r"\bas\s+\w+")


@overload
def kernel(function: Callable[..., Any]) -> Any: ...


@overload
def kernel(
    *, allocates: bool = ..., contracts: bool = ..., inline: bool = ...
) -> Callable[[Callable[..., Any]], Any]: ...


def kernel(
    function: Callable[..., Any] | None = None,
    *,
    allocates: bool = False,
    contracts: bool = False,
    inline: bool = False,
) -> Any:
    """Compiles a function with numba when it is first called, or loads what was compiled before.

    It runs without the interpreter's lock; a division by zero gives inf or NaN, as with arrays.

    Args:
        function: to compile.
        allocates: it makes arrays or other objects, or calls what does.
        contracts: products and sums may be fused, which rounds once instead of twice.
        inline: it is always compiled into its callers; for the few where that was measured to pay.

    Returns:
        numba's dispatcher; without `function`, a decorator.
    """
    options: dict[str, Any] = {"nogil": True, "error_model": "numpy"}
    options |= {} if allocates else {"_nrt": False}
    options |= {"fastmath": {"contract"}} if contracts else {}
    options |= {"forceinline": True} if inline else {}

    def compiled(function: Callable[..., Any]) -> Any:
        dispatcher = numba.njit(**options)(function)
        dispatcher._cache = _Cache(function)
        KERNELS.append(dispatcher)
        return dispatcher

    return compiled if function is None else compiled(function)


class _Index(IndexDataCacheFile):  # type: ignore[misc]
    def _load_index(self) -> dict[Any, Any]:
        try:
            return dict(super()._load_index())
        except (AttributeError, ImportError):  # it names a NamedTuple that has moved since
            return {}


class _Cache(FunctionCache):  # type: ignore[misc]
    """Machine code on disk, stamped with the content of all that it was compiled from."""

    def __init__(self, function: Callable[..., Any]) -> None:
        super().__init__(function)
        # Without the line of the function: it may move, and leaves nothing behind.
        name = re.sub(r"-\d+(\.py\d+\w*)$", r"\1", self._impl.filename_base)
        stamp = digest_of(Path(function.__code__.co_filename))
        self._cache_file = _Index(self._cache_path, name, stamp)

    @property
    def is_warm(self) -> bool:
        """True when something usable is on disk."""
        return bool(self._cache_file._load_index())


@cache
def digest_of(module: Path) -> str:
    """SHA-256 of a module and of all modules of the package that it imports, directly or not."""
    files, left = set[Path](), [module]
    while left:
        file = left.pop()
        if file not in files:
            files.add(file)
            left += imports_of(file)
    parts = sorted((os.path.relpath(file, PACKAGE), _read(file)) for file in files)
    return hashlib.sha256(repr(parts).encode()).hexdigest()


@cache
def _read(file: Path) -> str:
    return file.read_text(encoding="utf-8")


@cache
def imports_of(file: Path) -> tuple[Path, ...]:
    """The modules of the package that a file imports, wherever it does."""
    found = []
    for origin, names, plain in _IMPORT.findall(_read(file)):
        module = (origin or plain).split(".")[1:]
        found.append(module)
        found += [[*module, name] for name in re.findall(r"\w+", _ALIAS.sub("", names))]
    places = (PACKAGE.joinpath(*parts).with_suffix(".py") for parts in found if parts)
    return tuple(place for place in places if place.is_file())


class _Wait(event.Listener):  # type: ignore[misc]
    """Tells whoever waits for the compiler that it is at work, once in a process."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._depth, self._begun, self._spent, self._done, self._told = 0, 0.0, 0.0, 0, False

    def on_start(self, event: event.Event) -> None:
        """A function begins to be compiled, maybe for another that is."""
        with self._lock:
            if self._depth == 0:
                self._begun = time.monotonic()
            self._depth += 1
            spent = self._spent + time.monotonic() - self._begun
            if spent > PATIENCE_S and not self._told:
                self._told = True
                left = sum(not each._cache.is_warm for each in KERNELS)
                seconds = left * spent / max(self._done, 1)
                sys.stderr.write(
                    f"nics_drl_bridge: compiling up to {left} kernels, once on this machine: about "
                    f"{seconds:.0f} s\n"
                )

    def on_end(self, event: event.Event) -> None:
        """It was compiled, or could not be."""
        with self._lock:
            self._depth, self._done = self._depth - 1, self._done + 1
            if self._depth == 0:
                self._spent += time.monotonic() - self._begun


event.register("numba:compile", _Wait())
