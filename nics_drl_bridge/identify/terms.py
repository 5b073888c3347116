"""Terms that a model may have, and models that are put together from terms.

A term filter gets the exponents (K, V) of all terms, and selects those that each degree of freedom
may have (D, K). Least squares then fits only these.

- `select_motion_terms`: for a state that is the motion, derived from the poses. All terms up to an
  order that mirror symmetry allows; a state that is a component of the twist is so by definition.
- `select_textbook_terms`: for the same state; only the terms by which textbooks describe it.
- `select_terms_through_state`: for a state that follows commands and was not measured. The twist
  depends on the state alone, as the textbook's does.

A mirror image of a robot exchanges left and right: vy and wz change sign, and so do the variables
that cause them, such as a steering angle. The motion of the image is the image of the motion, so
that vx is even in these variables, and vy and wz are odd.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import Enum, auto
from functools import partial
from itertools import product

import numpy as np
import scipy  # its parts load slowly, when used
from numpy.typing import NDArray

from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.geometry import Array
from nics_drl_bridge.identify.alignment import find_speed_index
from nics_drl_bridge.identify.calibration import Alpha
from nics_drl_bridge.identify.fit import (
    ORDER,
    STILL,
    TOGETHER,
    Fit,
    Regression,
    find_constant_combinations,
    fit_kept_terms,
    list_unmoved_variables,
    prune_and_refit,
    regress,
    select_twist_terms,
)
from nics_drl_bridge.identify.textbook import probe_structure
from nics_drl_bridge.recording.recording import Samples
from nics_drl_bridge.robot.kernels import MAX_ORDER
from nics_drl_bridge.robot.kinds import compute_steady_twist, slips, textbook
from nics_drl_bridge.robot.spec import POSE_RATES, RobotSpec, StateVariable
from nics_drl_bridge.robot.taylor import TaylorModel, evaluate, list_exponents

Mask = NDArray[np.bool_]
Powers = NDArray[np.int64]

TWIST = slice(0, 3)  # degrees of freedom: the twist, then the rates of the state
FIRST_STATE = 3
VX = POSE_RATES.index("vx")
VY = POSE_RATES.index("vy")
MIRRORED_RATES = ("vy", "wz")
IN_MIRROR = np.array([1.0, -1.0, -1.0])  # signs of vx, vy and wz
# share of the states' ranges, and number of states, at which a textbook is expanded
PROBED = 0.7
PROBES = 400
VISIBLE = 0.01  # share of the largest term that a term of an expansion must have
NOTHING = 1e-9  # spread of a rate, or size of a coefficient, that counts as zero


class Kind(Enum):
    """Where the state of a robot comes from."""

    MOTION = auto()  # it is the motion, derived from the poses; or there is no state
    FOLLOWER = auto()  # it was not measured and follows the commands
    MEASURED = auto()  # it is a stream of the recording


@dataclass(frozen=True)
class Library:
    """The terms that a model may have, and their linear fit (Eq. 1 and 2).

    Attributes:
        spec: the robot.
        kind: where its state comes from.
        centred: True if poses are those of the robot's reference point.
        alpha: threshold of the pruning (Eq. 2); a motion's terms are not pruned.
        order: of the base, from which other models depart; a motion's base is its textbook.
    """

    spec: RobotSpec
    kind: Kind
    centred: bool
    alpha: Alpha
    order: int

    def fit(self, samples: Samples, order: int) -> Fit:
        """Fits the terms up to an order."""
        if self.kind is Kind.MOTION:
            return fit_motion_terms(samples, self.spec, order)
        fit = prune_and_refit(self._regress(samples, order), self.spec, self.alpha)
        return replace(fit, model=self._define(fit.model))

    def fit_model(self, samples: Samples, order: int) -> TaylorModel:
        """Fits the terms up to an order, without errors, which take most of the time."""
        if self.kind is Kind.MOTION:
            return fit_motion_model(samples, self.spec, order, select_motion_terms)
        regression = self._regress(samples, order)
        return self._define(fit_kept_terms(regression, self.spec, self.alpha))

    def _regress(self, samples: Samples, order: int) -> Regression:
        """Fits all terms up to an order that a state which is no motion may have."""
        allowed = None
        if self.kind is Kind.FOLLOWER:
            allowed = partial(select_terms_through_state, centred=self.centred)
        return regress(samples, self.spec, order, True, allowed)

    def _define(self, model: TaylorModel) -> TaylorModel:
        """Drops lateral motion that is noise; an inferred speed is that along x."""
        coefficients = model.coefficients.copy()
        slips_sideways = slips(self.spec) or any(
            variable.twist == "vy" for variable in self.spec.state
        )
        if not (self.spec.moves_sideways or slips_sideways):
            coefficients[VY] = 0.0
        is_speed = self._select_inferred_speed(model)
        if (coefficients[VX, is_speed] > 0.0).any():
            coefficients[VX, is_speed] = 1.0
        return replace(model, coefficients=coefficients)

    def _select_inferred_speed(self, model: TaylorModel) -> Mask:
        """Selects the term (K,) of a speed alone that was not measured; none if it was."""
        speed = find_speed_index(self.spec)
        if self.kind is not Kind.FOLLOWER or speed is None:
            return np.zeros(len(model.powers), dtype=np.bool_)
        alone = np.eye(len(model.variables), dtype=np.int64)[speed]
        return np.asarray((model.powers == alone).all(axis=1))

    def fit_base(self, samples: Samples, tyres: bool) -> TaylorModel:
        """Fits the base: the textbook's terms of a motion, else those up to its order."""
        if self.kind is Kind.MEASURED:
            return self.fit_model(samples, self.order)
        if self.kind is Kind.FOLLOWER:
            through = partial(
                select_terms_through_state, centred=self.centred, by_book=True
            )
            regression = regress(samples, self.spec, self.order, False, through)
            return self._define(fit_kept_terms(regression, self.spec, 1.0))
        allowed = partial(select_textbook_terms, tyres=tyres)
        return fit_motion_model(samples, self.spec, self.order, allowed)

    def select_free(self, model: TaylorModel) -> Mask:
        """Selects the coefficients (D, K) that no definition and no measurement fixes."""
        free = model.coefficients != 0.0
        if self.kind is Kind.MOTION:
            return np.asarray(free & ~select_defined_dofs(self.spec)[:, None])
        free[FIRST_STATE:] = False
        is_speed = self._select_inferred_speed(model)
        free[VX, is_speed & (model.coefficients[VX] == 1.0)] = False
        return np.asarray(free)


