"""Finds the switch of a recording: a column of two values, one of which enables the commands."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from nics_drl_bridge.geometry import Array
from nics_drl_bridge.recording.names import word_set
from nics_drl_bridge.recording.survey import Survey, TableSurvey
from nics_drl_bridge.recording.table import Column, is_text
from nics_drl_bridge.recording.values import match_values

ENABLING = word_set("""
    safety enable enabled armed active activated auto autonomous autonomy
    deadman engaged engage
""")
DISABLING = word_set("estop emergency kill stop stopped disabled manual fault")
ON_WORDS = word_set("auto autonomous autonomy enabled on armed active offboard run")
MODES = ENABLING | word_set("mode state status safety switch")
NO_VALUES = np.zeros(0)
FASTER = 2.0  # factor by which the robot moves faster while the switch is on
MIN_ROWS_PER_VALUE = 20  # rows of each value that are needed to rule a switch out


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


def guess_switch(
    tables: Sequence[TableSurvey], poses: tuple[Array, Array] | None
) -> Switch | None:
    """Finds the only switch by its name; `poses`, stamps (T,) and poses (T, 3), may rule it out."""
    switches = []
    for table in tables:
        for column in table.columns:
            words = {*table.list_words(column.name)}
            values = table.data.get(column.name, NO_VALUES)
            on = _find_on_value(words, values)
            if on is not None and not _is_denied(table, column, on, poses):
                switches.append(Switch(table, column.name, on))
    if len(switches) != 1:
        return None
    return switches[0]


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
    if {*numbers[np.isfinite(numbers)].tolist()} != {0.0, 1.0}:
        return None
    if words & DISABLING or {"e", "stop"} <= words:
        return "0"
    if words & ENABLING:
        return "1"
    return None


def _is_denied(
    table: TableSurvey, column: Survey, on: str, poses: tuple[Array, Array] | None
) -> bool:
    """True if the robot does not move faster while the switch is on."""
    values = table.data[column.name]
    if poses is None or table.t is None or len(table.t) != len(values):
        return False
    t, pose = poses
    order = np.argsort(table.t, kind="stable")
    row = np.searchsorted(table.t[order], t, side="right") - 1
    is_known = (row >= 0) & (t <= table.t[order[-1]])
    is_on = match_values(values, _parse_value(on))[order][np.clip(row, 0, None)]
    step = np.hypot(*np.diff(pose[:, :2], axis=0).T)
    span = np.diff(t)
    is_usable = is_known[1:] & is_known[:-1] & (span > 0.0)
    while_on = is_usable & is_on[1:] & is_on[:-1]
    while_off = is_usable & ~is_on[1:] & ~is_on[:-1]
    if while_on.sum() < MIN_ROWS_PER_VALUE or while_off.sum() < MIN_ROWS_PER_VALUE:
        return False
    speed_on = float(step[while_on].sum() / span[while_on].sum())
    speed_off = float(step[while_off].sum() / span[while_off].sum())
    return speed_on < FASTER * speed_off


def _parse_value(text: str) -> float | str:
    if text in ("0", "1"):
        return float(text)
    return text
