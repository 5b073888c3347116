"""Refinement of a model by its errors over seconds (Ljung, System Identification, ch. 7).

1. `apply_definitions` fixes what the data can't tell: the scale of an inferred speed.
2. `make_problem` selects windows of the training part: pairs of poses one horizon apart.
3. `minimise_errors` adjusts coefficients, rotation and one time so that predictions from the first
   pose of each window end at the second: nonlinear least squares.
4. `simplify` removes terms of the twist that hardly improve the predictions, weakest first.
5. `drop_doubtful_rotation` sets a rotation below three standard errors to zero.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from nics_drl_bridge import geometry
from nics_drl_bridge.geometry import Array
from nics_drl_bridge.identify import open_loop
from nics_drl_bridge.identify.calibration import Calibration, Response
from nics_drl_bridge.identify.clocks import SEPARABLE_S
from nics_drl_bridge.identify.drive import Drive
from nics_drl_bridge.identify.shooting import HEADING_ARM_M, SPACING_S
from nics_drl_bridge.identify.signals import find_speed_index
from nics_drl_bridge.identify.statistics import (
    CERTAIN,
    estimate_clustered_errors,
    estimate_uncertainty,
    minimise,
)
from nics_drl_bridge.identify.terms import FIRST_STATE, TWIST, VX, VY, Mask
from nics_drl_bridge.robot.spec import RobotSpec
from nics_drl_bridge.robot.taylor import TaylorModel

NamedErrors = Mapping[str, Mapping[str, float]]  # by degree of freedom and term

HORIZONS_S = (1.0, 2.5, 5.0)
MIN_WINDOWS = 10  # per horizon
# A window contains a jump of the pose if its error exceeds this many times the median error and
# this fraction of the longest path,
OUTLYING = 10.0
OUTLYING_SHARE = 0.25
# unless more than this fraction of the windows do.
MOST_OUTLIERS = 0.3

# Errors [m] and slopes of a diverging model are clipped, so that their scaling stays finite.
DIVERGED = 1e3
STEEPEST = 1e100
ROTATION_STEP_RAD = 1e-5  # of the finite difference by the rotation
LEAST_SCALE = 0.05  # minimum scale of a parameter of the search; that of times [s] and angles [rad]
# A model uses the values at the start of a step, so a time is uncertain by the standard deviation
# of a uniform distribution over the step.
WITHIN_STEP = 12.0**-0.5
# maximum fraction of its distance by which a state approaches its command in one step
FASTEST = 0.99
# terms are removed while the error rises by less than this fraction in total
WORTH = 0.1
TOO_SHORT = (
    "The training part is too short to refine the model by its errors over seconds; record a "
    "longer drive."
)
UNSTABLE = (
    "The predictions of the fitted model diverge on the training part, so it could not "
    "be refined."
)


def refine_by_predictions(
    linear: TaylorModel, calibration: Calibration, drive: Drive
) -> tuple[TaylorModel, Calibration, str]:
    """Refines a linear fit by its predictions of the training part, and removes terms.

    Returns:
        The refined model and calibration, and a sentence on the result.
    """
    model, calibration = apply_definitions(
        linear.add_errors({}), calibration, drive.spec
    )
    problem = make_problem(model, calibration, drive)
    if problem is None:
        return merge_errors(model, linear, {}), calibration, TOO_SHORT
    try:
        best = simplify(problem, minimise_errors(problem, model, calibration))
        best = drop_doubtful_rotation(problem, best, calibration)
    except np.linalg.LinAlgError:  # the model is unstable: its slopes overflow
        return merge_errors(model, linear, {}), calibration, UNSTABLE
    errors = replace(best.model, std_errors=best.std_errors).named_errors
    note = _describe_result(problem, best, calibration)
    return merge_errors(best.model, linear, errors), best.calibration, note


def _describe_result(problem: "Problem", best: "Refined", before: Calibration) -> str:
    adjusted = "Coefficients"
    if best.calibration != before:
        adjusted += " and calibration"
    by = f"the open-loop errors over up to {problem.horizon_s:g} s"
    parts = f"of x, y and heading times {HEADING_ARM_M:g} m"
    left = f"the root mean square {parts} left on the training part"
    return f"{adjusted} were refined by {by}: {left} is {best.error:.4f} m."


def adjust_to_drive(
    model: TaylorModel, calibration: Calibration, drive: Drive
) -> tuple[TaylorModel, Calibration] | None:
    """Adjusts a refined model to another drive, term by term; None if that is not possible."""
    problem = make_problem(model, calibration, drive)
    if problem is None:
        return None
    try:
        refined = minimise_errors(problem, model, calibration)
    except np.linalg.LinAlgError:
        return None
    return refined.model, refined.calibration


def apply_definitions(
    model: TaylorModel, calibration: Calibration, spec: RobotSpec
) -> tuple[TaylorModel, Calibration]:
    """Scales an inferred speed so that vx = 1 speed, and drops lateral motion that is noise.

    Lateral motion is noise unless it is commanded or a state measures it.
    """
    slips = any(variable.twist == "vy" for variable in spec.state)
    if not (spec.moves_sideways or slips):
        coefficients = model.coefficients.copy()
        coefficients[VY] = 0.0
        model = replace(model, coefficients=coefficients)
    i = find_speed_index(spec)
    if not calibration.responses or i is None:
        return model, calibration
    (alone,) = find_linear_terms(model, spec.state[i].name)
    if alone is None or model.coefficients[VX, alone] <= 0.0:
        return model, calibration
    return _scale_state(model, calibration, i, float(model.coefficients[VX, alone]))


def _scale_state(
    model: TaylorModel, calibration: Calibration, i: int, scale: float
) -> tuple[TaylorModel, Calibration]:
    """Expresses a state in a unit in which its values are `scale` times as large."""
    coefficients = model.coefficients / scale ** model.powers[:, i]
    coefficients[FIRST_STATE + i] *= scale
    (alone,) = find_linear_terms(model, model.variables[i])
    if alone is not None:
        coefficients[VX, alone] = 1.0  # exactly
    low = model.low.copy()
    high = model.high.copy()
    limits = model.limits.copy()
    for values in (low, high, limits):
        values[i] *= scale
    model = replace(model, coefficients=coefficients, low=low, high=high, limits=limits)
    responses = list(calibration.responses)
    responses[i] = replace(responses[i], gain=responses[i].gain * scale)
    return model, replace(calibration, responses=tuple(responses))


def merge_errors(
    model: TaylorModel, linear: TaylorModel, refined: NamedErrors
) -> TaylorModel:
    """Adds standard errors: the linear fit's where a row is unchanged, else the larger of both."""
    fitted = linear.named_errors
    merged: dict[str, dict[str, float]] = {}
    for dof, old, new in zip(
        model.dofs, linear.coefficients, model.coefficients, strict=True
    ):
        before = dict(zip(linear.term_names, old, strict=True))
        after = zip(model.term_names, new, strict=True)
        is_unchanged = all(before.get(term, 0.0) == value for term, value in after)
        errors = fitted.get(dof, {})
        merged[dof] = dict(errors) if is_unchanged else {}
        for term, error in refined.get(dof, {}).items():
            merged[dof][term] = max(error, errors.get(term, 0.0))
    return model.add_errors(merged)


