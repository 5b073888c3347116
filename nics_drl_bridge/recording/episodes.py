"""Episodes of a recording that one column distinguishes."""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.recording.joining import split_at
from nics_drl_bridge.recording.mapping import Mapping
from nics_drl_bridge.recording.recording import Recording
from nics_drl_bridge.recording.table import Column, Source, Table
from nics_drl_bridge.recording.values import MappedReader

MIN_EPISODE_ROWS = 3  # shorter episodes are left out


class EpisodeOfTable(Source):
    """The rows of one episode in a table that holds everything that a mapping reads."""

    def __init__(
        self,
        source: Source,
        table: Table,
        name: str,
        rows: NDArray[np.intp],
        episode: str,
    ) -> None:
        super().__init__(f"{source.place} (episode {episode})", [name])
        self.episode = episode
        self._table = table
        self._rows = rows

    def read(self, name: str) -> Table:
        """Returns the table with the rows of the episode."""
        table = self._table
        rows = self._rows

        def read_column(which: str | int) -> Column:
            return table.column(which)[rows]

        def name_row(k: int) -> str:
            return table.row(int(rows[k]))

        return replace(table, place=self.place, column=read_column, row=name_row)


def split_table(source: Source, mapping: Mapping) -> list[EpisodeOfTable]:
    """Returns the episodes of a table; empty for several tables, or rows that come with stamps.

    Raises ConfigError if no episode is long enough.
    """
    reader = MappedReader(source, mapping)
    table, reference = reader.locate(mapping.episode or 0)
    if len(source.names) > 1 and any(
        name != _find_name(source, table) for name in _list_tables_used(source, mapping)
    ):
        return []
    if table.stamps("") is not None:
        return []  # such stamps continue from one episode to the next
    values, first, group = np.unique(
        table.column(reference), return_index=True, return_inverse=True
    )
    name = _find_name(source, table)
    episodes = []
    for k in np.argsort(first):
        rows = np.flatnonzero(group == k)
        if len(rows) >= MIN_EPISODE_ROWS:
            label = _format_label(values[k])
            episodes.append(EpisodeOfTable(source, table, name, rows, label))
    if not episodes:
        raise ConfigError(
            f"{table.place}: no value of the column {reference!r} lasts for "
            f"{MIN_EPISODE_ROWS} rows; name the column that numbers the episodes."
        )
    return episodes


def split_by_time(
    source: Source, mapping: Mapping, recording: Recording, since: float
) -> Recording:
    """Splits a recording where its episode column changes.

    `since` [s] was subtracted from its stamps. Raises ConfigError if pose and commands have
    different clocks.
    """
    if recording.pose.clock != recording.command.clock:
        raise ConfigError(
            f"{source.place}: episode: pose and commands have clocks of their own; "
            "give each episode as a recording of its own."
        )
    reader = MappedReader(source, mapping)
    table, which = reader.locate(mapping.episode or 0)
    column = table.column(which)
    at = reader.stamp_rows(table, column, None)
    values = column[at.rows]
    changes = np.flatnonzero(values[1:] != values[:-1]) + 1
    starts = [-np.inf, *(float(t) - since for t in at.t[changes])]
    labels = [_format_label(values[k]) for k in (0, *changes)]
    names = [f"{source.place} (episode {label})" for label in labels]
    return split_at(recording, starts, names)


def _format_label(value: Any) -> str:
    return str(value) if isinstance(value, str) else f"{float(value):g}"


def _find_name(source: Source, table: Table) -> str:
    return next(name for name in source.names if source.get_table(name) is table)


def _list_tables_used(source: Source, mapping: Mapping) -> Iterator[str]:
    """Yields the tables from which a mapping reads its values."""
    reader = MappedReader(source, mapping)
    references: list[tuple[Any, str | None]] = [
        (v.from_, None) for v in mapping.command.values()
    ]
    references += [(value.from_, None) for value in mapping.state.values()]
    references.append((mapping.pose.x.from_ if mapping.pose.x else 0, mapping.pose.in_))
    for reference, within in references:
        yield _find_name(source, reader.locate(reference, within)[0])
