"""Hypotheses on a drive: the textbook as a base, effects beside it, and orders of terms beyond."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import product

import numpy as np

from nics_drl_bridge import geometry
from nics_drl_bridge.errors import FitError
from nics_drl_bridge.geometry import Array
from nics_drl_bridge.identify import forms, shooting, terms
from nics_drl_bridge.identify.calibration import Calibration
from nics_drl_bridge.identify.drive import Drive
from nics_drl_bridge.identify.excitation import list_unmoved_variables
from nics_drl_bridge.identify.fit import Alpha, Order, prune
from nics_drl_bridge.identify.open_loop import HORIZON_S
from nics_drl_bridge.identify.statistics import CERTAIN, estimate_clustered_errors
from nics_drl_bridge.recording.recording import Samples
from nics_drl_bridge.robot import taylor
from nics_drl_bridge.robot.curve import InputCurve
from nics_drl_bridge.robot.spec import RobotSpec
from nics_drl_bridge.robot.taylor import TaylorModel

ORDERS = (1, 2, 3)  # orders that `auto` chooses from
PULLS = (0.1, 0.01, 0.001)  # pulls that are tried for each order
ORDERS_OF_FOLLOWERS = (2, 3, 4)
ORDERS_OF_MEASURED = (1,)  # besides that of the base
WORTH = 0.95  # a higher order must reduce the error to this fraction
FOLDS = 3
# spacing of trials' windows
SPACING_S = 0.5
EVALUATIONS = 25
BASE_ORDER = 3
PRUNING = 0.99  # threshold (Eq. 2) of `auto` for a model that was found by predictions
BASE_EVALUATIONS = 100
NOTHING = 1e-4  # m, rad: size below which a removed part of a mounting counts as zero
# A model uses the values at the start of a step, so a time is uncertain by the standard deviation
# of a uniform distribution over the step.
WITHIN_STEP = 12.0**-0.5
LONGEST_LAG_S = 2.0  # a state that takes longer is coasting, so it hides no latency
BANDS_S = (0.5, 1.0, 2.0, HORIZON_S)
UNSEEN = f"predictions over {HORIZON_S:g} s of parts that a fit did not see"

# (order, 0 for the textbook's terms alone; pull towards these)
Hypothesis = tuple[int, float]
TEXTBOOK = 0, 0.0


@dataclass(frozen=True)
class Trial:
    """A trial of one order, on parts of the training data that its fits did not see."""

    order: int  # 0: only the textbook's terms
    pull: float  # weight that keeps coefficients near the textbook's
    error: float  # mean error after `HORIZON_S`, as a fraction of the path
    # (W,) distances at the ends of predictions, by horizon [m]
    errors: dict[float, Array]

    @property
    def level(self) -> float:
        """Geometric mean of the mean errors over all horizons that fit; infinite if none does."""
        # Short horizons show best what drives a robot, long ones where it ends up.
        means = [float(far.mean()) for far in self.errors.values() if len(far)]
        return float(np.exp(np.mean(np.log(means)))) if means else np.inf


@dataclass(frozen=True)
class Draft:
    """A form, and the prediction problem by which its models are fitted."""

    library: terms.Library
    form: forms.Form
    parameters: shooting.Parameters
    problem: shooting.Shooting

    @property
    def spec(self) -> RobotSpec:
        """The robot."""
        return self.library.spec

    def select(self, inside: terms.Mask | None) -> Samples:
        """Returns the samples inside (T,), with the states that follow the commands."""
        samples = self.problem.resample(self.parameters.start)
        return samples if inside is None else samples.rows(inside)

    def fit_base(
        self, inside: terms.Mask | None = None, other: TaylorModel | None = None
    ) -> shooting.Predictive:
        """Fits the base's terms, gains and lags; the search may start at another model."""
        spec = self.spec
        model = self.library.fit_base(self.select(inside), self.form.tyres)
        if self.form.followed:
            model = terms.add_linear_terms(model)
        first = None
        if other is not None:
            model, first = terms.merge_terms(model, other)
        fitted = shooting.fit_to_predictions(
            self.problem,
            model,
            self.library.select_free(model),
            self.parameters,
            inside,
            BASE_EVALUATIONS,
            first=first,
        )
        return replace(fitted, model=terms.stabilise(fitted.model, spec))

    def refine(
        self,
        base: TaylorModel,
        linear: TaylorModel,
        inside: terms.Mask | None = None,
        evaluations: int = shooting.EVALUATIONS,
        pull: float = shooting.PULL,
    ) -> shooting.Predictive:
        """Adjusts the terms of a linear fit, and those of a base that they are pulled towards."""
        if self.library.kind is terms.Kind.MEASURED:
            base = linear  # rates of a measured state are fitted to that state itself
        base, first = terms.merge_terms(base, linear)
        both = replace(
            base, coefficients=np.where(first != 0.0, first, base.coefficients)
        )
        free = self.library.select_free(both)
        return shooting.fit_to_predictions(
            self.problem, base, free, self.parameters, inside, evaluations, pull, first
        )

    def measure_error(self, predictive: shooting.Predictive) -> float:
        """Returns the mean distance of predicted from measured ends, over all horizons [m]."""
        error = self.problem.errors(predictive.model, predictive.values)[0]
        return float(np.nanmean(np.hypot(error[..., 0], error[..., 1])))

    def calibrate(
        self, found: shooting.Predictive, calibration: Calibration
    ) -> Calibration:
        """Returns a calibration with delays, input curves, lags and mounting of a search."""
        at = dict(zip(self.parameters.names, found.values.tolist(), strict=True))
        responses = (
            replace(
                response,
                lag_s=at.get(f"{response.state}.lag", response.lag_s),
                gain=at.get(f"{response.state}.gain", response.gain),
            )
            for response in calibration.responses
        )
        latency = self.form.latency_at(self.parameters, found.values)
        known = calibration.uncertainty | found.named_errors(self.parameters.names)
        within_step = WITHIN_STEP * self.problem.samples.dt
        for name, _ in self.form.delays:
            key = f"{name}.delay"
            if key in known:
                known[key] = float(np.hypot(known[key], within_step))
        time_error = self._estimate_time_error(found)
        offset = calibration.clock_offset_s
        is_told = not np.isnan(time_error)
        # A delay between two clocks is a part of their offset, unless that dates a derived state.
        if "clock_offset_s" in known and self.problem.inferred is not None:
            offset -= latency - calibration.command_latency_s
            latency = calibration.command_latency_s
            beside = known.get("command_latency_s", 0.0)
            if is_told:
                known["clock_offset_s"] = float(np.hypot(time_error, beside))
        elif is_told:
            known["command_latency_s"] = time_error
        calibration = replace(
            calibration,
            clock_offset_s=offset,
            command_latency_s=latency,
            inputs=self.form.curves_at(self.parameters, found.values),
            responses=tuple(responses),
            uncertainty=known,
        )
        if self.problem.mounted:
            return add_predicted_mounting(calibration, found)
        return calibration

    def _estimate_time_error(self, found: shooting.Predictive) -> float:
        """Returns the standard error of the latency [s], which the model's step widens."""
        names = list(self.parameters.names)
        name = "latency"
        if self.form.delays:
            at = dict(zip(names, found.values.tolist(), strict=True))
            name = min(
                (f"{key}.delay" for key, _ in self.form.delays), key=at.__getitem__
            )
        error = float(found.value_errors[names.index(name)])
        return float(np.hypot(error, WITHIN_STEP * self.problem.samples.dt))

    def add_errors(
        self, found: shooting.Predictive, linear: TaylorModel
    ) -> TaylorModel:
        """Returns a found model with standard errors; those of other terms are a linear fit's."""
        model = found.model
        errors = estimate_coefficient_errors(found)
        at = dict(zip(self.parameters.names, found.values.tolist(), strict=True))
        sigma = dict(
            zip(self.parameters.names, found.value_errors.tolist(), strict=True)
        )
        for state, command in self.form.followed:
            row = terms.FIRST_STATE + model.variables.index(state)
            own = terms.find_linear_term(model, state)
            driven = terms.find_linear_term(model, command)
            rate, gained = np.abs(model.coefficients[row, [own, driven]])
            relative = sigma[f"{state}.lag"] / at[f"{state}.lag"]
            by_gain = rate * sigma.get(f"{state}.gain", 0.0)
            errors[row, own] = rate * relative
            errors[row, driven] = np.hypot(gained * relative, by_gain)
        named = {dof: dict(by_term) for dof, by_term in linear.named_errors.items()}
        refined = replace(model, std_errors=errors).named_errors
        for dof, by_term in refined.items():
            named.setdefault(dof, {}).update(by_term)
        return model.add_errors(named)

    def prune(self, found: shooting.Predictive, alpha: Alpha) -> shooting.Predictive:
        """Prunes the twist of a found model (Eq. 2), and adjusts the terms that are kept."""
        model = found.model
        chi = taylor.evaluate(self.select(None).x, model.powers)
        spread = chi.std(axis=0)
        beta = model.coefficients * np.where(spread > 0.0, spread, 1.0)
        coefficients = model.coefficients.copy()
        threshold = PRUNING if alpha == "auto" else alpha
        for row in range(terms.FIRST_STATE):
            coefficients[row, ~prune(beta[row], threshold)] = 0.0
        if (coefficients == model.coefficients).all():
            return found
        pruned = replace(model, coefficients=coefficients)
        free = self.library.select_free(pruned)
        parameters = replace(self.parameters, start=found.values)
        return shooting.fit_to_predictions(self.problem, pruned, free, parameters)

    def cross_validate(self, asked: tuple[Hypothesis, ...]) -> tuple[Trial, ...]:
        """Cross-validates each hypothesis over `FOLDS` parts of a drive.

        A part is not left out if a variable would not have moved without it, or if the rest is too
        short to fit a model.
        """
        samples = self.problem.samples
        values = self.parameters.start
        everything = np.arange(len(samples.t))
        unmoved = list_unmoved_variables(samples, self.spec)
        problem = replace(self.problem, spacing_s=SPACING_S, fixed=values)
        fixed = replace(self, problem=problem, parameters=shooting.NO_PARAMETERS)
        nothing = np.zeros((0, len(BANDS_S)))
        distances = dict.fromkeys(asked, nothing)  # (W, H) of ends
        paths = nothing  # (W, H)
        judge = replace(problem, horizons=BANDS_S)
        for block in np.array_split(everything, FOLDS):
            unseen = np.isin(everything, block)
            if list_unmoved_variables(samples.rows(~unseen), self.spec) != unmoved:
                continue
            try:
                models = list(fixed.fit_models(asked, ~unseen))
            except FitError:
                continue
            for hypothesis, model in models:
                error, path = judge.errors(model, values, unseen)
                far = np.hypot(error[..., 0], error[..., 1])
                distances[hypothesis] = np.concatenate([distances[hypothesis], far])
            paths = np.concatenate([paths, path])
        longest = paths[:, -1]
        length = float(longest[~np.isnan(longest)].sum())
        trials = []
        for (order, pull), far in distances.items():
            share = float(np.nansum(far[:, -1])) / length if length else np.nan
            columns = zip(BANDS_S, far.T, strict=True)
            errors = {h: column[~np.isnan(column)] for h, column in columns}
            trials.append(Trial(order, pull, share, errors))
        return tuple(trials)

    def fit_models(
        self, asked: tuple[Hypothesis, ...], inside: terms.Mask
    ) -> Iterator[tuple[Hypothesis, TaylorModel]]:
        """Yields the model of each hypothesis, fitted to the rows inside (T,)."""
        samples = self.select(inside)
        base = self.fit_base(inside).model
        starts: dict[int, TaylorModel] = {}  # of the searches, by order
        for order, pull in asked:
            if not pull:
                yield (order, pull), base
                continue
            if order not in starts:
                starts[order] = self.library.fit(samples, order).model
            refined = self.refine(base, starts[order], inside, EVALUATIONS, pull)
            starts[order] = refined.model  # near the best model of the next pull
            yield (order, pull), refined.model


