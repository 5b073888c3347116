"""Finds the switch of a recording: a column of two values, of which one lets commands count."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.geometry import Array
from nics_drl_bridge.recording.names import split_words, word_set
from nics_drl_bridge.recording.survey import Survey, TableSurvey

ENABLING = word_set("""
    safety enable enabled armed active activated auto autonomous autonomy
    deadman engaged engage
""")
DISABLING = word_set("estop emergency kill stop stopped disabled manual fault")
ON_WORDS = word_set("auto autonomous autonomy enabled on armed active offboard run")
MODES = ENABLING | word_set("mode state status safety switch")
FASTER = 2.0  # the robot moves so much faster while the switch is on
FEWEST = 20  # rows of each value of the switch, from which on the motion tells


class Switch(NamedTuple):
    """A column that has to have a value for the commands to count."""

    table: TableSurvey
    column: str
    on: str  # the value, as a mapping has it

    def refer_to(self, alone: bool) -> str:
        """Returns how a mapping refers to the column."""
        text = self.table.refer_to(self.column, alone)
        return text if text.startswith('"') or ":" not in text else write_key(text)


def write_key(text: str) -> str:
    """Returns a reference with a colon as a key of YAML."""
    return f'"{text}"'


def guess_switch(
    tables: Sequence[TableSurvey], pose: tuple[Array, Array] | None
) -> Switch | None:
    """Finds the only switch, by its name; `pose`, stamps (T,) and poses (T, 3), may deny it."""
    found = []
    for table in tables:
        for column in table.columns:
            words = split_words(column.name)
            words = split_words(table.name) if words == ["data"] else words
            on = _find_on_value({*words}, table, column)
            if on is not None and not _is_denied(table, column, on, pose):
                found.append(Switch(table, column.name, on))
    return found[0] if len(found) == 1 else None


def _find_on_value(words: set[str], table: TableSurvey, column: Survey) -> str | None:
    """Returns the value at which the commands count, by the names of column and values."""
    data = table.data.get(column.name)
    if data is None or not len(data):
        return None
    if data.dtype.kind in "US":
        texts = {str(each) for each in np.unique(data)}
        on = [each for each in texts if each.lower() in ON_WORDS]
        return on[0] if words & MODES and len(texts) == 2 and len(on) == 1 else None
    if data.dtype.kind not in "fiub":
        return None
    values = {
        float(each) for each in np.unique(data[np.isfinite(data.astype(np.float64))])
    }
    if values != {0.0, 1.0}:
        return None
    if words & DISABLING or {"e", "stop"} <= words:
        return "0"
    return "1" if words & ENABLING else None


def _is_denied(
    table: TableSurvey, column: Survey, on: str, pose: tuple[Array, Array] | None
) -> bool:
    """True if the robot does not move faster while the switch is on."""
    data = table.data[column.name]
    if pose is None or table.t is None or len(table.t) != len(data):
        return False
    t, place = pose
    order = np.argsort(table.t, kind="stable")
    row = np.searchsorted(table.t[order], t, side="right") - 1
    known = (row >= 0) & (t <= table.t[order[-1]])
    is_on = _match_value(data, on)[order][np.clip(row, 0, None)]
    step = np.hypot(*np.diff(place[:, :2], axis=0).T)
    span = np.diff(t)
    moved = known[1:] & known[:-1] & (span > 0.0)
    while_on = moved & is_on[1:] & is_on[:-1]
    while_off = moved & ~is_on[1:] & ~is_on[:-1]
    if while_on.sum() < FEWEST or while_off.sum() < FEWEST:
        return False
    speeds = [
        float(step[rows].sum() / span[rows].sum()) for rows in (while_on, while_off)
    ]
    return speeds[0] < FASTER * speeds[1]


def _match_value(data: NDArray[np.generic], value: str) -> NDArray[np.bool_]:
    if data.dtype.kind in "US":
        return np.asarray(data.astype(np.str_) == value)
    return np.asarray(data.astype(np.float64) == float(value))