def fit_motion_terms(
    samples: Samples,
    spec: RobotSpec,
    order: int,
    allowed: Callable[..., Mask] | None = None,
) -> Fit:
    """Fits the terms of a motion up to an order to its rates (Eq. 1), without pruning.

    Args:
        samples: rows of a drive whose state is the motion.
        spec: the robot.
        order: of the terms.
        allowed: a term filter; by default `select_motion_terms`.
    """
    constants = _find_constant_variables(samples, spec)
    regression = _regress_motion(
        samples, spec, order, allowed or select_motion_terms, constants
    )
    fit = prune_and_refit(regression, spec, 1.0)
    return replace(fit, model=_define_motion(fit.model, samples, spec, constants))


def fit_motion_model(
    samples: Samples, spec: RobotSpec, order: int, allowed: Callable[..., Mask]
) -> TaylorModel:
    """Does the same as `fit_motion_terms`, without errors, which take most of the time."""
    constants = _find_constant_variables(samples, spec)
    regression = _regress_motion(samples, spec, order, allowed, constants)
    model = fit_kept_terms(regression, spec, 1.0)
    return _define_motion(model, samples, spec, constants)


def _regress_motion(
    samples: Samples,
    spec: RobotSpec,
    order: int,
    allowed: Callable[..., Mask],
    constants: dict[str, float],
) -> Regression:
    held = tuple(c.name for c in spec.command if constants.get(c.name))
    return regress(samples, spec, order, term_filter=partial(allowed, held=held))


def _define_motion(
    model: TaylorModel, samples: Samples, spec: RobotSpec, constants: dict[str, float]
) -> TaylorModel:
    """Zeroes rates that never changed, and sets the rows of the twist that are states."""
    still = samples.dq.std(axis=0) <= NOTHING
    still[FIRST_STATE:] |= np.array(
        [v.name in constants for v in spec.state], dtype=np.bool_
    )
    coefficients = np.where(still[:, None], 0.0, model.coefficients)
    return _define_twist(replace(model, coefficients=coefficients), spec, constants)


