"""Who has bound which ports of UDP over IPv4, as Linux tells it; elsewhere nobody is seen."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path

TABLE = Path("/proc/net/udp")
FIRST_PORT, PORTS_OF_A_DOMAIN = 7400, 250
"""Of RTPS: the first port of a domain is that of its multicast."""


def multicast_port(domain_id: int) -> int:
    """Which port those of a domain bind who look for others beyond this machine."""
    return FIRST_PORT + PORTS_OF_A_DOMAIN * domain_id


def ports_of(process: int | str = "self") -> set[int]:
    """The ports that a process has bound."""
    names = set()
    for file in Path(f"/proc/{process}/fd").iterdir():
        with contextlib.suppress(OSError):  # another thread has closed it
            names.add(os.readlink(file))
    return {port for inode, port in _sockets() if f"socket:[{inode}]" in names}


def domains_in_use() -> set[int]:
    """The DDS domains that somebody takes part in who is on this machine."""
    first = (port - FIRST_PORT for _, port in _sockets())
    return {offset // PORTS_OF_A_DOMAIN for offset in first if offset >= 0}


def _sockets() -> list[tuple[str, int]]:
    """Inode and port of each socket."""
    try:
        lines = TABLE.read_text(encoding="ascii").splitlines()[1:]
    except OSError:
        return []
    rows = [line.split() for line in lines]
    return [(row[9], int(row[1].split(":")[1], 16)) for row in rows]
