"""Other processes, and what they use, from /proc (Linux)."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any


@dataclass(frozen=True)
class Use:
    """At one moment.

    Attributes:
        rss_mb: resident memory [MB].
        files: open file descriptors.
        threads: of the process.
    """

    rss_mb: float
    files: int
    threads: int


def use_of(pid: int | None = None) -> Use:
    """Of a process, or of this one."""
    home = Path("/proc") / str(pid or os.getpid())
    rows = dict(
        line.split(":", 1)
        for line in (home / "status").read_text().splitlines()
        if ":" in line
    )
    return Use(
        rss_mb=int(rows["VmRSS"].split()[0]) * 1024 / 1e6,
        files=sum(1 for _ in (home / "fd").iterdir()),
        threads=int(rows["Threads"]),
    )


def core_seconds(pid: int) -> float:
    """Time that all threads of a process have spent on a core so far [s], user and system."""
    # The name, in parentheses, may hold anything; the fields behind it are numbers.
    fields = (Path("/proc") / str(pid) / "stat").read_text().rpartition(")")[2].split()
    user = int(fields[11])
    system = int(fields[12])
    return (user + system) / os.sysconf("SC_CLK_TCK")


@contextmanager
def busy(loops: int) -> Iterator[None]:
    """Runs busy loops beside the block."""
    words = [sys.executable, "-c", "while True: pass"]
    started = [subprocess.Popen(words) for _ in range(loops)]
    try:
        yield
    finally:
        for each in started:
            each.kill()
            each.wait()


@contextmanager
def part(
    script: str, domain_id: int, call: str, *words: str, **given: Any
) -> Iterator[subprocess.Popen[Any]]:
    """A call of a campaign in a process of its own, in a ROS domain, until the end of the block.

    Args:
        script: the campaign's file.
        domain_id: of ROS.
        call: of one of its functions.
        words: arguments of the process.
        given: further arguments of `Popen`.
    """
    environment = os.environ | {
        "ROS_DOMAIN_ID": str(domain_id),
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
    }
    file = Path(script)
    code = f"import {file.stem} as campaign; campaign.{call}"
    command = [sys.executable, "-c", code, *words]
    with subprocess.Popen(
        command, env=environment, cwd=file.parent, **given
    ) as process:
        try:
            yield process
        finally:
            process.kill()
