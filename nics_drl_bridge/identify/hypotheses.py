"""Hypotheses on a drive: the textbook as a base, effects beside it, and orders of terms beyond."""

from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import product
from typing import Any

import numpy as np

from nics_drl_bridge import geometry
from nics_drl_bridge.errors import FitError
from nics_drl_bridge.geometry import Array
from nics_drl_bridge.identify import forms, shooting, terms
from nics_drl_bridge.identify.calibration import Alpha, Calibration, Order
from nics_drl_bridge.identify.fit import list_unmoved_variables, prune
from nics_drl_bridge.identify.open_loop import HORIZON_S
from nics_drl_bridge.identify.statistics import CERTAIN
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
MOUNTING = ("x", "y", "heading")  # parameters of the tracked body's pose
# ratio of the error of a pull to that of a stronger one, from which no weaker one is tried
HOPELESS = 1.02
LONGEST_LAG_S = 2.0  # a state that takes longer is coasting, so it hides no latency
BANDS_S = (0.5, 1.0, 2.0, HORIZON_S)
UNSEEN = f"predictions over {HORIZON_S:g} s of parts that a fit did not see"

# (order, 0 for the textbook's terms alone; pull towards these)
Hypothesis = tuple[int, float]
TEXTBOOK = 0, 0.0
# name of a change, the change, and the fraction to which it must cut the error
Change = tuple[str, Callable[[forms.Form], forms.Form], float]


