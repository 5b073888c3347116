"""Time series: means of held commands, states that follow them, smoothed poses, and noise.

A command takes effect in this order:

1. `average_effect` bends the values of the commands by the input curves of the motors, and delays
   each one.
2. The stream of commands holds a value until the next stamp. `average_held` integrates it, so that
   any interval gets its exact mean.
3. `infer_states` lets unmeasured states follow the commands by first-order lags: over a step `dt`,
   a state keeps `exp(-dt / lag)` of its distance from the command.
"""

from dataclasses import replace

import numpy as np
import scipy  # its parts load slowly, when used
from numpy.typing import NDArray

from nics_drl_bridge.geometry import Array
from nics_drl_bridge.identify.kernels import follow_first_order
from nics_drl_bridge.recording.recording import Stream
from nics_drl_bridge.robot import taylor
from nics_drl_bridge.robot.curve import InputCurve, apply_curves, delays
from nics_drl_bridge.robot.spec import RobotSpec

MOST_SMOOTHED = 64  # maximum number of poses that a parabola is fitted to
FEWEST_SMOOTHED = 4
RIDGE = 1e-9  # keeps the normal equations of a parabola regular
DEFAULT_LAG_S = 0.1
SHORTEST_LAG_S = 1e-6
AT_REST_S = (
    2.0  # this long before the first command, states have the values of a robot at rest
)
# Sixth differences cancel smooth motion (polynomials up to the fifth order) and leave white noise,
# which they amplify by the root of the sum of their squared weights.
DIFFERENCE = 6
DIFFERENCE_GAIN = np.sqrt(924.0)
# median absolute deviation of a normal distribution with a standard deviation of 1
GAUSSIAN_MAD = 0.6745


def average_effect(
    command: Stream,
    spec: RobotSpec,
    curves: tuple[InputCurve, ...],
    start: Array,
    end: Array,
) -> Array:
    """Returns means (..., C) over intervals (...) [s] of commands after their curves and delays."""
    names = [c.name for c in spec.command]
    bent = replace(command, values=apply_curves(command.values, names, curves))
    delay_s = delays(names, curves)
    means = average_held(bent, spec, start, end)
    for c in np.flatnonzero(delay_s):
        delayed = average_held(bent, spec, start - delay_s[c], end - delay_s[c])
        means[..., c] = delayed[..., c]
    return means


def average_held(
    command: Stream,
    spec: RobotSpec,
    start: Array,
    end: Array,
    powers: NDArray[np.int64] | None = None,
) -> Array:
    """Returns means (..., C) of held commands over intervals (...) [s].

    With exponents `powers` (K, C), returns the means (..., K) of these products instead.
    """
    # Before its first command a robot is at rest, so commands that ever change are zero then.
    at_rest = np.clip(0.0, spec.command_low, spec.command_high)
    before = np.where(select_moved_commands(command), at_rest, command.values[0])
    values = np.concatenate([before[None], command.values])
    if powers is not None:
        values = taylor.evaluate(values, powers)
    # Row k of the values holds from edge k to edge k + 1.
    first = min(start.min(), command.t[0]) - 1.0
    last = max(end.max(), command.t[-1]) + 1.0
    edges = np.concatenate([[first], command.t, [last]])
    integrals = values * np.diff(edges)[:, None]
    return _average(edges, integrals, start, end)


def average_between_stamps(t: Array, values: Array, start: Array, end: Array) -> Array:
    """Returns means (n, K) over intervals (n,) of values (T, K), linear between stamps (T,)."""
    trapezoids = np.diff(t)[:, None] * (values[1:] + values[:-1]) / 2.0
    return _average(t, trapezoids, start, end)


def _average(edges: Array, integrals: Array, start: Array, end: Array) -> Array:
    """Returns means (..., K) over intervals (...), from integrals (E, K) between edges (E + 1,)."""
    zero = np.zeros((1, integrals.shape[1]))
    area = np.concatenate([zero, np.cumsum(integrals, axis=0)])  # up to each edge
    means = np.empty((*start.shape, integrals.shape[1]))
    for k, column in enumerate(area.T):
        means[..., k] = np.interp(end, edges, column) - np.interp(start, edges, column)
    return means / (end - start)[..., None]


def select_moved_commands(command: Stream) -> NDArray[np.bool_]:
    """Returns a mask (C,) of the commands that ever changed."""
    return np.asarray(np.ptp(command.values, axis=0) > 0.0)


def select_moved_inputs(command: Stream, spec: RobotSpec) -> NDArray[np.bool_]:
    """Returns a mask (S,) of the states whose command changed, or (C,) without any state."""
    moved = select_moved_commands(command)
    return moved[list_followed_commands(spec)] if spec.state else moved


def list_followed_commands(spec: RobotSpec) -> NDArray[np.intp]:
    """Returns the index (S,) of the command that each state variable follows."""
    names = [c.name for c in spec.command]
    return np.array([names.index(str(v.follows)) for v in spec.state], dtype=np.intp)


def find_speed_index(spec: RobotSpec) -> int | None:
    """Returns the index of the speed along the direction of travel; None if not unique."""
    speeds = [i for i, v in enumerate(spec.state) if v.unit == "m/s"]
    return speeds[0] if len(speeds) == 1 else None