def _find_constant_variables(samples: Samples, spec: RobotSpec) -> dict[str, float]:
    """Returns the values of the variables that never moved, by name; 0 if close to it."""
    variables = (*spec.state, *spec.command)
    unmoved = list_unmoved_variables(samples, spec)
    constants = {}
    for variable, mean in zip(variables, samples.x.mean(axis=0), strict=True):
        if variable.name in unmoved:
            is_zero = abs(mean) <= STILL * (variable.max - variable.min)
            constants[variable.name] = 0.0 if is_zero else float(mean)
    return constants


def _define_twist(
    model: TaylorModel, spec: RobotSpec, constants: dict[str, float]
) -> TaylorModel:
    """Sets the rows of the twist that are states; a state that never moved is a constant there."""
    linear = np.eye(len(model.variables), dtype=np.int64)
    constant = 0 * linear[:1]
    model = add_terms(
        model, np.concatenate([constant, linear[: len(spec.state)]], axis=0)
    )
    powers = model.powers
    coefficients = model.coefficients
    # remaining lateral motion is noise, unless it is a state
    if not spec.moves_sideways:
        coefficients[VY] = 0.0
    for i, variable in enumerate(spec.state):
        if variable.twist is None:
            continue
        value = constants.get(variable.name)
        if value is None:
            row = (powers == linear[i]).all(axis=1) * 1.0
        else:
            row = value * (powers == constant).all(axis=1)
        coefficients[POSE_RATES.index(variable.twist)] = row
    return replace(drop_unused_terms(model), bounded=True)


def select_motion_terms(
    powers: Powers, spec: RobotSpec, held: tuple[str, ...] = ()
) -> Mask:
    """Selects the terms (D, K) of a robot whose state is its motion.

    A state that is a component of the twist is so by definition. Slip along y is proportional.
    Beyond the first order, mirror symmetry must hold. Without a command, the robot comes to rest.

    Args:
        powers: (K, V) exponents of the terms.
        spec: the robot.
        held: commands that had one value all the time, and therefore act as a constant.
    """
    names = spec.variable_names
    reversed_names = list_reversed_variables(spec)
    order = powers.sum(axis=1)
    allowed = np.ones((len(spec.dof_names), len(powers)), dtype=np.bool_)
    slip = [names.index(v.name) for v in spec.state if v.twist == "vy"]
    allowed[:, (powers[:, slip].sum(axis=1) > 0) & (order > 1)] = False
    if reversed_names is not None:
        is_odd = _are_odd(powers, names, reversed_names)
        for row, dof in enumerate(spec.dof_names):
            keeps_symmetry = is_odd == is_reversed(dof, reversed_names)
            allowed[row] &= keeps_symmetry | (order <= 1)
    if spec.state:  # commands act through the state
        allowed[TWIST] &= (powers[:, len(spec.state) :] == 0).all(axis=1)
    allowed[_come_to_rest(spec, reversed_names, held)] &= order > 0
    for i, variable in enumerate(spec.state):
        alone = (order == 1) & (powers[:, i] == 1)
        if variable.twist:
            allowed[POSE_RATES.index(variable.twist)] = alone
        else:
            command = find_followed_command(spec, variable)
            by_command = (order == 1) & (powers[:, command] == 1)
            allowed[FIRST_STATE + i] = alone | by_command
    return np.asarray(allowed)


def _come_to_rest(
    spec: RobotSpec, reversed_names: tuple[str, ...] | None, held: tuple[str, ...]
) -> Mask:
    """Selects the degrees of freedom (D,) without a constant: no command that was held acts there.

    Without a known mirror, a command that was held may act on all of them.
    """
    if reversed_names is None:
        return np.full(len(spec.dof_names), not (spec.state or held))
    acting = [is_reversed(name, reversed_names) for name in held]
    return np.array(
        [is_reversed(dof, reversed_names) not in acting for dof in spec.dof_names]
    )


