from __future__ import annotations

import base64
import io
import re
from html.parser import HTMLParser

import numpy as np
import pytest
from PIL import Image

from nics_drl_bridge.policy.evaluation import Episode
from nics_drl_bridge.report.page import Code, Picture, Table, page
from nics_drl_bridge.report.pictures import trajectories

WALLS = np.array([[-3.0, -3.0, 3.0, -3.0]])
VOID = {"meta", "img", "br"}


class Checker(HTMLParser):
    """Collects text and makes sure that every tag is closed in order."""

    def __init__(self):
        super().__init__()
        self.open, self.tags, self.text = [], [], ""

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text += data


def parsed(html):
    checker = Checker()
    checker.feed(html)
    checker.close()
    assert not checker.open
    return checker


def episode(seed=0, result="success", steps=20):
    t = np.linspace(0.0, 1.0, steps + 1)
    path = np.stack([t, t**2 * (seed + 1), t], axis=1)
    circles = np.array([[1.0, 1.0, 0.25]])
    return Episode(seed, result, path, path, np.array([1.0, 1.0]), circles, 3.0)


def test_a_page_is_well_formed_and_holds_what_it_was_given():
    blocks = ["a paragraph", Table(["name", "value"], [["speed", "1.5"]]), Code("x = 1\ny = 2")]
    found = parsed(page("Title", "a lead", [("First", blocks), ("Second", [])]))
    for text in ("Title", "a lead", "First", "a paragraph", "speed", "1.5", "x = 1\ny = 2"):
        assert text in found.text
    assert found.tags.count("h2") == 2
    assert found.tags.count("tr") == 2


def test_text_is_never_taken_for_markup():
    evil = "<script>alert('1 & 2')</script>"
    blocks = [evil, Code(evil), Table([evil], [[evil]]), Picture(b"png", evil + '"')]
    html = page(evil, evil, [(evil, blocks)])
    found = parsed(html)
    assert "script" not in found.tags
    assert found.text.count(evil) == 9  # title, heading, lead, section, 4 blocks, caption
    assert html.count('alt="') == 1


def test_a_page_needs_no_other_file():
    html = page("t", "l", [("s", [Picture(b"\x89PNG", "c")])])
    source = re.search(r'src="data:image/png;base64,([^"]+)"', html)
    assert base64.b64decode(source[1]) == b"\x89PNG"
    assert "http" not in html
    assert "<link" not in html


def decoded(png):
    image = Image.open(io.BytesIO(png))
    image.load()
    assert image.format == "PNG"
    return np.asarray(image.convert("RGB"))


@pytest.mark.parametrize("count", [1, 2, 3, 4, 7])
def test_there_is_one_panel_per_episode(count):
    episodes = [episode(seed) for seed in range(count)]
    image = decoded(trajectories({"one": episodes, "two": episodes}, WALLS, 0.2))
    assert image.shape[0] > 400 * -(-count // 3)
    assert image.std() > 5.0


def test_another_path_gives_another_picture():
    pictures = [trajectories({"run": [episode(seed)]}, WALLS, 0.2) for seed in (0, 0, 1)]
    assert np.array_equal(decoded(pictures[0]), decoded(pictures[1]))
    assert not np.array_equal(decoded(pictures[0]), decoded(pictures[2]))


def test_a_run_that_ended_early_is_drawn_as_far_as_it_went():
    runs = {"all": [episode(0), episode(1)], "short": [episode(0)]}
    decoded(trajectories(runs, WALLS, 0.2))
