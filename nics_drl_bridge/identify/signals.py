"""Signals in time: held commands, the states that follow them, means, resampled poses, noise."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import scipy  # .signal loads in a second, when used
from numpy.typing import NDArray
from scipy.interpolate import make_interp_spline

from nics_drl_bridge.geometry import Array
from nics_drl_bridge.identify.kernels import limp
from nics_drl_bridge.recording.recording import Stream
from nics_drl_bridge.robot import taylor
from nics_drl_bridge.robot.curve import InputCurve, apply_curves, delays
from nics_drl_bridge.robot.spec import RobotSpec

SMOOTHING_BATCH = 64
DEFAULT_LAG_S = 0.1
DIFFERENCE = 6
# factor by which a sixth difference amplifies white noise
DIFFERENCE_GAIN = np.sqrt(924.0)
GAUSSIAN_MAD = 0.6745


def taken(
    command: Stream,
    spec: RobotSpec,
    curves: tuple[InputCurve, ...],
    start: Array,
    end: Array,
) -> Array:
    """Returns means (..., C) of commands in effect over intervals (...) [s], given their curves."""
    names = [c.name for c in spec.command]
    stream = replace(command, values=apply_curves(command.values, names, curves))
    late = delays(names, curves)
    means = held(stream, spec, start, end)
    for c in np.flatnonzero(late):
        means[..., c] = held(stream, spec, start - late[c], end - late[c])[..., c]
    return means


def held(
    command: Stream,
    spec: RobotSpec,
    start: Array,
    end: Array,
    powers: NDArray[np.int64] | None = None,
) -> Array:
    """Returns means (..., C), or of powers (K, C), of held commands over intervals (...) [s]."""
    # Before its first command a robot is at rest, so commands that ever change are zero then.
    still = np.clip(0.0, spec.command_low, spec.command_high)
    before = np.where(moved_commands(command), still, command.values[0])
    values = np.concatenate([before[None], command.values])
    if powers is not None:
        values = taylor.evaluate(values, powers)
    low = min(start.min(), command.t[0]) - 1.0
    high = max(end.max(), command.t[-1]) + 1.0
    edges = np.concatenate([[low], command.t, [high]])
    return _means(edges, values * np.diff(edges)[:, None], start, end)


def interval_means(t: Array, values: Array, start: Array, end: Array) -> Array:
    """Returns means (n, K) over intervals (n,) of values (T, K), linear between stamps (T,)."""
    return _means(t, np.diff(t)[:, None] * (values[1:] + values[:-1]) / 2.0, start, end)


def _means(t: Array, parts: Array, start: Array, end: Array) -> Array:
    """Returns means (..., K) over intervals, from the integrals (T, K) between times."""
    area = np.concatenate([np.zeros((1, parts.shape[1])), np.cumsum(parts, axis=0)])
    means = np.empty((*start.shape, parts.shape[1]))
    for k, column in enumerate(area.T):
        means[..., k] = np.interp(end, t, column) - np.interp(start, t, column)
    return means / (end - start)[..., None]


def moved_commands(command: Stream) -> NDArray[np.bool_]:
    """Returns a mask (C,) of the commands that ever changed."""
    return np.asarray(np.ptp(command.values, axis=0) > 0.0)


def moved_inputs(command: Stream, spec: RobotSpec) -> NDArray[np.bool_]:
    """Returns a mask (S,) of the states whose command changed, or (C,) without any state."""
    moved = moved_commands(command)
    return moved[followed(spec)] if spec.state else moved


def followed(spec: RobotSpec) -> NDArray[np.intp]:
    """Returns the index (S,) of the command that each state variable follows."""
    names = [c.name for c in spec.command]
    return np.array([names.index(str(v.follows)) for v in spec.state], dtype=np.intp)


def speed_index(spec: RobotSpec) -> int | None:
    """Returns the index of the speed along the direction of travel; None if not unique."""
    speeds = [i for i, v in enumerate(spec.state) if v.unit == "m/s"]
    return speeds[0] if len(speeds) == 1 else None


def nominal_lags(spec: RobotSpec) -> Array:
    """Returns the spec's time constants (S,) `NAME_lag` [s], or a typical one."""
    return np.array(
        [spec.parameters.get(f"{v.name}_lag", DEFAULT_LAG_S) for v in spec.state]
    )


