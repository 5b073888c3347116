"""Numba's caches on disk, removed when the code has changed since."""

from __future__ import annotations

from pathlib import Path


def remove_stale_caches(package: Path) -> int:
    """Deletes the caches of a package that are older than any of its modules.

    Numba checks only the file of the cached function itself; when a function that it calls
    changes in another file, the old machine code would run on.
    """
    newest = max(module.stat().st_mtime_ns for module in package.rglob("*.py"))
    removed = 0
    for pattern in ("*.nbi", "*.nbc"):
        for cache in package.rglob(pattern):
            try:
                if cache.stat().st_mtime_ns < newest:
                    cache.unlink()
                    removed += 1
            except FileNotFoundError:  # another run was faster
                continue
    return removed
