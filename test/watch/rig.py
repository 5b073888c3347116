"""A source whose every frame is known, a client of the page's socket, and a headless browser."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import threading
import time
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import replace

import numpy as np
import pytest
from robots import direct_model, field

from nics_drl_bridge.env.bridge_env import BridgeEnv
from nics_drl_bridge.env.snapshot import Snapshot
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.watch.episode import EpisodeSource
from nics_drl_bridge.watch.server import PageServer
from nics_drl_bridge.watch.show import show

DEADLINE_S = 60.0
CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser"))), None)
needs_chromium = pytest.mark.skipif(
    CHROMIUM is None, reason="needs Chromium (Debian: apt-get install chromium)"
)


def shot(**changes) -> Snapshot:
    """One robot at (1 m, 0 m), heading 90 degrees, amid 72 beams of 1 m; one disc."""
    pose = np.array([[1.0, 0.0, np.pi / 2]])
    body = np.array([[1.0, 1.5, 0.0, 1.0, 0.0, 0.25, 0.0]])
    known = Snapshot(pose, np.ones((1, 72), np.float32), body, np.array([[2.0, 0.5]]))
    return replace(known, **changes)


class Forward:
    """A policy that drives forward."""

    def act(self, observation):
        return np.array([1.0, 0.0, 0.0], np.float32)


def source(count: int = 2, seed: int = 3, model=None) -> EpisodeSource:
    """Episodes of a robot that drives straight ahead among some discs, in a field of 6 m."""
    model = model or direct_model()

    def make(policy, world):
        env = BridgeEnv(model=model, world=world, estimator=True)
        if policy == "broken":
            raise ConfigError("policy 'broken': it does not open.")
        return env, Forward()

    return EpisodeSource(make, "forward", [field(count=count)], seed)


def until(condition, what: str):
    """The first value of a condition that holds."""
    deadline = time.monotonic() + DEADLINE_S
    while not (found := condition()):
        assert time.monotonic() < deadline, f"never came: {what}"
        time.sleep(0.005)
    return found


class Client:
    """A program that speaks to the page's socket."""

    def __init__(self, server: PageServer) -> None:
        from websockets.sync.client import connect

        address = f"{server.url.replace('http', 'ws')}socket"
        self._open = ExitStack()
        self.socket = self._open.enter_context(connect(address, max_size=None))

    def ask(self, kind: str, **about) -> None:
        self.socket.send(json.dumps({"kind": kind, **about}))

    def next(self, kind: str, fits=lambda message: True):
        """The next message of a kind that fits."""
        deadline = time.monotonic() + DEADLINE_S
        while True:
            message = json.loads(self.socket.recv(timeout=max(0.0, deadline - time.monotonic())))
            if message["kind"] == kind and fits(message):
                return message

    def close(self) -> None:
        self._open.close()


@contextmanager
def shown(of):
    """A source on a page: the server, and a client that has opened it."""
    with closing(PageServer(port=0)) as server:
        thread = threading.Thread(target=show, args=(of, server), daemon=True)
        thread.start()
        with closing(Client(server)) as client:
            yield server, client
    thread.join(DEADLINE_S)
    assert not thread.is_alive()


class Browser:
    """Headless Chromium by its DevTools protocol; `complaints` are errors of the page."""

    FLAGS = (
        "--headless=new", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run",
        "--disable-background-networking", "--disable-component-update", "--disable-sync",
        "--remote-debugging-port=0", "about:blank",
    )  # fmt: skip

    def __init__(self, folder) -> None:
        from websockets.sync.client import connect

        command = [CHROMIUM, f"--user-data-dir={folder}", *self.FLAGS]
        self._process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
        lines = (re.search(r"ws://\S+", line) for line in self._process.stderr)
        self._open = ExitStack()
        address = next(filter(None, lines))[0]
        self._socket = self._open.enter_context(connect(address, max_size=None))
        threading.Thread(target=self._process.stderr.read, daemon=True).start()
        self._count, self._session, self.events = 0, {}, []
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        attached = self.call("Target.attachToTarget", targetId=target, flatten=True)
        self._session = {"sessionId": attached["sessionId"]}
        for domain in ("Page", "Runtime", "Log"):
            self.call(f"{domain}.enable")

    def call(self, method: str, **params):
        self._count += 1
        order = {"id": self._count, "method": method, "params": params, **self._session}
        self._socket.send(json.dumps(order))
        while True:
            answer = json.loads(self._socket.recv(timeout=DEADLINE_S))
            if answer.get("id") == self._count:
                assert "error" not in answer, answer
                return answer["result"]
            self.events.append(answer)

    def open(self, url: str, width: int, height: int) -> None:
        size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": width < 760}
        self.call("Emulation.setDeviceMetricsOverride", **size)
        self.call("Page.navigate", url="about:blank")  # ends what shows an earlier server
        self.ask("0")
        self.events.clear()
        self.call("Page.navigate", url=url)
        until(lambda: self.ask("!!(window.nics && nics.counters.draws > 2)"), "a drawn frame")

    def ask(self, expression: str):
        how = {"returnByValue": True, "awaitPromise": True}
        done = self.call("Runtime.evaluate", expression=expression, **how)
        assert "exceptionDetails" not in done, done["exceptionDetails"]
        return done["result"].get("value")

    def mouse(self, kind: str, x: float, y: float) -> None:
        count = {} if kind == "Moved" else {"clickCount": 1}
        event = {"type": f"mouse{kind}", "x": x, "y": y, "button": "left", **count}
        self.call("Input.dispatchMouseEvent", **event)

    @property
    def complaints(self) -> list:
        self.ask("0")  # takes in what has come
        bad = ("error", "warning", "assert")
        return [
            event["params"]
            for event in self.events
            if event["method"] == "Runtime.exceptionThrown"
            or event.get("params", {}).get("entry", {}).get("level") in bad
            or (event["method"] == "Runtime.consoleAPICalled" and event["params"]["type"] in bad)
        ]

    def close(self) -> None:
        with suppress(Exception):
            self._open.close()
        self._process.terminate()
        self._process.wait(DEADLINE_S)
