"""Two network namespaces with a cable between them that loses packets; needs root, ip and nft."""

from __future__ import annotations

import os
import shutil
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

PATIENCE_S = 30.0
RULES = """
table netdev loss {{
    chain ingress {{
        type filter hook ingress device {device} priority 0;
        numgen random mod 100 < {percent} drop
    }}
}}
"""
"""At the ingress hook, where IP fragments are still apart: a scan is lost with any one of them."""


class NoNamespacesError(Exception):
    """What is missing on this machine."""


@dataclass(frozen=True)
class Link:
    """A cable.

    Attributes:
        ends: names of the two namespaces.
        devices: of the cable in each.
    """

    ends: tuple[str, str]
    devices: tuple[str, str]

    def lose(self, percent: int) -> None:
        """Loses so many of a hundred packets from now on, in both directions."""
        for end, device in zip(self.ends, self.devices, strict=True):
            rules = RULES.format(device=device, percent=percent) if percent else ""
            _run(
                "ip",
                "netns",
                "exec",
                end,
                "nft",
                "-f",
                "-",
                text=f"flush ruleset\n{rules}",
            )

    def command(self, end: int, words: list[str]) -> list[str]:
        """A command line that runs in one of the namespaces."""
        return ["ip", "netns", "exec", self.ends[end], *words]


@contextmanager
def link() -> Iterator[Link]:
    """Makes two namespaces and the cable, and removes them at the end.

    Raises:
        NoNamespacesError: the machine has no such things.
    """
    missing = [tool for tool in ("ip", "nft") if shutil.which(tool) is None]
    if os.geteuid() != 0 or missing:
        raise NoNamespacesError(
            f"packet loss needs root and the tools ip and nft; {', '.join(missing) or 'root'} is "
            "missing."
        )
    ends = (f"robot{os.getpid()}", f"stack{os.getpid()}")
    made = Link(ends, ("robot", "stack"))
    try:
        for end in ends:
            _run("ip", "netns", "add", end)
        _run(
            "ip",
            "-n",
            ends[0],
            "link",
            "add",
            "robot",
            "type",
            "veth",
            "peer",
            "stack",
            "netns",
            ends[1],
        )
        for number, (end, device) in enumerate(zip(ends, made.devices, strict=True), 1):
            _run(
                "ip", "-n", end, "address", "add", f"10.77.0.{number}/24", "dev", device
            )
            for name in ("lo", device):
                _run("ip", "-n", end, "link", "set", name, "up")
        for end, device in zip(ends, made.devices, strict=True):
            _await_carrier(end, device)
        yield made
    finally:
        for end in ends:
            subprocess.run(
                ["ip", "netns", "delete", end], check=False, capture_output=True
            )


def _await_carrier(end: str, device: str) -> None:
    """Waits until an end of the cable is up: who starts before does not use it, ever."""
    deadline = time.monotonic() + PATIENCE_S
    while "state UP" not in _run("ip", "-n", end, "link", "show", device):
        if time.monotonic() > deadline:
            raise NoNamespacesError(f"{device} in {end} has no carrier.")
        time.sleep(0.01)


def _run(*words: str, text: str = "") -> str:
    done = subprocess.run(
        words, input=text, capture_output=True, text=True, check=False
    )
    if done.returncode != 0:
        raise NoNamespacesError(f"{' '.join(words)}: {done.stderr.strip()}")
    return done.stdout
