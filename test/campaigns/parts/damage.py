"""One mutator for all inputs: Hypothesis draws what is wrong with one, and where."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

from bad_files import FILES, TEXTS
from hypothesis import strategies as st
from parts.attempt import Attempt, ReadOtherwiseError, call_nics
from parts.loaders import LOADERS, Loader, find_tree

TEXTS_IN_PLACE = ("word", "x" * 5000, "../../etc/passwd", "a\nb\x1b[2J")
TREES_IN_PLACE = ([], {}, [[[1]]], [1.0] * 5000, {"a": {"b": 1}})
values = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(-2, 2),
    st.integers(2**62, 2**80),
    st.floats(),
    st.sampled_from((*TEXTS_IN_PLACE, *TREES_IN_PLACE, 10**400)),
)


@st.composite
def change_bytes(draw: st.DrawFn, whole: bytes) -> bytes:
    """Bytes that were cut, flipped, replaced or inserted."""
    data = bytearray(whole)
    place = draw(st.integers(0, len(data) - 1))
    more = draw(st.binary(min_size=1, max_size=8))
    way = draw(st.sampled_from(("cut", "flip", "replace", "insert")))
    if way == "cut":
        data = data[:place]
    elif way == "flip":
        data[place] ^= 1 << (more[0] % 8)
    elif way == "replace":
        data[place : place + len(more)] = more
    else:
        data[place:place] = more
    if data == whole:
        data[place] ^= 1
    return bytes(data)


@st.composite
def change_tree(draw: st.DrawFn, tree: Any) -> str:
    """Replaces a value somewhere in nested mappings and lists; returns its place."""
    place = []
    inner = tree
    while True:
        keys = list(inner) if isinstance(inner, dict) else list(range(len(inner)))
        key = draw(st.sampled_from(keys))
        place.append(str(key))
        leaf = not isinstance(inner[key], dict | list) or not inner[key]
        if leaf or draw(st.integers(0, 4)) == 0:
            break
        inner = inner[key]
    if isinstance(inner, dict) and draw(st.integers(0, 7)) == 0:
        del inner[key]
        return f"{'.'.join(place)} is missing"
    inner[key] = draw(values)
    return f"{'.'.join(place)} is {str(inner[key])[:30]!r}"


@st.composite
def draw_attempts(draw: st.DrawFn, wholes: dict[str, Any], folder: Path) -> Attempt:
    """An input of any kind, whole or damaged, and what reads it.

    Args:
        draw: by Hypothesis.
        wholes: by the name of a loader, its input and what was read of that.
        folder: for the copy that is damaged.
    """
    loader = draw(st.sampled_from(LOADERS))
    source, content = wholes[loader.name]
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(source.parent, folder)
    path = folder / source.name
    ways: list[Callable[..., tuple[str, str]]] = [_spare, _change_bytes]
    ways += [_replace] * path.is_file()
    ways += [_retell] * bool(loader.text)
    ways += [_change_value] * (find_tree(loader) is not None)
    way = draw(st.sampled_from(ways))
    told, verdict = way(draw, loader, path)

    def read() -> None:
        found = loader.read(path)
        is_checked = verdict in ("same", "bad")
        if is_checked and (loader.sealed or found != content):
            raise ReadOtherwiseError

    act: Callable[[], object] = read
    if verdict == "bad" and loader.command and draw(st.integers(0, 4)) == 0:
        act = call_nics(folder, *loader.command, path)
    return Attempt(loader.name, told, act, verdict)


def _spare(draw: st.DrawFn, loader: Loader, path: Path) -> tuple[str, str]:
    return "whole", "good"


def _change_bytes(draw: st.DrawFn, loader: Loader, path: Path) -> tuple[str, str]:
    files = sorted(file for file in path.rglob("*") if file.is_file()) or [path]
    file = draw(st.sampled_from(files))
    file.write_bytes(draw(change_bytes(file.read_bytes())))
    return f"bytes of {file.name}", "any" if loader.free else "same"


def _replace(draw: st.DrawFn, loader: Loader, path: Path) -> tuple[str, str]:
    damage = draw(st.sampled_from((*FILES, "an endless device", "8 GB")))
    if damage in FILES:
        FILES[damage](path)
    elif damage == "8 GB":
        with path.open("wb") as file:
            file.truncate(2**33)
    else:
        path.unlink()
        path.symlink_to("/dev/zero")
    return damage, "bad"


def _retell(draw: st.DrawFn, loader: Loader, path: Path) -> tuple[str, str]:
    name = draw(st.sampled_from(sorted(TEXTS)))
    TEXTS[name](path / loader.text)
    loader.reseal(path)
    return name, "bad" if loader.sealed else "same"


def _change_value(draw: st.DrawFn, loader: Loader, path: Path) -> tuple[str, str]:
    tree = find_tree(loader)
    assert tree is not None
    open_tree, save_tree = tree
    data = open_tree(path)
    told = draw(change_tree(data))
    save_tree(path, data)
    return told, "any" if loader.sealed else "same"
