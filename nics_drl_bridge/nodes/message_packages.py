"""Message packages that are missing from the ROS 2 wheels, and how to install them."""

import sys
from collections.abc import Mapping
from functools import cache
from importlib.metadata import PathDistribution
from pathlib import Path
from typing import NamedTuple

from nics_drl_bridge.config import share_folder


class Wheels(NamedTuple):
    """The wheels of ROS 2 in this environment."""

    prefix: str  # of their names, as `ros-` or `ros-jazzy-`
    versions: Mapping[str, str]  # by name


@cache
def find_wheels() -> Wheels | None:
    """Return the installed wheels of ROS 2; None if ROS 2 is missing or installed otherwise."""
    versions = {}
    for folder in sys.path:
        for file in Path(folder).glob("ros[-_]*.dist-info"):
            package = PathDistribution(file)
            name = str(package.metadata["Name"]).lower().replace("_", "-")
            versions[name] = package.version
    for name in versions:
        if name.endswith("-rclpy"):
            return Wheels(name.removesuffix("rclpy"), versions)
    return None


def list_shipped_packages() -> dict[str, Path]:
    """Return the folders of the message packages shipped with this package, by name."""
    folder = share_folder() / "config" / "messages"
    return {path.name: path for path in sorted(folder.iterdir()) if path.is_dir()}


def explain_install(package: str) -> str:
    """Return the instruction for installing a message package."""
    if package in list_shipped_packages() and find_wheels() is not None:
        return f"install it by `nics install {package}`"
    return "install it with your ROS 2 distribution"