@dataclass(frozen=True)
class Candidate:
    """A part of a model that was tried, for the report."""

    name: str
    # mean error after `HORIZON_S` on parts that the fit did not see, as a fraction of the path
    error: float
    kept: bool


@dataclass(frozen=True)
class Base:
    """The textbook's terms with the best-predicting form, from which models depart."""

    draft: Draft  # its parameters start from the values found
    found: shooting.Predictive
    candidates: tuple[Candidate, ...] = ()  # forms that were tried, in this order


def fit_base(
    drive: Drive,
    calibration: Calibration,
    samples: Samples,
    library: terms.Library,
    clear: tuple[InputCurve, ...],
) -> Base:
    """Fits the textbook with and without each part of a form; keeps what improves predictions.

    `clear` curves are always kept.
    """
    problem = BaseProblem(drive, calibration, samples, library)
    plain_form = forms.make_form(drive, calibration, library)
    best = problem.fit(replace(plain_form, curves=calibration.inputs))
    trial = cross_validate_base(best)
    start = "textbook with input curves" if calibration.inputs else "textbook"
    candidates = [Candidate(start, trial.error, kept=True)]
    if len(calibration.inputs) > len(clear):
        plain = problem.fit(replace(plain_form, curves=clear))
        plain_trial = cross_validate_base(plain)
        # an infinite level: too short to judge
        is_better = plain_trial.level < trial.level or np.isinf(plain_trial.level)
        candidates = [
            Candidate("textbook", plain_trial.error, kept=True),
            Candidate("input curves", trial.error, kept=not is_better),
        ]
        if is_better:
            best = plain
            trial = plain_trial
    # Each change builds on those that were kept before it, so their order matters.
    for name, change, worth in list_changes(drive, calibration, samples, library):
        form = change(best.draft.form)
        if form == best.draft.form:
            continue
        changed = problem.fit(form, best)
        changed_trial = cross_validate_base(changed)
        is_better = changed_trial.level < worth * trial.level and _is_certain(
            changed, best
        )
        candidates.append(Candidate(name, changed_trial.error, kept=is_better))
        if is_better:
            best = changed
            trial = changed_trial
    return replace(best, candidates=tuple(candidates))