@dataclass(frozen=True)
class Problem:
    """Prediction problem of a refinement: windows of one drive, the same for every trial model."""

    drive: Drive
    horizon_s: float  # the longest horizon that fits into the drive
    # for each horizon, without jumps of the pose
    windows: tuple[open_loop.Windows, ...]
    # courses of X over them if the state was measured, else empty
    courses: tuple[open_loop.Course, ...]


def make_problem(
    model: TaylorModel, calibration: Calibration, drive: Drive
) -> Problem | None:
    """Selects the windows of a training part to predict; None if it is too short."""
    until = drive.settings.train_until_s
    chosen = []
    longest = 0.0
    for horizon in HORIZONS_S:
        windows = open_loop.select_windows(
            drive, calibration, 0.0, until, horizon, SPACING_S
        )
        if len(windows.start_t) >= MIN_WINDOWS:
            ends = open_loop.predict(model, calibration, drive, windows)
            chosen.append(_drop_jumps(windows, ends - windows.end))
            longest = horizon
    if not chosen:
        return None
    courses: tuple[open_loop.Course, ...] = ()
    if drive.recording.state is not None:
        courses = tuple(
            open_loop.trace_states(model, calibration, drive, windows)
            for windows in chosen
        )
    return Problem(drive, longest, tuple(chosen), courses)


