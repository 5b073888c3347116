"""On what was measured: machine, versions, commit, load."""

from __future__ import annotations

import os
import platform
import subprocess
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

LIBRARIES = (
    "numpy",
    "numba",
    "scipy",
    "gymnasium",
    "torch",
    "stable_baselines3",
    "onnxruntime",
    "mujoco",
    "ros-humble-rclpy",
    "ros-jazzy-rclpy",
)


def field(file: str, key: str) -> str:
    """The first value of a key in a file of /proc, or nothing where there is none."""
    try:
        lines = Path(file).read_text().splitlines()
    except OSError:
        return ""
    rows = (line.partition(":") for line in lines)
    return next((value.strip() for name, _, value in rows if name.strip() == key), "")


def describe() -> dict[str, Any]:
    """The machine, and the versions of what is measured with."""
    memory = field("/proc/meminfo", "MemTotal").split()
    return {
        "cpu": field("/proc/cpuinfo", "model name")
        or platform.processor()
        or platform.machine(),
        "architecture": platform.machine(),
        "cores": os.cpu_count(),
        "memory_gb": round(int(memory[0]) / 1e6, 1) if memory else None,
        "system": f"{platform.system()} {platform.release()}",
        "python": platform.python_version(),
        "libraries": {name: found for name in LIBRARIES if (found := version_of(name))},
    }


def version_of(library: str) -> str | None:
    """Of a library, if it is installed."""
    try:
        return version(library)
    except PackageNotFoundError:
        return None


def load() -> list[float]:
    """How many processes wanted to run, over 1, 5 and 15 minutes."""
    return [round(each, 2) for each in os.getloadavg()]


def commit_of(folder: Path) -> dict[str, Any]:
    """The commit of a working tree, and whether more than the results were changed since."""
    told = said(folder, "rev-parse", "HEAD")
    if told is None:
        return {"commit": None, "dirty": None}
    changes = said(
        folder,
        "status",
        "--porcelain",
        "--untracked-files=no",
        "--",
        ".",
        ":(exclude)benchmarks/results.json",
        ":(exclude)*.md",
    )
    return {"commit": told[:12], "dirty": bool(changes)}


def said(folder: Path, *words: str) -> str | None:
    """What git answers, `None` where it can't."""
    try:
        done = subprocess.run(
            ["git", "-C", str(folder), *words], capture_output=True, text=True
        )
    except OSError:
        return None
    return done.stdout.strip() if done.returncode == 0 else None