def refit_base(
    drive: Drive,
    calibration: Calibration,
    samples: Samples,
    library: terms.Library,
    former: Base,
) -> Base:
    """Fits a base of the same form to other data."""
    followed = forms.make_form(drive, calibration, library).followed
    form = replace(former.draft.form, curves=calibration.inputs, followed=followed)
    problem = BaseProblem(drive, calibration, samples, library)
    refitted = problem.fit(form, former if form.followed else None)
    return replace(refitted, candidates=former.candidates)


@dataclass(frozen=True)
class BaseProblem:
    """What a base is fitted to."""

    drive: Drive
    calibration: Calibration
    samples: Samples
    library: terms.Library

    def fit(self, form: forms.Form, start: Base | None = None) -> Base:
        """Fits the textbook with a form; the search may start at another base."""
        data = (self.drive, self.calibration, self.samples, form)
        parameters = forms.list_parameters(*data)
        if start is not None:
            parameters = parameters.start_from(start.draft.parameters)
        problem = forms.make_prediction_problem(*data, parameters)
        model = None
        if start is not None:
            model = start.found.model
            parameters = forms.choose_start(
                problem, model, parameters, start.draft.parameters
            )
        coarse = replace(problem, spacing_s=SPACING_S)
        draft = Draft(self.library, form, parameters, coarse)
        predictive = draft.fit_base(other=model)
        parameters = replace(parameters, start=predictive.values)
        return Base(replace(draft, parameters=parameters, problem=problem), predictive)


