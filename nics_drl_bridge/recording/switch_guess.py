"""Finds the switches of a recording: columns of two values, one of which enables the commands."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.recording.names import word_set
from nics_drl_bridge.recording.survey import TableSurvey
from nics_drl_bridge.recording.table import Column, is_text

ENABLING = word_set("""
    safety enable enabled armed active activated auto autonomous autonomy
    deadman engaged engage
""")
DISABLING = word_set("estop emergency kill stop stopped disabled manual fault")
POWER = word_set("on power powered")
POWERED = word_set("motor motors drive drives")
ON_WORDS = word_set("auto autonomous autonomy enabled on armed active offboard run")
MODES = ENABLING | word_set("mode state status safety switch")
NO_VALUES = np.zeros(0)


class Switch(NamedTuple):
    """A column that must have a certain value for the commands to count."""

    table: TableSurvey
    column: str
    on: str  # the value, as written in a mapping

    def refer_to(self, is_single: bool) -> str:
        """Returns how a mapping refers to the column as a key."""
        text = self.table.refer_to(self.column, is_single)
        if ":" in text and not text.startswith('"'):
            return f'"{text}"'
        return text


def guess_switches(tables: Sequence[TableSurvey]) -> tuple[Switch, ...]:
    """Finds switches by the names of columns and values; none if they are never on together."""
    switches = []
    for table in tables:
        is_on = np.ones(table.rows, dtype=np.bool_)
        for column in table.columns:
            words = {*table.list_words(column.name)}
            values = table.data.get(column.name, NO_VALUES)
            on = _find_on_value(words, values)
            if on is None:
                continue
            switches.append(Switch(table, column.name, on))
            if len(values) == table.rows:
                is_on &= _equals(values, on)
        if table.rows and not is_on.any():
            return ()
    return tuple(switches)


def _equals(values: Column, on: str) -> NDArray[np.bool_]:
    if is_text(values):
        return np.array([str(value) == on for value in values])
    return np.asarray(values.astype(np.float64) == float(on))


def _find_on_value(words: set[str], values: Column) -> str | None:
    """Returns the value at which the commands count, from the names of column and values."""
    if is_text(values):
        texts = {str(value) for value in np.unique(values)}
        on = [text for text in texts if text.lower() in ON_WORDS]
        if words & MODES and len(texts) == 2 and len(on) == 1:
            return on[0]
        return None
    if values.dtype.kind not in "fiub":
        return None
    numbers = np.unique(values.astype(np.float64))
    numbers = numbers[np.isfinite(numbers)]
    if len(numbers) != 2 or numbers[0] != 0.0:
        return None
    if words & DISABLING or {"e", "stop"} <= words:
        return "0"
    is_powered = words & POWER and words & POWERED and numbers[1] == 1.0
    if words & ENABLING or {"dead", "man"} <= words or is_powered:
        return np.format_float_positional(numbers[1], trim="-")
    return None
