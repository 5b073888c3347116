"""What a process uses, from /proc (Linux)."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path


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
