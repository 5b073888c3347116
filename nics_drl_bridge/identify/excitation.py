"""Excitation: what a drive moved, and moved independently, and so what a fit can learn from it.

Outliers: the rows that it can't. Least trimmed squares with concentration steps finds the bulk
(Rousseeuw, Van Driessen: Computing LTS regression for large data sets). Rows far from it are
dropped and the rest is fitted by ordinary least squares: reweighted least squares with weights of
0 and 1. Without outliers, the fit is plain least squares.

Coverage: the range of motion of each command in a drive, computed before any fit.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import qr

from nics_drl_bridge.errors import FitError
from nics_drl_bridge.identify.signals import GAUSSIAN_MAD, white_noise
from nics_drl_bridge.recording.recording import Recording, Samples, samples_on_one_clock
from nics_drl_bridge.robot.spec import RobotSpec

Array = NDArray[np.float64]

STILL = 1e-3
"""A variable whose spread is below this share of its range did not move."""
NOISE_ONLY = 1.5
"""Nor did a measured state whose spread is below this multiple of its noise, if its command did
not move."""
DEPENDENT = 1e-7
"""A normalised feature whose component orthogonal to those before it is below this is a copy."""
TOGETHER = 1e-3
"""Commands are linearly dependent if a normalised combination of them is smaller than this."""
MIN_SAMPLES_PER_TERM = 5
NEGLIGIBLE = 1e-3
"""A velocity component below this share of the other one is modelled as zero."""
NOISY = 5e-4
"""A measured state is noisy if its noise exceeds this share of its range."""


@dataclass(frozen=True)
class Excitation:
    """Excitation of a robot's variables by a drive.

    Attributes:
        unmoved: variables that the drive never moved, so that no term contains them.
        together: commands that moved, but were linearly dependent.
        levels: number of different values of each command, at most 10.
    """

    unmoved: tuple[str, ...]
    together: tuple[str, ...]
    levels: dict[str, int]


def excitation_of(samples: Samples, spec: RobotSpec) -> Excitation:
    """Returns the excitation of the variables by a drive."""
    return Excitation(
        unmoved_variables(samples, spec), commands_together(samples, spec), levels(samples, spec)
    )


def unmoved_variables(samples: Samples, spec: RobotSpec) -> tuple[str, ...]:
    """Returns the names of the variables of X that stayed constant for the whole drive.

    A state whose command never moved did not move either if it shows nothing but noise.
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


def commands_together(samples: Samples, spec: RobotSpec) -> tuple[str, ...]:
    """Returns the names of the commands that moved, but were linearly dependent."""
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
    """Returns the number of different values of each command; more than ten count as ten."""
    first = len(spec.state)
    return {
        c.name: min(10, len(np.unique(np.round(samples.x[:, first + i], 9))))
        for i, c in enumerate(spec.command)
    }


def independent_columns(chi: Array) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Splits columns into an independent set and copies; earlier, low-order ones are kept first."""
    unit = chi / np.linalg.norm(chi, axis=0)
    independent: list[int] = []
    dependent: list[int] = []
    r = np.abs(np.diag(qr(unit, mode="r")[0]))  # no pivoting: each against its predecessors
    for k in range(chi.shape[1]):
        (independent if k < len(r) and r[k] > DEPENDENT else dependent).append(k)
    return np.array(independent, dtype=np.intp), np.array(dependent, dtype=np.intp)


def moved_terms(
    samples: Samples, powers: NDArray[np.int64], names: tuple[str, ...], unmoved: tuple[str, ...]
) -> NDArray[np.int64]:
    """Returns the terms (K, V) of variables that moved; refuses too few samples for them."""
    still = [names.index(name) for name in unmoved]
    moved: NDArray[np.int64] = powers[(powers[:, still] == 0).all(axis=1)]
    if len(samples.t) < MIN_SAMPLES_PER_TERM * len(moved):
        raise FitError(
            f"{len(samples.t)} samples are too few for {len(moved)} terms; drive for longer, or "
            "lower the order."
        )
    if len(unmoved) == len(names):
        raise FitError(
            "no command ever changed, so nothing can be learnt; vary each over its range."
        )
    return moved


def terms_through_state(
    powers: NDArray[np.int64], spec: RobotSpec, unmoved: tuple[str, ...]
) -> NDArray[np.bool_]:
    """Selects the terms (K,) allowed in the body twist of a noisy recording."""
    if not spec.state:
        return np.ones(len(powers), dtype=np.bool_)
    allowed = (powers[:, len(spec.state) :] == 0).all(axis=1)
    if any(v.unit == "m/s" and v.name not in unmoved for v in spec.state):
        allowed &= powers.sum(axis=1) > 0
    return np.asarray(allowed)


def moving_dofs(dq: Array) -> tuple[int, ...]:
    """Returns the indices of the dofs that move: of vx and vy the non-negligible, and all others.

    Args:
        dq: (T, D) rates.
    """
    size = np.sqrt((dq**2).mean(axis=0))
    moves = np.ones(len(size), dtype=np.bool_)
    moves[:2] = size[:2] > NEGLIGIBLE * size[:2].max()
    return tuple(map(int, np.flatnonzero(moves)))


def states_are_noisy(samples: Samples, spec: RobotSpec) -> bool:
    """True if the noise of a measured state would bias a fit."""
    if not spec.state:
        return False
    size = len(spec.state)
    width = np.array([v.max - v.min for v in spec.state])
    return bool((white_noise(samples.x[:, :size]) > NOISY * width).any())


BULK = 0.75
"""Share of the rows used in the initial fit."""
CONCENTRATIONS = 12
FAR = 8.0
"""An outlier is this many standard deviations of the bulk away,"""
LARGE = 1.0
"""and rows are searched only if some residual also exceeds this share of the rates' usual range,
more than any misfit of the model."""
LEAST = 1e-6
"""Rates below this, in SI units, are rounding errors and never outliers."""
USUAL = (5.0, 95.0)
"""Percentiles that bound the usual range; jumps in 5 % of the rows lie outside."""
MOST = 0.2
"""A larger share of rows is not outliers but a misfit of the model."""
BEYOND = 0.5
"""A value beyond its limits by this share of its range is a sensor fault."""
BULK_PERCENTILE, GAUSSIAN_BULK = 90.0, 1.645
"""If there are outliers, the misfit of the rest is estimated from its tail, not from its median."""


def inliers(chi: Array, target: Array, usual: float) -> NDArray[np.bool_]:
    """Selects the rows (T,) of a regression of a target on features that are not outliers.

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


