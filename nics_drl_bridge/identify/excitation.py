"""Excitation: which variables a drive moved, and moved independently, so a fit can learn them."""

from dataclasses import dataclass

import numpy as np
import scipy  # its parts load slowly, when used
from numpy.typing import NDArray

from nics_drl_bridge.errors import FitError
from nics_drl_bridge.geometry import Array
from nics_drl_bridge.identify.signals import GAUSSIAN_MAD, measure_white_noise
from nics_drl_bridge.recording.recording import Recording, Samples, samples_on_one_clock
from nics_drl_bridge.robot.spec import RobotSpec

STILL = 1e-3  # a variable whose spread is below this fraction of its range did not move
# a state below this multiple of its noise did not move if its command did not
NOISE_ONLY = 1.5
# a normalised feature whose part orthogonal to the earlier ones is smaller is a copy
DEPENDENT = 1e-7
# commands are linearly dependent if a normalised combination is smaller
TOGETHER = 1e-3
MIN_SAMPLES_PER_TERM = 5
# a velocity component below this fraction of the other one is modelled as zero
NEGLIGIBLE = 1e-3
# a measured state is noisy if its noise exceeds this fraction of its range
NOISY = 5e-4
BULK = 0.75  # fraction of the rows used in the initial fit
CONCENTRATIONS = 12
FAR = 8.0  # an outlier is this many standard deviations of the bulk away
LEAST = 1e-6  # rates below this, in SI units, are rounding errors and never outliers
# percentiles that bound the usual range; jumps in 5 % of the rows lie outside
USUAL = (5.0, 95.0)
MOST = 0.2  # a larger fraction of rows are not outliers but a misfit of the model
# a value beyond its limits by this fraction of its range is a sensor fault
BEYOND = 0.5
# If there are outliers, the misfit of the rest is estimated from its tail, not from its median.
BULK_PERCENTILE = 90.0
GAUSSIAN_BULK = 1.645
GRID_S = 0.05
ENDS = (2.0, 98.0)  # percentiles that bound the range of a command
# a drive over a smaller fraction of a command's range says little about the rest
NARROW = 0.4


@dataclass(frozen=True)
class Excitation:
    """Which of a robot's variables a drive moves."""

    # variables that the drive never moved, so no term contains them
    unmoved: tuple[str, ...]
    together: tuple[str, ...]  # commands that moved, but were linearly dependent

    @classmethod
    def of(cls, samples: Samples, spec: RobotSpec) -> "Excitation":
        """Computes the excitation from a drive's samples."""
        return cls(
            list_unmoved_variables(samples, spec), list_commands_together(samples, spec)
        )


def list_unmoved_variables(samples: Samples, spec: RobotSpec) -> tuple[str, ...]:
    """Returns the variables of X that stayed constant, or show only noise without a command."""
    limits = np.array([v.max - v.min for v in (*spec.state, *spec.command)])
    spread = samples.x.std(axis=0)
    still = spread < STILL * limits
    noise_only = spread < NOISE_ONLY * measure_white_noise(samples.x)
    named = dict(zip(spec.variable_names, still, strict=True))
    for i, variable in enumerate(spec.state):
        if variable.follows:
            followed = [variable.follows]
        else:
            followed = [c.name for c in spec.command]
        still[i] |= noise_only[i] and all(named[name] for name in followed)
    return tuple(n for n, s in zip(spec.variable_names, still, strict=True) if s)


def list_commands_together(samples: Samples, spec: RobotSpec) -> tuple[str, ...]:
    """Returns the commands that moved, but were linearly dependent."""
    part_of = (
        np.abs(find_constant_combinations(samples, spec)).max(axis=0, initial=0.0) > 0.1
    )
    return tuple(c.name for c, part in zip(spec.command, part_of, strict=True) if part)


def find_constant_combinations(samples: Samples, spec: RobotSpec) -> Array:
    """Returns orthonormal combinations (N, C) of the scaled commands that stayed constant."""
    command = samples.x[:, len(spec.state) :]
    reach = np.array([c.max - c.min for c in spec.command])
    moved = np.flatnonzero(command.std(axis=0) >= STILL * reach)
    unit = command[:, moved] - command[:, moved].mean(axis=0)
    size, axes = np.linalg.svd(
        unit / np.linalg.norm(unit, axis=0), full_matrices=False
    )[1:]
    constant = np.zeros((np.count_nonzero(size <= TOGETHER), len(reach)))
    constant[:, moved] = axes[size <= TOGETHER]
    return constant


