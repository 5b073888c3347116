"""Terms that a model may have: by mirror symmetry, by its textbook, and through its state."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import orth

from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.geometry import Array
from nics_drl_bridge.identify import excitation
from nics_drl_bridge.identify.fit import Fit, pruned, regress
from nics_drl_bridge.identify.yardstick import structure_of
from nics_drl_bridge.recording.recording import Samples
from nics_drl_bridge.robot.kinds import compute_steady_twist
from nics_drl_bridge.robot.spec import POSE_RATES, RobotSpec
from nics_drl_bridge.robot.taylor import TaylorModel

Mask = NDArray[np.bool_]
Powers = NDArray[np.int64]

NOTHING = 1e-9  # spread of a rate that counts as zero


def mirrored(spec: RobotSpec) -> tuple[str, ...] | None:
    """Names the variables that change sign in a mirror; None if the textbook does not say."""
    rng = np.random.default_rng(0)
    reach = np.maximum(spec.command_high, -spec.command_low)
    some = rng.uniform(0.1, 0.9, (8, len(spec.command))) * reach
    try:
        twist = compute_steady_twist(spec, some) * np.array([1.0, -1.0, -1.0])
        for signs in product((1.0, -1.0), repeat=len(spec.command)):
            if np.allclose(compute_steady_twist(spec, some * signs), twist):
                break
        else:
            return None
    except ConfigError:
        return None
    odd = [c.name for c, sign in zip(spec.command, signs, strict=True) if sign < 0.0]
    aside = [v.name for v in spec.state if v.twist in ("vy", "wz") or v.follows in odd]
    return (*aside, *odd)


def is_reversed(name: str, odd: tuple[str, ...]) -> bool:
    """True if a variable or a rate of the twist changes sign in a mirror that reverses `odd`."""
    return name in ("vy", "wz") or name.removeprefix("d_") in odd


def sided(spec: RobotSpec) -> bool:
    """True if a lever arm along y is distinguishable from unequal wheels."""
    return spec.moves_sideways or mirrored(spec) is not None


def tyres_slip(spec: RobotSpec) -> bool:
    """True for a front-steered car whose motion is its state: it may slip sideways."""
    given = structure_of(spec)
    told = {v.twist for v in spec.state} >= {"vx", "vy", "wz"}
    return told and given is not None and given[1].used and not given[1].front_drive


def library(powers: Powers, spec: RobotSpec, held: tuple[str, ...] = ()) -> Mask:
    """Selects the terms (D, K) that each degree of freedom may have.

    A state that is a component of the twist is so by definition. Slip along y is proportional.
    Beyond the first order, what a mirror reverses only has reversed terms. Commands that were
    `held` at one value act as a constant.
    """
    names = spec.variable_names
    odd = mirrored(spec)
    order = powers.sum(axis=1)
    slip = [names.index(v.name) for v in spec.state if v.twist == "vy"]
    allowed = np.ones((len(spec.dof_names), len(powers)), dtype=np.bool_)
    allowed[:, (powers[:, slip].sum(axis=1) > 0) & (order > 1)] = False
    if odd is not None:
        reversed_ = powers[:, [n in odd for n in names]].sum(axis=1) % 2 == 1
        for d, name in enumerate(spec.dof_names):
            allowed[d] &= (reversed_ == is_reversed(name, odd)) | (order <= 1)
    if spec.state:  # commands act through the state
        allowed[:3] &= (powers[:, len(spec.state) :] == 0).all(axis=1)
    if odd is not None:  # without a command, the robot comes to rest
        pushed = [is_reversed(name, odd) for name in held]
        rest = [is_reversed(name, odd) not in pushed for name in spec.dof_names]
        allowed[rest] &= order > 0
    elif not (spec.state or held):
        allowed &= order > 0
    for i, variable in enumerate(spec.state):
        alone = (order == 1) & (powers[:, i] == 1)
        if variable.twist:
            allowed[POSE_RATES.index(variable.twist)] = alone
        else:
            follows = names.index(str(variable.follows))
            allowed[3 + i] = alone | ((order == 1) & (powers[:, follows] == 1))
    return np.asarray(allowed)


def through_state(powers: Powers, spec: RobotSpec, centred: bool) -> Mask:
    """Selects the terms (D, K) that each degree of freedom may have.

    If poses are those of the robot's `centred` reference point, motion along x is even in what a
    mirror reverses, and beyond the first order the rest is odd. States lag behind their commands.
    """
    names = spec.variable_names
    odd = mirrored(spec)
    order = powers.sum(axis=1)
    unmoved = [
        name for name, most in zip(names, powers.max(axis=0), strict=True) if most == 0
    ]
    allowed = np.ones((len(spec.dof_names), len(powers)), dtype=np.bool_)
    allowed[:3] = excitation.terms_through_state(powers, spec, tuple(unmoved))
    if odd is not None and centred:
        aside = powers[:, [name in odd for name in names]].sum(axis=1) % 2 == 1
        allowed[0] &= ~aside
        allowed[1:3] &= aside | (order <= 1)
    for i, variable in enumerate(spec.state):
        own = [names.index(variable.name), names.index(str(variable.follows))]
        allowed[3 + i] = (order == 1) & powers[:, own].any(axis=1)
    return allowed


def by_textbook(
    powers: Powers, spec: RobotSpec, held: tuple[str, ...] = (), tyres: bool = False
) -> Mask:
    """Selects the terms (D, K) by which the twist follows commands with a lag, as in textbooks."""
    names = spec.variable_names
    states = len(spec.state)
    order = powers.sum(axis=1)
    allowed, given = library(powers, spec, held) & (order <= 1), structure_of(spec)
    if given is None or not states:
        return np.asarray(allowed)
    moves, bicycle = given
    first = np.eye(len(names), dtype=np.int64)
    speed = [i for i, v in enumerate(spec.state) if v.twist == "vx"]
    paced = bool(speed) and powers[:, speed].any()  # else its speed never changed

    def has(d: int, *rows: NDArray[np.int64]) -> None:
        for row in rows:
            allowed[d] |= (powers == row).all(axis=1)

    for i, variable in enumerate(spec.state):
        if variable.twist is None:
            continue
        part = POSE_RATES.index(variable.twist)
        allowed[3 + i] = False
        if tyres and paced and variable.twist != "vx":  # by the lateral acceleration
            has(
                3 + i,
                2 * first[speed[0]] + first[[v.twist for v in spec.state].index("wz")],
            )
        # no constant, because without a command the robot comes to rest
        has(3 + i, first[i])
        commands = first[states:][np.abs(moves[part]) > 0.0]
        if bicycle.used and variable.twist == "wz" and paced:
            has(3 + i, first[speed[0]], *(commands + first[speed[0]]))
            continue
        has(3 + i, *commands)
        if any(command @ [name in held for name in names] for command in commands):
            has(3 + i, 0 * first[i])
    return np.asarray(allowed)


def linear_fit(
    samples: Samples,
    spec: RobotSpec,
    order: int,
    allowed: Callable[..., Mask] = library,
) -> Fit:
    """Fits all library terms up to an order to the rates (Eq. 1); the twist by definition."""
    variables = (*spec.state, *spec.command)
    unmoved = excitation.unmoved_variables(samples, spec)
    mean = samples.x.mean(axis=0)
    least = excitation.STILL * np.array([v.max - v.min for v in variables])
    at = {
        v.name: float(value) * bool(abs(value) > some)
        for v, value, some in zip(variables, mean, least, strict=True)
        if v.name in unmoved
    }
    held = tuple(c.name for c in spec.command if at.get(c.name))
    found = pruned(
        regress(samples, spec, order, allowed=partial(allowed, held=held)), spec, 1.0
    )
    still = samples.dq.std(axis=0) <= NOTHING
    still[3:] |= np.array([v.name in at for v in spec.state], dtype=np.bool_)
    coefficients = np.where(still[:, None], 0.0, found.model.coefficients)
    model = replace(found.model, coefficients=coefficients)
    return replace(found, model=_by_definition(model, spec, at))


def _by_definition(
    model: TaylorModel, spec: RobotSpec, at: dict[str, float]
) -> TaylorModel:
    """Sets the rows of the twist that are states; one that stayed `at` a value is a constant."""
    first = np.eye(len(model.variables), dtype=np.int64)
    rows = [0 * first[0], *first[: len(spec.state)]]
    more = [row for row in rows if not (model.powers == row).all(axis=1).any()]
    powers = np.concatenate(
        [model.powers, np.reshape(more, (-1, len(first))).astype(np.int64)]
    )
    coefficients = np.zeros((len(model.dofs), len(powers)))
    coefficients[:, : len(model.powers)] = model.coefficients
    # remaining lateral motion is noise, unless it is a state
    if not spec.moves_sideways:
        coefficients[1] = 0.0
    for i, variable in enumerate(spec.state):
        if variable.twist:
            value = at.get(variable.name)
            own, share = (first[i], 1.0) if value is None else (rows[0], value)
            coefficients[POSE_RATES.index(variable.twist)] = share * (
                powers == own
            ).all(axis=1)
    kept = coefficients.any(axis=0)
    none = np.zeros((0, 0))
    return replace(
        model,
        powers=powers[kept],
        coefficients=coefficients[:, kept],
        std_errors=none,
        bounded=True,
    )


def shared(model: TaylorModel, spec: RobotSpec, samples: Samples) -> TaylorModel:
    """Distributes an effect over commands of one unit that always moved together.

    Uses the minimum-norm coefficients, for example for four wheels and three degrees of freedom.
    """
    still = excitation.combinations(samples, spec)
    command = samples.x[:, len(spec.state) :]
    parts = np.abs(still).max(axis=0, initial=0.0) > NOTHING
    constant = still / np.maximum(command.std(axis=0), NOTHING)
    if (
        len(
            {
                c.unit
                for c, part in zip(spec.command, parts.tolist(), strict=True)
                if part
            }
        )
        != 1
    ):
        return model
    if np.abs(constant @ command.mean(axis=0)).max() > excitation.TOGETHER:
        return model
    normal = orth(constant.T)
    onto = np.eye(len(model.variables))
    onto[len(spec.state) :, len(spec.state) :] -= normal @ normal.T
    rows: dict[tuple[int, ...], Array] = {}
    for powers, effect in zip(model.powers.tolist(), model.coefficients.T, strict=True):
        factors = np.repeat(np.arange(len(powers)), powers)
        for places in product(
            *(np.flatnonzero(np.abs(onto[f]) > NOTHING) for f in factors)
        ):
            term = np.bincount(np.array(places, dtype=np.int64), minlength=len(powers))
            share = float(np.prod(onto[factors, list(places)]))
            key = tuple(term.tolist())
            rows[key] = rows.get(key, np.zeros(len(effect))) + share * effect
    coefficients = np.array(list(rows.values())).T
    kept = (np.abs(coefficients) > NOTHING).any(axis=0)
    powers = np.array(list(rows), dtype=np.int64)[kept]
    none = np.zeros((0, 0))
    return replace(
        model, powers=powers, coefficients=coefficients[:, kept], std_errors=none
    )


def stable(model: TaylorModel, spec: RobotSpec) -> TaylorModel:
    """Returns a model in which no state grows by itself."""
    coefficients = model.coefficients.copy()
    alone = model.powers.sum(axis=1) == 1
    for i in range(len(spec.state)):
        own = alone & (model.powers[:, i] == 1)
        coefficients[3 + i, own] = np.minimum(coefficients[3 + i, own], 0.0)
    return replace(model, coefficients=coefficients)


def together(base: TaylorModel, other: TaylorModel) -> tuple[TaylorModel, Array]:
    """Returns a model over the terms of both, and the other's coefficients (D, K) for them."""
    rows = {tuple(row): k for k, row in enumerate(other.powers.tolist())}
    more = [row for row in base.powers.tolist() if tuple(row) not in rows]
    rows |= {tuple(row): len(rows) + k for k, row in enumerate(more)}
    powers = np.array(list(rows), dtype=np.int64)
    coefficients, first = np.zeros((2, len(base.dofs), len(powers)))
    coefficients[:, [rows[tuple(row)] for row in base.powers.tolist()]] = (
        base.coefficients
    )
    first[:, : len(other.powers)] = other.coefficients
    none = np.zeros((0, 0))
    return replace(
        base, powers=powers, coefficients=coefficients, std_errors=none
    ), first


def defined(spec: RobotSpec) -> Mask:
    """Selects the degrees of freedom (D,) that the state defines, so that they are not fitted."""
    by_state = np.zeros(len(spec.dof_names), dtype=np.bool_)
    for i, variable in enumerate(spec.state):
        by_state[POSE_RATES.index(variable.twist) if variable.twist else 3 + i] = True
    return by_state