@dataclass(frozen=True)
class Trial:
    """A trial of one order, on parts of the training data that its fits did not see."""

    order: int  # 0: only the textbook's terms
    pull: float  # weight that keeps coefficients near the textbook's
    error: float  # mean error after `HORIZON_S`, as a fraction of the path
    # (W,) distances at the ends of predictions, by horizon [m]
    errors: dict[float, Array]

    @classmethod
    def of(cls, order: int, pull: float, far: Array, paths: Array) -> "Trial":
        """Returns a trial whose predictions end `far` (W, H) off, after paths (W, H) [m]."""
        length = float(np.nansum(paths[:, -1]))
        share = float(np.nansum(far[:, -1])) / length if length else np.nan
        columns = zip(BANDS_S, far.T, strict=True)
        errors = {horizon: column[~np.isnan(column)] for horizon, column in columns}
        return cls(order, pull, share, errors)

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
    problem: shooting.Shooting

    def select(self, inside: terms.Mask | None) -> Samples:
        """Returns the samples inside (T,), with the states that follow the commands."""
        samples = self.problem.resample(self.problem.parameters.start)
        return samples if inside is None else samples.rows(inside)

    def fit_base(
        self, inside: terms.Mask | None = None, other: TaylorModel | None = None
    ) -> shooting.Predictive:
        """Fits the base's terms, gains and lags; the search may start at another model."""
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
            inside,
            BASE_EVALUATIONS,
            first=first,
        )
        return replace(fitted, model=terms.stabilise(fitted.model, self.library.spec))

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
        both = np.where(first != 0.0, first, base.coefficients)
        free = self.library.select_free(replace(base, coefficients=both))
        return shooting.fit_to_predictions(
            self.problem, base, free, inside, evaluations, pull, first
        )

    def calibrate(
        self, found: shooting.Predictive, calibration: Calibration
    ) -> Calibration:
        """Returns a calibration with delays, input curves, lags and mounting of a search."""
        at = found.named
        responses = (
            replace(
                response,
                lag_s=at.get(f"{response.state}.lag", response.lag_s),
                gain=at.get(f"{response.state}.gain", response.gain),
            )
            for response in calibration.responses
        )
        calibration = replace(
            calibration,
            inputs=self.form.make_curves(at),
            responses=tuple(responses),
            uncertainty=calibration.uncertainty | self._widen_errors(found),
        )
        calibration = self._calibrate_time(found, calibration)
        if self.problem.is_mounted:
            return add_predicted_mounting(calibration, found)
        return calibration

    def _widen_errors(self, found: shooting.Predictive) -> dict[str, float]:
        """Returns the errors of the parameters of commands and states; a step widens delays."""
        within_step = WITHIN_STEP * self.problem.samples.dt
        return {
            name: float(np.hypot(e, within_step)) if name.endswith(".delay") else e
            for name, e in found.shown_errors.items()
        }

    def _calibrate_time(
        self, found: shooting.Predictive, calibration: Calibration
    ) -> Calibration:
        """Returns a calibration with the clock offset and the latency of a search."""
        at = found.named
        latency = self.form.find_latency(at)
        delays = (f"{command}.delay" for command, _ in self.form.delays)
        quickest = min(delays, key=at.__getitem__, default="latency")
        within_step = WITHIN_STEP * self.problem.samples.dt
        error = float(np.hypot(found.errors[quickest], within_step))
        known = dict(calibration.uncertainty)
        # A delay between two clocks is a part of their offset, unless that dates a derived state.
        if "clock_offset_s" in known and self.problem.inferred is not None:
            if not np.isnan(error):
                beside = known.get("command_latency_s", 0.0)
                known["clock_offset_s"] = float(np.hypot(error, beside))
            late = latency - calibration.command_latency_s
            offset = calibration.clock_offset_s - late
            return replace(calibration, clock_offset_s=offset, uncertainty=known)
        if not np.isnan(error):
            known["command_latency_s"] = error
        return replace(calibration, command_latency_s=latency, uncertainty=known)

    def add_errors(
        self, found: shooting.Predictive, linear: TaylorModel
    ) -> TaylorModel:
        """Returns a found model with standard errors; those of other terms are a linear fit's."""
        errors = found.coefficient_errors.copy()
        for state, command in self.form.followed:
            _add_lag_errors(errors, found, state, command)
        named = {dof: dict(by_term) for dof, by_term in linear.named_errors.items()}
        model = found.model
        for dof, by_term in replace(model, std_errors=errors).named_errors.items():
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
        parameters = replace(self.problem.parameters, start=found.values)
        problem = replace(self.problem, parameters=parameters)
        free = self.library.select_free(pruned)
        return shooting.fit_to_predictions(problem, pruned, free)

    def cross_validate(self, asked: tuple[Hypothesis, ...]) -> tuple[Trial, ...]:
        """Cross-validates hypotheses over `FOLDS` parts of a drive.

        A weaker pull is not tried for an order whose error grew by a factor of `HOPELESS` already
        from the pull before.
        """
        folds = list(self.list_folds({order for order, pull in asked if pull}))
        trials: list[Trial] = []
        hopeless = set()
        for order, pull in asked:
            if order in hopeless:
                continue
            trial = self._coarse.try_hypothesis(order, pull, folds)
            before = [other for other in trials if other.order == order]
            if before and trial.error > HOPELESS * before[-1].error:
                hopeless.add(order)
            trials.append(trial)
        return tuple(trials)

    @cached_property
    def _coarse(self) -> "Draft":
        """The same draft with fewer windows, and with known parameters, for trials."""
        parameters = self.problem.parameters.freeze()
        problem = replace(self.problem, spacing_s=SPACING_S, parameters=parameters)
        return replace(self, problem=problem)

    @cached_property
    def _folds(self) -> tuple["Fold", ...]:
        """The parts of a drive to leave out, with the base fitted to the rest.

        A part is not left out if a variable would not have moved without it, or if the rest is too
        short to fit a model.
        """
        samples = self.problem.samples
        spec = self.library.spec
        everything = np.arange(len(samples.t))
        unmoved = list_unmoved_variables(samples, spec)
        folds = []
        for block in np.array_split(everything, FOLDS):
            unseen = np.isin(everything, block)
            if list_unmoved_variables(samples.rows(~unseen), spec) != unmoved:
                continue
            with suppress(FitError):
                base = self._coarse.fit_base(~unseen).model
                folds.append(Fold(unseen, base, {}))
        return tuple(folds)

    def list_folds(self, orders: Collection[int]) -> Iterator["Fold"]:
        """Yields the folds whose rest is long enough for fits of all orders, with these fits."""
        for fold in self._folds:
            with suppress(FitError):
                inside = self._coarse.select(~fold.unseen)
                starts = {k: self.library.fit_model(inside, k) for k in orders}
                yield replace(fold, starts=starts)

    def try_hypothesis(self, order: int, pull: float, folds: list["Fold"]) -> Trial:
        """Predicts the parts that were left out of the fits of a hypothesis."""
        judge = replace(self.problem, horizons=BANDS_S)
        distances = [np.zeros((0, len(BANDS_S)))]  # (W, H) of ends
        paths = [np.zeros((0, len(BANDS_S)))]  # (W, H)
        for fold in folds:
            model = fold.base
            if pull:
                start = fold.starts[order]
                model = self.refine(model, start, ~fold.unseen, EVALUATIONS, pull).model
                fold.starts[order] = model  # near the best model of the next pull
            error, path = judge.errors(model, judge.parameters.start, fold.unseen)
            distances.append(np.hypot(error[..., 0], error[..., 1]))
            paths.append(path)
        return Trial.of(order, pull, np.concatenate(distances), np.concatenate(paths))