class Motors(NamedTuple):
    """Motors, which limit states that follow commands with a gain of one, in addition to lags."""

    fall: Array  # (S,) minimum and maximum rates [unit of the command / s]
    rise: Array
    dead: Array  # (S,) maximum command without an effect [its unit]

    @property
    def limited(self) -> NDArray[np.bool_]:
        """(S,) True where rates have limits."""
        return np.isfinite(self.fall) | np.isfinite(self.rise)


def free_motors(states: int) -> Motors:
    """Returns motors without any limits."""
    return Motors(np.full(states, -np.inf), np.full(states, np.inf), np.zeros(states))


def inferred_states(
    command: Stream,
    spec: RobotSpec,
    lags: Array,
    latency: Array | float,
    grid: Array,
    motors: Motors | None = None,
) -> Array:
    """Infers states (T, S) at uniform times (T,) by lags and latencies (S,) [s], with gain one."""
    dt = float(grid[1] - grid[0])
    follows = followed(spec)
    fall, rise, dead = motors or free_motors(len(follows))
    if dead.any():
        least = np.zeros(command.values.shape[1])
        least[follows] = dead
        size = np.maximum(np.abs(command.values) - least, 0.0)
        command = replace(command, values=np.sign(command.values) * size)
    late = np.broadcast_to(latency, len(follows)).tolist()
    means = {one: held(command, spec, grid - one, grid + dt - one) for one in set(late)}
    target = np.empty((len(grid), len(follows)))
    for i, (one, c) in enumerate(zip(late, follows, strict=True)):
        target[:, i] = means[one][:, c]
    long_ago = np.array([command.t[0] - 2.0])
    initial = held(command, spec, long_ago, long_ago + 1.0)[0, follows]
    states = np.empty((len(grid), len(follows)))
    for i, a in enumerate(np.exp(-dt / np.maximum(lags, 1e-6))):
        if np.isinf([fall[i], rise[i]]).all():
            lag = ([0.0, 1.0 - a], [1.0, -a])
            begin = initial[i : i + 1]
            states[:, i] = scipy.signal.lfilter(*lag, target[:, i], zi=begin)[0]
        else:
            states[0, i] = initial[i]
            limp(states[:, i], target[:, i], 1.0 - a, dt * fall[i], dt * rise[i])
    return states


def white_noise(values: Array) -> Array:
    """Returns the standard deviation (D,) of white noise on otherwise smooth series (T, D)."""
    rest = np.diff(values, DIFFERENCE, axis=0) / DIFFERENCE_GAIN
    if len(rest) < DIFFERENCE:
        return np.zeros(values.shape[1])
    return np.asarray(np.median(np.abs(rest), axis=0) / GAUSSIAN_MAD)


def unwrapped(pose: Array) -> Array:
    """Returns poses (T, 3) with unwrapped headings."""
    return np.concatenate([pose[:, :2], np.unwrap(pose[:, 2])[:, None]], axis=1)


def resample(
    t: Array, pose: Array, at: Array, half_width: float, weights: Array | None = None
) -> Array:
    """Resamples unwrapped poses (T, 3) at (n,), by parabolas over `half_width` [s] unless 0."""
    distinct = np.concatenate([[True], np.diff(t) > 0.0])
    weights = np.ones_like(pose) if weights is None else weights
    t = t[distinct]
    pose = pose[distinct]
    weights = weights[distinct]
    if half_width == 0.0:
        return np.asarray(make_interp_spline(t, pose, k=3)(at))
    low = np.searchsorted(t, at - half_width)
    low = np.clip(np.minimum(low, np.searchsorted(t, at) - 2), 0, max(len(t) - 4, 0))
    high = np.maximum(np.searchsorted(t, at + half_width), low + 4)
    index = low[:, None] + np.arange(min(SMOOTHING_BATCH, int((high - low).max())))
    inside = (index < high[:, None]) & (index < len(t))
    index = np.minimum(index, len(t) - 1)
    weight = inside[..., None] * weights[index]
    basis = ((t[index] - at[:, None]) / half_width)[..., None] ** np.arange(3)
    normal = np.einsum("nki,nkd,nkj->ndij", basis, weight, basis) + 1e-9 * np.eye(3)
    right = np.einsum(
        "nki,nkd,nkd->ndi", basis, weight, pose[index] - pose[low][:, None]
    )
    return np.asarray(np.linalg.solve(normal, right[..., None])[:, :, 0, 0] + pose[low])
