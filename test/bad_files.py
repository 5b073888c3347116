"""What may be wrong with a file, whatever it is of."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

DEEP = 10_000
LARGE = 2_000_000


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
    "deeply nested in brackets": _text(lambda _: b"a: " + b"[" * DEEP + b"]" * DEEP),
    "deeply nested in braces": _text(lambda _: b"a: " + b"{b: " * DEEP + b"}" * DEEP),
    "deeply indented": _text(
        lambda _: (
            b"".join(b" " * n + b"a:\n" for n in range(200)) + b" " * 200 + b"a: 1\n"
        )
    ),
    "a list": _text(lambda _: b"- 1\n- 2\n"),
    "one word": _text(lambda _: b"word\n"),
    "a tab": _text(lambda whole: b"a:\n\tb: 1\n" + whole),
    "an alias bomb": _text(
        lambda _: (
            b"a: &a [1,1,1,1,1,1,1,1,1]\n"
            + b"".join(
                b"%c: &%c [" % (k, k) + b",".join([b"*%c" % (k - 1)] * 9) + b"]\n"
                for k in range(ord("b"), ord("j"))
            )
        )
    ),
    "an object of Python": _text(
        lambda _: b"a: !!python/object/apply:os.system ['true']\n"
    ),
    "two documents": _text(lambda whole: whole + b"\n---\n" + whole),
    "an unknown key": _text(lambda whole: whole.rstrip() + b"\nunheard_of: 1\n"),
    "a very long line": _text(
        lambda whole: whole.rstrip() + b"\nlong: " + b"x" * LARGE + b"\n"
    ),
    "an unclosed quote": _text(lambda whole: whole + b'\nb: "never\n'),
    "an alias of itself": _text(lambda _: b"a: &a [*a]\n"),
    "a merge of nothing": _text(lambda whole: whole.rstrip() + b"\n<<: 3\n"),
    "a date": _text(lambda whole: whole.rstrip() + b"\nsince: 2020-99-99\n"),
    "a surrogate": _text(lambda whole: whole.rstrip() + b'\ns: "\\uD800"\n'),
    "control characters": _text(lambda whole: whole.rstrip() + b"\ns: \x01\x02\n"),
}
"""Of YAML files."""

VALUES = (
    "word",
    "no",
    "010",
    "0x1F",
    "1_000",
    "12:30",
    ".nan",
    ".inf",
    "-.inf",
    "-1",
    "0",
    "1e300",
    "-1e300",
    "1e-300",
    "99999999999999999999999999",
    "null",
    "[]",
    "{}",
    "[1, 2]",
    "[.nan]",
    "{a: 1}",
    "true",
    "''",
    "'1.0'",
    "2020-01-01",
    "1.0 m",
    "[[[]]]",
)
"""Put in the place of any value of a YAML file."""
