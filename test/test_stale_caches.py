from __future__ import annotations

import os

import pytest
import stale_caches


@pytest.fixture
def package(tmp_path):
    folder = tmp_path / "package"
    write(folder / "caller.py", "from package.inner import called\n", 100)
    write(folder / "inner" / "called.py", "import package.inner.far\n", 100)
    write(folder / "inner" / "far.py", "", 100)
    write(folder / "beside.py", "", 100)
    for name in ("caller.f-1.py311.nbi", "caller.f-1.py311.1.nbc", "beside.g-1.py311.nbi"):
        write(folder / "__pycache__" / name, "", 200)
    write(folder / "__pycache__" / "caller.cpython-311.pyc", "", 50)
    assert cleared(folder) == 0  # notes what they were compiled from
    return folder


def write(path, text, second=None):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    if second is not None:
        os.utime(path, (second, second))


def cleared(package):
    stale_caches._imports.cache_clear()
    stale_caches._digest.cache_clear()
    return stale_caches.remove_stale_caches(package)


def caches(package):
    return {path.name for path in (package / "__pycache__").glob("*.nb[ic]")}


def test_caches_stay_while_the_content_stays(package):
    os.utime(package / "inner" / "far.py", (300, 300))
    assert cleared(package) == 0
    assert len(caches(package)) == 3


@pytest.mark.parametrize("changed", ["caller.py", "inner/called.py", "inner/far.py"])
def test_a_change_of_what_a_module_imports_removes_its_caches_alone(package, changed):
    write(package / changed, (package / changed).read_text() + "x = 1\n", 50)
    assert cleared(package) == 2
    assert caches(package) == {"beside.g-1.py311.nbi"}
    assert (package / "__pycache__" / "caller.cpython-311.pyc").exists()


def test_caches_compiled_after_the_change_stay(package):
    write(package / "inner" / "far.py", "x = 1\n")
    assert cleared(package) == 2
    write(package / "__pycache__" / "caller.f-1.py311.nbi", "")
    assert cleared(package) == 0


def test_without_a_note_caches_older_than_the_code_go(package):
    (package / "__pycache__" / "caller.closure").unlink()
    write(package / "inner" / "far.py", "", 300)
    assert cleared(package) == 2


def test_caches_of_a_module_that_is_gone_go(package):
    (package / "beside.py").unlink()
    assert cleared(package) == 1