def cross_validate_base(base: Base) -> Trial:
    """Cross-validates the textbook with the form of a base."""
    return base.draft.cross_validate((TEXTBOOK,))[0]


def list_changes(
    drive: Drive, calibration: Calibration, samples: Samples, library: terms.Library
) -> Iterator[tuple[str, Callable[[forms.Form], forms.Form], float]]:
    """Yields changes to the form of a motion by name, and the fraction to cut the error to."""
    if library.kind is not terms.Kind.MOTION:
        yield from _list_follower_changes(drive, calibration, samples)
        return
    # Drag and friction are hard to distinguish, so both are tried, then each without the other.
    speeds = tuple(v.name for v in drive.spec.state if v.twist == "vx")
    shared = forms.list_delays(drive, calibration)
    delays = "a delay of each command"
    # First, because a wrong delay hides other effects and is hidden by them.
    if len(shared) > 1:
        yield delays, lambda form: replace(form, delays=shared), WORTH
    if terms.has_slipping_tyres(drive.spec):
        yield "tyres that slip", lambda form: replace(form, tyres=True), WORTH
    if speeds:
        drag = "drag and back-EMF"
        friction = "dry friction"
        both = f"{drag}, and {friction}"
        yield both, lambda form: replace(form, drag=speeds, friction=speeds), WORTH
        without = f"without {drag}"
        yield without, lambda form: replace(form, drag=()), 1.0 / WORTH
        without = f"without {friction}"
        yield without, lambda form: replace(form, friction=()), 1.0 / WORTH
    if len(shared) > 1:
        yield delays, lambda form: replace(form, delays=shared), WORTH
    if speeds:
        yield (
            "a dead zone",
            lambda form: forms.add_dead_zones(form, drive, samples),
            WORTH,
        )
        limits = "limits of acceleration"
        yield limits, lambda form: replace(form, limits=speeds), WORTH
        others = tuple(
            v.name for v in drive.spec.state if v.twist and not drive.spec.steers
        )
        if others:
            all_limits = f"limits of {', '.join(others)}"
            yield all_limits, lambda form: replace(form, limits=others), WORTH
        backwards = forms.find_two_way_curves(drive, samples)
        if backwards:
            gain = "a gain of its own backwards"
            yield gain, lambda form: forms.add_reverse_gains(form, backwards), WORTH