def select_textbook_terms(
    powers: Powers, spec: RobotSpec, held: tuple[str, ...] = (), tyres: bool = False
) -> Mask:
    """Selects the terms (D, K) by which the twist follows commands with a lag, as in textbooks.

    Args:
        powers: (K, V) exponents of the terms.
        spec: the robot.
        held: commands that had one value all the time, and therefore act as a constant.
        tyres: allows terms of the lateral acceleration, which makes tyres slip.
    """
    names = spec.variable_names
    states = len(spec.state)
    allowed = select_motion_terms(powers, spec, held) & (powers.sum(axis=1) <= 1)
    structure = probe_structure(spec)
    if structure is None or not states:
        return np.asarray(allowed)
    moves, bicycle = structure
    linear = np.eye(len(names), dtype=np.int64)
    twist = [v.twist for v in spec.state]
    # without it, the speed never changed
    has_speed = "vx" in twist and bool(powers[:, twist.index("vx")].any())
    is_held = np.array([name in held for name in names])

    def allow(row: int, *terms: NDArray[np.int64]) -> None:
        for term in terms:
            allowed[row] |= (powers == term).all(axis=1)

    for i, component in enumerate(twist):
        if component is None:
            continue
        row = FIRST_STATE + i
        allowed[row] = False
        if tyres and has_speed and component != "vx":  # by the lateral acceleration
            allow(row, 2 * linear[twist.index("vx")] + linear[twist.index("wz")])
        # no constant, because without a command the robot comes to rest
        allow(row, linear[i])
        is_moving = np.abs(moves[POSE_RATES.index(component)]) > 0.0
        commands = linear[states:][is_moving]
        if bicycle.used and component == "wz" and has_speed:
            speed = linear[twist.index("vx")]
            allow(row, speed, *(commands + speed))
            continue
        allow(row, *commands)
        if is_held[states:][is_moving].any():
            allow(row, 0 * linear[i])
    return np.asarray(allowed)


def select_terms_through_state(
    powers: Powers, spec: RobotSpec, centred: bool, by_book: bool = False
) -> Mask:
    """Selects the terms (D, K) of a robot whose states follow commands and were not measured.

    The twist depends on the state alone, and the rate of a state on itself and its command.

    Args:
        powers: (K, V) exponents of the terms.
        spec: the robot.
        centred: True if poses are those of the robot's reference point, so that mirror symmetry
            must hold: for vx in all terms, for vy and wz beyond the first order.
        by_book: allows only the terms by which the textbook's twist can be expanded.
    """
    names = spec.variable_names
    reversed_names = list_reversed_variables(spec)
    order = powers.sum(axis=1)
    unmoved = tuple(
        name for name, most in zip(names, powers.max(axis=0), strict=True) if most == 0
    )
    allowed = np.ones((len(spec.dof_names), len(powers)), dtype=np.bool_)
    allowed[TWIST] = select_twist_terms(powers, spec, unmoved)
    if by_book:
        allowed[TWIST] &= _select_textbook_twist(powers, spec)
    if reversed_names is not None and centred:
        is_odd = _are_odd(powers, names, reversed_names)
        allowed[VX] &= ~is_odd
        allowed[VX + 1 : FIRST_STATE] &= is_odd | (order <= 1)
    for i, variable in enumerate(spec.state):
        own = [i, find_followed_command(spec, variable)]
        allowed[FIRST_STATE + i] = (order == 1) & powers[:, own].any(axis=1)
    return allowed


def _select_textbook_twist(powers: Powers, spec: RobotSpec) -> Mask:
    """Selects the terms (3, K) by which the twist of a textbook can be expanded.

    A variable that never moved, which is in none of the terms, is a constant factor.
    """
    never_moved = ~powers.any(axis=0)
    allowed = np.zeros((3, len(powers)), dtype=np.bool_)
    for row, expansion in zip(allowed, _expand_textbook_twist(spec), strict=True):
        for term in expansion:
            row |= (powers == np.where(never_moved, 0, term)).all(axis=1)
    return allowed & powers.any(axis=1)


def _expand_textbook_twist(spec: RobotSpec) -> tuple[tuple[Array, ...], ...]:
    """Returns the terms (V,) of the expanded twist of a textbook, and those of a trim, by part.

    A trim, a wheel that steers a little to one side, leaves an angle out of a term.
    """
    commands = np.zeros(len(spec.command), dtype=np.int64)
    alone = np.eye(len(spec.state), dtype=np.int64)
    expansions = []
    for terms in _expand_twist_by_state(spec):
        trims = [
            term - alone[factor]
            for term in terms
            for factor in np.flatnonzero(term)
            if spec.state[factor].unit == "rad"
        ]
        both = (*terms, *trims)
        expansions.append(tuple(np.append(term, commands) for term in both))
    return tuple(expansions)


