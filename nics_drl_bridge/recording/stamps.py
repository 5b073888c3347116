"""Repairs of stamps and counters as loggers leave them, each with a sentence on what it mended."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.geometry import Array
from nics_drl_bridge.interface import S_PER_NS
from nics_drl_bridge.recording.units import UNITS

BITS = (8, 16, 24, 31, 32)  # of registers that overflow
STAMP_BITS = (16, 24, 31, 32)
LATE_ROWS, LATE_S = 50, 1.0  # rows that come too late do so by less
USUAL = 10.0  # an overflow goes on with a step of less than this many usual ones
LONGEST_STEP_S = 2.0  # median step between rows; a longer one is of another unit


def joined(seconds: NDArray[Any], nanoseconds: NDArray[Any]) -> Array:
    """Joins stamps that were split into seconds and nanoseconds [s]."""
    return np.asarray(seconds + nanoseconds * S_PER_NS, dtype=np.float64)


def overflow(values: Array, scale: tuple[float, ...], bits: tuple[int, ...]) -> float | None:
    """Returns the range of a register that overflows in values (T,), which are counts x scale.

    An overflow leaves a jump of more than half of the range, after which the values go on as before
    once the range is added. None if no range explains the jumps.
    """
    step = np.diff(values)
    if not len(step):
        return None
    usual = float(np.percentile(np.abs(step), 95))
    span = float(np.ptp(values))
    for size in sorted(2.0**b * s for b in bits for s in scale):
        jump = np.abs(step) > size / 2.0
        if max(span, np.abs(values).max()) > size or not jump.any() or jump.mean() > 0.5:
            continue
        rest = np.abs(step[jump] - np.sign(step[jump]) * size)
        if rest.max() <= USUAL * max(usual, size * 1e-9):
            return size
    return None


def unwrapped(values: Array, size: float) -> tuple[Array, int]:
    """Continues values (T,) over the overflows of a register; returns them and their number."""
    step = np.diff(values)
    turns = -np.round(step / size) * (np.abs(step) > size / 2.0)
    return values + size * np.append(0.0, np.cumsum(turns)), int(np.abs(turns).sum())


def without_overflow(t: Array, name: str) -> tuple[Array, str]:
    """Continues stamps (T,) of a clock of 32 bits or less that began anew."""
    if not (np.diff(t) < 0.0).any():
        return t, ""
    size = overflow(t, (1.0, 1e-3, 1e-6, 1e-9), STAMP_BITS)
    if size is None:
        return t, ""
    made, count = unwrapped(t, size)
    return made, f"{name}: its clock overflowed at {size:.10g} {_times(count)}, and was continued."


def in_order(t: Array, name: str) -> tuple[Array, NDArray[np.intp], str]:
    """Sorts the few late rows; joins parts after each of which the clock was set back.

    Returns stamps (T,) [s] that never decrease, and the row of each.
    """
    rows = np.arange(len(t))
    back = np.diff(t) < 0.0
    if not back.any():
        return t, rows, ""
    late = np.maximum.accumulate(t) - t
    run, longest = 0, 0
    for k in range(len(t)):  # rows in a row that are older than one before them
        run = run + 1 if late[k] > 0.0 else 0
        longest = max(longest, run)
    if longest <= LATE_ROWS and late.max() <= LATE_S:
        order = np.argsort(t, kind="stable")
        finding = f"{int((late > 0.0).sum())} of {len(t)} rows came after later ones"
        return t[order], order, f"{name}: {finding}, by up to {late.max():.3g} s, and were sorted."
    usual = float(np.median(np.diff(t)[~back])) if (~back).any() else 0.0
    shift = np.where(back, usual - np.diff(t), 0.0)
    first = float(-np.diff(t)[back][0])
    k = int(np.argmax(back)) + 1
    said = f"{name}: the clock was set back {_times(int(back.sum()))} (row {k}, by {first:.3g} s)"
    return (
        t + np.append(0.0, np.cumsum(shift)), rows,
        f"{said}; the parts were joined, a usual step of {usual:.3g} s apart.",
    )  # fmt: skip


def _times(count: int) -> str:
    return "once" if count == 1 else f"{count} times"


def not_repeated(t: Array, values: Array, name: str) -> tuple[NDArray[np.bool_], str]:
    """Selects rows (T,) that do not repeat the one before them, stamp and values (T, D)."""
    again = (np.diff(t) == 0.0) & (np.diff(values, axis=0) == 0.0).all(axis=1)
    if not again.any():
        return np.ones(len(t), dtype=np.bool_), ""
    finding = f"{int(again.sum())} of {len(t)} rows repeat the row before them"
    return np.append(True, ~again), f"{name}: {finding}, stamp and all, and were left out."


def likely_unit(t: Array) -> str | None:
    """Returns the unit of stamps (T,) that can't be seconds; None if they can."""
    step = np.diff(t)
    step = step[step > 0.0]
    usual = float(np.median(step)) if len(step) else 0.0
    if usual <= LONGEST_STEP_S:
        return None
    fitting = (u for u in ("ms", "us", "ns") if usual * UNITS[u].factor < LONGEST_STEP_S)
    return next(fitting, None)