def _is_certain(changed: Base, before: Base) -> bool:
    """True if dead zones and limits that a change added clearly exceed their standard errors."""
    values = zip(
        changed.draft.parameters.names,
        changed.found.values.tolist(),
        changed.found.value_errors.tolist(),
        strict=True,
    )
    return not any(
        value < CERTAIN * error
        for name, value, error in values
        if name.endswith((".dead", ".fall", ".rise"))
        and name not in before.draft.parameters.names
    )


def _list_follower_changes(
    drive: Drive, calibration: Calibration, samples: Samples
) -> Iterator[tuple[str, Callable[[forms.Form], forms.Form], float]]:
    """Yields changes to the form of states that follow commands, as `list_changes` does."""
    followed = forms.list_followed(drive)
    if not followed:
        return
    shared = tuple((c, calibration.command_latency_s) for _, c in followed)
    delays = "a delay of each command"
    if len(shared) > 1:
        yield delays, lambda form: replace(form, delays=shared), WORTH
    for state, _ in followed:
        yield f"limits of {state}", partial(forms.add_limits, state=state), WORTH
    if len(shared) > 1:
        yield delays, lambda form: replace(form, delays=shared), WORTH
    for _, command in followed:
        bent = partial(
            forms.add_dead_zones, drive=drive, samples=samples, commands=(command,)
        )
        yield f"a dead zone of {command}", bent, WORTH


def list_candidates(
    base: Base | None, trials: Sequence[Trial], order: Order = "auto"
) -> Iterator[Candidate]:
    """Yields all candidates that were tried: forms of the textbook, then orders of terms."""
    if base is not None:
        yield from base.candidates
    if not trials:
        return
    best = choose_trial(trials, order)
    for trial in trials:
        if trial.order:
            name = f"terms up to order {trial.order}"
            if trial.pull:
                name += f", pulled by {trial.pull:g}"
            yield Candidate(name, trial.error, trial is best)


def list_hypotheses(order: Order, library: terms.Library) -> tuple[Hypothesis, ...]:
    """Returns the hypotheses for an order, from the most constrained to the least."""
    if library.kind is terms.Kind.MOTION:
        orders = ORDERS if order == "auto" else (order,)
        return (TEXTBOOK, *product(orders, PULLS))
    if library.kind is terms.Kind.FOLLOWER:
        asked = ORDERS_OF_FOLLOWERS if order == "auto" else (order,)
        return (TEXTBOOK, *product(asked, PULLS[1:2]))
    if order == "auto":
        return (TEXTBOOK, *product(ORDERS_OF_MEASURED, PULLS[2:]))
    return (TEXTBOOK,)


def choose_trial(trials: Sequence[Trial], order: Order = "auto") -> Trial:
    """Returns the first trial that no other clearly improves on; of one `order` if given."""
    eligible = [trial for trial in trials if order in ("auto", trial.order)]
    eligible = eligible or list(trials)
    best = eligible[0]
    for trial in eligible[1:]:
        if trial.error < WORTH * best.error:
            best = trial
    return best


def find_lags(model: TaylorModel, spec: RobotSpec) -> dict[str, float]:
    """Returns the lags [s] by which a base's states follow, by name, plus their own delays."""
    is_linear = model.powers.sum(axis=1) == 1
    lags = {}
    delays = model.delays[model.drivers]
    for i, variable in enumerate(spec.state):
        term = is_linear & (model.powers[:, i] == 1)
        rate = float(model.coefficients[3 + i, term].sum())
        if variable.twist and rate * LONGEST_LAG_S < -1.0:
            lags[variable.name] = float(delays[i]) - 1.0 / rate
    return lags


