"""What may be wrong with a file, whatever it is of."""

import os
from collections.abc import Callable
from pathlib import Path


def _folder(path: Path) -> None:
    path.unlink()
    path.mkdir()


def _loop(path: Path) -> None:
    path.unlink()
    path.symlink_to(path)


def _pipe(path: Path) -> None:
    path.unlink()
    os.mkfifo(path)


def _nothing(path: Path) -> None:
    path.unlink()
    path.symlink_to(os.devnull)


def _text(change: Callable[[bytes], bytes]) -> Callable[[Path], None]:
    return lambda path: path.write_bytes(change(path.read_bytes())) and None


FILES: dict[str, Callable[[Path], object]] = {
    "missing": Path.unlink,
    "a folder": _folder,
    "a loop of links": _loop,
    "the null device": _nothing,
    "a pipe": _pipe,
    "empty": _text(lambda _: b""),
    "zeros": _text(lambda whole: bytes(len(whole))),
    "noise": _text(lambda whole: bytes(range(256)) * 8),
    "cut at half": _text(lambda whole: whole[: len(whole) // 2] + b"\xff"),
    "UTF-16": _text(lambda whole: whole.decode("latin-1").encode("utf-16")),
}
"""Of any kind."""

TEXTS: dict[str, Callable[[Path], object]] = {
    "Latin-1": _text(lambda whole: whole + "\n# größer\n".encode("latin-1")),
    "a tab": _text(lambda whole: b"a:\n\tb: 1\n" + whole),
    "two documents": _text(lambda whole: whole + b"\n---\n" + whole),
    "an unknown key": _text(lambda whole: whole.rstrip() + b"\nunheard_of: 1\n"),
    "an unclosed quote": _text(lambda whole: whole + b'\nb: "never\n'),
    "a merge of nothing": _text(lambda whole: whole.rstrip() + b"\n<<: 3\n"),
    "a date": _text(lambda whole: whole.rstrip() + b"\nsince: 2020-99-99\n"),
    "a surrogate": _text(lambda whole: whole.rstrip() + b'\ns: "\\uD800"\n'),
    "control characters": _text(lambda whole: whole.rstrip() + b"\ns: \x01\x02\n"),
}
"""Of YAML files, besides what `test_config` reads."""
