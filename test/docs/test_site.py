"""The site: made from the code without a warning, and readable without a network."""

from __future__ import annotations

import re
import subprocess
import sys
import threading
from contextlib import closing
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest
from browser import Browser, needs_chromium, until

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """The folder of the site, built without a warning."""
    folder = tmp_path_factory.mktemp("site")
    command = [
        sys.executable,
        "-m",
        "mkdocs",
        "build",
        "--strict",
        "--site-dir",
        str(folder),
    ]
    done = subprocess.run(
        command, cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return folder


@pytest.mark.process
@pytest.mark.slow
@pytest.mark.timeout(900)
def test_the_site_asks_for_nothing_outside(site):
    asked = re.compile(
        r"""<(?:script|img|iframe)[^>]*\ssrc="https?:|<link[^>]*\shref="https?:"""
    )
    pages = list(site.rglob("*.html"))
    assert len(pages) > 50
    canonical = re.compile(r'<link rel="canonical"[^>]*>')
    for page in pages:
        text = canonical.sub("", page.read_text(encoding="utf-8"))
        assert not asked.search(text), page


class Quiet(SimpleHTTPRequestHandler):
    """Serves files without a word."""

    def log_message(self, *_):
        pass


@needs_chromium
@pytest.mark.process
@pytest.mark.slow
@pytest.mark.timeout(900)
def test_a_browser_shows_every_page_of_the_site_without_a_flaw(site, tmp_path):
    with (
        ThreadingHTTPServer(
            ("127.0.0.1", 0), partial(Quiet, directory=str(site))
        ) as server,
        closing(Browser(tmp_path)) as browser,
    ):
        threading.Thread(target=server.serve_forever, daemon=True).start()
        (tmp_path / "flawed.html").write_text(
            "<img src=none.png><p style='width: 2000px'>x"
        )
        assert len(browser.flaws((tmp_path / "flawed.html").as_uri())) >= 3
        for page in site.rglob("*.html"):
            name = page.relative_to(site).as_posix()
            assert browser.flaws(f"http://127.0.0.1:{server.server_port}/{name}") == []
        server.shutdown()


@needs_chromium
@pytest.mark.process
@pytest.mark.slow
@pytest.mark.timeout(900)
def test_a_word_typed_into_the_search_of_the_site_on_disk_finds_its_page(
    site, tmp_path
):
    with closing(Browser(tmp_path)) as browser:
        field = "document.querySelector('.md-search__input')"
        browser.open((site / "index.html").as_uri(), 1280, 800, ready=f"!!{field}")
        browser.ask(f"{field}.focus()")
        browser.call("Input.insertText", text="covariance")
        first = "document.querySelector('.md-search-result__link')?.href"
        assert until(lambda: browser.ask(first), "a result").startswith(site.as_uri())
        assert browser.complaints == []
