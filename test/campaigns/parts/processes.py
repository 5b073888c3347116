"""Other processes of a campaign, and what a process uses, from /proc (Linux)."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple


class Use(NamedTuple):
    """What a process uses at one moment."""

    rss_mb: float  # resident memory [MB]
    files: int  # open file descriptors
    threads: int


def measure_use(pid: int | None = None) -> Use:
    """Returns what a process uses, by default this one."""
    home = Path(f"/proc/{pid or os.getpid()}")
    lines = (home / "status").read_text().splitlines()
    rows = dict(line.split(":", 1) for line in lines if ":" in line)
    return Use(
        rss_mb=int(rows["VmRSS"].split()[0]) * 1024 / 1e6,
        files=len(list((home / "fd").iterdir())),
        threads=int(rows["Threads"]),
    )


@contextmanager
def keep_busy(loops: int) -> Iterator[None]:
    """Runs busy loops beside the block."""
    words = [sys.executable, "-c", "while True: pass"]
    started = [subprocess.Popen(words) for _ in range(loops)]
    try:
        yield
    finally:
        for loop in started:
            loop.kill()
            loop.wait()


def make_environment(domain_id: int) -> dict[str, str]:
    """Returns the environment of a process in a ROS domain of this machine alone."""
    discovery = {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    return os.environ | {"ROS_DOMAIN_ID": str(domain_id)} | discovery


@contextmanager
def call_apart(
    script: str, domain_id: int, call: str, *words: str, **options: Any
) -> Iterator[subprocess.Popen[Any]]:
    """Calls a function of a campaign in a process of its own, until the end of the block.

    Args:
        script: the campaign's file.
        domain_id: of ROS.
        call: of one of its functions.
        words: arguments of the process.
        options: further arguments of `Popen`.
    """
    file = Path(script)
    code = f"import {file.stem} as campaign; campaign.{call}"
    command = [sys.executable, "-c", code, *words]
    options |= {"env": make_environment(domain_id), "cwd": file.parent}
    with subprocess.Popen(command, **options) as process:
        try:
            yield process
        finally:
            process.kill()
