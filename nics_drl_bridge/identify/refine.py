"""Refinement of a model by its errors over seconds (Ljung, System Identification, ch. 7)."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge import geometry
from nics_drl_bridge.geometry import Array
from nics_drl_bridge.identify import open_loop
from nics_drl_bridge.identify.calibration import Calibration, Response
from nics_drl_bridge.identify.clocks import TOLD_S
from nics_drl_bridge.identify.drive import Drive
from nics_drl_bridge.identify.signals import speed_index
from nics_drl_bridge.identify.statistics import (
    CERTAIN,
    clustered_errors,
    minimise,
    uncertainty,
)
from nics_drl_bridge.robot.spec import RobotSpec
from nics_drl_bridge.robot.taylor import TaylorModel

Mask = NDArray[np.bool_]
Errors = Mapping[str, Mapping[str, float]]

HORIZONS_S = (1.0, 2.5, 5.0)
SPACING_S = 0.25
MIN_WINDOWS = 10
HEADING_ARM_M = 0.3  # a heading error counts as a position error at this distance
# a window whose error exceeds this many times the median contains a jump
OUTLYING = 10.0
# provided that the error also exceeds this fraction of the longest path
OUTLYING_SHARE = 0.25
MOST_OUTLIERS = 0.3
# slopes of a diverging model are clipped, so that their scaling stays finite
STEEPEST = 1e100
TURN_RAD = 1e-5  # step of the finite difference by the rotation
DIVERGED = 1e3
LEAST_SCALE = 0.05
# A model uses the values at the start of a step, so a time is uncertain by the standard deviation
# of a uniform distribution over the step.
WITHIN = 12.0**-0.5
# maximum fraction of its distance by which a state approaches its command in one step
FASTEST = 0.99
TOO_SHORT = (
    "The training part is too short to refine the model by its errors over seconds; record a "
    "longer drive."
)
# terms are removed while the error rises by less than this fraction in total
WORTH = 0.1


def refined(
    linear: TaylorModel, calibration: Calibration, drive: Drive
) -> tuple[TaylorModel, Calibration, str]:
    """Refines a linear fit by its predictions, removes terms; returns a sentence on the result."""
    model, calibration = by_definition(linear.add_errors({}), calibration, drive.spec)
    problem = problem_of(model, calibration, drive)
    note = TOO_SHORT
    if problem is not None:
        try:
            best = simplify(problem, refine(problem, model, calibration))
            best = without_doubtful_rotation(problem, best, calibration)
            errors = replace(best.model, std_errors=best.std_errors).named_errors
            what = "Coefficients"
            if best.calibration != calibration:
                what += " and calibration"
            by = f"{what} were refined by the open-loop errors over up to {problem.horizon_s:g} s"
            parts = f"of x, y and heading times {HEADING_ARM_M:g} m"
            left = f"the root mean square {parts} left on the training part"
            note = f"{by}: {left} is {best.error:.4f} m."
            return merged(best.model, linear, errors), best.calibration, note
        except np.linalg.LinAlgError:  # the model is unstable: its slopes overflow
            why = "The predictions of the fitted model diverge on the training part"
            note = f"{why}, so it could not be refined."
    return merged(model, linear, {}), calibration, note


def without_doubtful_rotation(
    problem: "Problem", best: "Refined", before: Calibration
) -> "Refined":
    """Refines again without a rotation that is below three standard errors."""
    calibration = best.calibration
    sigma = calibration.uncertainty.get("rotation_rad", 0.0)
    turned = calibration.rotation_rad
    if turned in (0.0, before.rotation_rad) or abs(turned) >= CERTAIN * sigma:
        return best
    others = {k: v for k, v in calibration.uncertainty.items() if k != "rotation_rad"}
    straight = replace(calibration, rotation_rad=0.0, uncertainty=others)
    found = refine(problem, best.model, straight)
    told = found.calibration.uncertainty | {"rotation_rad": sigma}
    return replace(found, calibration=replace(found.calibration, uncertainty=told))


def readjusted(
    model: TaylorModel, calibration: Calibration, drive: Drive
) -> tuple[TaylorModel, Calibration] | None:
    """Adjusts a refined model to another drive, term by term; None if that is not possible."""
    problem = problem_of(model, calibration, drive)
    try:
        found = None if problem is None else refine(problem, model, calibration)
    except np.linalg.LinAlgError:
        return None
    return None if found is None else (found.model, found.calibration)


def by_definition(
    model: TaylorModel, calibration: Calibration, spec: RobotSpec
) -> tuple[TaylorModel, Calibration]:
    """Scales an inferred speed so that vx = 1 speed, and drops lateral motion that is noise.

    Lateral motion is noise unless it is commanded or a state measures it.
    """
    coefficients = model.coefficients.copy()
    limits = model.limits.copy()
    low = model.low.copy()
    high = model.high.copy()
    slips = any(variable.twist == "vy" for variable in spec.state)
    if not (spec.moves_sideways or slips):
        coefficients[1] = 0.0
    responses = list(calibration.responses)
    i = speed_index(spec)
    if responses and i is not None:
        (alone,) = linear_terms(model, spec.state[i].name)
        scale = 0.0 if alone is None else float(coefficients[0, alone])
        if scale > 0.0:
            coefficients = coefficients / scale ** model.powers[:, i]
            coefficients[3 + i] *= scale
            limits[i] *= scale
            low[i] *= scale
            high[i] *= scale
            responses[i] = replace(responses[i], gain=responses[i].gain * scale)
            coefficients[0, alone] = 1.0
    model = replace(model, coefficients=coefficients, limits=limits, low=low, high=high)
    return model, replace(calibration, responses=tuple(responses))


def merged(model: TaylorModel, linear: TaylorModel, refined: Errors) -> TaylorModel:
    """Adds standard errors: the linear fit's where a row is unchanged, else the larger of both."""
    first = linear.named_errors
    rows = {}
    for dof, old, new in zip(
        model.dofs, linear.coefficients, model.coefficients, strict=True
    ):
        before = dict(zip(linear.term_names, old, strict=True))
        after = zip(model.term_names, new, strict=True)
        known = first.get(dof, {})
        rows[dof] = (
            dict(known) if all(before.get(k, 0.0) == v for k, v in after) else {}
        )
        for term, error in refined.get(dof, {}).items():
            rows[dof][term] = max(error, known.get(term, 0.0))
    return model.add_errors(rows)


