"""The roads of a newcomer, by the commands of the pages."""

from __future__ import annotations

import shlex
from importlib import import_module
from textwrap import dedent

import pytest
from docs.test_pages import INDENTED, ROOT, check_options, text_of
from PIL import Image

from nics_drl_bridge.robot.spec import load_robot

from .runs import BENCHMARKS, fails

SCRIPT = "first_hour.py"
GOOD = {
    "seconds": {"picture": 100.0, "robot": 300.0, "recording": 60.0, "task": 200.0},
    "success": {"robot": 0.95, "task": 0.9},
    "moved_pixels": 200,
    "report_bytes": 9000,
}


@pytest.fixture
def first_hour(monkeypatch):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    return import_module("first_hour")


@pytest.mark.parametrize(
    ("changed", "sentence"),
    [
        ({}, None),
        ({"seconds": {"picture": 200.0}}, "picture: took 200 s"),
        ({"success": {"robot": 0.88}}, "robot: success 88.0%"),
        ({"moved_pixels": 3}, "picture: 3 pixels differ"),
        ({"report_bytes": 0}, "recording: there is no report"),
    ],
)
def test_each_bar_can_be_missed(first_hour, changed, sentence):
    missed = first_hour.missed_of(GOOD | changed)
    assert [line[: len(sentence)] for line in missed] == (
        [] if sentence is None else [sentence]
    )


def test_a_picture_moves_if_its_ends_differ(first_hour, tmp_path):
    still, shifted = (Image.new("RGB", (100, 80), "white") for _ in range(2))
    still.paste("black", (10, 10, 20, 20))
    shifted.paste("black", (60, 30, 70, 40))
    for name, last, extent in (
        ("moving.gif", shifted, 60),
        ("still.gif", still.copy(), 0),
    ):
        still.save(tmp_path / name, save_all=True, append_images=[shifted, last])
        assert first_hour.moved(tmp_path / name) == extent


def test_every_command_and_option_of_a_road_exists(first_hour):
    for lines in first_hour.ROADS.values():
        for line in lines:
            check_options(shlex.split(line)[1:])


def test_the_robot_is_that_of_the_page(first_hour, tmp_path):
    text = text_of(ROOT / "docs" / "robots.md")
    (shown,) = [block for block in INDENTED.findall(text) if "name: my_robot" in block]
    for name, content in (
        ("page.yaml", dedent(shown)),
        ("road.yaml", first_hour.BURGER),
    ):
        (tmp_path / name).write_text(content)
    assert load_robot(tmp_path / "page.yaml") == load_robot(tmp_path / "road.yaml")


@pytest.mark.process
@pytest.mark.campaign
@pytest.mark.timeout(3600)
def test_a_policy_that_has_not_learnt_does_not_get_there():
    missed = fails(SCRIPT, "untrained", "--roads", "robot", timeout_s=3000.0)
    assert missed[0].startswith("robot: success")
