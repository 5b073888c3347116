"""What the pages show is run: each page's `nics` lines in order, in a folder with a reader's files.

Trainings and evaluations are short here; everything else is as it stands on the page.
"""

from __future__ import annotations

import re
from importlib.util import find_spec

import pytest
from command_line import nics

from docs.shown import ELSEWHERE, lines_of, runs_here, supply, words_of
from docs.test_pages import PAGES

NEEDED = ("rosbags", "onnx", "mujoco", "torch", "rclpy")
CASES = [page for page in PAGES if any(map(runs_here, lines_of(page)))]


@pytest.mark.skipif(None in map(find_spec, NEEDED), reason="the pages use all extras")
@pytest.mark.ros
@pytest.mark.process
@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize("page", CASES, ids=lambda page: page.name)
def test_every_command_of_a_page_runs_as_it_is_shown(page, tmp_path):
    for line in filter(runs_here, lines_of(page)):
        supply(line, tmp_path)
        done = nics(*words_of(line, tmp_path), cwd=tmp_path)
        assert done.returncode == 0, f"{line}\n{done.stdout}{done.stderr}"


def test_what_is_left_to_other_tests_is_shown_somewhere():
    lines = [line for page in PAGES for line in lines_of(page)]
    assert all(any(re.match(each, line) for line in lines) for each in ELSEWHERE)