@dataclass(frozen=True)
class Problem:
    """Prediction problem of a refinement: windows of one drive, the same for every trial model."""

    drive: Drive
    horizon_s: float  # the longest horizon that fits into the drive
    chosen: tuple[open_loop.Windows, ...]  # for each horizon, without jumps of the pose
    # courses of X over them if the state was measured, else empty
    courses: tuple[open_loop.Course, ...]


def problem_of(
    model: TaylorModel, calibration: Calibration, drive: Drive
) -> Problem | None:
    """Selects the windows of a training part to predict; None if it is too short."""
    until = drive.settings.train_until_s
    chosen = []
    longest = 0.0
    for horizon in HORIZONS_S:
        found = open_loop.windows(drive, calibration, 0.0, until, horizon, SPACING_S)
        if len(found.start_t) >= MIN_WINDOWS:
            error = open_loop.predict(model, calibration, drive, found) - found.end
            chosen.append(_without_outliers(found, error))
            longest = horizon
    if not chosen:
        return None
    measured = drive.recording.state is not None
    courses = (
        open_loop.course_of(model, calibration, drive, w) for w in chosen if measured
    )
    return Problem(drive, longest, tuple(chosen), tuple(courses))


def _without_outliers(chosen: open_loop.Windows, error: Array) -> open_loop.Windows:
    size = np.hypot(error[:, 0], error[:, 1])
    far = max(
        OUTLYING * float(np.median(size)), OUTLYING_SHARE * float(chosen.path.max())
    )
    inside = size <= far
    if (
        inside.all()
        or inside.mean() < 1.0 - MOST_OUTLIERS
        or inside.sum() < MIN_WINDOWS
    ):
        return chosen
    return chosen.rows(inside)