def split_independent_columns(chi: Array) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Splits columns into an independent set and copies; earlier, low-order ones are kept first.

    A column of zeros counts as a copy.
    """
    unit = chi / np.maximum(np.linalg.norm(chi, axis=0), np.finfo(np.float64).tiny)
    # no pivoting: each column is compared with its predecessors
    apart = np.abs(np.diag(scipy.linalg.qr(unit, mode="r")[0])) > DEPENDENT
    return np.flatnonzero(apart), np.flatnonzero(~apart)


def select_moved_terms(
    powers: NDArray[np.int64], names: tuple[str, ...], unmoved: tuple[str, ...]
) -> NDArray[np.int64]:
    """Returns the terms (K, V) of variables that moved; FitError if none did."""
    if len(unmoved) == len(names):
        raise FitError(
            "no command ever changed, so nothing can be learnt; vary each command."
        )
    still = [names.index(name) for name in unmoved]
    moved: NDArray[np.int64] = powers[(powers[:, still] == 0).all(axis=1)]
    return moved


def check_sample_count(samples: Samples, terms: int) -> None:
    """Raises FitError if the samples are too few for a number of terms."""
    if len(samples.t) < MIN_SAMPLES_PER_TERM * terms:
        few = f"{len(samples.t)} samples are too few for {terms} terms"
        raise FitError(f"{few}; drive for longer, or lower the order.")


def select_twist_terms(
    powers: NDArray[np.int64], spec: RobotSpec, unmoved: tuple[str, ...]
) -> NDArray[np.bool_]:
    """Selects the terms (K,) allowed in the body twist of a noisy recording."""
    if not spec.state:
        return np.ones(len(powers), dtype=np.bool_)
    allowed = (powers[:, len(spec.state) :] == 0).all(axis=1)
    if any(v.unit == "m/s" and v.name not in unmoved for v in spec.state):
        allowed &= powers.sum(axis=1) > 0
    return np.asarray(allowed)


def list_moving_dofs(dq: Array) -> tuple[int, ...]:
    """Returns indices of the rates (T, D) that move: vx, vy unless negligible, and the others."""
    size = np.sqrt((dq**2).mean(axis=0))
    return tuple(
        d for d in range(len(size)) if d > 1 or size[d] > NEGLIGIBLE * size[:2].max()
    )


def states_are_noisy(samples: Samples, spec: RobotSpec) -> bool:
    """True if the noise of a measured state would bias a fit."""
    width = np.array([v.max - v.min for v in spec.state])
    return bool((measure_white_noise(samples.x[:, : len(width)]) > NOISY * width).any())


def select_inliers(chi: Array, target: Array, usual: float) -> NDArray[np.bool_]:
    """Selects the rows of a target (T,) on features (T, K) that are not outliers."""
    everything = np.ones(len(target), dtype=np.bool_)
    plain = _measure_residuals(chi, target)
    if not (
        plain > max(FAR / 2.0 * float(np.median(plain)) / GAUSSIAN_MAD, usual)
    ).any():
        return everything
    count = max(int(BULK * len(target)), min(len(target), chi.shape[1] + 1))
    bulk = np.argsort(np.abs(target - np.median(target)), kind="stable")[:count]
    for start in (np.argsort(plain, kind="stable")[:count], bulk):
        rest = _fit_best_rows(chi, target, start)
        inside = (
            rest <= FAR * float(np.percentile(rest, BULK_PERCENTILE)) / GAUSSIAN_BULK
        )
        if inside.mean() >= 1.0 - MOST:
            return np.asarray(inside)
    return everything


def select_plausible_rows(x: Array, spec: RobotSpec) -> NDArray[np.bool_]:
    """Selects the rows (T,) of X (T, V) that are within or close to the variables' limits."""
    low, high = np.array([[v.min, v.max] for v in (*spec.state, *spec.command)]).T
    margin = BEYOND * (high - low)
    inside = ((x >= low - margin) & (x <= high + margin)).all(axis=1)
    if inside.mean() >= 1.0 - MOST:
        return np.asarray(inside)
    return np.ones(len(x), dtype=np.bool_)


