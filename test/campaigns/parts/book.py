"""Rows that a long run keeps in a file, so that it goes on where it was stopped."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

Row = dict[str, Any]


class Book:
    """The rows of a run, in a file if there is one, whose first line says what was asked for."""

    def __init__(self, file: Path | None, asked: Row) -> None:
        self.asked = asked
        self._file = file
        head = json.dumps(asked)
        text = file.read_text() if file is not None and file.exists() else ""
        # A run that was killed while it wrote leaves a part of a line.
        whole = text[: text.rfind("\n") + 1]
        first, *rows = (whole or text or head).splitlines()
        if first != head:
            raise SystemExit(f"{file}: is of another run, {first}; name another file.")
        self.rows: list[Row] = [json.loads(row) for row in rows]
        if whole != text or not text:
            self._write("w", [asked, *self.rows])

    def add(self, rows: Sequence[Row]) -> None:
        """Keeps rows."""
        self.rows += rows
        self._write("a", rows)

    def _write(self, mode: str, lines: Sequence[Row]) -> None:
        if self._file is not None:
            with self._file.open(mode) as file:
                file.write("".join(json.dumps(line) + "\n" for line in lines))
