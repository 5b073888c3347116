"""Guesses by name which column of a recording numbers its episodes."""

from collections.abc import Iterator, Sequence

import numpy as np

from nics_drl_bridge.recording.names import word_set
from nics_drl_bridge.recording.survey import Survey, TableSurvey

EPISODES = word_set("episode ep trial traj trajectory rollout run")
NO_VALUES = np.zeros(0)
MIN_MEAN_EPISODE_ROWS = 20  # minimum number of rows of an episode, on average


def guess_episode(tables: Sequence[TableSurvey]) -> tuple[TableSurvey, Survey] | None:
    """Finds the only column that numbers episodes; None if there is none, or several."""
    columns: list[tuple[TableSurvey, Survey]] = []
    for table in tables:
        for column in _find_episode_columns(table):
            columns.append((table, column))
    if len(columns) != 1:
        return None
    return columns[0]


def _find_episode_columns(table: TableSurvey) -> Iterator[Survey]:
    """Yields the columns named like an episode that keep each of their values for many rows."""
    for column in table.columns:
        words = table.list_words(column.name)
        if EPISODES.isdisjoint(words) or column.name in table.stamp_columns:
            continue
        values = table.data.get(column.name, NO_VALUES)
        count = len(np.unique(values))
        changes = np.flatnonzero(values[1:] != values[:-1])
        if not 1 < count == len(changes) + 1 <= len(values) / MIN_MEAN_EPISODE_ROWS:
            continue
        # `run` with two values may be a switch, unless the stamps restart with it.
        may_be_switch = "run" in words and count == 2
        if not may_be_switch or _restarts(table, int(changes[0])):
            yield column


def _restarts(table: TableSurvey, row: int) -> bool:
    """True if the stamps go back after a row."""
    t = table.t
    return t is not None and row + 1 < len(t) and bool(t[row + 1] < t[row])
