"""A share of a core for a group of processes, by a Linux control group; needs no ROS 2."""

import os
import time
from contextlib import AbstractContextManager
from pathlib import Path

CONTROL_GROUPS = Path("/sys/fs/cgroup")
PERIOD_US = 100_000  # the kernel's own, which containers and systemd use too
CLOSING_S = 2.0
POLL_S = 0.02


class CoreShare(AbstractContextManager["CoreShare", None]):
    """A control group with priority over other programs, up to its share of a core.

    Raises OSError if this user must not create one.
    """

    def __init__(self, root: Path = CONTROL_GROUPS) -> None:
        controllers = root / "cgroup.controllers"
        self._is_v2 = controllers.is_file()
        if self._is_v2:
            (root / "cgroup.subtree_control").write_text("+cpu", encoding="ascii")
        parent = root if self._is_v2 else root / "cpu"
        self._folder = parent / f"nics_drl_bridge_{os.getpid()}"
        self._folder.mkdir()
        if self._is_v2:
            self._write("cpu.weight", 10_000)
        else:
            self._write("cpu.shares", 262_144)

    def add(self, pid: int) -> None:
        """Move a process into the group; its future children follow."""
        self._write("cgroup.procs", pid)

    def limit(self, cores: float) -> None:
        """Limit all processes together to a fraction of a core."""
        quota_us = round(cores * PERIOD_US)
        if self._is_v2:
            self._write("cpu.max", f"{quota_us} {PERIOD_US}")
        else:
            self._write("cpu.cfs_period_us", PERIOD_US)
            self._write("cpu.cfs_quota_us", quota_us)

    def _write(self, name: str, value: object) -> None:
        (self._folder / name).write_text(str(value), encoding="ascii")

    def __exit__(self, *_: object) -> None:
        deadline = time.monotonic() + CLOSING_S
        while True:
            try:
                self._folder.rmdir()
            except OSError:  # a process has not ended yet
                if time.monotonic() > deadline:
                    raise
                time.sleep(POLL_S)
            else:
                return
