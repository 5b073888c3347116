"""Prediction-error method: fits a model to its prediction errors over seconds (Ljung, ch. 7).

Each window starts at a state that was measured, or that follows the commands, and goes on by the
commands; the derivatives of its end by the coefficients are computed along the way.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge import geometry
from nics_drl_bridge.geometry import Array
from nics_drl_bridge.identify.kernels import Shot, make_used_terms, shoot, tangent
from nics_drl_bridge.identify.open_loop import put_states
from nics_drl_bridge.identify.statistics import (
    estimate_clustered_covariance,
    estimate_clustered_errors,
    minimise_robustly,
)
from nics_drl_bridge.recording.recording import Samples
from nics_drl_bridge.robot import taylor
from nics_drl_bridge.robot.taylor import TaylorModel

Mask = NDArray[np.bool_]
Rows = NDArray[np.intp]
# values of parameters, by name
Values = dict[str, float]
# commands in effect (T, C) during each step
Commands = Callable[[Values], Array]
# a model with lags, friction and limits
Shape = Callable[[TaylorModel, Values], TaylorModel]
# states (T, S) that follow the commands
States = Callable[[Values], Array]
# weights of motions from start to end, usually 1
Trust = Callable[[Array, Array], Array]

HORIZONS_S = (0.3, 1.0, 2.5, 5.0)  # the shortest separates latency from lag
SPACING_S = 0.25  # between the starts of windows
HEADING_ARM_M = 0.3  # a heading error counts as a position error at this distance
FARTHEST_M = 50.0  # errors are clipped at this distance per second of the horizon
PULL = 0.001  # usual weight of the first coefficients relative to the predictions
# error that weighs as much, at a pull of 1, as a term the size of the rates
REFERENCE_M_S = 0.1
DRIFT_M_S = 0.01  # drift of good predictions: noise counts as this much time
# step of finite differences by the values of parameters, relative to their scale
DIFFERENCE = 0.02
EVALUATIONS = 60
# minimum distance of a start value from its bounds, as a fraction of its range
INSIDE = 0.05
LEAST_SCALE = 0.02  # scale of the loss, below which errors count by their squares [m/s]
NO_ERROR = 1e-9
STEEPEST = 1e6  # derivatives of a diverging model are clipped
SAME_STEP = 0.01  # fraction of a step by which two steps may differ


@dataclass(frozen=True)
class Parameters:
    """Parameters of a model besides its coefficients, such as a delay, and their bounds.

    A name is `latency`, a part of the mounting (`x`, `y` and `heading`), or a command or state with
    one of its parameters, such as `throttle.delay` [s], `throttle.dead`, `vx.lag` [s], `vx.gain`,
    or `vx.rise` and `vx.fall` (limits). `forms.list_parameters` lists them.
    """

    names: tuple[str, ...]
    start: Array  # (I,)
    scale: Array  # (I,)
    low: Array  # (I,)
    high: Array  # (I,); values whose bound is not above `low` are known

    @property
    def sought(self) -> Rows:
        """Indices of the unknown values."""
        return np.flatnonzero(self.high > self.low)

    def name(self, values: Array) -> Values:
        """Returns values (I,) by name."""
        return dict(zip(self.names, values.tolist(), strict=True))

    def freeze(self) -> "Parameters":
        """Returns the same parameters, known to have their start values."""
        return replace(self, low=self.start, high=self.start)

    def shift_stamps(self, latency_s: float) -> "Parameters":
        """Returns the same delays relative to stamps that are later by a time [s]."""
        is_time = [name == "latency" or name.endswith(".delay") for name in self.names]
        later = np.where(is_time, latency_s, 0.0)
        return replace(
            self,
            start=self.start - later,
            low=self.low - later,
            high=self.high - later,
        )

    def start_from(self, other: "Parameters") -> "Parameters":
        """Starts from the values of other parameters, where these have them."""
        values = self.name(self.start) | other.name(other.start)
        start = [values[name] for name in self.names]
        return replace(self, start=np.clip(start, self.low, self.high))


@dataclass(frozen=True)
class Shooting:
    """A prediction problem: a drive on one time axis, and the parameters that explain it."""

    samples: Samples
    parameters: Parameters
    commands: Commands
    shape: Shape
    trust: Trust
    # of states that were not measured; None if the samples have the states
    inferred: States | None = None
    noise_m: float = 0.0  # standard deviation of measured positions
    horizons: tuple[float, ...] = HORIZONS_S
    spacing_s: float = SPACING_S

    def list_windows(self, inside: Mask | None = None) -> tuple[Rows, Rows]:
        """Returns first rows (W,) of windows, and steps (W, H) to their horizons; 0: not inside.

        Windows have no gaps, and only rows `inside` (T,).
        """
        t = self.samples.t
        dt = self.samples.dt
        last = len(t) - 1
        first = np.arange(0, last, max(1, round(self.spacing_s / dt)))
        steps = np.tile(
            np.maximum(1, np.round(np.array(self.horizons) / dt)), (len(first), 1)
        )
        steps = steps.astype(np.intp)
        end = np.minimum(first[:, None] + steps, last)
        apart = t[end] - t[first][:, None] - steps * dt
        whole = (end - first[:, None] == steps) & (
            np.abs(apart) < SAME_STEP * dt * steps
        )
        if inside is not None:
            outside = np.append(0, np.cumsum(~inside))
            whole &= outside[end] == outside[first][:, None]
        is_used = whole.any(axis=1)
        return first[is_used], np.where(whole, steps, 0)[is_used]

    @property
    def is_mounted(self) -> bool:
        """True if the parameters have the pose of the tracked body in the base."""
        return "heading" in self.parameters.names

    @property
    def longest_horizon_s(self) -> float:
        """The longest horizon that fits into the drive; 0 if none does [s]."""
        _, steps = self.list_windows()
        fits = steps.any(axis=0)
        return max(np.array(self.horizons)[fits].tolist(), default=0.0)

    def measure_motion(self, first: Rows, steps: Rows) -> Array:
        """Returns the measured poses (W, H, 3) at windows' horizons, relative to the starts."""
        pose = self.samples.q[:, :3]
        return geometry.between(pose[first][:, None], pose[first[:, None] + steps])

    def measure_paths(self, first: Rows, steps: Rows) -> Array:
        """Returns the lengths (W, H) of the measured paths over windows [m]."""
        length = np.append(
            0.0, np.cumsum(np.hypot(*np.diff(self.samples.q[:, :2], axis=0).T))
        )
        return np.asarray(length[first[:, None] + steps] - length[first][:, None])

    def predict(
        self,
        model: TaylorModel,
        values: Array,
        first: Rows,
        steps: Rows,
        free: Mask | None = None,
    ) -> tuple[Array, Array]:
        """Returns poses (W, H, 3), derivatives (W, H, 3, P) by the `free` (D, K) coefficients."""
        at = self.parameters.name(values)
        model = self.shape(model, at)
        state = self.samples.q[:, 3:] if self.inferred is None else self.inferred(at)
        if free is None:
            free = np.zeros(model.coefficients.shape, dtype=np.bool_)
        used = (model.coefficients != 0.0) | free
        terms, moving = make_used_terms(model, used, free)
        command = self.commands(at)
        shot = Shot(
            np.ascontiguousarray(state[first]),
            first,
            np.ascontiguousarray(command),
            steps,
            np.zeros((*steps.shape, 3)),
            np.zeros((*steps.shape, 3, len(moving))),
        )
        sizes = state.shape[1], command.shape[1], len(terms.dof), len(moving)
        shoot(shot, terms, moving, model.dt, tangent(*sizes))
        if self.is_mounted:
            return _mount_poses(np.array([at["x"], at["y"], at["heading"]]), shot)
        return shot.end, shot.slope

    def resample(self, values: Array) -> Samples:
        """Returns the samples with the commands in effect, and with inferred states."""
        if self.inferred is None:
            return self.samples
        at = self.parameters.name(values)
        state = self.inferred(at)
        x = np.concatenate([state, self.commands(at)], axis=1)
        return put_states(replace(self.samples, x=x), state)

    def errors(
        self, model: TaylorModel, values: Array, inside: Mask | None = None
    ) -> tuple[Array, Array]:
        """Returns prediction errors (W, H, 3), and the lengths (W, H) of paths.

        Both are NaN where a horizon does not fit; errors of diverged predictions are infinite.
        """
        first, steps = self.list_windows(inside)
        error = self.predict(model, values, first, steps)[0] - self.measure_motion(
            first, steps
        )
        error[..., 2] = geometry.wrap_angle(error[..., 2])
        error[np.isnan(error)] = np.inf
        error[steps == 0] = np.nan
        return error, np.where(steps > 0, self.measure_paths(first, steps), np.nan)

    def measure_mean_error(self, model: TaylorModel, values: Array) -> float:
        """Returns the mean distance of predicted from measured ends, over all horizons [m]."""
        error, _ = self.errors(model, values)
        return float(np.nanmean(np.hypot(error[..., 0], error[..., 1])))


