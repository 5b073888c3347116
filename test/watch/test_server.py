from __future__ import annotations

import logging
import socket
import sys
import threading
import urllib.error
import urllib.request
from contextlib import closing
from functools import partial

import pytest
from browser import until
from robots import direct_model, field

from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.watch import server as module
from nics_drl_bridge.watch.frame import Frame, Stage, WorldFrame
from nics_drl_bridge.watch.server import PageServer
from watch.rig import Client, shot

STAGE = Stage("a title", direct_model(), (field(count=0),))


@pytest.fixture
def server():
    with closing(PageServer(port=0)) as running:
        yield running


def talk(server, text):
    """A connection that has sent a text."""
    address, port = server.url.removeprefix("http://").strip("/").split(":")
    page = socket.create_connection((address, int(port)), timeout=30)
    page.sendall(text.encode())
    return page


def handshake(server):
    """What a browser sends to open the socket."""
    host = server.url.removeprefix("http://").strip("/")
    return (
        f"GET /socket HTTP/1.1\r\nHost: {host}\r\nConnection: Upgrade\r\nUpgrade: websocket\r\n"
        "Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n\r\n"
    )


def get(url, **headers):
    """Status, headers and text of an answer."""
    asked = urllib.request.Request(url, headers=headers)
    try:
        with urllib.request.urlopen(asked, timeout=30) as answer:
            return answer.status, answer.headers, answer.read().decode()
    except urllib.error.HTTPError as error:
        return error.code, error.headers, ""


def test_this_machine_gets_one_page_that_may_load_nothing_from_elsewhere(server):
    assert server._server.socket.getsockname()[0] == "127.0.0.1"
    status, headers, page = get(server.url)
    assert status == 200
    assert page.startswith("<!doctype html>")
    assert "http://" not in page
    assert "https://" not in page
    assert "default-src 'none'" in headers["Content-Security-Policy"]
    assert get(server.url, Host="rebound.example")[0] == 403
    assert get(f"{server.url}else")[0] == 404


@pytest.mark.parametrize("header", ["Host", "Origin"])
def test_a_header_that_stands_twice_is_refused_as_a_foreign_one_is(server, header):
    own = server.url.removeprefix("http://").strip("/")
    twice = f"Host: {own}\r\n" + f"{header}: {own}\r\n" + f"{header}: evil.example\r\n"
    with talk(server, f"GET /socket HTTP/1.1\r\n{twice}\r\n") as page:
        assert page.recv(12, socket.MSG_WAITALL) == b"HTTP/1.1 403"


def test_the_page_of_a_foreign_site_can_not_open_the_socket(server):
    from websockets.exceptions import InvalidStatus
    from websockets.sync.client import connect

    address = f"{server.url.replace('http', 'ws')}socket"
    with (
        pytest.raises(InvalidStatus, match="403"),
        connect(address, origin="https://evil.example"),
    ):
        pass
    with connect(address, origin=server.url.rstrip("/")):
        pass


def test_who_comes_late_sees_the_newest_stage_and_frame(server):
    server.set_stage(STAGE)
    for seconds in (1.0, 2.0):
        server.publish(Frame(seconds, (WorldFrame(shot()),)), paused=True)
    with closing(Client(server)) as client:
        assert client.next("stage")["title"] == "a title"
        frame = client.next("frame")
        assert (frame["time"], frame["paused"]) == (2.0, True)
        server.publish(Frame(3.0, (WorldFrame(shot()),)))
        assert client.next("frame")["time"] == 3.0


def test_requests_arrive_and_nonsense_is_told_in_a_sentence(server):
    with closing(Client(server)) as client:
        until(lambda: server.watched, "the page")
        client.ask("goal", x=1.0, y=-2.0)
        request = server.request(30.0)
        assert (request.kind, request.x, request.y) == ("goal", 1.0, -2.0)
        for nonsense in (
            "no json",
            '{"kind": "fly"}',
            '{"kind": "goal", "x": 1e999}',
            "[]",
        ):
            client.socket.send(nonsense)
            assert "the page sent an invalid request" in client.next("notice")["text"]
        assert server.request(0.0) is None
    until(lambda: not server.watched, "the end of the page")


def test_a_page_that_floods_the_server_does_not_fill_its_memory(server):
    with closing(Client(server)) as client:
        until(lambda: server.watched, "the page")
        for _ in range(module.MOST_REQUESTS + 50):
            client.ask("step")
        client.socket.send("no json")
        client.next("notice")  # so all before it has been read
    taken = 0
    while server.request(0.0):
        taken += 1
    assert taken == module.MOST_REQUESTS


def test_a_page_that_reads_nothing_does_not_hold_up_the_end(server):
    with talk(server, handshake(server)) as page:
        until(lambda: server.watched, "the page")
        server.tell("x" * 50_000_000)  # more than all buffers between the two hold
        page.recv(100_000, socket.MSG_WAITALL)  # its beginning: the rest is stuck
        end = threading.Thread(target=server.close, daemon=True)
        end.start()
        end.join(9.0)  # a farewell would be awaited for 10 s
        assert not end.is_alive()


def test_a_page_that_falls_asleep_or_errs_is_no_traceback(monkeypatch):
    import websockets.sync.server as library

    handler = logging.Handler()
    heard = []
    handler.emit = heard.append
    monkeypatch.setattr(logging.root, "handlers", [handler])
    waits = {"ping_interval": 0.05, "ping_timeout": 0.05, "close_timeout": 0.05}
    quick = partial(library.serve, **waits)
    monkeypatch.setattr(library, "serve", quick)
    with closing(PageServer(port=0)) as server:
        with talk(server, handshake(server)):
            until(lambda: server.watched, "the page")
            until(lambda: not server.watched, "that its silence is noticed")
        with talk(server, "no request\r\n\r\n") as page:
            page.recv(1000)
    assert not heard


def test_a_taken_port_and_a_missing_library_are_one_sentence(server, monkeypatch):
    port = int(server.url.rsplit(":", 1)[1].strip("/"))
    told = rf"^port {port} of 127\.0\.0\.1 can't be served \(Address already in use\); .*--port"
    with pytest.raises(ConfigError, match=told):
        PageServer(port)
    monkeypatch.setitem(sys.modules, "websockets.sync.server", None)
    with pytest.raises(ConfigError, match=r"pip install 'nics_drl_bridge\[view\]'"):
        PageServer(port=0)
