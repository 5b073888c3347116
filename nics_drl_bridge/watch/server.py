"""Serves the page to this machine only: sends frames to browsers, receives their requests."""

import json
import logging
import os
import queue
import socket
import threading
from contextlib import suppress
from importlib.resources import files
from typing import Any, Literal
from weakref import WeakSet

from pydantic import Field, ValidationError

from nics_drl_bridge import defaults
from nics_drl_bridge.config import Schema
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.extensions import require_modules
from nics_drl_bridge.seeds import GREATEST_SEED
from nics_drl_bridge.watch.frame import Frame, Stage
from nics_drl_bridge.watch.motion import MotionMeter

HOST = "127.0.0.1"
MOST_REQUESTS = 256
MOST_BYTES = 4096
# Sleeping or failing pages are not logged.
QUIET = logging.Logger("pages", logging.CRITICAL + 1)
# The page loads nothing from other hosts, and sends nothing to them.
POLICY = "; ".join(
    [
        "default-src 'none'",
        "script-src 'unsafe-inline'",
        "style-src 'unsafe-inline'",
        "img-src data:",
        "connect-src 'self' ws://{host}",
        "base-uri 'none'",
        "form-action 'none'",
        "frame-ancestors 'none'",
    ]
)


class Request(Schema):
    """A request from a page."""

    kind: Literal[
        "goal",
        "obstacle",
        "clear",
        "drive",
        "policy",
        "world",
        "seed",
        "restart",
        "seek",
        "pause",
        "speed",
        "step",
    ]
    # index of the world in the frame
    world: int = Field(default=0, ge=0, le=10_000)
    x: float = Field(default=0.0, ge=-1e8, le=1e8)  # place of a goal or obstacle [m]
    y: float = Field(default=0.0, ge=-1e8, le=1e8)
    # radius, or half the side of a box [m]
    size: float = Field(default=0.2, ge=0.01, le=10.0)
    shape: Literal["circle", "box"] = "circle"
    name: str = Field(default="", max_length=500)  # name of a policy or world
    # speed, seed, or time [s]
    value: int | float = Field(default=0.0, ge=-GREATEST_SEED, le=GREATEST_SEED)
    on: bool = True  # False ends a pause or driving by hand
    # fractions of the maximum speeds forward, to the left, and turning left
    twist: tuple[float, float, float] = (0.0, 0.0, 0.0)