def _drop_jumps(windows: open_loop.Windows, error: Array) -> open_loop.Windows:
    """Drops windows whose errors (W, 3) show a jump of the pose, if they are few."""
    distance = np.hypot(error[:, 0], error[:, 1])
    far = max(
        OUTLYING * float(np.median(distance)),
        OUTLYING_SHARE * float(windows.path.max()),
    )
    inside = distance <= far
    too_few = inside.mean() < 1.0 - MOST_OUTLIERS or inside.sum() < MIN_WINDOWS
    if inside.all() or too_few:
        return windows
    return windows.rows(inside)


def compute_errors(
    problem: Problem, model: TaylorModel, calibration: Calibration
) -> Array:
    """Returns the errors (n,) of all predictions: x, y and heading of each window [m].

    The heading counts at `HEADING_ARM_M`; noisy poses count less.
    """
    columns = zip(*(vars(windows).values() for windows in problem.windows), strict=True)
    windows = open_loop.Windows(*map(np.concatenate, columns))
    with np.errstate(all="ignore"):  # a trial step may diverge and is then rejected
        if problem.courses:
            ends = [
                open_loop.predict_ends(course, model)[0] for course in problem.courses
            ]
            predicted = open_loop.convert_to_tracked(
                windows, calibration, np.concatenate(ends)
            )
        else:  # all windows by a single rollout
            predicted = open_loop.predict(model, calibration, problem.drive, windows)
        error = predicted - windows.end
        error[:, 2] = HEADING_ARM_M * geometry.wrap_angle(error[:, 2])
        error *= _compute_weights(problem, windows)
    error = np.nan_to_num(error.ravel(), nan=DIVERGED)
    return np.asarray(np.clip(error, -DIVERGED, DIVERGED))


def _compute_weights(problem: Problem, windows: open_loop.Windows) -> Array:
    """Returns factors (W, 3) of errors, from the variances of the poses at both ends."""
    return np.asarray(np.sqrt(problem.drive.trust(windows.start_t, windows.end_t)))


def differentiate_errors(
    problem: Problem,
    model: TaylorModel,
    calibration: Calibration,
    free: "_FreeParameters",
) -> Array:
    """Returns the derivatives (n, P) of `compute_errors` for a measured state."""
    parts = []
    for course in problem.courses:
        ends, moved = open_loop.predict_ends(course, model, free.coefficients)
        slope = open_loop.differentiate_ends(course, calibration, ends, moved)
        if "rotation_rad" in free.names:
            by_rotation = _differentiate_by_rotation(course, calibration, ends)
            slope = np.concatenate([slope, by_rotation[:, :, None]], axis=2)
        slope[:, 2] *= HEADING_ARM_M
        slope *= _compute_weights(problem, course.chosen)[..., None]
        parts.append(slope.reshape(-1, slope.shape[2]))
    slopes = np.nan_to_num(np.concatenate(parts), nan=0.0)
    return np.clip(slopes, -STEEPEST, STEEPEST)


def _differentiate_by_rotation(
    course: open_loop.Course, calibration: Calibration, ends: Array
) -> Array:
    """Returns the derivatives (W, 3) of predicted poses by the rotation, by finite differences."""

    def predict(rotation: float) -> Array:
        rotated = replace(calibration, rotation_rad=rotation)
        return open_loop.convert_to_tracked(course.chosen, rotated, ends)

    right = predict(calibration.rotation_rad - ROTATION_STEP_RAD)
    left = predict(calibration.rotation_rad + ROTATION_STEP_RAD)
    difference = left - right
    difference[:, 2] = geometry.wrap_angle(difference[:, 2])
    return difference / (2.0 * ROTATION_STEP_RAD)


