from __future__ import annotations

import pytest
from browser import until

from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.watch import show as module
from nics_drl_bridge.watch.frame import Frame, WorldFrame
from nics_drl_bridge.watch.server import Request
from nics_drl_bridge.watch.show import Tempo, open_page
from watch.rig import shot, shown
from watch.test_server import STAGE


class Counter:
    """Frames by number, of which one fails; a goal fails, a world is another stage."""

    period_s = 0.005

    def __init__(self, fails=0):
        self.count = 0
        self.fails = fails

    def stage(self):
        return STAGE

    def frame(self):
        return Frame(float(self.count), (WorldFrame(shot()),))

    def advance(self):
        self.count += 1
        if self.count == self.fails:
            raise ConfigError("this one is missing.")
        return False

    def take(self, request):
        if request.kind == "goal":
            raise ConfigError("there is no goal.")
        return request.kind == "world"


def test_a_paused_source_goes_on_step_by_step():
    with shown(Counter()) as (_, client):
        client.ask("pause", on=True)
        before = client.next("frame", lambda frame: frame["paused"])["time"]
        for k in (1, 2):
            client.ask("step")
            client.next("frame", lambda frame, k=k: frame["time"] == before + k)
        client.ask("pause", on=False)
        client.next(
            "frame", lambda frame: frame["time"] > before + 10 and not frame["paused"]
        )


def test_an_error_is_told_on_the_page_and_pauses_it():
    with shown(Counter(fails=1000)) as (_, client):
        client.next("stage")
        client.ask("world", name="other")
        client.next("stage")
        client.ask("goal")
        assert client.next("notice")["text"] == "there is no goal."
        client.ask("speed", value=64.0)
        assert client.next("notice")["text"] == "this one is missing."
        client.next("frame", lambda frame: frame["paused"])


def test_a_page_that_was_closed_while_paused_holds_nobody_up():
    source = Counter()
    with shown(source) as (_, client):
        client.ask("pause", on=True)
        client.next("frame", lambda frame: frame["paused"])
        count = source.count
        client.close()
        until(lambda: source.count > count + 5, "further frames")


@pytest.mark.parametrize(("given", "taken"), [(2.0, 2.0), (1e9, 64.0), (0.0, 0.05)])
def test_the_speed_stays_within_bounds(given, taken):
    pace = Tempo()
    pace.take(Request(kind="speed", value=given))
    assert pace.speed == taken


def test_with_a_display_the_browser_opens_it(monkeypatch, capsys):
    opened = []
    monkeypatch.setenv("DISPLAY", ":0")
    monkeypatch.setattr(
        module.webbrowser, "open", lambda url: opened.append(url) or True
    )
    open_page("http://127.0.0.1:1/")
    assert opened == ["http://127.0.0.1:1/"]
    assert capsys.readouterr().err == ""
