from __future__ import annotations

import signal
import subprocess
import sys
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]

# rclpy's major version tells the distribution where no ROS 2 is sourced, as with wheels.
DISTRIBUTIONS = {"3": "humble", "7": "jazzy", "9": "kilted"}
# In a process of its own: importing rclpy from wheels restarts the interpreter.
ASK_ROS = """
import os, rclpy
print(os.environ.get("ROS_DISTRO", ""), rclpy.get_rmw_implementation_identifier())
"""


def pytest_configure() -> None:
    """Lets SIGINT interrupt again, here and in all children.

    A shell starts a background job, as in `make test &` of a script, with SIGINT ignored, and every
    process below it inherits that: Ctrl-C could not be tested.
    """
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_report_header() -> str:
    if find_spec("rclpy") is None:
        return "ROS 2: none, its tests skip"
    asked = subprocess.run(
        [sys.executable, "-c", ASK_ROS], capture_output=True, text=True, timeout=60
    )
    if asked.returncode != 0:
        reason = asked.stderr.strip().splitlines()[-1:] or ["no message"]
        return f"ROS 2: rclpy is there but can't be imported ({reason[0]})"
    distribution, _, middleware = asked.stdout.rstrip("\n").partition(" ")
    release = _rclpy_version()
    distribution = distribution or DISTRIBUTIONS.get(
        release.split(".")[0], "unknown distribution"
    )
    return f"ROS 2: {distribution}, rclpy {release}, {middleware}"


def _rclpy_version() -> str:
    try:
        return version("rclpy")
    except PackageNotFoundError:
        return "of unknown version"


@pytest.fixture(scope="session")
def shared_recordings() -> Path:
    """The folder of real recordings that lies beside the repository."""
    folder = ROOT.parent / "shared" / "recordings"
    if not folder.is_dir():
        pytest.skip(f"needs the real recordings, which are not at {folder}")
    return folder
