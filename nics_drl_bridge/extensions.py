"""Extensions by name: entry points of other packages, and of this one's own extras.

A group is `nics_drl_bridge.GROUP`; `docs/extensions.md` says what each expects.
"""

from __future__ import annotations

from functools import cache
from importlib.metadata import EntryPoint, entry_points
from typing import Any

from nics_drl_bridge.errors import MISSING_ROS, ConfigError, nearest

PACKAGE = "nics_drl_bridge"
ROS = ("rclpy", "_msgs", "std_srvs", "builtin_interfaces")
INSTALL = {
    "mcap": "bags", "mujoco": "mujoco", "ray": "train,distributed", "rosbags": "bags",
    "torch": "train",
}  # fmt: skip
"""Libraries, and the extra of this package that brings each."""


@cache
def known(group: str) -> dict[str, EntryPoint]:
    """The extensions of a group by name, sorted; one of another package goes before one of ours."""
    found = entry_points(group=f"{PACKAGE}.{group}")
    ours_first = sorted(found, key=lambda each: (each.name, not each.value.startswith(PACKAGE)))
    return {each.name: each for each in ours_first}


def load(group: str, name: str) -> Any:
    """An extension by its group and its name.

    Raises ConfigError if there is none of that name, or a library that it needs is missing.
    """
    extensions = known(group)
    if name not in extensions:
        raise ConfigError(f"unknown {group.rstrip('s')} {name!r}; {nearest(name, extensions)}")
    try:
        return extensions[name].load()
    except ModuleNotFoundError as error:
        raise ConfigError(f"{group.rstrip('s')} {name!r} {missing(error.name or '')}") from None


def missing(module: str) -> str:
    """A clause about a library that is not installed, to follow the name of what needs it."""
    library = module.partition(".")[0]
    if library.endswith(ROS):
        return MISSING_ROS.format(module=module)
    if library in INSTALL:
        return f"needs the module {module!r}; pip install '{PACKAGE}[{INSTALL[library]}]'."
    return f"needs the module {module!r}; install it."
