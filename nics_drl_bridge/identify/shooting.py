"""Prediction-error method: fits a model to its prediction errors over seconds (Ljung, ch. 7).

Each window starts at a state that was measured, or that follows the commands, and goes on by the
commands; the derivatives of its end by the coefficients are computed along the way.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge import geometry
from nics_drl_bridge.geometry import Array
from nics_drl_bridge.identify.kernels import (
    Shot,
    allocate_tangent,
    make_used_terms,
    shoot,
)
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
            outside = geometry.accumulate(~inside)
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
        length = geometry.measure_path(self.samples.q)
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
        state = self.samples.q[:, 3:] if self.inferred is None else self.inferred(at)
        command = self.commands(at)
        if free is None:
            free = np.zeros(model.coefficients.shape, dtype=np.bool_)
        if self.inferred is None and state.shape[1]:
            model = self.shape(model, at)
            end, slope = _predict_windows(model, state, command, first, steps, free)
        else:  # no state depends on where a window starts, nor does a shape affect the twist
            x = np.concatenate([state, command], axis=1)
            end, slope = predict_along_path(model, x, first, steps, free)
        if self.is_mounted:
            mounting = np.array([at["x"], at["y"], at["heading"]])
            return _mount_poses(mounting, end, slope)
        return end, slope

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


def _predict_windows(
    model: TaylorModel,
    state: Array,
    command: Array,
    first: Rows,
    steps: Rows,
    free: Mask,
) -> tuple[Array, Array]:
    """Rolls a model out from the first state of each window; see `Shooting.predict`."""
    used = (model.coefficients != 0.0) | free
    terms, moving = make_used_terms(model, used, free)
    shot = Shot(
        np.ascontiguousarray(state[first]),
        first,
        np.ascontiguousarray(command),
        steps,
        np.zeros((*steps.shape, 3)),
        np.zeros((*steps.shape, 3, len(moving))),
    )
    scratch = allocate_tangent(shot, terms, len(moving))
    shoot(shot, terms, moving, model.dt, scratch)
    return shot.end, shot.slope


def predict_along_path(
    model: TaylorModel, x: Array, first: Rows, steps: Rows, free: Mask
) -> tuple[Array, Array]:
    """Predicts windows from one path through all X (T, V), if only the twist has free terms.

    Returns the same as `Shooting.predict`.
    """
    chi = _evaluate_terms(x, model.powers)
    path = _Path.along(model.coefficients[:3] @ chi, model.dt)
    last = first[:, None] + steps
    moved = path.pose[:, last] - path.pose[:, first][..., None]
    slopes = []
    for dof in range(3):
        slope = path.differentiate(chi[free[dof]], dof)
        # How the heading changes before a window does not count in it.
        turned = slope[:, 2, first][..., None]
        slope = slope[..., last] - slope[..., first][..., None]
        slope[:, 0] += turned * moved[1]
        slope[:, 1] -= turned * moved[0]
        slopes.append(slope)
    heading = path.pose[2, first][:, None]
    end = _turn_back(moved[None], heading)[0]
    slope = _turn_back(np.concatenate(slopes), heading)
    return np.moveaxis(end, 0, -1), np.moveaxis(slope, (0, 1), (-1, -2))


def _evaluate_terms(x: Array, powers: NDArray[np.int64]) -> Array:
    """Returns the terms (K, T) of X (T, V)."""
    columns = np.ascontiguousarray(x.T)
    chi = np.ones((len(powers), len(x)))
    for term, row in zip(chi, powers, strict=True):
        for variable in np.repeat(np.arange(len(row)), row):
            term *= columns[variable]
    return chi


def _turn_back(moved: Array, heading: Array) -> Array:
    """Returns motions (n, 3, W, H) as seen from headings (W, 1)."""
    c = np.cos(heading)
    s = np.sin(heading)
    x = c * moved[:, 0] + s * moved[:, 1]
    y = c * moved[:, 1] - s * moved[:, 0]
    return np.stack([x, y, moved[:, 2]], axis=1)


@dataclass(frozen=True)
class _Path:
    """A path by known twists."""

    pose: Array  # (3, T + 1) from the origin; the heading is unwrapped
    turn: Array  # (T,) by each step [rad]
    ahead: Array  # (2, T) way of a step per unit of vx [s]
    dt: float

    @classmethod
    def along(cls, twist: Array, dt: float) -> "_Path":
        """Integrates twists (3, T) along arcs over steps of dt [s]."""
        turn = dt * twist[2]
        heading = geometry.accumulate(turn)
        middle = heading[:-1] + turn / 2.0
        chord = dt * np.sinc(turn / (2.0 * np.pi))
        ahead = chord * np.stack([np.cos(middle), np.sin(middle)])
        aside = np.stack([-ahead[1], ahead[0]])
        place = np.cumsum(twist[0] * ahead + twist[1] * aside, axis=1)
        pose = np.concatenate([np.zeros((2, 1)), place], axis=1)
        return cls(np.concatenate([pose, heading[None]]), turn, ahead, dt)

    def differentiate(self, chi: Array, dof: int) -> Array:
        """Returns derivatives (P, 3, T + 1) by the coefficients of terms (P, T) of a dof."""
        slope = np.zeros((len(chi), 3, self.pose.shape[1]))
        x, y, heading = np.swapaxes(slope[..., 1:], 0, 1)
        if dof == 0:
            x[:] = self.ahead[0] * chi
            y[:] = self.ahead[1] * chi
        elif dof == 1:
            x[:] = -self.ahead[1] * chi
            y[:] = self.ahead[0] * chi
        else:
            dx, dy = np.diff(self.pose[:2])
            heading[:] = self.dt * chi
            lean = np.cumsum(heading, axis=1) - heading / 2.0
            shorter = -self.turn / 12.0 * heading
            x[:] = shorter * dx - lean * dy
            y[:] = shorter * dy + lean * dx
        return np.cumsum(slope, axis=2, out=slope)


def _mount_poses(mounting: Array, base: Array, slope: Array) -> tuple[Array, Array]:
    """Returns ends (W, H, 3) and their derivatives for a body at a pose (3,) in the base."""
    end = geometry.between(mounting, geometry.compose(base, mounting))
    end[..., 2] = base[..., 2]
    arm = np.broadcast_to(mounting[:2], (*end.shape[:2], 2))
    arm = geometry.rotate(arm, base[..., 2])
    across = np.stack([-arm[..., 1], arm[..., 0]], axis=-1)[..., None]
    moved = slope[..., :2, :] + across * slope[..., 2:, :]
    c = np.cos(mounting[2])
    s = np.sin(mounting[2])
    along = moved[..., 0, :]
    aside = moved[..., 1, :]
    rows = [c * along + s * aside, c * aside - s * along, slope[..., 2, :]]
    return end, np.stack(rows, axis=-2)


@dataclass(frozen=True)
class Predictive:
    """A model fitted to predictions; its uncertainty is computed when it is asked for."""

    model: TaylorModel
    names: tuple[str, ...]  # of the parameters
    values: Array  # (I,) of the parameters
    search: "_Search"
    theta: Array  # the minimum, as the search scales it

    @cached_property
    def _uncertainty(self) -> tuple[Array, Array]:
        return self.search.estimate_uncertainty(self.theta)

    @property
    def residual(self) -> Array:
        """The scaled errors (n,) of the predictions [m/s]."""
        return self.search.measure_errors(self.theta)

    @property
    def value_covariance(self) -> Array:
        """The covariance (I, I) of the values; NaN for known ones."""
        return self._uncertainty[0]

    @property
    def coefficient_errors(self) -> Array:
        """The standard errors (D, K) of the coefficients; NaN for known ones."""
        return self._uncertainty[1]

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
        self.weight = self._weigh_errors()
        self.measured = problem.measure_motion(self.first, self.steps)
        self.sought = self.parameters.sought
        self.count = len(self.sought)
        self.pull = REFERENCE_M_S * np.sqrt(pull * 3 * np.count_nonzero(self.wanted))
        self.known: tuple[Array, Array] | None = (
            None  # the latest theta, and its errors
        )

    def _weigh_errors(self) -> Array:
        """Returns the weights (W, H, 3) of errors at the ends of windows."""
        problem = self.problem
        weight = np.array([1.0, 1.0, HEADING_ARM_M])
        usual = np.array(problem.horizons) + problem.noise_m / DRIFT_M_S
        t = problem.samples.t
        trust = problem.trust(
            t[self.first][:, None], t[self.first[:, None] + self.steps]
        )
        return np.asarray(weight / usual[:, None] * np.sqrt(trust))

    def at(self, theta: Array) -> tuple[TaylorModel, Array]:
        """Returns the model, before values shape it, and the values of the parameters."""
        coefficients = self.model.coefficients.copy()
        coefficients[self.free] += theta[self.count :] * self.unit
        values = self.parameters.start.copy()
        values[self.sought] += self.parameters.scale[self.sought] * theta[: self.count]
        values = np.maximum(values, self.parameters.low)  # rounding could pass it
        return replace(self.model, coefficients=coefficients), values

    def shoot(self, theta: Array, free: Mask | None = None) -> tuple[Array, Array]:
        """Returns scaled errors (n,), and derivatives (n, P) by the `free` coefficients."""
        trial, values = self.at(theta)
        end, slope = self.problem.predict(trial, values, self.first, self.steps, free)
        error = end - self.measured
        error[..., 2] = geometry.wrap_angle(error[..., 2])
        rest = np.clip(error, -FARTHEST_M, FARTHEST_M) * self.weight
        slopes = (slope * self.weight[..., None])[self.wanted]
        rows = np.nan_to_num(rest[self.wanted].ravel(), nan=FARTHEST_M)
        return rows, slopes.reshape(len(rows), slope.shape[-1])

    def measure_errors(self, theta: Array) -> Array:
        """Returns the scaled errors (n,)."""
        if self.known is None or not np.array_equal(theta, self.known[0]):
            self.known = theta.copy(), self.shoot(theta)[0]
        return self.known[1]

    def residual(self, theta: Array) -> Array:
        """Returns the residual (n + P,): errors, and pulls of the coefficients."""
        pulls = self.pull * theta[self.count :]
        return np.append(self.measure_errors(theta), pulls)

    def jacobian(self, theta: Array) -> Array:
        """Returns the derivatives (n + P, I + P) of the residual."""
        pulls = np.zeros((len(self.unit), len(theta)))
        pulls[:, self.count :] = self.pull * np.eye(len(self.unit))
        return np.concatenate([self.differentiate(theta), pulls])

    def differentiate(self, theta: Array) -> Array:
        """Returns the derivatives (n, I + P) of the errors."""
        rest, slope = self.shoot(theta, self.free)
        slope = np.clip(np.nan_to_num(slope * self.unit), -STEEPEST, STEEPEST)
        return np.concatenate([self.differentiate_by_values(theta, rest), slope], 1)

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
            slopes[:, i] = (self.shoot(trial)[0] - rest) / step
        return slopes

    def run(self, first: Array | None, evaluations: int) -> Predictive:
        """Searches for the minimum of the errors."""
        start = np.zeros(self.count + len(self.unit))
        begun = self.residual(start)
        if first is not None:
            trial = start.copy()
            shift = first[self.free] - self.model.coefficients[self.free]
            trial[self.count :] = shift / self.unit
            rest = self.residual(trial)
            if np.abs(rest).sum() < np.abs(begun).sum():
                start = trial
                begun = rest
        low, high = self._list_bounds()
        # At a bound the search would not move.
        aside = np.minimum(INSIDE * (high - low), 1.0)[: self.count]
        start[: self.count] = np.clip(
            0.0, low[: self.count] + aside, high[: self.count] - aside
        )
        size = max(float(np.median(np.abs(begun))), LEAST_SCALE)
        best = minimise_robustly(
            self.residual, self.jacobian, start, (low, high), size, evaluations
        )
        model, values = self.at(best)
        model = self.problem.shape(model, self.parameters.name(values))
        return Predictive(model, self.parameters.names, values, self, best)

    def _list_bounds(self) -> tuple[Array, Array]:
        """Returns the bounds (I + P,) of the scaled values; coefficients have none."""
        unbounded = np.full(len(self.unit), np.inf)
        parameters = self.parameters
        low, high = (
            ((bound - parameters.start) / parameters.scale)[self.sought]
            for bound in (parameters.low, parameters.high)
        )
        return np.append(low, -unbounded), np.append(high, unbounded)

    def estimate_uncertainty(self, theta: Array) -> tuple[Array, Array]:
        """Returns the covariance (I, I) of the values, and errors (D, K) of the coefficients."""
        count = self.count
        rest = self.measure_errors(theta)
        slopes = self.differentiate(theta)
        span = self._cluster_rows()
        prior = np.append(np.zeros(count), np.full(len(self.unit), self.pull))
        scale = self.parameters.scale[self.sought]
        joint = estimate_clustered_covariance(slopes, rest, span, prior**2)
        known = len(self.parameters.names)
        covariance = np.full((known, known), np.nan)
        places = np.ix_(self.sought, self.sought)
        covariance[places] = joint[:count, :count] * np.outer(scale, scale)
        errors = np.full(self.free.shape, np.nan)
        # Without the pull, which would make them seem more certain than the drive does.
        alone = estimate_clustered_errors(slopes[:, count:], rest, span)
        errors[self.free] = alone * self.unit
        return covariance, errors

    def _cluster_rows(self) -> Rows:
        """Returns the part of the drive (n,) in which each error's window starts."""
        starts = self.problem.samples.t[self.first]
        starts = np.repeat(starts, 3 * self.wanted.sum(axis=1))
        return np.floor(starts / max(self.problem.horizons)).astype(np.intp)