def describe_lag_sums(latency: float, lags: dict[str, float], beside: float) -> str:
    """States that only the sum of latency [s] and lags is known; `beside` was found with lags."""
    # A model with one lag treats the second lag of a servo as latency.
    sums = ", ".join(f"{beside + lag:.3f} s for {name}" for name, lag in lags.items())
    return f"Latency ({latency:.3f} s) can't be separated from the lags: trust their sums, {sums}."


def estimate_coefficient_errors(predictive: shooting.Predictive) -> Array:
    """Returns standard errors (D, K) of the free coefficients; NaN for the others."""
    span = max(shooting.HORIZONS_S)
    cluster = np.floor((predictive.starts - predictive.starts.min()) / span).astype(
        np.intp
    )
    errors = np.full(predictive.free.shape, np.nan)
    errors[predictive.free] = estimate_clustered_errors(
        predictive.jacobian, predictive.residual, cluster
    )
    return errors


def drop_doubtful_mounting(
    draft: Draft, calibration: Calibration, predictive: shooting.Predictive
) -> Draft | None:
    """Returns a draft without the parts of its mounting below 3 standard errors; None if all stay.

    Removed parts are zero in the calibration that `add_predicted_mounting` returns.
    """
    sigma = predictive.value_errors[-3:]
    total = geometry.compose(predictive.values[-3:], calibration.mounting)
    doubtful = (np.abs(total) < CERTAIN * sigma) & (total != 0.0)
    if not doubtful.any():
        return None
    mounting = calibration.mounting
    rest = predictive.values[-3:].copy()
    if doubtful[2]:
        rest[2] = -mounting[2]
    aside = geometry.rotate(mounting[:2], float(rest[2]))
    rest[:2] = np.where(doubtful[:2], -aside, rest[:2])
    parameters = draft.parameters
    start = parameters.start.copy()
    low = parameters.low.copy()
    high = parameters.high.copy()
    start[-3:] = rest
    places = np.flatnonzero(doubtful) + len(start) - 3
    low[places] = start[places]
    high[places] = start[places]
    return replace(
        draft, parameters=replace(parameters, start=start, low=low, high=high)
    )


def add_predicted_mounting(
    calibration: Calibration, predictive: shooting.Predictive
) -> Calibration:
    """Adds the mounting found by predictions to that of the calibration."""
    x, y, heading = map(
        float, geometry.compose(predictive.values[-3:], calibration.mounting)
    )
    names = ("lever_arm_x_m", "lever_arm_y_m", "rotation_rad")
    known = dict(calibration.uncertainty)
    errors = dict(zip(names, predictive.value_errors[-3:].tolist(), strict=True))
    was_mounted = predictive.values[-2] != 0.0
    if np.isnan(errors["lever_arm_y_m"]) and not was_mounted:
        y = calibration.lever_arm_m[1]
    for name, error in errors.items():
        if not np.isnan(error):  # what the model lacks bends each of both estimates
            known[name] = max(error, known.get(name, 0.0))
    x, y, heading = (0.0 if abs(part) < NOTHING else part for part in (x, y, heading))
    return replace(
        calibration,
        rotation_rad=-heading,
        lever_arm_m=(x, y),
        uncertainty=known,
    )


def describe_forms(base: Base, trials: Sequence[Trial], order: Order) -> Iterator[str]:
    """Lists what a model has besides the terms of its base, and how much that improves it."""
    best = choose_trial(trials, order)
    if not np.isfinite(best.error):
        return
    form = base.draft.form
    parts = [
        f"an input curve of {curve.command}" for curve in form.curves if curve.bends
    ]
    if form.delays:
        parts.append("a delay of each command")
    effects = {
        "drag and back-EMF": form.drag,
        "dry friction": form.friction,
        "limits": form.limits,
    }
    for effect, names in effects.items():
        if names:
            parts.append(f"{effect} of {', '.join(names)}")
    if form.tyres:
        parts.append("tyres that slip")
    finding = "The model is the textbook"
    if base.draft.library.kind is terms.Kind.MEASURED:
        finding = f"The model has terms up to order {base.draft.library.order}"
    if parts:
        finding += f" with {', '.join(parts)}"
    shares = f"{trials[0].error:.1%} of the path away"
    if best.order > 0:
        finding += f", and terms up to order {best.order}"
        shares += f" by that, {best.error:.1%} with the terms"
    yield f"{finding}: {UNSEEN} end {shares}."
