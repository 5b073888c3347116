"""Machine code is kept as long as nothing that it was compiled from changed, in every process."""

import os
import shutil
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from nics_drl_bridge import kernels
from nics_drl_bridge.env.kernels import scale_actions

LOW = """
from nics_drl_bridge.constants import STEP
from nics_drl_bridge.kernels import kernel

@kernel
def low(x):
    return x + STEP
"""
HIGH = """
from nics_drl_bridge.kernels import kernel
from nics_drl_bridge.low_kernels import low

@kernel
def high(x):
    return 10.0 * low(x)

@kernel(allocates=True)
def broken(x):
    return 1.0 / x
"""
OTHER = """
from nics_drl_bridge.kernels import kernel

@kernel
def other(x):
    return -x
"""
ASK = """
from nics_drl_bridge.high_kernels import broken, high
from nics_drl_bridge.other_kernels import other
print(high(1.0), other(1.0), broken(0.0))
print(sum(high._cache_misses.values()), sum(other._cache_misses.values()))
"""


@pytest.fixture
def package(tmp_path):
    folder = tmp_path / "nics_drl_bridge"
    folder.mkdir()
    shutil.copy(kernels.__file__, folder)
    for name, text in {
        "__init__.py": "",
        "constants.py": "STEP = 1.0\n",
        "low_kernels.py": LOW,
        "high_kernels.py": HIGH,
        "other_kernels.py": OTHER,
    }.items():
        (folder / name).write_text(text)
    return folder


FOR_WHEEL = """
from nics_drl_bridge.kernels import compile_for_wheel
compile_for_wheel()
"""
TARGET = {"NUMBA_CPU_NAME": kernels.TARGET, "NUMBA_CPU_FEATURES": ""}


def ask(
    package: Path, code: str = ASK, target: dict[str, str] | None = None
) -> tuple[list[float], list[int]]:
    """What the kernels give in a fresh process, and how many were compiled there."""
    # Not kept as bytecode, which an edit within the same second would leave as it was.
    env = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
    done = subprocess.run(
        [sys.executable, "-B", "-c", code],
        cwd=package.parent,
        capture_output=True,
        text=True,
        check=False,
        env=env | (target or {}),
    )
    assert done.returncode == 0, done.stderr
    values, compiled = done.stdout.splitlines()
    return [float(word) for word in values.split()], [
        int(word) for word in compiled.split()
    ]


@pytest.mark.slow
def test_kernels_are_compiled_once_and_again_after_an_edit_of_what_they_are_made_of(
    package,
):
    def edit(file, old, new):
        path = package / file
        stamp = path.stat()
        path.write_text(path.read_text().replace(old, new))
        os.utime(path, ns=(stamp.st_atime_ns, stamp.st_mtime_ns))  # by content alone

    # A division by zero is inf.
    assert ask(package) == ([20.0, -1.0, float("inf")], [1, 1])
    edit("constants.py", "1.0", "3.0")
    assert ask(package) == ([40.0, -1.0, float("inf")], [1, 0])
    files = len(list(package.rglob("*.nbi")))
    edit("high_kernels.py", "\n@kernel\ndef high", "\n\n\n@kernel\ndef high")
    edit("high_kernels.py", "10.0 *", "20.0 *")
    assert ask(package) == ([80.0, -1.0, float("inf")], [1, 0])
    assert len(list(package.rglob("*.nbi"))) == files  # a kernel that moved leaves none


@pytest.mark.slow
@pytest.mark.skipif(not kernels.runs_target(), reason=f"not {kernels.TARGET}")
def test_machine_code_that_a_wheel_carries_is_loaded_until_its_source_changes(package):
    ask(package, FOR_WHEEL + ASK, TARGET)
    shutil.rmtree(package / "__pycache__")
    package = (
        package.parent.rename(package.parent.with_name("elsewhere")) / package.name
    )
    assert ask(package) == ([20.0, -1.0, float("inf")], [0, 0])
    constants = package / "constants.py"
    constants.write_text(constants.read_text().replace("1.0", "3.0"))
    assert ask(package) == ([40.0, -1.0, float("inf")], [1, 0])