@dataclass(frozen=True)
class _FreeParameters:
    """The parameters (P,) of a refinement: coefficients, then fields of the calibration."""

    model: TaylorModel
    calibration: Calibration
    coefficients: Mask  # (D, K) free coefficients
    time: str | None  # free time of the calibration, a field's name
    names: tuple[str, ...]  # all free fields of the calibration

    @classmethod
    def select(
        cls, model: TaylorModel, calibration: Calibration, spec: RobotSpec
    ) -> "_FreeParameters":
        """Frees what neither a definition nor a measurement fixes."""
        # The rotation is defined by the direction without motion; omnidirectional robots lack one.
        # A rotation known without a lever arm, and a known time, are fixed: a model that lacks
        # a term would change them to compensate.
        uncertainty_by_name = calibration.uncertainty
        time = _select_time(calibration)
        is_turned = (
            "rotation_rad" in uncertainty_by_name
            and not calibration.is_exact
            and not spec.moves_sideways
        )
        if calibration.responses and "lever_arm_x_m" in uncertainty_by_name:
            is_turned = False
        names = [time] if time else []
        if is_turned:
            names.append("rotation_rad")
        coefficients = select_free_coefficients(model, calibration)
        return cls(model, calibration, coefficients, time, tuple(names))

    def start(self) -> Array:
        """Returns the parameters (P,) of the model and the calibration themselves."""
        values = [float(getattr(self.calibration, name)) for name in self.names]
        return np.append(self.model.coefficients[self.coefficients], values)

    def insert(self, theta: Array) -> tuple[TaylorModel, Calibration]:
        """Returns model and calibration at parameters (P,); fixed gains follow their lags."""
        coefficients = self.model.coefficients.copy()
        count = int(self.coefficients.sum())
        coefficients[self.coefficients] = theta[:count]
        for row, response in enumerate(self.calibration.responses, start=FIRST_STATE):
            decay, command = find_linear_terms(
                self.model, response.state, response.command
            )
            if decay is None or command is None or self.coefficients[row, command]:
                continue
            coefficients[row, command] = -response.gain * coefficients[row, decay]
        values: dict[str, Any] = dict(
            zip(self.names, map(float, theta[count:]), strict=True)
        )
        model = replace(self.model, coefficients=coefficients)
        return model, replace(self.calibration, **values)

    def find_bounds(self) -> tuple[Array, Array]:
        """Returns bounds (P,) within which no state that follows a command overshoots in a step."""
        low = np.full(self.model.coefficients.shape, -np.inf)
        high = -low
        unbounded = np.full(len(self.names), np.inf)
        for row, response in enumerate(self.calibration.responses, start=FIRST_STATE):
            decay, _ = find_linear_terms(self.model, response.state, response.command)
            if decay is not None:
                low[row, decay] = -FASTEST / self.model.dt
                high[row, decay] = 0.0
        return (
            np.append(low[self.coefficients], -unbounded),
            np.append(high[self.coefficients], unbounded),
        )


def _select_time(calibration: Calibration) -> str | None:
    """Returns the calibration's time to refine: clock offset or latency; None if it is known."""
    known = calibration.uncertainty
    if not calibration.responses:
        return None
    if "clock_offset_s" in known:
        time = "clock_offset_s"
    elif calibration.command_latency_s > 0.0:
        time = "command_latency_s"
    else:
        return None
    if known[time] <= SEPARABLE_S and not are_lags_measured(calibration):
        return None
    return time


def select_free_coefficients(model: TaylorModel, calibration: Calibration) -> Mask:
    """Selects the free coefficients (D, K): kept, and not fixed by the definition of a state."""
    # An inferred speed is along the direction of travel, vx = 1 speed; known lags are fixed.
    free = model.coefficients != 0.0
    if not calibration.responses:
        # the rates of a measured state were fitted to that state itself
        free[FIRST_STATE:] = False
    for row, response in enumerate(calibration.responses, start=FIRST_STATE):
        decay, command = find_linear_terms(model, response.state, response.command)
        if decay is None:
            continue
        if model.coefficients[VX, decay] == 1.0:
            free[VX, decay] = False
        elif command is not None:
            # the scale of this state is arbitrary, so its gain is fixed
            free[row, command] = False
        if are_lags_measured(calibration):
            free[row, decay] = False
    return np.asarray(free)


