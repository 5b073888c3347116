"""Excitation: which inputs a drive moved, and which of them it moved apart from each other.

Robust regression: which rows of a fit are outliers, as a jump of the pose makes them.

Least trimmed squares in concentration steps finds the bulk of the rows (Rousseeuw, Van
Driessen: Computing LTS regression for large data sets), what lies far from it is left out, and
the rest is fitted by ordinary least squares: reweighted least squares with weights of 0 and 1.
A recording without outliers is so fitted as if this did not exist.

Coverage: how well a drive moved each command, told before anything is fitted.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import qr

from nics_drl_bridge.recording.recording import Recording, Samples, samples_on_one_clock
from nics_drl_bridge.robot.spec import RobotSpec

Array = NDArray[np.float64]

STILL = 1e-3
"""A variable whose spread is below this share of its range did not move."""
NOISE_ONLY = 1.5
"""Nor did a measured state whose spread is below this multiple of its noise."""
DEPENDENT = 1e-7
"""A standardised feature whose part orthogonal to the others is below this is a copy."""
TOGETHER = 1e-3
"""Commands move together where less than this share of one's spread is its own."""
DIFFERENCE = 6
DIFFERENCE_GAIN = np.sqrt(924.0)  # white noise grows by this in a sixth difference
GAUSSIAN_MAD = 0.6745


def unmoved_variables(samples: Samples, spec: RobotSpec) -> tuple[str, ...]:
    """Names of the variables of X that stayed where they were for the whole drive.

    A state whose command never moved did not move either if all that it shows is noise.
    """
    limits = np.array([v.max - v.min for v in (*spec.state, *spec.command)])
    spread = samples.x.std(axis=0)
    still = spread < STILL * limits
    noise_only = spread < NOISE_ONLY * white_noise(samples.x)
    named = dict(zip(spec.variable_names, still, strict=True))
    for i, variable in enumerate(spec.state):
        followed = [variable.follows] if variable.follows else [c.name for c in spec.command]
        still[i] |= noise_only[i] and all(named[name] for name in followed)
    return tuple(n for n, s in zip(spec.variable_names, still, strict=True) if s)


def white_noise(x: Array) -> Array:
    """Standard deviation (V,) of white noise on series (T, V), from their sixth differences."""
    rest = np.diff(x, DIFFERENCE, axis=0) / DIFFERENCE_GAIN
    if len(rest) < DIFFERENCE:
        return np.zeros(x.shape[1])
    return np.asarray(np.median(np.abs(rest), axis=0) / GAUSSIAN_MAD)


def commands_together(samples: Samples, spec: RobotSpec) -> tuple[str, ...]:
    """Names of the commands that moved, but of which one is always made of the others."""
    moved = [
        i
        for i, c in enumerate(spec.command, start=len(spec.state))
        if samples.x[:, i].std() >= STILL * (c.max - c.min)
    ]
    if len(moved) < 2:
        return ()
    unit = samples.x[:, moved] - samples.x[:, moved].mean(axis=0)
    unit = unit / np.linalg.norm(unit, axis=0)
    size, axes = np.linalg.svd(unit, full_matrices=False)[1:]
    if size[-1] > TOGETHER:
        return ()
    part_of = np.abs(axes[size <= TOGETHER]).max(axis=0) > 0.1
    return tuple(spec.variable_names[i] for i, p in zip(moved, part_of, strict=True) if p)


def levels(samples: Samples, spec: RobotSpec) -> dict[str, int]:
    """How many different values each command took; more than ten count as ten."""
    first = len(spec.state)
    return {
        c.name: min(10, len(np.unique(np.round(samples.x[:, first + i], 9))))
        for i, c in enumerate(spec.command)
    }


def independent_columns(chi: Array) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Splits columns into an independent set and copies; low orders are kept first."""
    unit = chi / np.linalg.norm(chi, axis=0)
    independent: list[int] = []
    dependent: list[int] = []
    r = np.abs(np.diag(qr(unit, mode="r")[0]))  # without pivoting: each against those before it
    for k in range(chi.shape[1]):
        (independent if k < len(r) and r[k] > DEPENDENT else dependent).append(k)
    return np.array(independent, dtype=np.intp), np.array(dependent, dtype=np.intp)


BULK = 0.75
"""Share of the rows that the start is fitted to."""
CONCENTRATIONS = 12
FAR = 8.0
"""An outlier is this many standard deviations of the bulk away,"""
LARGE = 1.0
"""and by more than this share of the rates' usual range: no misfit of the model is that."""
LEAST = 1e-6
"""Rates below this, in SI units, are rounding errors and never outliers."""
USUAL = (5.0, 95.0)
"""Percentiles that bound the usual range; jumps in 5 % of the rows lie outside."""
MOST = 0.2
"""More rows than this are no outliers: the model does not fit."""
BEYOND = 0.5
"""A variable this share of its range beyond its limits was not measured but made up."""
BULK_PERCENTILE, GAUSSIAN_BULK = 90.0, 1.645
"""Once there are outliers, the misfit of the rest is judged by its tail, not by its middle."""