def _add_lag_errors(
    errors: Array, found: shooting.Predictive, state: str, command: str
) -> None:
    """Writes the errors (D, K) of the terms by which a state follows a command."""
    model = found.model
    row = terms.FIRST_STATE + model.variables.index(state)
    own = terms.find_linear_term(model, state)
    driven = terms.find_linear_term(model, command)
    rate, gained = np.abs(model.coefficients[row, [own, driven]])
    sigma = found.errors
    relative = sigma[f"{state}.lag"] / found.named[f"{state}.lag"]
    by_gain = rate * sigma.get(f"{state}.gain", 0.0)
    errors[row, own] = rate * relative
    errors[row, driven] = np.hypot(gained * relative, by_gain)


@dataclass(frozen=True)
class Fold:
    """A part of a drive that is left out of fits, and what these start from."""

    unseen: terms.Mask  # (T,) rows of the part
    base: TaylorModel  # fitted to the other rows
    starts: dict[int, TaylorModel]  # latest fits to the other rows, by order


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

    @cached_property
    def trial(self) -> Trial:
        """The cross-validation of the textbook with this form."""
        return self.draft.cross_validate((TEXTBOOK,))[0]


def fit_base(evidence: forms.Evidence, clear: tuple[InputCurve, ...]) -> Base:
    """Fits the textbook with and without each part of a form; keeps what improves predictions.

    `clear` curves are always kept.
    """
    best = _choose_curves(evidence, clear)
    candidates = list(best.candidates)
    # Each change builds on those that were kept before it, so their order matters.
    tried = [best.draft.form]  # since the last that was kept
    for name, change, worth in list_changes(evidence):
        form = change(best.draft.form)
        if form in tried:
            continue
        tried.append(form)
        changed = fit_form(evidence, form, best)
        is_better = changed.trial.level < worth * best.trial.level
        is_better = is_better and _is_certain(changed.found, best.found)
        candidates.append(Candidate(name, changed.trial.error, kept=is_better))
        if is_better:
            best = changed
            tried = [form]
    return replace(best, candidates=tuple(candidates))


def _choose_curves(evidence: forms.Evidence, clear: tuple[InputCurve, ...]) -> Base:
    """Fits the plainest form with all input curves found, or with the `clear` ones if better."""
    plain_form = forms.make_form(evidence)
    inputs = evidence.calibration.inputs
    curved = fit_form(evidence, replace(plain_form, curves=inputs))
    if len(inputs) <= len(clear):
        start = "textbook with input curves" if inputs else "textbook"
        return replace(
            curved, candidates=(Candidate(start, curved.trial.error, kept=True),)
        )
    plain = fit_form(evidence, replace(plain_form, curves=clear))
    # an infinite level: too short to judge
    is_better = plain.trial.level < curved.trial.level or np.isinf(plain.trial.level)
    candidates = (
        Candidate("textbook", plain.trial.error, kept=True),
        Candidate("input curves", curved.trial.error, kept=not is_better),
    )
    return replace(plain if is_better else curved, candidates=candidates)


def refit_base(evidence: forms.Evidence, former: Base) -> Base:
    """Fits a base of the same form to other data."""
    followed = forms.make_form(evidence).followed
    inputs = evidence.calibration.inputs
    form = replace(former.draft.form, curves=inputs, followed=followed)
    refitted = fit_form(evidence, form, former if followed else None)
    return replace(refitted, candidates=former.candidates)


def fit_form(
    evidence: forms.Evidence, form: forms.Form, start: Base | None = None
) -> Base:
    """Fits the textbook with a form; the search may start at another base."""
    parameters = forms.list_parameters(evidence, form)
    if start is not None:
        parameters = parameters.start_from(start.draft.problem.parameters)
    problem = forms.make_prediction_problem(evidence, form, parameters)
    model = None
    if start is not None:
        model = start.found.model
        problem = forms.choose_start(problem, model, start.found.names)
    coarse = replace(problem, spacing_s=SPACING_S)
    found = Draft(evidence.library, form, coarse).fit_base(other=model)
    parameters = replace(problem.parameters, start=found.values)
    problem = replace(problem, parameters=parameters)
    return Base(Draft(evidence.library, form, problem), found)