class PageServer:
    """Serves the page at `url` in its own threads; slow browsers skip frames.

    Port 0 stands for any free port. Raises ConfigError if the port is taken or the library is
    missing.
    """

    def __init__(self, port: int = defaults.PAGE_PORT) -> None:
        with require_modules("the page"):
            from websockets.sync.server import serve
        self._requests: queue.Queue[Request] = queue.Queue(MOST_REQUESTS)
        self._news = threading.Condition()
        # newest stage, notice and frame
        self._texts = ["", "", ""]
        self._numbers = [0, 0, 0]
        self._pages: set[Any] = set()
        self._connections: WeakSet[Any] = WeakSet()
        self._meter = MotionMeter()
        self.closed = False

        def connect(*args: Any, **options: Any) -> Any:
            from websockets.sync.server import ServerConnection

            connection = ServerConnection(*args, **options)
            with self._news:
                self._connections.add(connection)
            return connection

        try:
            self._server = serve(
                self._serve_page,
                HOST,
                port,
                process_request=self._answer,
                create_connection=connect,  # type: ignore[arg-type]  # it is only called
                compression=None,
                max_size=MOST_BYTES,
                origins=None,
                logger=QUIET,
            )
        except OSError as error:
            reason = f"port {port} of {HOST} can't be served ({os.strerror(error.errno or 0)})"
            raise ConfigError(
                f"{reason}; choose another with --port, or 0 for any."
            ) from None
        address = f"{HOST}:{self._server.socket.getsockname()[1]}"
        self.url = f"http://{address}/"
        self._hosts = {address, address.replace(HOST, "localhost")}
        self._thread = threading.Thread(target=self._server.serve_forever, daemon=True)
        self._thread.start()

    @property
    def watched(self) -> bool:
        """True while a page is open."""
        return bool(self._pages)

    def set_stage(self, stage: Stage) -> None:
        """Changes the stage."""
        self._set(0, json.dumps(stage.plain(), separators=(",", ":")))

    def publish(self, frame: Frame, **about: Any) -> None:
        """Shows a frame with additional facts."""
        self._set(
            2, json.dumps(frame.plain(self._meter) | about, separators=(",", ":"))
        )

    def measure(self, frame: Frame) -> None:
        """Measures a frame without showing it, so that the next frame has velocities."""
        frame.measured_by(self._meter)

    def tell(self, sentence: str) -> None:
        """Shows a sentence for a while."""
        self._set(1, json.dumps({"kind": "notice", "text": sentence}))

    def _set(self, part: int, text: str) -> None:
        with self._news:
            self._texts[part] = text
            self._numbers[part] += 1
            self._news.notify_all()

    def request(self, seconds: float) -> Request | None:
        """Returns the next request of a page, or None after some time [s]."""
        try:
            return self._requests.get(seconds > 0.0, max(seconds, 0.0))
        except queue.Empty:
            return None

    def _answer(self, connection: Any, request: Any) -> Any:
        """Returns an HTTP response; None allows the page, or a program, to open the socket."""
        from websockets.datastructures import Headers
        from websockets.http11 import Response

        refuse = connection.respond
        host = ", ".join(request.headers.get_all("Host"))
        if host not in self._hosts:  # a foreign host name may point to this machine
            return refuse(403, "This page is served to this machine only.\n")
        if request.path == "/socket":
            origins = request.headers.get_all("Origin")  # empty for programs
            if all(origin.removeprefix("http://") in self._hosts for origin in origins):
                return None
            return refuse(403, "This socket is open to its own page only.\n")
        if request.path != "/":
            return refuse(404, "The only page is /.\n")
        body = files("nics_drl_bridge.watch").joinpath("page.html").read_bytes()
        about = {
            "Content-Type": "text/html; charset=utf-8",
            "Content-Length": str(len(body)),
            "Content-Security-Policy": POLICY.format(host=host),
            "Cache-Control": "no-store",
            "X-Content-Type-Options": "nosniff",
            "Connection": "close",
        }
        return Response(200, "OK", Headers(about), body)

    def _serve_page(self, page: Any) -> None:
        """Serves one page: this thread receives, another one sends."""
        from websockets.exceptions import ConnectionClosed

        with self._news:
            self._pages.add(page)
        sender = threading.Thread(target=self._send, args=(page,), daemon=True)
        sender.start()
        try:
            for text in page:
                self._take(text)
        except ConnectionClosed:
            pass
        finally:
            with self._news:
                self._pages.discard(page)
                self._news.notify_all()
            sender.join()

    def _take(self, text: str | bytes) -> None:
        try:
            with suppress(queue.Full):  # drop requests that nobody handles
                self._requests.put_nowait(Request.model_validate_json(text))
        except ValidationError as error:
            first = error.errors()[0]
            place = ".".join(map(str, first["loc"])) or "JSON"
            self.tell(f"the page sent an invalid request: {place}: {first['msg']}.")

    def _send(self, page: Any) -> None:
        from websockets.exceptions import ConnectionClosed

        sent = [0, self._numbers[1], 0]
        with suppress(ConnectionClosed):
            while texts := self._wait_for_news(page, sent):
                for text in texts:
                    page.send(text)

    def _wait_for_news(self, page: Any, sent: list[int]) -> list[str]:
        """Waits for texts newer than the numbers `sent`, and updates them; empty once closed."""
        with self._news:
            while page in self._pages and self._numbers == sent:
                self._news.wait()
            if page not in self._pages:
                return []
            rows = zip(self._texts, self._numbers, sent, strict=True)
            texts = [text for text, new, old in rows if new > old]
            sent[:] = self._numbers
        return texts

    def close(self) -> None:
        """Closes all pages and frees the port; this also ends threads that wait for a frame."""
        self.closed = True
        with self._news:
            connections = tuple(self._connections)
        for connection in connections:
            # A page that does not read would not answer a closing handshake, and a connection
            # that a browser opened in advance sends no request.
            with suppress(OSError):
                connection.socket.shutdown(socket.SHUT_RDWR)
        self._server.shutdown()
        self._thread.join()
