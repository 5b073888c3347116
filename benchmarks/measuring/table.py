"""A table of figures, before they are filled in."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Table:
    """A table of figures.

    Attributes:
        head: its columns.
        rows: the run that a row is of, and its cells, with placeholders.
        notes: explain the marks below the table.
    """

    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    notes: bool = True