def _mount_poses(mounting: Array, shot: Shot) -> tuple[Array, Array]:
    """Returns ends (W, H, 3) and their derivatives for a body at a pose (3,) in the base."""
    end = geometry.between(mounting, geometry.compose(shot.end, mounting))
    end[..., 2] = shot.end[..., 2]
    arm = np.broadcast_to(mounting[:2], (*end.shape[:2], 2))
    arm = geometry.rotate(arm, shot.end[..., 2])
    across = np.stack([-arm[..., 1], arm[..., 0]], axis=-1)[..., None]
    moved = shot.slope[..., :2, :] + across * shot.slope[..., 2:, :]
    c = np.cos(mounting[2])
    s = np.sin(mounting[2])
    along = moved[..., 0, :]
    aside = moved[..., 1, :]
    rows = [c * along + s * aside, c * aside - s * along, shot.slope[..., 2, :]]
    return end, np.stack(rows, axis=-2)


@dataclass(frozen=True)
class Predictive:
    """A model fitted to predictions."""

    model: TaylorModel
    names: tuple[str, ...]  # of the parameters
    values: Array  # (I,) of the parameters
    residual: Array  # (n,) scaled errors [m/s]
    # (I, I) covariance of the values; NaN for known ones
    value_covariance: Array
    coefficient_errors: Array  # (D, K) standard errors; NaN for known coefficients

    @property
    def named(self) -> Values:
        """Values of the parameters, by name."""
        return dict(zip(self.names, self.values.tolist(), strict=True))

    @property
    def errors(self) -> Values:
        """Standard errors of the parameters, by name; NaN for known ones."""
        errors = np.sqrt(np.maximum(np.diag(self.value_covariance), 0.0))
        return dict(zip(self.names, errors.tolist(), strict=True))

    @property
    def shown_errors(self) -> Values:
        """Errors of the parameters of commands and states, such as `throttle.dead`.

        Parameters that do not affect the predictions are left out.
        """
        errors = self.errors.items()
        return {name: e for name, e in errors if "." in name and e > NO_ERROR}


