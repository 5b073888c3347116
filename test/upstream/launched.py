"""Launch files run by the real `ros2 launch`, and ended as Ctrl-C in a terminal does."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import time
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import psutil

PACKAGE = "nics_drl_bridge"
COMPILED_S = 280.0
POLL_S = 0.05
SEVERED = ("SIGTERM", "SIGKILL", "process has died", "Traceback", "Segmentation")
"""What a log tells of nodes that did not end by Ctrl-C alone."""


class Launched(AbstractContextManager["Launched", None]):
    """A launch in a session of its own, so that its processes get Ctrl-C together."""

    def __init__(
        self, file: str, folder: Path, domain_id: int, **arguments: Any
    ) -> None:
        words = [f"{name}:={value}" for name, value in arguments.items()]
        chosen = {
            "ROS_DOMAIN_ID": str(domain_id),
            "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        }
        self.domain_id = domain_id
        self.log = folder / "launch.log"
        env = (
            os.environ | chosen | {"ROS_LOG_DIR": str(folder), "ROS_HOME": str(folder)}
        )
        with self.log.open("wb") as log:
            self._process = subprocess.Popen(
                ["ros2", "launch", PACKAGE, file, *words],
                env=env,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                start_new_session=True,
                preexec_fn=lambda: signal.signal(
                    signal.SIGINT, signal.default_int_handler
                ),
            )
        self.seen: set[psutil.Process] = set()

    @property
    def text(self) -> str:
        """What it said so far."""
        return self.log.read_text(encoding="utf-8", errors="replace")

    def told(
        self, pattern: str, times: int = 1, within_s: float = COMPILED_S
    ) -> list[str]:
        """Waits until lines match, and returns what they hold."""
        deadline = time.monotonic() + within_s
        while len(found := re.findall(pattern, self.text)) < times:
            assert self._process.poll() is None, self.text
            assert time.monotonic() < deadline, f"no {pattern!r} in:\n{self.text}"
            time.sleep(POLL_S)
        self.seen |= set(psutil.Process(self._process.pid).children(recursive=True))
        return found

    def runs(self, *nodes: str) -> None:
        """Waits until nodes run."""
        for node in nodes:
            self.told(rf"\[{re.escape(node)}\]: running")

    def wait(self, within_s: float = 60.0) -> int:
        """The exit code of a launch that ends by itself."""
        return self._process.wait(within_s)

    def end(self, within_s: float = 60.0) -> tuple[int, float]:
        """Presses Ctrl-C; returns the exit code and the time [s] until all had ended."""
        if self._process.poll() is None:
            launch = psutil.Process(self._process.pid)
            self.seen |= set(launch.children(recursive=True))
        begin_s = time.monotonic()
        os.killpg(self._process.pid, signal.SIGINT)
        code = self._process.wait(within_s)
        return code, time.monotonic() - begin_s

    def ends_well(self) -> float:
        """Presses Ctrl-C; everything has to end by it alone. Returns the time [s]."""
        code, took_s = self.end()
        text = self.text
        # Python's own race: to signal a child that has just ended takes its exit code away.
        for pid in re.findall(
            r"Unknown child process pid (\d+), will report returncode 255", text
        ):
            text = text.replace(f"process has died [pid {pid}, exit code 255", "")
        assert code == 0, text
        assert not [word for word in SEVERED if word in text], text
        assert not [each for each in self.seen if each.is_running()], "orphans"
        return took_s

    def __exit__(self, *_: object) -> None:
        for each in self.seen:
            if each.is_running():
                each.kill()
        if self._process.poll() is None:
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()
