from __future__ import annotations

import os

import pytest
from stale_caches import remove_stale_caches


@pytest.fixture
def package(tmp_path):
    for name, second in (
        ("caller.py", 100),
        ("inner/called.py", 100),
        ("__pycache__/caller.f-1.py311.nbi", 200),
        ("__pycache__/caller.f-1.py311.1.nbc", 200),
        ("__pycache__/caller.cpython-311.pyc", 50),
    ):
        path = tmp_path / name
        path.parent.mkdir(exist_ok=True)
        path.write_text("")
        os.utime(path, (second, second))
    return tmp_path


def names(package):
    return {path.suffix for path in (package / "__pycache__").iterdir()}


def test_caches_newer_than_all_modules_stay(package):
    assert remove_stale_caches(package) == 0
    assert names(package) == {".nbi", ".nbc", ".pyc"}


def test_a_change_in_any_module_removes_all_caches_and_nothing_else(package):
    os.utime(package / "inner" / "called.py", (300, 300))
    assert remove_stale_caches(package) == 2
    assert names(package) == {".pyc"}


def test_caches_made_after_the_change_stay(package):
    os.utime(package / "inner" / "called.py", (300, 300))
    os.utime(package / "__pycache__" / "caller.f-1.py311.nbi", (301, 301))
    assert remove_stale_caches(package) == 1
    assert names(package) == {".nbi", ".pyc"}
