"""Two network namespaces with a cable between them that loses packets; needs root, ip and nft."""

from __future__ import annotations

import os
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager

PATIENCE_S = 30.0
DEVICES = ("robot", "stack")
# At the ingress hook IP fragments are still apart: a scan is lost with any one of them.
RULES = """
table netdev loss {{
    chain ingress {{
        type filter hook ingress device {device} priority 0;
        numgen random mod 100 < {percent} drop
    }}
}}
"""


class NoNamespacesError(Exception):
    """What is missing on this machine."""


class Link:
    """A cable between two namespaces, with a device in each."""

    def __init__(self) -> None:
        self.ends = [f"{device}{os.getpid()}" for device in DEVICES]

    def lose(self, percent: int) -> None:
        """Loses so many of a hundred packets from now on, in both directions."""
        for end, device in zip(self.ends, DEVICES, strict=True):
            rules = RULES.format(device=device, percent=percent) if percent else ""
            _run(f"ip netns exec {end} nft -f -", f"flush ruleset\n{rules}")

    def command(self, end: int, words: list[str]) -> list[str]:
        """Returns a command line that runs in one of the namespaces."""
        return ["ip", "netns", "exec", self.ends[end], *words]

    def connect(self) -> None:
        """Makes the namespaces and the cable. Raises NoNamespacesError."""
        one, other = self.ends
        for end in self.ends:
            _run(f"ip netns add {end}")
        _run(f"ip -n {one} link add robot type veth peer stack netns {other}")
        for number, (end, device) in enumerate(zip(self.ends, DEVICES, strict=True)):
            _run(f"ip -n {end} address add 10.77.0.{number + 1}/24 dev {device}")
            for name in ("lo", device):
                _run(f"ip -n {end} link set {name} up")
        for end, device in zip(self.ends, DEVICES, strict=True):
            _await_carrier(end, device)


@contextmanager
def open_link() -> Iterator[Link]:
    """Connects a cable, and removes it at the end. Raises NoNamespacesError."""
    link = Link()
    try:
        link.connect()
        yield link
    finally:
        for end in link.ends:
            words = ["ip", "netns", "delete", end]
            subprocess.run(words, check=False, capture_output=True)


def _await_carrier(end: str, device: str) -> None:
    """Waits until an end of the cable is up: who starts before does not use it, ever."""
    deadline_s = time.monotonic() + PATIENCE_S
    while "state UP" not in _run(f"ip -n {end} link show {device}"):
        if time.monotonic() > deadline_s:
            raise NoNamespacesError(f"{device} in {end} has no carrier.")
        time.sleep(0.01)


def _run(command: str, text: str = "") -> str:
    try:
        done = subprocess.run(
            command.split(), input=text, capture_output=True, text=True, check=True
        )
    except FileNotFoundError:
        raise NoNamespacesError("packet loss needs the tools ip and nft.") from None
    except subprocess.CalledProcessError as error:
        told = f"{command}: {error.stderr.strip()}; packet loss needs root"
        raise NoNamespacesError(told) from None
    return done.stdout