def are_lags_measured(calibration: Calibration) -> bool:
    """True if both offset and latency are known: only the wheels' response separates them."""
    return {"clock_offset_s", "command_latency_s"} <= set(calibration.uncertainty)


def find_linear_terms(model: TaylorModel, *names: str | None) -> list[int | None]:
    """Returns the index of each variable's linear term; None without such a term."""
    found: list[int | None] = []
    for name in names:
        exponents = np.array([v == name for v in model.variables], dtype=np.int64)
        terms = np.flatnonzero((model.powers == exponents).all(axis=1))
        found.append(int(terms[0]) if len(terms) else None)
    return found


@dataclass(frozen=True)
class Refined:
    """A refined model."""

    model: TaylorModel
    # with refined offset (or latency), rotation, lags and gains
    calibration: Calibration
    # root mean square of `compute_errors` on the training part [m]
    error: float
    std_errors: Array  # (D, K) of the refined coefficients; NaN for the others


def minimise_errors(
    problem: Problem, model: TaylorModel, calibration: Calibration
) -> Refined:
    """Adjusts coefficients and calibration to minimise the open-loop error; adds no terms."""
    free = _FreeParameters.select(model, calibration, problem.drive.spec)
    count = int(free.coefficients.sum())
    start = free.start()
    scale = np.maximum(np.abs(start), LEAST_SCALE)
    scale[count:] = LEAST_SCALE

    def residual(theta: Array) -> Array:
        return compute_errors(problem, *free.insert(theta))

    def jacobian(theta: Array) -> Array:
        return differentiate_errors(problem, *free.insert(theta), free)

    low, high = free.find_bounds()
    theta, slopes, rest = minimise(
        residual,
        np.clip(start, low, high),
        scale,
        (low, high),
        jacobian=jacobian if problem.courses else None,
    )
    model, calibration = free.insert(theta)
    sigma = estimate_uncertainty(slopes, rest)[count:]
    return Refined(
        model,
        _add_uncertainty(free, model, calibration, sigma),
        float(np.sqrt(np.mean(rest**2))),
        _estimate_errors(problem, free, slopes, rest, model),
    )


def _estimate_errors(
    problem: Problem,
    free: _FreeParameters,
    slopes: Array,
    rest: Array,
    model: TaylorModel,
) -> Array:
    """Returns standard errors (D, K); windows of one stretch of the drive form a cluster.

    Args:
        problem: the windows.
        free: the parameters.
        slopes: (n, P) derivatives of the errors.
        rest: (n,) errors that are left.
        model: the refined model.
    """
    starts = np.concatenate([np.repeat(w.start_t, 3) for w in problem.windows])
    cluster = np.floor((starts - starts.min()) / max(HORIZONS_S)).astype(np.intp)
    count = free.coefficients.sum()
    errors = np.full(model.coefficients.shape, np.nan)
    errors[free.coefficients] = estimate_clustered_errors(slopes, rest, cluster)[:count]
    for row, state in enumerate(problem.drive.spec.state, start=FIRST_STATE):
        decay, command = find_linear_terms(model, state.name, state.follows)
        if decay is None or command is None:
            continue
        if free.coefficients[row, decay] and not free.coefficients[row, command]:
            gain = abs(
                model.coefficients[row, command] / model.coefficients[row, decay]
            )
            errors[row, command] = gain * errors[row, decay]
    return errors