def prediction_errors(
    problem: Problem, model: TaylorModel, calibration: Calibration
) -> Array:
    """Returns the errors (n,) of all predictions: x, y and heading of each window [m]."""
    each = zip(*(vars(windows).values() for windows in problem.chosen), strict=True)
    chosen = open_loop.Windows(*map(np.concatenate, each))
    with np.errstate(all="ignore"):  # a trial step may diverge and is then rejected
        if problem.courses:
            ends = [
                open_loop.relative_ends(course, model)[0] for course in problem.courses
            ]
            predicted = open_loop.tracked_ends(
                chosen, calibration, np.concatenate(ends)
            )
        else:  # all windows by a single rollout
            predicted = open_loop.predict(model, calibration, problem.drive, chosen)
        error = predicted - chosen.end
        error[:, 2] = HEADING_ARM_M * geometry.wrap_angle(error[:, 2])
        error *= _scale(problem, chosen)
    return np.asarray(
        np.clip(np.nan_to_num(error.ravel(), nan=DIVERGED), -DIVERGED, DIVERGED)
    )


def _scale(problem: Problem, chosen: open_loop.Windows) -> Array:
    """Returns factors (W, 3) of errors, from the variances of the poses at both ends."""
    return np.asarray(np.sqrt(problem.drive.trust(chosen.start_t, chosen.end_t)))


def prediction_slopes(
    problem: Problem, model: TaylorModel, calibration: Calibration, free: "_Free"
) -> Array:
    """Returns the derivatives (n, P) of `prediction_errors` for a measured state."""
    parts = []
    for course in problem.courses:
        ends, moved = open_loop.relative_ends(course, model, free.coefficients)
        slope = open_loop.tracked_slopes(course, calibration, ends, moved)
        if "rotation_rad" in free.names:
            angles = calibration.rotation_rad + np.array([-TURN_RAD, TURN_RAD])
            either = (replace(calibration, rotation_rad=angle) for angle in angles)
            right, left = (
                open_loop.tracked_ends(course.chosen, c, ends) for c in either
            )
            aside = (left - right)[:, :, None]
            aside[:, 2] = geometry.wrap_angle(aside[:, 2])
            slope = np.concatenate([slope, aside / (2.0 * TURN_RAD)], axis=2)
        slope[:, 2] *= HEADING_ARM_M
        slope *= _scale(problem, course.chosen)[..., None]
        parts.append(slope.reshape(-1, slope.shape[2]))
    return np.clip(np.nan_to_num(np.concatenate(parts), nan=0.0), -STEEPEST, STEEPEST)


@dataclass(frozen=True)
class _Free:
    model: TaylorModel
    calibration: Calibration
    coefficients: Mask  # (D, K) free coefficients
    time: str | None  # free field of the calibration
    names: tuple[str, ...]  # all free fields

    @classmethod
    def of(
        cls, model: TaylorModel, calibration: Calibration, spec: RobotSpec
    ) -> "_Free":
        """Frees what neither a definition nor a measurement fixes."""
        # The rotation is defined by the direction without motion; omnidirectional robots lack one.
        # A rotation known without a lever arm, and a known time, are fixed: a model that lacks
        # a term would change them to compensate.
        known = calibration.uncertainty
        time = None
        if calibration.responses and "clock_offset_s" in known:
            time = "clock_offset_s"
        elif calibration.responses and calibration.command_latency_s > 0.0:
            time = "command_latency_s"
        if time and known[time] <= TOLD_S and not lag_is_measured(calibration):
            time = None
        turn = (
            "rotation_rad" in known
            and not calibration.is_exact
            and not spec.moves_sideways
        )
        turn &= not (calibration.responses and "lever_arm_x_m" in known)
        names = (*([time] if time else ()), *(["rotation_rad"] if turn else ()))
        return cls(
            model, calibration, free_coefficients(model, calibration), time, names
        )

    def at(self, theta: Array) -> tuple[TaylorModel, Calibration]:
        """Returns model and calibration at parameters (P,); fixed gains follow their lags."""
        coefficients = self.model.coefficients.copy()
        count = int(self.coefficients.sum())
        coefficients[self.coefficients] = theta[:count]
        for i, response in enumerate(self.calibration.responses):
            own, command = linear_terms(self.model, response.state, response.command)
            if (
                own is not None
                and command is not None
                and not self.coefficients[3 + i, command]
            ):
                coefficients[3 + i, command] = -response.gain * coefficients[3 + i, own]
        values: dict[str, Any] = dict(
            zip(self.names, map(float, theta[count:]), strict=True)
        )
        return replace(self.model, coefficients=coefficients), replace(
            self.calibration, **values
        )

    def bounds(self) -> tuple[Array, Array]:
        """Returns bounds (P,) within which no state that follows a command overshoots in a step."""
        low = np.full(self.model.coefficients.shape, -np.inf)
        high = -low
        rest = np.full(len(self.names), np.inf)
        for i, response in enumerate(self.calibration.responses):
            own, _ = linear_terms(self.model, response.state, response.command)
            if own is not None:
                low[3 + i, own] = -FASTEST / self.model.dt
                high[3 + i, own] = 0.0
        return np.append(low[self.coefficients], -rest), np.append(
            high[self.coefficients], rest
        )


