"""Prediction-error method: a model by the errors of its predictions over seconds (Ljung, ch. 7).

Each window starts at a measured state and follows the commands; the derivatives of its end by the
coefficients are computed along the way.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from nics_drl_bridge import geometry
from nics_drl_bridge.geometry import Array
from nics_drl_bridge.identify.kernels import Shot, shoot, tangent
from nics_drl_bridge.identify.statistics import clustered_errors
from nics_drl_bridge.recording.recording import Samples
from nics_drl_bridge.robot import taylor
from nics_drl_bridge.robot.kernels import term_arrays
from nics_drl_bridge.robot.taylor import TaylorModel

Mask = NDArray[np.bool_]
Commands = Callable[[Array], Array]  # those in effect (T, C) during each step, by values (I,)

HORIZONS_S = (1.0, 2.5, 5.0)
SPACING_S = 0.25
HEADING_ARM_M = 0.3  # a heading error counts as a position error at this distance
FARTHEST_M = 50.0  # errors are cut at this distance per second of the horizon
PRIOR = 0.001  # weight of the linear fit against the predictions
DIFFERENCE = 0.02  # step of finite differences by the values of inputs, in their scale
EVALUATIONS = 30
SAME_STEP = 0.01  # share of a step by which two steps may differ


@dataclass(frozen=True)
class Inputs:
    """Values on which the commands in effect depend, as a delay [s], and their bounds."""

    start: Array  # (I,)
    scale: Array  # (I,)
    low: Array  # (I,)
    high: Array  # (I,)


@dataclass(frozen=True)
class Shooting:
    """A prediction problem: a drive on one time axis, and its commands."""

    samples: Samples
    commands: Commands
    mounted: bool = False  # True if the last three values are the pose of what `q` is, in the base
    horizons: tuple[float, ...] = HORIZONS_S
    spacing_s: float = SPACING_S

    def starts(self, horizon: float, inside: Mask | None = None) -> tuple[NDArray[np.intp], int]:
        """Returns first rows (W,) of windows without gaps, of rows `inside` (T,), and steps."""
        t, dt = self.samples.t, self.samples.dt
        steps = max(1, round(horizon / dt))
        first = np.arange(0, max(len(t) - steps, 0), max(1, round(self.spacing_s / dt)))
        last = first + steps
        whole = np.abs(t[last] - t[first] - steps * dt) < SAME_STEP * dt * steps
        if inside is not None:
            outside = np.append(0, np.cumsum(~inside))
            whole &= outside[last] == outside[first]
        return first[whole], steps

    def moved(self, first: NDArray[np.intp], steps: int) -> Array:
        """Returns the measured poses (W, 3) at windows' ends from those at their starts."""
        pose = self.samples.q[:, :3]
        return geometry.between(pose[first], pose[first + steps])

    def paths(self, first: NDArray[np.intp], steps: int) -> Array:
        """Returns the lengths (W,) of the measured paths over windows [m]."""
        step = np.hypot(*np.diff(self.samples.q[:, :2], axis=0).T)
        length = np.append(0.0, np.cumsum(step))
        return np.asarray(length[first + steps] - length[first])

    def predict(
        self, model: TaylorModel, values: Array, first: NDArray[np.intp], steps: int,
        free: Mask | None = None,
    ) -> tuple[Array, Array]:  # fmt: skip
        """Returns ends (W, 3) of windows, derivatives (W, 3, P) by `free` (D, K) coefficients."""
        free = np.zeros(model.coefficients.shape, dtype=np.bool_) if free is None else free
        used = (model.coefficients != 0.0) | free
        dofs, places = np.nonzero(used)
        terms = term_arrays(replace(model, coefficients=used.astype(np.float64)))
        terms = terms._replace(coefficient=model.coefficients[dofs, places])
        moving = np.flatnonzero(free[dofs, places]).astype(np.int64)
        command, state = self.commands(values), self.samples.q[:, 3:]
        rows = first[:, None] + np.arange(steps)
        count = len(first)
        low, high = model.state_box
        shot = Shot(
            np.ascontiguousarray(state[first]), np.ascontiguousarray(command[rows]), low, high,
            np.zeros((count, 3)), np.zeros((count, 3, len(moving))),
        )  # fmt: skip
        scratch = tangent(state.shape[1], command.shape[1], len(dofs), len(moving))
        shoot(shot, terms, moving, model.dt, scratch)
        return _seen_from(values[-3:], shot) if self.mounted else (shot.end, shot.slope)

    def errors(
        self, model: TaylorModel, values: Array, horizon: float, inside: Mask | None = None
    ) -> tuple[Array, Array]:
        """Returns errors (W, 3) of predictions over a horizon [s], and the paths' lengths (W,)."""
        first, steps = self.starts(horizon, inside)
        error = self.predict(model, values, first, steps)[0] - self.moved(first, steps)
        error[:, 2] = geometry.wrap_angle(error[:, 2])
        return error, self.paths(first, steps)