def plausible(x: Array, spec: RobotSpec) -> NDArray[np.bool_]:
    """Selects the rows (T,) of X (T, V) that are within or close to the variables' limits."""
    low, high = np.array([[v.min, v.max] for v in (*spec.state, *spec.command)]).T
    margin = BEYOND * (high - low)
    inside = ((x >= low - margin) & (x <= high + margin)).all(axis=1)
    everything = np.ones(len(x), dtype=np.bool_)
    return np.asarray(inside) if inside.mean() >= 1.0 - MOST else everything


def _concentrated(chi: Array, target: Array, chosen: NDArray[np.intp]) -> Array:
    """Returns absolute residuals (T,) of the fit to the best fitting rows, found from `chosen`."""
    rest = np.abs(target - chi @ _solve(chi[chosen], target[chosen]))
    for _ in range(CONCENTRATIONS):
        again = np.argsort(rest, kind="stable")[: len(chosen)]
        if np.array_equal(np.sort(again), np.sort(chosen)):
            break
        chosen = again
        rest = np.abs(target - chi @ _solve(chi[chosen], target[chosen]))
    return rest


def usual_ranges(dq: Array) -> Array:
    """Returns the width (D,) of the usual range of rates (T, D); x and y share the wider one."""
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
"""Percentiles that bound the range of a command."""


@dataclass(frozen=True)
class CommandCoverage:
    """Coverage of one command by a drive.

    Attributes:
        name: of the command.
        unit: its unit.
        low, high: its range, without 2 % at each end.
        share: of the range that the robot's limits allow.
        own: share of its spread that the other commands do not explain.
        levels: number of different values; more than ten count as ten.
        fault: why nothing can be learnt about it; empty if something can.
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
        """Returns a human-readable line."""
        if self.fault:
            return f"{self.name}: {self.fault}"
        return (
            f"{self.name}: moved from {self.low:.2f} to {self.high:.2f} {self.unit} "
            f"({100.0 * self.share:.0f} % of its range), {100.0 * self.own:.0f} % of it on its own"
        )


def coverage(recording: Recording, spec: RobotSpec) -> tuple[CommandCoverage, ...]:
    """Measures the coverage of a recording's commands, by the same rules as a fit.

    Args:
        recording: of the robot.
        spec: the robot.

    Returns:
        One per command, in the order of the spec.
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
    """Returns the share (C,) of each column's spread that is linearly independent of the others."""
    centred = x - x.mean(axis=0)
    own = np.zeros(x.shape[1])
    for i, size in enumerate(np.linalg.norm(centred, axis=0)):
        others = np.delete(centred, i, axis=1)
        rest = centred[:, i] - others @ np.linalg.lstsq(others, centred[:, i], rcond=None)[0]
        own[i] = np.linalg.norm(rest) / size if size > 0.0 else 0.0
    return own