def list_changes(evidence: forms.Evidence) -> Iterator[Change]:
    """Yields changes to the form of a model in the order in which they are tried."""
    if evidence.library.kind is not terms.Kind.MOTION:
        yield from _list_follower_changes(evidence)
        return
    spec = evidence.drive.spec
    # Drag and friction are hard to distinguish, so both are tried, then each without the other.
    speeds = tuple(v.name for v in spec.state if v.twist == "vx")
    delays = _list_delay_changes(forms.list_delays(evidence))
    # First, because a wrong delay hides other effects and is hidden by them.
    yield from delays
    if terms.has_slipping_tyres(spec):
        yield "tyres that slip", _change(tyres=True), WORTH
    if speeds:
        drag = "drag and back-EMF"
        friction = "dry friction"
        yield f"{drag}, and {friction}", _change(drag=speeds, friction=speeds), WORTH
        yield f"without {drag}", _change(drag=()), 1.0 / WORTH
        yield f"without {friction}", _change(friction=()), 1.0 / WORTH
    yield from delays
    if speeds:
        bent = partial(forms.add_dead_zones, evidence=evidence)
        yield "a dead zone", bent, WORTH
        yield "limits of acceleration", _change(limits=speeds), WORTH
        others = tuple(v.name for v in spec.state if v.twist and not spec.steers)
        if others:
            yield f"limits of {', '.join(others)}", _change(limits=others), WORTH
        backwards = forms.find_two_way_curves(evidence)
        if backwards:
            reverse = partial(forms.add_reverse_gains, curves=backwards)
            yield "a gain of its own backwards", reverse, WORTH


def _change(**parts: Any) -> Callable[[forms.Form], forms.Form]:
    """Returns a change that sets parts of a form."""
    return lambda form: replace(form, **parts)


def _list_delay_changes(delays: tuple[tuple[str, float], ...]) -> list[Change]:
    """Returns the change that delays each command by itself, if there are several."""
    if len(delays) < 2:
        return []
    return [("a delay of each command", _change(delays=delays), WORTH)]


def _is_certain(changed: shooting.Predictive, before: shooting.Predictive) -> bool:
    """True if dead zones and limits that a change added clearly exceed their standard errors."""
    errors = changed.errors
    return not any(
        value < CERTAIN * errors[name]
        for name, value in changed.named.items()
        if name.endswith((".dead", ".fall", ".rise")) and name not in before.names
    )


def _list_follower_changes(evidence: forms.Evidence) -> Iterator[Change]:
    """Yields changes to the form of states that follow commands."""
    followed = forms.list_followed(evidence.drive)
    latency = evidence.calibration.command_latency_s
    delays = _list_delay_changes(tuple((c, latency) for _, c in followed))
    yield from delays
    for state, _ in followed:
        yield f"limits of {state}", partial(forms.add_limits, state=state), WORTH
    yield from delays
    for _, command in followed:
        bent = partial(forms.add_dead_zones, evidence=evidence, commands=(command,))
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


def drop_doubtful_mounting(
    draft: Draft, calibration: Calibration, found: shooting.Predictive
) -> Draft | None:
    """Returns a draft without the parts of its mounting below 3 standard errors; None if all stay.

    Removed parts are zero in the calibration that `add_predicted_mounting` returns.
    """
    rest, sigma = _get_mounting(found)
    total = geometry.compose(rest, calibration.mounting)
    doubtful = (np.abs(total) < CERTAIN * sigma) & (total != 0.0)
    if not doubtful.any():
        return None
    mounting = calibration.mounting
    if doubtful[2]:
        rest[2] = -mounting[2]
    aside = geometry.rotate(mounting[:2], float(rest[2]))
    rest[:2] = np.where(doubtful[:2], -aside, rest[:2])
    parameters = draft.problem.parameters
    places = [parameters.names.index(name) for name in MOUNTING]
    start = parameters.start.copy()
    start[places] = rest
    known = np.isin(np.arange(len(start)), np.array(places)[doubtful])
    parameters = replace(
        parameters,
        start=start,
        low=np.where(known, start, parameters.low),
        high=np.where(known, start, parameters.high),
    )
    return replace(draft, problem=replace(draft.problem, parameters=parameters))


def _get_mounting(found: shooting.Predictive) -> tuple[Array, Array]:
    """Returns the pose (3,) of the tracked body that a search found, and its standard errors."""
    named = found.named
    errors = found.errors
    pose = np.array([named[name] for name in MOUNTING])
    return pose, np.array([errors[name] for name in MOUNTING])


def add_predicted_mounting(
    calibration: Calibration, found: shooting.Predictive
) -> Calibration:
    """Adds the mounting found by predictions to that of the calibration."""
    rest, sigma = _get_mounting(found)
    pose = geometry.compose(rest, calibration.mounting)
    known = dict(calibration.uncertainty)
    if np.isnan(sigma[1]) and rest[1] == 0.0:
        pose[1] = calibration.lever_arm_m[1]
    names = ("lever_arm_x_m", "lever_arm_y_m", "rotation_rad")
    for name, error in zip(names, sigma.tolist(), strict=True):
        if not np.isnan(error):  # what the model lacks bends each of both estimates
            known[name] = max(error, known.get(name, 0.0))
    x, y, heading = np.where(np.abs(pose) < NOTHING, 0.0, pose).tolist()
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