def _fit_best_rows(chi: Array, target: Array, chosen: NDArray[np.intp]) -> Array:
    """Returns absolute residuals (T,) of a fit to the best-fitting rows, starting from `chosen`."""
    for _ in range(CONCENTRATIONS):
        rest = _measure_residuals(chi, target, chosen)
        again = np.argsort(rest, kind="stable")[: len(chosen)]
        if np.array_equal(np.sort(again), np.sort(chosen)):
            return rest
        chosen = again
    return _measure_residuals(chi, target, chosen)


def _measure_residuals(
    chi: Array, target: Array, rows: NDArray[np.intp] | slice = slice(None)
) -> Array:
    """Returns absolute residuals (T,) of a least-squares fit to some rows."""
    return np.abs(
        target - chi @ np.linalg.lstsq(chi[rows], target[rows], rcond=None)[0]
    )


def measure_usual_ranges(dq: Array) -> Array:
    """Returns the width (D,) of the usual range of rates (T, D); x and y share the wider one."""
    low, high = np.percentile(dq, USUAL, axis=0)
    width = np.maximum(high - low, LEAST)
    width[:2] = width[:2].max()
    return np.asarray(width)


@dataclass(frozen=True)
class CommandCoverage:
    """Coverage of one command by a drive."""

    name: str
    unit: str
    low: float  # its range, without the outer 2 % at each end
    high: float
    share: float  # fraction of the range that the robot's limits allow
    own: float  # fraction of its spread that the other commands do not explain
    fault: str  # why it can't be learnt; empty if it can

    def line(self) -> str:
        """Formats one line for people."""
        if self.fault:
            return f"{self.name}: {self.fault}"
        moved = f"from {self.low:.2f} to {self.high:.2f} {self.unit}"
        share = f"{100.0 * self.share:.0f} % of its range"
        return f"{self.name}: moved {moved} ({share}), {100.0 * self.own:.0f} % of it on its own"


def describe_narrow_commands(recording: Recording, spec: RobotSpec) -> list[str]:
    """Returns a sentence for each command of which a drive covers only a small part."""
    return [
        f"{c.name} covers {100.0 * c.share:.0f} % of its range, {c.low:.3g} to {c.high:.3g} "
        f"{c.unit}: beyond that the simulator guesses; drive over the whole range, or narrow it in "
        "the robot's file."
        for c in measure_coverage(recording, spec)
        if not c.fault and c.share < NARROW
    ]


def measure_coverage(
    recording: Recording, spec: RobotSpec
) -> tuple[CommandCoverage, ...]:
    """Measures the coverage of each command of a recording, by the same rules as a fit."""
    t = recording.command.t
    row = recording.command.values
    grid = np.arange(t[0], t[-1], GRID_S)
    command = row[np.searchsorted(t, grid, side="right") - 1]
    nothing = np.zeros((len(grid), 3))
    samples = samples_on_one_clock(grid, nothing, nothing[:, :0], command)
    excited = Excitation.of(samples, spec.model_copy(update={"state": ()}))
    faults = dict.fromkeys(excited.together, "moved only together with others")
    faults |= dict.fromkeys(excited.unmoved, "never moved")
    lowest, highest = np.percentile(command, ENDS, axis=0)
    share = (highest - lowest) / (spec.command_high - spec.command_low)
    own_share = _measure_own_shares(samples.x)
    return tuple(
        CommandCoverage(
            c.name,
            c.unit,
            low=float(lowest[i]),
            high=float(highest[i]),
            share=float(share[i]),
            own=float(own_share[i]),
            fault=faults.get(c.name, ""),
        )
        for i, c in enumerate(spec.command)
    )


def _measure_own_shares(x: Array) -> Array:
    """Returns the fraction (C,) of each column's spread that is independent of the others."""
    centred = x - x.mean(axis=0)
    shares = np.zeros(x.shape[1])
    for i, size in enumerate(np.linalg.norm(centred, axis=0)):
        others = np.delete(centred, i, axis=1)
        rest = (
            centred[:, i]
            - others @ np.linalg.lstsq(others, centred[:, i], rcond=None)[0]
        )
        shares[i] = np.linalg.norm(rest) / size if size > 0.0 else 0.0
    return shares