def get_nominal_lags(spec: RobotSpec) -> Array:
    """Returns the spec's time constants (S,) `NAME_lag` [s], or a typical one."""
    return np.array(
        [spec.parameters.get(f"{v.name}_lag", DEFAULT_LAG_S) for v in spec.state]
    )


def infer_states(
    command: Stream, spec: RobotSpec, lags: Array, latency: Array | float, grid: Array
) -> Array:
    """Infers states (T, S) at uniform times (T,) from commands, with a gain of one.

    Args:
        command: the commands.
        spec: the robot; each state follows one command.
        lags: (S,) time constants [s].
        latency: () or (S,) from a command's stamp to its effect [s].
        grid: (T,) uniform times [s].
    """
    dt = float(grid[1] - grid[0])
    follows = list_followed_commands(spec)
    targets = np.empty((len(grid), len(follows)))
    for late in np.unique(latency):
        means = average_held(command, spec, grid - late, grid + dt - late)
        delayed = np.broadcast_to(latency, len(follows)) == late
        targets[:, delayed] = means[:, follows[delayed]]
    at_rest = np.array([command.t[0] - AT_REST_S])
    initial = average_held(command, spec, at_rest, at_rest + 1.0)[0, follows]
    states = np.empty((len(grid), len(follows)))
    for i, kept in enumerate(np.exp(-dt / np.maximum(lags, SHORTEST_LAG_S))):
        states[:, i] = lag_behind(targets[:, i], float(initial[i]), float(kept))
    return states


def lag_behind(targets: Array, begin: float, kept: float) -> Array:
    """Returns states (T,), at first `begin`, that keep a share of their distance from targets."""
    states = np.empty(len(targets))
    states[0] = begin
    follow_first_order(states, np.ascontiguousarray(targets), kept)
    return states


def measure_white_noise(values: Array) -> Array:
    """Returns the standard deviation (D,) of white noise on otherwise smooth series (T, D)."""
    rest = np.diff(values, DIFFERENCE, axis=0) / DIFFERENCE_GAIN
    if len(rest) < DIFFERENCE:
        return np.zeros(values.shape[1])
    return np.asarray(np.median(np.abs(rest), axis=0) / GAUSSIAN_MAD)


def unwrap_headings(pose: Array) -> Array:
    """Returns poses (T, 3) with unwrapped headings."""
    return np.concatenate([pose[:, :2], np.unwrap(pose[:, 2])[:, None]], axis=1)


def resample(
    t: Array, pose: Array, at: Array, half_width: float, weights: Array | None = None
) -> Array:
    """Resamples unwrapped poses (T, 3) at times (n,): smoothed if `half_width` [s] is not 0.

    Without smoothing, a cubic spline passes through all poses. With it, the value at a time is that
    of a parabola, fitted with weights (T, 3) to the poses within the half-width, at least four. Of
    more than `MOST_SMOOTHED` poses, only every second, third and so on is used.
    """
    distinct = np.concatenate([[True], np.diff(t) > 0.0])
    weights = np.ones_like(pose) if weights is None else weights
    t = t[distinct]
    pose = pose[distinct]
    weights = weights[distinct]
    if half_width == 0.0:
        return np.asarray(scipy.interpolate.make_interp_spline(t, pose, k=3)(at))
    row, is_used = _find_rows_around(t, at, half_width)
    weight = is_used[..., None] * weights[row]  # (n, m, 3)
    z = (t[row] - at[:, None]) / half_width
    change = pose[row] - pose[row[:, :1]]
    return np.asarray(_fit_parabolas(z, change, weight) + pose[row[:, 0]])


def _find_rows_around(
    t: Array, at: Array, half_width: float
) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
    """Returns rows (n, m) of stamps around each time (n,), and which of these to use.

    Those not to be used pad the rows to one number m.
    """
    first = np.minimum(np.searchsorted(t, at - half_width), np.searchsorted(t, at) - 2)
    first = np.clip(first, 0, max(len(t) - FEWEST_SMOOTHED, 0))
    last = np.maximum(np.searchsorted(t, at + half_width), first + FEWEST_SMOOTHED)
    stride = -(-(last - first) // MOST_SMOOTHED)  # rounded up
    most = min(MOST_SMOOTHED, int((last - first).max()))
    row = first[:, None] + stride[:, None] * np.arange(most)
    is_used = (row < last[:, None]) & (row < len(t))
    return np.minimum(row, len(t) - 1), is_used


def _fit_parabolas(z: Array, change: Array, weight: Array) -> Array:
    """Returns the values (n, 3) at z = 0 of parabolas through changes (n, m, 3) at z (n, m)."""
    # The normal equations of  change = c0 + c1 z + c2 z^2,  z from -1 to 1, for each time n,
    # neighbour k, degree of freedom d, powers i and j. The value at the time is c0.
    basis = z[..., None] ** np.arange(3)
    normal = np.einsum("nki,nkd,nkj->ndij", basis, weight, basis) + RIDGE * np.eye(3)
    right = np.einsum("nki,nkd,nkd->ndi", basis, weight, change)
    coefficients = np.linalg.solve(normal, right[..., None])[..., 0]  # (n, 3, 3)
    return np.asarray(coefficients[..., 0])