def fit_to_predictions(
    problem: Shooting,
    model: TaylorModel,
    free: Mask,
    inside: Mask | None = None,
    evaluations: int = EVALUATIONS,
    pull: float = PULL,
    first: Array | None = None,
) -> Predictive:
    """Adjusts free coefficients (D, K) and unknown parameters to minimise the prediction errors.

    Coefficients are pulled towards the model's. The search starts at `first` if that is better.
    """
    return _Search(problem, model, free, inside, pull).run(first, evaluations)


class _Search:
    """Least squares over windows, by scaled values and coefficients (I + P,); 0 is the model."""

    def __init__(
        self,
        problem: Shooting,
        model: TaylorModel,
        free: Mask,
        inside: Mask | None,
        pull: float,
    ) -> None:
        self.problem = problem
        self.model = model
        self.free = free
        self.parameters = problem.parameters
        size = np.sqrt(
            (taylor.evaluate(problem.samples.x, model.powers) ** 2).mean(axis=0)
        )
        spread = np.maximum(problem.samples.dq.std(axis=0), 1e-6)
        # Coefficients (D, K) that make each term as large as the rates usually are.
        self.unit = (spread[:, None] / np.maximum(size, 1e-9))[free]
        self.first, self.steps = problem.list_windows(inside)
        self.wanted = self.steps > 0
        weight = np.array([1.0, 1.0, HEADING_ARM_M])
        usual = np.array(problem.horizons) + problem.noise_m / DRIFT_M_S
        t = problem.samples.t
        trust = problem.trust(
            t[self.first][:, None], t[self.first[:, None] + self.steps]
        )
        self.weight = weight / usual[:, None] * np.sqrt(trust)
        self.measured = problem.measure_motion(self.first, self.steps)
        self.sought = self.parameters.sought
        self.count = len(self.sought)
        self.pull = REFERENCE_M_S * np.sqrt(pull * 3 * np.count_nonzero(self.wanted))

    def at(self, theta: Array) -> tuple[TaylorModel, Array]:
        """Returns the model, before values shape it, and the values of the parameters."""
        coefficients = self.model.coefficients.copy()
        coefficients[self.free] += theta[self.count :] * self.unit
        values = self.parameters.start.copy()
        values[self.sought] += self.parameters.scale[self.sought] * theta[: self.count]
        values = np.maximum(values, self.parameters.low)  # rounding could pass it
        return replace(self.model, coefficients=coefficients), values

    def shot(self, theta: Array, sloped: bool) -> tuple[Array, Array]:
        """Returns scaled errors (n,), and derivatives (n, P) by the coefficients."""
        trial, values = self.at(theta)
        free = self.free if sloped else None
        end, slope = self.problem.predict(trial, values, self.first, self.steps, free)
        error = end - self.measured
        error[..., 2] = geometry.wrap_angle(error[..., 2])
        rest = np.clip(error, -FARTHEST_M, FARTHEST_M) * self.weight
        slopes = (slope * self.weight[..., None])[self.wanted]
        rows = np.nan_to_num(rest[self.wanted].ravel(), nan=FARTHEST_M)
        return rows, slopes.reshape(len(rows), slope.shape[-1])

    def residual(self, theta: Array) -> Array:
        """Returns the residual (n + P,): errors, and pulls of the coefficients."""
        return np.append(self.shot(theta, False)[0], self.pull * theta[self.count :])

    def jacobian(self, theta: Array) -> Array:
        """Returns the derivatives (n + P, I + P) of the residual."""
        count = self.count
        unit = self.unit
        rest, slope = self.shot(theta, True)
        by_values = self.differentiate_by_values(theta, rest)
        slope = np.clip(np.nan_to_num(slope * unit), -STEEPEST, STEEPEST)
        own = np.concatenate(
            [np.zeros((len(unit), count)), self.pull * np.eye(len(unit))], axis=1
        )
        return np.concatenate([np.concatenate([by_values, slope], axis=1), own])

    def differentiate_by_values(self, theta: Array, rest: Array) -> Array:
        """Returns derivatives (n, I) of errors (n,) by the scaled values."""
        slopes = np.zeros((len(rest), self.count))
        for i, value in enumerate(self.sought):
            step = DIFFERENCE
            if self.parameters.names[value].endswith(("latency", ".delay")):
                # A limited state starts to move at a whole step.
                step = self.model.dt / self.parameters.scale[value]
            trial = theta.copy()
            trial[i] += step
            errors, _ = self.shot(trial, False)
            slopes[:, i] = (errors - rest) / step
        return slopes

    def run(self, first: Array | None, evaluations: int) -> Predictive:
        """Searches for the minimum of the errors."""
        count = self.count
        start = np.zeros(self.count + len(self.unit))
        begun = self.residual(start)
        if first is not None:
            trial = start.copy()
            trial[count:] = (
                first[self.free] - self.model.coefficients[self.free]
            ) / self.unit
            rest = self.residual(trial)
            if np.abs(rest).sum() < np.abs(begun).sum():
                start = trial
                begun = rest
        low = np.full(len(start), -np.inf)
        high = -low
        parameters = self.parameters
        at = self.sought
        low[:count] = ((parameters.low - parameters.start) / parameters.scale)[at]
        high[:count] = ((parameters.high - parameters.start) / parameters.scale)[at]
        # At a bound the search would not move.
        aside = np.minimum(INSIDE * (high - low)[:count], 1.0)
        start[:count] = np.clip(0.0, low[:count] + aside, high[:count] - aside)
        size = max(float(np.median(np.abs(begun))), LEAST_SCALE)
        best = minimise_robustly(
            self.residual, self.jacobian, start, (low, high), size, evaluations
        )
        return self.predictive(best)

    def predictive(self, theta: Array) -> Predictive:
        """Returns the model with the data for its uncertainty."""
        best, values = self.at(theta)
        best = self.problem.shape(best, self.parameters.name(values))
        rest = self.shot(theta, False)[0]
        starts = self.problem.samples.t[self.first]
        starts = np.repeat(starts, 3 * self.wanted.sum(axis=1))
        span = np.floor(starts / max(self.problem.horizons)).astype(np.intp)
        prior = np.append(np.zeros(self.count), np.full(len(self.unit), self.pull))
        slopes = self.jacobian(theta)[: len(rest)]
        scale = np.append(self.parameters.scale[self.sought], self.unit)
        joint = estimate_clustered_covariance(slopes, rest, span, prior**2)
        joint = joint * np.outer(scale, scale)
        size = len(values)
        covariance = np.full((size, size), np.nan)
        covariance[np.ix_(self.sought, self.sought)] = joint[: self.count, : self.count]
        errors = np.full(self.free.shape, np.nan)
        # Without the pull, which would make them seem more certain than the drive does.
        alone = estimate_clustered_errors(slopes[:, self.count :], rest, span)
        errors[self.free] = alone * self.unit
        names = self.parameters.names
        return Predictive(best, names, values, rest, covariance, errors)
