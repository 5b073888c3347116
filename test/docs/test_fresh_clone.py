"""The blocks of the pages that install something run as they are shown, in a fresh clone."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

from docs.shown import supply
from docs.test_pages import FENCED, INDENTED, PAGES, ROOT, text_of

INSTALLS = re.compile(r"pip install '\.\[|make (demo|setup|benchmark)\b")
SERVES = re.compile(
    r"nics watch|mujoco_node"
)  # until Ctrl-C: tests of their own run these
OWN = "python3 -m venv venv && . venv/bin/activate"
OF_OTHERS = (
    "PYTHONPATH",
    "VIRTUAL_ENV",
    "LD_LIBRARY_PATH",
    "_ROS_WHEELS_BOOTSTRAP_COMPLETE",
)


def blocks() -> dict[str, list[str]]:
    """The lines of each block, by page and place; developers type others in `make test-all`."""
    found: dict[str, list[str]] = {}
    for page in PAGES:
        for k, text in enumerate(INDENTED.findall(FENCED.sub("", text_of(page)))):
            lines = textwrap.dedent(text).splitlines()
            there = page.name == "CONTRIBUTING.md" or lines in found.values()
            if not there and any(map(INSTALLS.match, lines)):
                found[f"{page.stem}-{k}"] = lines
    return found


def environment() -> dict[str, str]:
    """What a reader's shell has: nothing of the environment that runs the tests."""
    mine = Path(sys.prefix) / "bin"
    path = [each for each in os.environ["PATH"].split(os.pathsep) if Path(each) != mine]
    clean = {key: value for key, value in os.environ.items() if key not in OF_OTHERS}
    return clean | {"PATH": os.pathsep.join(path)}


@pytest.mark.process
@pytest.mark.skipif(
    not (ROOT / ".git").exists(), reason="needs the repository, to clone it"
)
@pytest.mark.timeout(2400)
@pytest.mark.parametrize("lines", blocks().values(), ids=blocks().keys())
def test_a_block_that_installs_something_runs_in_a_fresh_clone(lines, tmp_path):
    clone = tmp_path / "clone"
    subprocess.run(["git", "clone", "--quiet", str(ROOT), str(clone)], check=True)
    for line in lines:
        if line.startswith("nics "):
            supply(line, clone)
    lines = [line for line in lines if not SERVES.match(line)]
    if lines[0].startswith("pip "):
        lines = [OWN, *lines]
    done = subprocess.run(
        ["bash", "-e", "-c", "\n".join(lines)],
        cwd=clone,
        env=environment(),
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
    )
    measured = "met their bars: " in done.stdout and " broken " not in done.stdout
    assert done.returncode == 0 or measured, done.stdout  # a speed may be missed here