def index(folder, version="1"):
    made = kernels._Index(str(folder), "file", "stamp")
    made._version += version
    return made


def test_a_class_of_arguments_may_get_another_name(tmp_path, monkeypatch):
    module = ModuleType("renamed")
    module.Pair = type("Pair", (), {"__module__": "renamed"})
    monkeypatch.setitem(sys.modules, "renamed", module)
    index(tmp_path).save(module.Pair, "code")
    assert index(tmp_path).load(module.Pair) == "code"
    del module.Pair
    assert index(tmp_path).load("other") is None
    index(tmp_path).save("other", "other code")
    assert index(tmp_path).load("other") == "other code"


def test_of_two_processes_that_save_at_once_neither_gets_the_others_code(
    tmp_path, monkeypatch
):
    one = index(tmp_path)
    other = index(tmp_path)
    write = one._save_data
    unaware = dict

    def meanwhile(name, data):
        other._load_index = unaware  # it looked before either had saved
        other.save("of another", "another's code")
        write(name, data)

    monkeypatch.setattr(one, "_save_data", meanwhile)
    one.save("own", "own code")
    assert index(tmp_path).load("of another") in (None, "another's code")
    assert index(tmp_path).load("own") in (None, "own code")


def test_a_process_that_ends_while_it_saves_leaves_no_code_of_an_earlier_version(
    tmp_path, monkeypatch
):
    index(tmp_path, "1").save("key", "old code")
    assert index(tmp_path, "1").load("key") == "old code"
    ended = index(tmp_path, "2")
    monkeypatch.setattr(ended, "_save_data", lambda *_: None)
    ended.save("key", "new code")
    assert index(tmp_path, "2").load("key") is None


def test_a_kernel_of_ones_own_is_made_of_the_files_beside_it(tmp_path):
    folder = tmp_path / "mine"
    folder.mkdir()
    for name, text in {
        "__init__.py": "",
        "main_kernels.py": "from .helpers import half\nimport consts, numpy as np\n",
        "helpers.py": "from nics_drl_bridge import geometry\nfrom . import more\n",
        "more.py": "",
        "../consts.py": "import mine.deep as deep\n",
        "deep.py": "",
    }.items():
        (folder / name).write_text(text)
    found = set()
    left = [folder / "main_kernels.py"]
    while left:
        for each in kernels.imports_of(left.pop()):
            if each not in found and tmp_path in each.parents:
                left.append(each)
            found.add(each)
    names = {each.name for each in found if tmp_path in each.parents}
    assert names - {"__init__.py"} == {"helpers.py", "more.py", "consts.py", "deep.py"}
    assert kernels.PACKAGE / "geometry.py" in found


def test_a_bound_kernel_takes_what_its_arrays_hold_when_it_is_called():
    out = np.zeros((1, 2))
    actions = np.zeros((1, 2))
    scale = kernels.bind(scale_actions, out, actions, np.zeros(2), np.full(2, 4.0))
    for number in (-1.0, 0.0, 1.0):
        actions[:] = number
        assert scale() is True
        assert np.array_equal(out, np.full((1, 2), 2.0 + 2.0 * number))
    actions[0, 1] = np.nan
    assert scale() is False


@kernels.kernel
def _multiply_add(a: float, b: float, c: float) -> float:
    return a * b + c


@kernels.kernel(contracts=True)
def _call_it_fused(a: float, b: float, c: float) -> float:
    return _multiply_add(a, b, c)


def test_a_kernel_rounds_as_it_says_whichever_kernel_calls_it_first():
    # The product is 1 + 2 tiny + tiny^2; rounded before the sum, it loses tiny^2.
    tiny = 2.0**-27
    assert _call_it_fused(1.0 + tiny, 1.0 + tiny, -(1.0 + 2.0 * tiny)) == 0.0
