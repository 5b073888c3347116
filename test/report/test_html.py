import base64
import re
from html.parser import HTMLParser

import pytest

from nics_drl_bridge.report.html import (
    make_bullets,
    make_code,
    make_details,
    make_page,
    make_paragraph,
    make_picture,
    make_table,
    make_tiles,
)

VOID = {"meta", "img", "br"}


class Checker(HTMLParser):
    """Collects text and makes sure that every tag is closed in order."""

    def __init__(self):
        super().__init__()
        self.open = []
        self.tags = []
        self.text = ""

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


def test_a_page_is_well_formed_and_what_is_folded_is_open_in_print():
    blocks = [
        make_paragraph("a paragraph"),
        make_table(["name", "value"], [["speed", "1.5"]]),
        make_details("All figures", [make_code("x = 1\ny = 2")]),
    ]
    html = make_page("Title", "a lead", [("First", blocks), ("Second", [])])
    found = parsed(html)
    for text in ("Title", "a lead", "First", "a paragraph", "1.5", "x = 1\ny = 2"):
        assert text in found.text
    for tag, count in {"h2": 2, "tr": 2, "details": 1, "summary": 1}.items():
        assert found.tags.count(tag) == count
    assert "<details open" not in html
    assert "details::details-content" in html.partition("@media print")[2]


def test_text_is_never_taken_for_markup():
    evil = "<script>alert('1 & 2')</script>"
    blocks = [
        make_paragraph(evil),
        make_code(evil),
        make_table([evil], [[evil]]),
        make_picture(b"png", evil + '"'),
    ]
    blocks += [
        make_bullets([evil]),
        make_tiles([(evil, evil, True)]),
        make_details(evil, []),
    ]
    html = make_page(evil, evil, [(evil, blocks)])
    found = parsed(html)
    assert "script" not in found.tags
    assert (
        found.text.count(evil) == 13
    )  # title, heading, lead, section, caption, and the blocks
    assert html.count('alt="') == 1


def test_a_page_needs_no_other_file():
    html = make_page("t", "l", [("s", [make_picture(b"\x89PNG", "c")])])
    source = re.search(r'src="data:image/png;base64,([^"]+)"', html)
    assert base64.b64decode(source[1]) == b"\x89PNG"
    assert "http" not in html
    assert "<link" not in html


@pytest.mark.parametrize(("good", "sign"), [(True, False), (False, True)])
def test_a_doubtful_figure_is_told_by_a_sign_and_not_by_its_colour_alone(good, sign):
    assert ("⚠" in parsed(make_tiles([("93 %", "of the episodes", good)])).text) is sign


@pytest.mark.parametrize(("width", "wide"), [(700, False), (701, True)])
def test_a_phone_scrolls_a_picture_that_it_can_not_show_in_whole(width, wide):
    png = b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR" + width.to_bytes(4, "big") + bytes(9)
    assert ('<figure class="wide">' in make_picture(png, "c")) is wide
