"""Takes what is intact out of a damaged SQLite file of a bag."""

from __future__ import annotations

import shutil
import sqlite3
from contextlib import closing, suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

BATCH = 500
SMALLEST_ROW = 16
"""No message takes less room than this [bytes]: it bounds how many there can be."""
SMALLEST_PAGE = 512
BESIDE = ("-wal", "-journal")
"""Files beside a database that was not closed, which SQLite needs to put it in order."""

Row = tuple[int, int, bytes]
"""Topic id, time of receipt [ns], message."""


def intact_rows(path: Path) -> tuple[dict[int, tuple[str, str]], dict[str, str], list[Row]]:
    """All rows that can be read.

    Returns:
        Name and type of each topic by its id, definition of each type, and the messages.
    """
    with TemporaryDirectory() as folder:
        copy = Path(folder) / "bag.db3"
        shutil.copyfile(path, copy)
        _drop_cut_page(copy)
        for ending in BESIDE:
            with suppress(FileNotFoundError):
                shutil.copyfile(f"{path}{ending}", f"{copy}{ending}")
        with closing(sqlite3.connect(copy)) as base:
            base.text_factory = lambda raw: raw.decode("utf-8", "replace")
            # With this, SQLite opens a file that is shorter than it should be.
            base.execute("PRAGMA writable_schema = ON")
            try:
                found = base.execute("SELECT id, name, type FROM topics").fetchall()
            except sqlite3.Error:
                return {}, {}, []
            topics = {key: (name, kind) for key, name, kind in found}
            return topics, _definitions(base), _rows(base, copy.stat().st_size // SMALLEST_ROW)


def _drop_cut_page(copy: Path) -> None:
    """Leaves whole pages only: SQLite fills one that is cut off with zeros, without a word."""
    with copy.open("r+b") as file:
        size = int.from_bytes(file.read(18)[16:], "big")
        size = 65536 if size == 1 else size
        if size >= SMALLEST_PAGE and size & (size - 1) == 0:
            file.truncate(copy.stat().st_size // size * size)


def _definitions(base: sqlite3.Connection) -> dict[str, str]:
    with suppress(sqlite3.Error):
        ask = "SELECT topic_type, encoded_message_definition FROM message_definitions"
        return dict(base.execute(ask).fetchall())
    return {}


def _rows(base: sqlite3.Connection, bound: int) -> list[Row]:
    """Messages in batches; one by one where a batch can't be read."""
    ask = "SELECT id, topic_id, timestamp, data FROM messages WHERE id BETWEEN ? AND ?"
    rows: list[Row] = []
    with suppress(sqlite3.Error):
        bound = base.execute("SELECT MAX(id) FROM messages").fetchone()[0] or 0
    for first in range(1, bound + 1, BATCH):
        last = min(first + BATCH - 1, bound)
        try:
            batch = base.execute(ask, (first, last)).fetchall()
        except sqlite3.Error:
            batch = []
            for each in range(first, last + 1):
                with suppress(sqlite3.Error):
                    batch += base.execute(ask, (each, each)).fetchall()
        rows += [row[1:] for row in batch if _is_message(row)]
    return rows


def _is_message(row: tuple[Any, ...]) -> bool:
    return [type(value) for value in row[1:]] == [int, int, bytes]
