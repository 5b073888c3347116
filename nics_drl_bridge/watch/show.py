"""Shows a source on the page, at a pace that the page can change."""

import os
import sys
import time
import webbrowser
from collections.abc import Callable
from contextlib import suppress
from typing import Protocol

from nics_drl_bridge.errors import BridgeError, ConfigError, suggest
from nics_drl_bridge.watch.frame import Frame, Stage
from nics_drl_bridge.watch.server import PageServer, Request

POLL_S = 0.2
MOST_FRAMES_PER_S = 60.0
SLOWEST = 0.05
FASTEST = 64.0
PACE = frozenset({"pause", "speed", "step"})
Handle = Callable[[Request], None]


class FrameSource(Protocol):
    """A source of frames that handles requests."""

    period_s: float  # time between two frames at speed 1 [s]

    def stage(self) -> Stage:
        """Returns everything that stays the same from frame to frame."""

    def frame(self) -> Frame:
        """Returns the current frame."""

    def advance(self) -> bool:
        """Advances to the next frame; returns True if the stage changed. Raises BridgeError."""

    def take(self, request: Request) -> bool:
        """Handles a page's request; returns True if the stage changed. Raises BridgeError."""

    def close(self) -> None:
        """Frees all resources."""


class Tempo:
    """Determines when the next frame is due, given the speed, pauses and single steps."""

    def __init__(self) -> None:
        self.speed = 1.0
        self.paused = False
        self._single = False
        self._due = 0.0

    def take(self, request: Request) -> None:
        """Changes the pace if the request asks for it."""
        if request.kind == "speed":
            self.speed = min(max(request.value, SLOWEST), FASTEST)
        elif request.kind in ("pause", "step"):
            self._single = request.kind == "step"
            self.paused = self._single or request.on

    def wait(self, server: PageServer, period_s: float, handle: Handle) -> bool:
        """Handles requests until the next frame is due; returns False once the server is closed."""
        while not server.closed:
            now = time.monotonic()
            going = self._single or not (self.paused and server.watched)
            if going and now >= self._due:
                self._single = False
                period_s = period_s / self.speed
                self._due = max(self._due + period_s, now)
                return True
            request = server.request(min(POLL_S, self._due - now) if going else POLL_S)
            if request is not None:
                self.take(request)
                handle(request)
        return False

    def plain(self) -> dict[str, object]:
        """Returns the pace as plain data."""
        return {"speed": self.speed, "paused": self.paused}


def check_listed(request: Request, stage: Stage) -> None:
    """Raises ConfigError for a policy or world that the page does not offer.

    Any program on this machine can write to the page's socket. So a request may only choose from
    the lists shown on the page, and can't open any other file.
    """
    if request.kind in stage.choices:
        offered = stage.choices[request.kind]
        if request.name not in offered:
            hint = suggest(request.name, offered)
            raise ConfigError(
                f"{request.kind} {request.name!r}: is not on the page's list; {hint}"
            )


def show(
    source: FrameSource,
    server: PageServer,
    is_over: Callable[[], bool] = lambda: False,
) -> None:
    """Shows a source until the server is closed, or `is_over` returns True before a frame."""
    pace = Tempo()
    shown_s = 0.0

    def publish() -> None:
        server.publish(source.frame(), **pace.plain())

    def handle(request: Request) -> None:
        try:
            check_listed(request, source.stage())
            if request.kind not in PACE and source.take(request):
                server.set_stage(source.stage())
        except BridgeError as error:
            server.tell(str(error))
        publish()

    server.set_stage(source.stage())
    publish()
    while not is_over() and pace.wait(server, source.period_s, handle):
        try:
            if source.advance():
                server.set_stage(source.stage())
        except BridgeError as error:
            server.tell(str(error))
            pace.paused = True
        if time.monotonic() - shown_s > 1.0 / MOST_FRAMES_PER_S or pace.paused:
            shown_s = time.monotonic()
            publish()


def open_page(url: str, browser: bool = True) -> None:
    """Opens the page in a browser if there is a display, or prints its address."""
    has_display = any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY"))
    if browser and (has_display or sys.platform in ("darwin", "win32")):
        with suppress(webbrowser.Error):
            if webbrowser.open(url):
                return
    sys.stderr.write(f"watch: {url}\n")
