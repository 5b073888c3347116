from __future__ import annotations

import json
import re
import sys
from pathlib import Path

from command_line import nics

from nics_drl_bridge.commands.installation import EXTRAS, checks


def test_the_doctor_tells_what_works_on_this_machine(tmp_path):
    told = nics("doctor --install --json", cwd=tmp_path)
    assert told.returncode == 0, told.stderr
    parts = {each["part"]: each for each in json.loads(told.stdout)["checks"]}
    assert {
        "Python",
        "ROS 2",
        "cores",
        "kernels",
        *(f"extra {name}" for name in EXTRAS),
    } <= set(parts)
    assert parts["Python"]["works"]
    assert "of " in parts["kernels"]["found"]


def test_a_missing_extra_comes_with_the_command_that_installs_it(monkeypatch):
    checks()  # imports all that looks for modules on its own
    for module in ("tensorboard", "rclpy"):
        monkeypatch.setitem(sys.modules, module, None)
    found = {each.part: each for each in checks()}
    assert not found["extra train"].works
    assert "'tensorboard' is missing" in found["extra train"].found
    assert found["extra train"].fix == "pip install 'nics_drl_bridge[train]'"
    assert "pip install 'nics_drl_bridge[ros]'" in found["ROS 2"].fix


def test_every_extra_that_all_brings_is_examined():
    setup = (Path(__file__).parents[2] / "setup.py").read_text(encoding="utf-8")
    brought = re.search(r"for name in \((.*?)\)", setup, re.DOTALL)
    names = re.findall(r'"(\w+)"', brought[1])
    assert "bags" in names
    assert set(names) <= set(EXTRAS)
