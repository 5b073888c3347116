from __future__ import annotations

import gc
import os
import re
import signal
from collections import defaultdict
from collections.abc import Generator
from importlib.util import find_spec
from pathlib import Path

import pytest

from nics_drl_bridge.nodes.transport import set_transport

ROOT = Path(__file__).resolve().parents[1]

# One thread for linear algebra, here and in children, set before numpy is loaded: the workers fill
# the cores, and threads of BLAS that wait for each other multiply the time of small problems.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
set_transport(os.environ)

# Rings of tests that `make test` leaves out; CONTRIBUTING.md describes them. A whole file is moved
# to a ring by its row here, a single test by the ring's name as a mark.
RINGS = {
    "docs": "examples, notebooks, commands and Python of the pages, and the site in a browser",
    "package": "wheels, source archives and installations of every kind",
    "campaign": "long proofs of a promise, before a release",
}
FILES = {
    "test_examples.py": "docs",
    "docs/test_notebooks.py": "docs",
    "docs/test_shown_commands.py": "docs",
    "docs/test_shown_python.py": "docs",
    "docs/test_site.py": "docs",
    "docs/test_fresh_clone.py": "package",
    "benchmarks/test_benchmarks.py": "campaign",
    "identify/test_drives_of_others.py": "campaign",
}

# About what a test takes on two busy cores, by its marks [s].
USUAL_S = {"process": 3.0, "ros": 1.5, "slow": 1.5}

# A run with `-m "not (a or b)"` leaves out whole files, before it imports what they need.
LEFT_OUT = re.compile(r"not \((\w+(?: or \w+)*)\)")
FILE_MARKS = re.compile(r"^pytestmark = (.*)$", re.MULTILINE)


def pytest_configure(config: pytest.Config) -> None:
    """Registers the rings, and lets SIGINT interrupt again, here and in all children.

    A shell starts a background job, as in `make test &` of a script, with SIGINT ignored, and every
    process below it inherits that: Ctrl-C could not be tested.
    """
    for ring, content in RINGS.items():
        config.addinivalue_line("markers", f"{ring}: {content}")
    if missing := [name for name in FILES if not (ROOT / "test" / name).is_file()]:
        raise pytest.UsageError(f"FILES of {__file__}: no such file: {missing}")
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def left_out(config: pytest.Config) -> set[str]:
    """The marks of tests that this run leaves out."""
    match = LEFT_OUT.fullmatch(config.option.markexpr)
    return set(match[1].split(" or ")) if match else set()


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Ignores a file of which every test is left out."""
    if collection_path.suffix != ".py" or not left_out(config):
        return None
    marks = {FILES.get(os.path.relpath(collection_path, ROOT / "test"))}
    match = FILE_MARKS.search(collection_path.read_text(encoding="utf-8"))
    if match:
        marks |= set(re.findall(r"pytest\.mark\.(\w+)", match[1]))
    return True if marks & left_out(config) else None


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """Keeps the garbage collector away from modules and tests, a million objects that stay."""
    gc.disable()
    collected = yield
    gc.freeze()
    gc.enable()
    return collected


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Marks every test with the ring of its file, and puts long files first.

    Otherwise a worker that takes a long file last keeps the others waiting.
    """
    seconds: defaultdict[Path, float] = defaultdict(float)
    for item in items:
        file = os.path.relpath(item.path, ROOT / "test")
        if file in FILES:
            item.add_marker(FILES[file])
        usual = [USUAL_S.get(mark.name, 0.0) for mark in item.iter_markers()]
        seconds[item.path] += max(usual, default=0.0)
    items.sort(key=lambda item: -seconds[item.path])


def pytest_report_header(config: pytest.Config) -> str:
    if "ros" in left_out(config):
        return "ROS 2: its tests are left out"
    if find_spec("rclpy") is None:
        return "ROS 2: none, its tests skip or are left out"
    distribution = os.environ.get("ROS_DISTRO", "from wheels")
    return f"ROS 2: {distribution}, {os.environ.get('RMW_IMPLEMENTATION', 'its usual middleware')}"


def find_shared(name: str) -> Path:
    """A folder of data that lies beside the repository."""
    folder = ROOT.parent / "shared" / name
    if not folder.is_dir():
        pytest.skip(f"needs the {name} of others, which are not at {folder}")
    return folder


@pytest.fixture(scope="session")
def shared_recordings() -> Path:
    """Real recordings."""
    return find_shared("recordings")


@pytest.fixture(scope="session")
def shared_barn() -> Path:
    """Gazebo worlds and tables of the benchmark BARN, as its authors gave them."""
    return find_shared("barn")