def _expand_twist_by_state(spec: RobotSpec) -> list[Powers]:
    """Returns the terms (K, S) of the expanded twist of a textbook, by part."""
    count = len(spec.state)
    powers = list_exponents(count, MAX_ORDER)
    rng = np.random.default_rng(0)
    low, high = np.array([[v.min, v.max] for v in spec.state]).T
    state = rng.uniform(PROBED * low, PROBED * high, (PROBES, count))
    chi = evaluate(state, powers)
    size = np.sqrt((chi**2).mean(axis=0))
    try:
        twist = textbook(spec).twist(state)
        effect = np.linalg.lstsq(chi / size, twist, rcond=None)[0].T
    except ConfigError:
        effect = np.tile((powers.sum(axis=1) <= ORDER) * 1.0, (3, 1))
    parts = np.abs(effect)
    return [powers[part > max(VISIBLE * part.max(), NOTHING)] for part in parts]


def find_followed_command(spec: RobotSpec, variable: StateVariable) -> int:
    """Returns the index among X of the command that a state follows; ConfigError without one."""
    if variable.follows is None:
        fault = f"state {variable.name!r} of robot {spec.name!r} follows no command"
        raise ConfigError(f"{fault}; add `follows:` to it, or record it.")
    return spec.variable_names.index(variable.follows)


def select_defined_dofs(spec: RobotSpec) -> Mask:
    """Selects the degrees of freedom (D,) that the state defines, so that they are not fitted."""
    is_defined = np.zeros(len(spec.dof_names), dtype=np.bool_)
    for i, variable in enumerate(spec.state):
        if variable.twist:
            is_defined[POSE_RATES.index(variable.twist)] = True
        else:
            is_defined[FIRST_STATE + i] = True
    return is_defined


def list_reversed_variables(spec: RobotSpec) -> tuple[str, ...] | None:
    """Names the variables that change sign in a mirror; None if the textbook does not say."""
    rng = np.random.default_rng(0)
    largest = np.maximum(spec.command_high, -spec.command_low)
    commands = rng.uniform(0.1, 0.9, (8, len(spec.command))) * largest
    try:
        mirrored = compute_steady_twist(spec, commands) * IN_MIRROR
        for signs in product((1.0, -1.0), repeat=len(spec.command)):
            if np.allclose(compute_steady_twist(spec, commands * signs), mirrored):
                break
        else:
            return None
    except ConfigError:
        return None
    odd = [c.name for c, sign in zip(spec.command, signs, strict=True) if sign < 0.0]
    states = (
        v.name for v in spec.state if v.twist in MIRRORED_RATES or v.follows in odd
    )
    return (*states, *odd)


def is_reversed(name: str, reversed_names: tuple[str, ...]) -> bool:
    """True if a variable, or a degree of freedom, changes sign in a mirror."""
    return name in MIRRORED_RATES or name.removeprefix("d_") in reversed_names


def _are_odd(
    powers: Powers, names: tuple[str, ...], reversed_names: tuple[str, ...]
) -> Mask:
    """Selects the terms (K,) that change sign in a mirror."""
    is_reversed_variable = [name in reversed_names for name in names]
    return np.asarray(powers[:, is_reversed_variable].sum(axis=1) % 2 == 1)


def tells_lever_from_wheels(spec: RobotSpec) -> bool:
    """True if a lever arm along y is distinguishable from unequal wheels."""
    return spec.moves_sideways or list_reversed_variables(spec) is not None


def has_slipping_tyres(spec: RobotSpec) -> bool:
    """True for a front-steered car whose motion is its state: it may slip sideways."""
    structure = probe_structure(spec)
    if structure is None or not {v.twist for v in spec.state} >= set(POSE_RATES):
        return False
    _, bicycle = structure
    return bicycle.used and not bicycle.front_drive


def share_effects(model: TaylorModel, spec: RobotSpec, samples: Samples) -> TaylorModel:
    """Distributes an effect over commands of one unit that always moved together.

    Uses the minimum-norm coefficients, for example for four wheels and three degrees of freedom:
    commands u are replaced by P u, where P projects out the combinations that stayed constant.
    """
    combinations = find_constant_combinations(samples, spec)
    command = samples.x[:, len(spec.state) :]
    is_part = np.abs(combinations).max(axis=0, initial=0.0) > NOTHING
    parts = [c for c, part in zip(spec.command, is_part.tolist(), strict=True) if part]
    if len({c.unit for c in parts}) != 1:
        return model
    constant = combinations / np.maximum(command.std(axis=0), NOTHING)
    if np.abs(constant @ command.mean(axis=0)).max() > TOGETHER:
        return model
    normal = scipy.linalg.orth(constant.T)
    projection = np.eye(len(model.variables))
    projection[len(spec.state) :, len(spec.state) :] -= normal @ normal.T
    return _project_terms(model, projection)