def free_coefficients(model: TaylorModel, calibration: Calibration) -> Mask:
    """Selects the free coefficients (D, K): kept, and not fixed by the definition of a state."""
    # An inferred speed is along the direction of travel, vx = 1 speed; known lags are fixed.
    free = model.coefficients != 0.0
    if not calibration.responses:
        # the rates of a measured state were fitted to that state itself
        free[3:] = False
    for i, response in enumerate(calibration.responses):
        alone, command = linear_terms(model, response.state, response.command)
        if alone is None:
            continue
        if model.coefficients[0, alone] == 1.0:
            free[0, alone] = False
        elif command is not None:
            # the scale of this state is arbitrary, so its gain is fixed
            free[3 + i, command] = False
        if lag_is_measured(calibration):
            free[3 + i, alone] = False
    return np.asarray(free)


def lag_is_measured(calibration: Calibration) -> bool:
    """True if both offset and latency are known: only the wheels' response separates them."""
    return {"clock_offset_s", "command_latency_s"} <= set(calibration.uncertainty)


def linear_terms(model: TaylorModel, *names: str | None) -> list[int | None]:
    """Returns the columns of the terms of a single variable; None without such a term."""
    wanted = (
        np.array([v == name for v in model.variables], dtype=np.int64) for name in names
    )
    hits = (np.flatnonzero((model.powers == row).all(axis=1)) for row in wanted)
    return [int(hit[0]) if len(hit) else None for hit in hits]


@dataclass(frozen=True)
class Refined:
    """A refined model."""

    model: TaylorModel
    calibration: (
        Calibration  # with refined offset (or latency), rotation, lags and gains
    )
    # root mean square of the components of `prediction_errors` on the training part [m]
    error: float
    std_errors: Array  # (D, K) of the refined coefficients; NaN for the others


def refine(problem: Problem, model: TaylorModel, calibration: Calibration) -> Refined:
    """Adjusts coefficients and calibration to minimise the open-loop error; adds no terms."""
    free = _Free.of(model, calibration, problem.drive.spec)
    first = model.coefficients[free.coefficients]
    theta = np.append(first, [float(getattr(calibration, name)) for name in free.names])
    scale = np.maximum(np.abs(theta), LEAST_SCALE)
    scale[len(first) :] = LEAST_SCALE  # s, rad

    def residual(value: Array) -> Array:
        return prediction_errors(problem, *free.at(value))

    def jacobian(value: Array) -> Array:
        return prediction_slopes(problem, *free.at(value), free)

    given, (low, high) = jacobian if problem.courses else None, free.bounds()
    begun = np.clip(theta, low, high)
    theta, slope, rest = minimise(residual, begun, scale, (low, high), jacobian=given)
    model, calibration = free.at(theta)
    sigma = uncertainty(slope, rest)[len(first) :]
    calibration = _with_uncertainty(free, model, calibration, sigma)
    errors = _coefficient_errors(problem, free, slope, rest, model)
    return Refined(model, calibration, float(np.sqrt(np.mean(rest**2))), errors)


