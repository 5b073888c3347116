"""What the files say of an installation, against each other."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
SETUP = (ROOT / "setup.py").read_text(encoding="utf-8")


@pytest.mark.parametrize("name", ["README.md", "docs/install.md", "Makefile"])
def test_the_versions_of_python_are_those_of_setup(name):
    low, high = re.search(r'python_requires=">=3\.(\d+),<3\.(\d+)"', SETUP).groups()
    text = (ROOT / name).read_text(encoding="utf-8")
    told = set(re.findall(r"3\.(\d+) to 3\.(\d+)", text))
    assert told == {(low, str(int(high) - 1))}


def test_the_page_on_installing_has_every_extra_that_users_need():
    extras = set(re.findall(r'^    "(\w+)": \[', SETUP, re.MULTILINE)) - {"test"}
    page = (ROOT / "docs" / "install.md").read_text(encoding="utf-8")
    assert extras | {"all", "dev"} == set(
        re.findall(r"^\| `([\w-]+)` \|", page, re.MULTILINE)
    )