def _add_uncertainty(
    free: _FreeParameters, model: TaylorModel, calibration: Calibration, sigma: Array
) -> Calibration:
    """Adds the standard errors of the refined fields, and the lags that the model has now."""
    known = calibration.uncertainty
    errors = dict(zip(free.names, map(float, sigma), strict=True))
    if free.time:
        errors[free.time] = float(np.hypot(errors[free.time], WITHIN_STEP * model.dt))
        if calibration.limits:  # a lag before a limit looks like a delay
            errors[free.time] = max(errors[free.time], known[free.time])
    if are_lags_measured(calibration) and "clock_offset_s" in errors:
        both = np.hypot(errors["clock_offset_s"], known["command_latency_s"])
        errors["clock_offset_s"] = float(both)
    rotation = calibration.rotation_rad
    if "rotation_rad" in free.names:
        rotation = float(geometry.wrap_angle(rotation))
    responses = tuple(
        _update_response(model, row, response)
        for row, response in enumerate(calibration.responses, start=FIRST_STATE)
    )
    return replace(
        calibration,
        rotation_rad=rotation,
        uncertainty={**known, **errors},
        responses=responses,
    )


def _update_response(model: TaylorModel, row: int, response: Response) -> Response:
    """Returns the lag and gain that correspond to the coefficients of the state's rate."""
    decay, command = find_linear_terms(model, response.state, response.command)
    coefficients = model.coefficients[row]
    if decay is None or command is None:
        return response
    rate = -float(coefficients[decay])
    if not 0.0 < rate * model.dt < 1.0:
        return response
    lag = -model.dt / float(np.log1p(-rate * model.dt))
    return replace(response, lag_s=lag, gain=float(coefficients[command]) / rate)


def simplify(problem: Problem, refined: Refined) -> Refined:
    """Removes terms of the twist that hardly improve predictions, weakest first; refines again."""
    best = refined
    tried = set[tuple[int, int]]()
    limit = refined.error * (1.0 + WORTH)
    while True:
        weakest = _find_weakest(best, tried)
        if weakest is None:
            break
        tried.add(weakest)
        coefficients = best.model.coefficients.copy()
        coefficients[weakest] = 0.0
        # the last term: without it the robot would not move
        if not coefficients[TWIST].any():
            break
        shorter = replace(best.model, coefficients=coefficients)
        try:
            candidate = minimise_errors(problem, shorter, best.calibration)
        # the remaining model is unstable: its slopes overflow
        except np.linalg.LinAlgError:
            continue
        if candidate.error < limit:
            best = candidate
    used = np.abs(best.model.coefficients).sum(axis=0) > 0.0
    coefficients = np.ascontiguousarray(best.model.coefficients[:, used])
    model = replace(
        best.model, powers=best.model.powers[used], coefficients=coefficients
    )
    return replace(best, model=model, std_errors=best.std_errors[:, used])


def _find_weakest(
    refined: Refined, tried: set[tuple[int, int]]
) -> tuple[int, int] | None:
    """Returns row and term of the untried free coefficient of the twist with the least weight.

    The weight of a term is its share of the rate at the ends of the range of X.
    """
    model = refined.model
    free = select_free_coefficients(model, refined.calibration)[TWIST]
    largest = np.maximum(np.abs(model.low), np.abs(model.high))
    effects = np.prod(largest**model.powers, axis=1)
    weights = np.abs(model.coefficients[TWIST]) * effects
    weights = weights / np.maximum(weights.sum(axis=1, keepdims=True), 1e-12)
    for flat in np.argsort(np.where(free, weights, np.inf), axis=None):
        row, term = divmod(int(flat), weights.shape[1])
        if free[row, term] and (row, term) not in tried:
            return row, term
    return None


def drop_doubtful_rotation(
    problem: Problem, best: Refined, before: Calibration
) -> Refined:
    """Refines again without a rotation that is below three standard errors."""
    calibration = best.calibration
    rotation = calibration.rotation_rad
    sigma = calibration.uncertainty.get("rotation_rad", 0.0)
    is_certain = abs(rotation) >= CERTAIN * sigma
    if rotation in (0.0, before.rotation_rad) or is_certain:
        return best
    others = {k: v for k, v in calibration.uncertainty.items() if k != "rotation_rad"}
    straight = replace(calibration, rotation_rad=0.0, uncertainty=others)
    straightened = minimise_errors(problem, best.model, straight)
    errors = straightened.calibration.uncertainty | {"rotation_rad": sigma}
    return replace(
        straightened, calibration=replace(straightened.calibration, uncertainty=errors)
    )
