"""Message types by name, from any installed package."""

from __future__ import annotations

import re
import sys
from importlib import import_module
from pathlib import Path
from typing import Any

PARTS = 3
FIELD = re.compile(r"^\s*([A-Za-z][A-Za-z0-9_]*(?:/[A-Za-z0-9_/]+)?)")
"""The type at the start of a line of a `.msg` file."""


def message_type(kind: str) -> Any | None:
    """Returns the class of a type like `nav_msgs/msg/Odometry`; None if it is not installed."""
    parts = kind.split("/")
    if len(parts) != PARTS:
        return None
    try:
        return getattr(import_module(f"{parts[0]}.{parts[1]}"), parts[2], None)
    except ImportError:
        return None


def message_texts(kind: str) -> dict[str, str]:
    """Returns the `.msg` texts of a type and of all types in it, as far as they are installed."""
    texts: dict[str, str] = {}
    waiting = [kind]
    while waiting:
        each = waiting.pop()
        file = _file(each)
        if each in texts or file is None:
            continue
        texts[each] = file.read_text(encoding="utf-8")
        package = each.split("/")[0]
        for line in texts[each].splitlines():
            found = FIELD.match(line.partition("#")[0])
            if found is not None and ("/" in found[1] or found[1][0].isupper()):
                inner = found[1].split("/")
                waiting.append(f"{inner[0] if len(inner) > 1 else package}/msg/{inner[-1]}")
    return texts


def _file(kind: str) -> Path | None:
    package, _, name = kind.split("/")
    for prefix in (*_prefixes(), Path(sys.prefix)):
        file = prefix / "share" / package / "msg" / f"{name}.msg"
        if file.is_file():
            return file
    return None


def _prefixes() -> list[Path]:
    from ament_index_python.search_paths import get_search_paths

    try:
        return [Path(path) for path in get_search_paths()]
    except OSError:  # if ROS 2 comes from wheels, the variable is not set
        return []