def inliers(chi: Array, target: Array, usual: float) -> NDArray[np.bool_]:
    """Which rows (T,) of a regression of a target (T,) on features (T, K) are no outliers.

    Args:
        chi: (T, K).
        target: (T,).
        usual: width of the usual range of such rates, see `usual_ranges`.
    """
    everything = np.ones(len(target), dtype=np.bool_)
    least = LARGE * usual
    plain = np.abs(target - chi @ _solve(chi, target))
    if not (plain > max(FAR / 2.0 * _sigma(plain), least)).any():
        return everything
    count = max(int(BULK * len(target)), min(len(target), chi.shape[1] + 1))
    bulk = np.argsort(np.abs(target - np.median(target)), kind="stable")[:count]
    for start in (np.argsort(plain, kind="stable")[:count], bulk):
        rest = _concentrated(chi, target, start)
        inside = rest <= FAR * float(np.percentile(rest, BULK_PERCENTILE)) / GAUSSIAN_BULK
        if inside.mean() >= 1.0 - MOST:
            return np.asarray(inside)
    return everything


def plausible(x: Array, low: Array, high: Array) -> NDArray[np.bool_]:
    """Which rows (T,) of X (T, V) lie not far outside the variables' limits (V,)."""
    margin = BEYOND * (high - low)
    inside = ((x >= low - margin) & (x <= high + margin)).all(axis=1)
    everything = np.ones(len(x), dtype=np.bool_)
    return np.asarray(inside) if inside.mean() >= 1.0 - MOST else everything


def _concentrated(chi: Array, target: Array, chosen: NDArray[np.intp]) -> Array:
    """Residuals (T,) of the fit to the rows that it fits best."""
    rest = np.abs(target - chi @ _solve(chi[chosen], target[chosen]))
    for _ in range(CONCENTRATIONS):
        again = np.argsort(rest, kind="stable")[: len(chosen)]
        if np.array_equal(np.sort(again), np.sort(chosen)):
            break
        chosen = again
        rest = np.abs(target - chi @ _solve(chi[chosen], target[chosen]))
    return rest


def usual_ranges(dq: Array) -> Array:
    """Width (D,) of the range in which rates (T, D) usually are; x and y share the wider."""
    low, high = np.percentile(dq, USUAL, axis=0)
    width = np.maximum(high - low, LEAST)
    width[:2] = width[:2].max()
    return np.asarray(width)


def _solve(chi: Array, target: Array) -> Array:
    return np.asarray(np.linalg.lstsq(chi, target, rcond=None)[0])


def _sigma(rest: Array) -> float:
    return float(np.median(rest)) / GAUSSIAN_MAD


GRID_S = 0.05
ENDS = (2.0, 98.0)
"""Percentiles between which a command is said to have moved."""


@dataclass(frozen=True)
class CommandCoverage:
    """How a drive moved one command.

    Attributes:
        name: of the command.
        unit: its unit.
        low, high: between which it moved, but for 2 % at each end.
        share: of the range that the robot's limits allow.
        own: share of its spread that the other commands do not explain.
        levels: how many different values it took; more than ten count as ten.
        fault: why nothing can be learnt of it; empty if something can.
    """

    name: str
    unit: str
    low: float
    high: float
    share: float
    own: float
    levels: int
    fault: str

    def line(self) -> str:
        """For people."""
        if self.fault:
            return f"{self.name}: {self.fault}"
        return (
            f"{self.name}: moved from {self.low:.2f} to {self.high:.2f} {self.unit} "
            f"({100.0 * self.share:.0f} % of its range), {100.0 * self.own:.0f} % of it on its own"
        )


def coverage(recording: Recording, spec: RobotSpec) -> tuple[CommandCoverage, ...]:
    """How a recording's commands moved, by the rules that a fit judges a drive by.

    Args:
        recording: of the robot.
        spec: the robot.

    Returns:
        One for each command, in the order of the spec.
    """
    t, row = recording.command.t, recording.command.values
    grid = np.arange(t[0], t[-1], GRID_S)
    command = row[np.searchsorted(t, grid, side="right") - 1]
    none = np.zeros((len(grid), 0))
    samples = samples_on_one_clock(grid, np.zeros((len(grid), 3)), none, command)
    stateless = spec.model_copy(update={"state": ()})
    still = unmoved_variables(samples, stateless)
    together = commands_together(samples, stateless)
    count, own = levels(samples, stateless), _own(samples.x)
    low, high = np.percentile(command, ENDS, axis=0)
    share = (high - low) / (spec.command_high - spec.command_low)
    return tuple(
        CommandCoverage(
            c.name, c.unit, float(low[i]), float(high[i]), float(share[i]), float(own[i]),
            count[c.name],
            "never moved" if c.name in still
            else "moved only together with others" if c.name in together
            else "",
        )
        for i, c in enumerate(spec.command)
    )  # fmt: skip


def _own(x: Array) -> Array:
    """Share (C,) of each column's spread that no linear combination of the others explains."""
    centred = x - x.mean(axis=0)
    own = np.zeros(x.shape[1])
    for i, size in enumerate(np.linalg.norm(centred, axis=0)):
        others = np.delete(centred, i, axis=1)
        rest = centred[:, i] - others @ np.linalg.lstsq(others, centred[:, i], rcond=None)[0]
        own[i] = np.linalg.norm(rest) / size if size > 0.0 else 0.0
    return own
