"""Pages in a headless browser."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import threading
import time
from contextlib import ExitStack, suppress

import pytest

DEADLINE_S = 60.0
NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
CHROMIUM = os.environ.get("CHROMIUM") or next(
    filter(None, map(shutil.which, NAMES)), None
)
needs_chromium = pytest.mark.skipif(
    CHROMIUM is None, reason="needs Chromium (Debian: apt-get install chromium)"
)


def until(condition, what: str, deadline_s: float = DEADLINE_S):
    """The first value of a condition that holds."""
    deadline = time.monotonic() + deadline_s
    while not (found := condition()):
        assert time.monotonic() < deadline, f"never came: {what}"
        time.sleep(0.005)
    return found


class Browser:
    """Headless Chromium by its DevTools protocol; `complaints` are errors of the page."""

    FLAGS = (
        "--headless=new",
        "--no-sandbox",
        "--disable-gpu",
        "--disable-quic",
        "--no-first-run",
        "--disable-background-networking",
        "--disable-component-update",
        "--disable-sync",
        "--remote-debugging-port=0",
        "about:blank",
    )

    def __init__(self, folder) -> None:
        from websockets.sync.client import connect

        command = [CHROMIUM, f"--user-data-dir={folder}", *self.FLAGS]
        self._process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
        lines = (re.search(r"ws://\S+", line) for line in self._process.stderr)
        self._open = ExitStack()
        address = next(filter(None, lines))[0]
        self._socket = self._open.enter_context(connect(address, max_size=None))
        threading.Thread(target=self._process.stderr.read, daemon=True).start()
        self._count = 0
        self._session = {}
        self.events = []
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

    SHOWN = "!!(window.nics && nics.counters.draws > 2)"

    def resize(self, width: int, height: int) -> None:
        size = {
            "width": width,
            "height": height,
            "deviceScaleFactor": 1,
            "mobile": width < 760,
        }
        self.call("Emulation.setDeviceMetricsOverride", **size)

    def open(self, url: str, width: int, height: int, ready: str = SHOWN) -> None:
        self.resize(width, height)
        self.call(
            "Page.navigate", url="about:blank"
        )  # ends what shows an earlier server
        self.ask("0")
        self.events.clear()
        self.call("Page.navigate", url=url)
        until(lambda: self.ask(ready), ready)

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
            or (
                event["method"] == "Runtime.consoleAPICalled"
                and event["params"]["type"] in bad
            )
        ]

    def close(self) -> None:
        with suppress(Exception):
            self._open.close()
        self._process.terminate()
        self._process.wait(DEADLINE_S)

    def flaws(self, url: str, sizes=((1280, 800), (390, 844))) -> list:
        """What a page complains about, lacks, or does not fit into the width of a window."""
        self.open(url, *sizes[0], ready="document.readyState === 'complete'")
        found = self.complaints
        broken = (
            "[...document.images].filter(i => i.complete && !i.naturalWidth).length"
        )
        if self.ask(broken):
            found.append(f"{url}: a picture that is not there")
        for width, height in sizes:
            self.resize(width, height)
            if self.ask("document.documentElement.scrollWidth") > width:
                found.append(f"{url}: wider than {width} pixels")
        return found