def _coefficient_errors(
    problem: Problem, free: _Free, jacobian: Array, rest: Array, model: TaylorModel
) -> Array:
    """Returns standard errors (D, K); windows of one stretch of the drive form a cluster."""
    starts = np.concatenate([np.repeat(w.start_t, 3) for w in problem.chosen])
    cluster = np.floor((starts - starts.min()) / max(HORIZONS_S)).astype(np.intp)
    errors = np.full(model.coefficients.shape, np.nan)
    errors[free.coefficients] = clustered_errors(jacobian, rest, cluster)[
        : free.coefficients.sum()
    ]
    for d, state in enumerate(problem.drive.spec.state, start=3):
        own, command = linear_terms(model, state.name, state.follows)
        if own is None or command is None:
            continue
        if free.coefficients[d, own] and not free.coefficients[d, command]:
            gain = abs(model.coefficients[d, command] / model.coefficients[d, own])
            errors[d, command] = gain * errors[d, own]
    return errors


def _with_uncertainty(
    free: _Free, model: TaylorModel, calibration: Calibration, sigma: Array
) -> Calibration:
    known = calibration.uncertainty
    spread = dict(zip(free.names, map(float, sigma), strict=True))
    if free.time:
        spread[free.time] = float(np.hypot(spread[free.time], WITHIN * model.dt))
        if calibration.limits:  # a lag before a limit looks like a delay
            spread[free.time] = max(spread[free.time], known[free.time])
    if lag_is_measured(calibration) and "clock_offset_s" in spread:
        both = np.hypot(spread["clock_offset_s"], known["command_latency_s"])
        spread["clock_offset_s"] = float(both)
    turned = calibration.rotation_rad
    if "rotation_rad" in free.names:
        turned = float(geometry.wrap_angle(turned))
    responses = tuple(
        _response(model, i, r) for i, r in enumerate(calibration.responses)
    )
    found = {**known, **spread}
    return replace(
        calibration, rotation_rad=turned, uncertainty=found, responses=responses
    )


def _response(model: TaylorModel, i: int, response: Response) -> Response:
    """Returns the lag and gain that correspond to the coefficients of the state's rate."""
    own, command = linear_terms(model, response.state, response.command)
    row = model.coefficients[3 + i]
    if own is None or command is None or not 0.0 < -row[own] * model.dt < 1.0:
        return response
    rate = -float(row[own])
    lag = -model.dt / float(np.log1p(-rate * model.dt))
    return replace(response, lag_s=lag, gain=float(row[command]) / rate)


def simplify(problem: Problem, refined: Refined) -> Refined:
    """Removes terms of the twist that hardly improve predictions, weakest first; refines again."""
    best = refined
    tried = set[tuple[int, int]]()
    limit = refined.error * (1.0 + WORTH)
    while (weakest := _weakest(best, tried)) is not None:
        tried.add(weakest)
        coefficients = best.model.coefficients.copy()
        coefficients[weakest] = 0.0
        # the last term: without it the robot would not move
        if not coefficients[:3].any():
            break
        shorter = replace(best.model, coefficients=coefficients)
        try:
            again = refine(problem, shorter, best.calibration)
        # the remaining model is unstable: its slopes overflow
        except np.linalg.LinAlgError:
            continue
        if again.error < limit:
            best = again
    used = np.abs(best.model.coefficients).sum(axis=0) > 0.0
    coefficients = np.ascontiguousarray(best.model.coefficients[:, used])
    model = replace(
        best.model, powers=best.model.powers[used], coefficients=coefficients
    )
    return replace(best, model=model, std_errors=best.std_errors[:, used])


def _weakest(refined: Refined, tried: set[tuple[int, int]]) -> tuple[int, int] | None:
    """Returns the untried free term of the twist with the smallest weight over the range of X."""
    model = refined.model
    free = free_coefficients(model, refined.calibration)[:3]
    reach = np.maximum(np.abs(model.low), np.abs(model.high))
    size = np.abs(model.coefficients[:3]) * np.prod(reach**model.powers, axis=1)
    size = size / np.maximum(size.sum(axis=1, keepdims=True), 1e-12)
    for flat in np.argsort(np.where(free, size, np.inf), axis=None):
        d, k = divmod(int(flat), size.shape[1])
        if free[d, k] and (d, k) not in tried:
            return d, k
    return None