def _project_terms(model: TaylorModel, projection: Array) -> TaylorModel:
    """Returns the terms of a model whose variables are projected (V, V) beforehand."""
    effects: dict[tuple[int, ...], Array] = {}
    columns = zip(model.powers.tolist(), model.coefficients.T, strict=True)
    for exponents, effect in columns:
        for term, share in _expand_term(exponents, projection):
            so_far = effects.get(term, np.zeros(len(effect)))
            effects[term] = so_far + share * effect
    coefficients = np.array(list(effects.values())).T
    kept = (np.abs(coefficients) > NOTHING).any(axis=0)
    powers = np.array(list(effects), dtype=np.int64)[kept]
    return replace(
        model,
        powers=powers,
        coefficients=coefficients[:, kept],
        std_errors=np.zeros((0, 0)),
    )


def _expand_term(
    powers: list[int], projection: Array
) -> list[tuple[tuple[int, ...], float]]:
    """Returns the terms, and their factors, of a term (V,) whose variables are projected (V, V)."""
    factors = np.repeat(np.arange(len(powers)), powers)
    choices = [np.flatnonzero(np.abs(projection[f]) > NOTHING) for f in factors]
    expanded = []
    for places in product(*choices):
        indices = np.array(places, dtype=np.int64)
        term = np.bincount(indices, minlength=len(powers))
        share = float(np.prod(projection[factors, list(places)]))
        expanded.append((tuple(term.tolist()), share))
    return expanded


def stabilise(model: TaylorModel, spec: RobotSpec) -> TaylorModel:
    """Returns a model in which no state grows by itself."""
    coefficients = model.coefficients.copy()
    is_linear = model.powers.sum(axis=1) == 1
    for i in range(len(spec.state)):
        row = FIRST_STATE + i
        decay = is_linear & (model.powers[:, i] == 1)
        coefficients[row, decay] = np.minimum(coefficients[row, decay], 0.0)
    return replace(model, coefficients=coefficients)


def find_linear_term(model: TaylorModel, name: str) -> int:
    """Returns the index of the term of a variable alone, which the model must have."""
    alone = np.array([v == name for v in model.variables], dtype=np.int64)
    return int(np.flatnonzero((model.powers == alone).all(axis=1))[0])


def add_terms(model: TaylorModel, more: Powers) -> TaylorModel:
    """Returns a model that has these terms (K, V), too, maybe with a coefficient of zero."""
    known = set(map(tuple, model.powers.tolist()))
    new = [row for row in more.tolist() if tuple(row) not in known]
    both = np.array([*model.powers.tolist(), *new], dtype=np.int64)
    powers = both.reshape(-1, len(model.variables))
    coefficients = np.zeros((len(model.dofs), len(powers)))
    coefficients[:, : len(model.powers)] = model.coefficients
    return replace(
        model, powers=powers, coefficients=coefficients, std_errors=np.zeros((0, 0))
    )


def add_linear_terms(model: TaylorModel) -> TaylorModel:
    """Returns a model that has a term, maybe of zero, of each variable alone."""
    return add_terms(model, np.eye(len(model.variables), dtype=np.int64))


def drop_unused_terms(model: TaylorModel) -> TaylorModel:
    """Returns a model without terms that no degree of freedom has."""
    used = model.coefficients.any(axis=0)
    errors = model.std_errors
    return replace(
        model,
        powers=model.powers[used],
        coefficients=np.ascontiguousarray(model.coefficients[:, used]),
        std_errors=errors[:, used] if errors.size else errors,
    )


def merge_terms(base: TaylorModel, other: TaylorModel) -> tuple[TaylorModel, Array]:
    """Returns a model over the terms of both, and the other's coefficients (D, K) for them."""
    model = add_terms(base, other.powers)
    merged = add_terms(other, base.powers)
    places = {tuple(row): k for k, row in enumerate(merged.powers.tolist())}
    order = [places[tuple(row)] for row in model.powers.tolist()]
    return model, merged.coefficients[:, order]