def _seen_from(mounting: Array, shot: Shot) -> tuple[Array, Array]:
    """Returns ends (W, 3) and their derivatives of a body at a pose (3,) in the base."""
    end = geometry.between(mounting, geometry.compose(shot.end, mounting))
    end[:, 2] = shot.end[:, 2]
    arm = geometry.rotate(np.broadcast_to(mounting[:2], (len(end), 2)), shot.end[:, 2])
    across = np.stack([-arm[:, 1], arm[:, 0]], axis=1)[:, :, None]
    moved = shot.slope[:, :2] + across * shot.slope[:, 2:]
    c, s = np.cos(mounting[2]), np.sin(mounting[2])
    along, aside = moved[:, 0], moved[:, 1]
    return end, np.stack([c * along + s * aside, c * aside - s * along, shot.slope[:, 2]], axis=1)


@dataclass(frozen=True)
class Predictive:
    """A model fitted to predictions."""

    model: TaylorModel
    values: Array  # (I,) of the inputs
    error: float  # root mean square of the scaled errors [m/s]
    jacobian: Array  # (n, P) of the residual by the free coefficients
    residual: Array  # (n,)
    free: Mask  # (D, K)
    starts: Array  # (n,) start of the window of each residual [s]
    value_errors: Array  # (I,) standard errors of the values


def fitted(
    problem: Shooting, model: TaylorModel, free: Mask, inputs: Inputs, inside: Mask | None = None,
    evaluations: int = EVALUATIONS,
) -> Predictive:  # fmt: skip
    """Adjusts free coefficients (D, K) and values of inputs to the least prediction errors."""
    unit = scale_of(problem.samples, model)[free]
    chosen = [(*problem.starts(h, inside), h) for h in problem.horizons]
    chosen = [each for each in chosen if len(each[0])]
    weight = np.array([1.0, 1.0, HEADING_ARM_M])
    count, first = len(inputs.start), model.coefficients[free]

    def at(theta: Array) -> tuple[TaylorModel, Array]:
        coefficients = model.coefficients.copy()
        coefficients[free] = first + theta[count:] * unit
        late = inputs.start + inputs.scale * theta[:count]
        return replace(model, coefficients=coefficients), late

    def shot(theta: Array, sloped: bool) -> tuple[Array, Array]:
        trial, late = at(theta)
        rest, slopes = [], []
        for begin, steps, horizon in chosen:
            end, slope = problem.predict(trial, late, begin, steps, free if sloped else None)
            error = end - problem.moved(begin, steps)
            error[:, 2] = geometry.wrap_angle(error[:, 2])
            rest.append((np.clip(error, -FARTHEST_M, FARTHEST_M) * weight / horizon).ravel())
            slope = slope * weight[:, None] / horizon
            slopes.append(slope.reshape(3 * len(begin), slope.shape[2]))
        return np.nan_to_num(np.concatenate(rest), nan=FARTHEST_M), np.concatenate(slopes)

    begun, _ = shot(np.zeros(count + len(unit)), False)
    pull = np.sqrt(PRIOR * len(begun)) * 0.1

    def residual(theta: Array) -> Array:
        return np.append(shot(theta, False)[0], pull * theta[count:])

    def jacobian(theta: Array) -> Array:
        rest, slope = shot(theta, True)
        late = np.empty((len(rest), count))
        for c in range(count):
            aside = theta + DIFFERENCE * (np.arange(len(theta)) == c)
            late[:, c] = (shot(aside, False)[0] - rest) / DIFFERENCE
        slope = np.clip(np.nan_to_num(slope * unit), -1e6, 1e6)
        own = np.concatenate([np.zeros((len(unit), count)), pull * np.eye(len(unit))], axis=1)
        return np.concatenate([np.concatenate([late, slope], axis=1), own])

    low = np.full(count + len(unit), -np.inf)
    high = -low
    low[:count] = (inputs.low - inputs.start) / inputs.scale - 1e-9
    high[:count] = (inputs.high - inputs.start) / inputs.scale + 1e-9
    found = least_squares(
        residual, np.zeros(count + len(unit)), jac=jacobian, bounds=(low, high), loss="soft_l1",
        f_scale=max(float(np.median(np.abs(begun))), 0.02), max_nfev=evaluations,
    )  # fmt: skip
    best, late = at(found.x)
    rest, slope = shot(found.x, True)
    starts = [np.repeat(problem.samples.t[begin], 3) for begin, *_ in chosen]
    error = float(np.sqrt(np.mean(rest**2)))
    span = np.floor(np.concatenate(starts) / max(problem.horizons)).astype(np.intp)
    late_slope = jacobian(found.x)[: len(rest), :count] / inputs.scale
    value_errors = clustered_errors(late_slope, rest, span)
    return Predictive(
        best, late, error, slope, rest, free, np.concatenate(starts), value_errors
    )  # fmt: skip


def scale_of(samples: Samples, model: TaylorModel) -> Array:
    """Returns the coefficients (D, K) that make each term as large as the rates usually are."""
    size = np.sqrt((taylor.evaluate(samples.x, model.powers) ** 2).mean(axis=0))
    spread = np.maximum(samples.dq.std(axis=0), 1e-6)
    return np.asarray(spread[:, None] / np.maximum(size, 1e-9))
