"""TaylorModel: rates of pose and state as a short polynomial of state and command (Eq. 1)."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from itertools import chain, combinations_with_replacement
from typing import Annotated, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import AllowInfNan, ConfigDict, Field, NonNegativeFloat

from nics_drl_bridge import geometry
from nics_drl_bridge.config import Schema
from nics_drl_bridge.errors import ModelError
from nics_drl_bridge.geometry import Array
from nics_drl_bridge.robot.curve import InputCurve, apply_curves, delays, ends

# Fraction of its range by which a bounded state may leave it at either end
STATE_MARGIN = 0.25


@dataclass(frozen=True)
class TaylorModel:
    """`dQ/dt = A chi(X)` without the pruned terms (Eq. 1, 2), and the effects of motors around it.

    The commands in X are those in effect, after the input curves. Back-EMF weakens a motor as it
    turns faster. The rate of a state is clipped to its limits; then quadratic drag slows the state,
    and dry friction reduces it to zero, where it stays.
    """

    variables: tuple[str, ...]  # V names of X = [state, command]
    # D = 3 + S names of dQ/dt: vx, vy, wz, then the state's rates
    dofs: tuple[str, ...]
    dof_units: tuple[str, ...]
    # (K, V) exponents of the terms that any degree of freedom keeps
    powers: NDArray[np.int64]
    coefficients: Array  # (D, K); zero where a degree of freedom does not keep a term
    dt: float  # the step for which the rates are valid [s]; the simulator's step
    low: Array  # (V,) minimum of X in the recording
    high: Array  # (V,) maximum of X in the recording
    # Terms (dof, term) taken from the textbook, not from the drive
    assumed: tuple[tuple[str, str], ...] = ()
    # (D, K); NaN for a kept coefficient that was assumed or defined; (0, 0) if all are unknown
    std_errors: Array = field(default_factory=lambda: np.zeros((0, 0)))
    quality: "Quality | None" = None
    bounded: bool = False  # True if the state is clipped to `state_box`
    inputs: tuple[InputCurve, ...] = ()  # curves of the commands that have one
    # (S,) [unit of the state / s]
    friction: Array = field(default_factory=lambda: np.zeros(0))
    # (S,) [1 / (unit of the state s)]
    drag: Array = field(default_factory=lambda: np.zeros(0))
    # (S, C) rate at which a command in effect brakes a state, per command magnitude [1
    # / (its unit s)]
    back_emf: Array = field(default_factory=lambda: np.zeros((0, 0)))
    # (S, 2) minimum and maximum of each state's rate [unit of the state / s]
    limits: Array = field(default_factory=lambda: np.zeros((0, 2)))

    def __post_init__(self) -> None:
        states = self.state_size
        commands = len(self.variables) - states
        defaults = {
            "friction": np.zeros(states),
            "drag": np.zeros(states),
            "back_emf": np.zeros((states, commands)),
            "limits": np.tile([-np.inf, np.inf], (states, 1)),
        }
        for name, default in defaults.items():
            if not getattr(self, name).size:
                object.__setattr__(self, name, default)

    @property
    def state_size(self) -> int:
        """Number of state variables, S."""
        return len(self.dofs) - 3

    @property
    def state_box(self) -> tuple[Array, Array]:
        """Minimum and maximum state (S,) to which it is clipped; infinite unless `bounded`."""
        low = self.low[: self.state_size]
        high = self.high[: self.state_size]
        margin = np.full_like(low, np.inf)
        if self.bounded:
            margin = STATE_MARGIN * np.maximum(high - low, 1e-3)
        return low - margin, high + margin

    @property
    def terms_kept(self) -> int:
        """Number of non-zero coefficients."""
        return int(np.count_nonzero(self.coefficients))

    @property
    def is_plain(self) -> bool:
        """True if the model consists of its terms only."""
        return not self.inputs and self.is_free

    @property
    def is_free(self) -> bool:
        """True if the terms alone give the rates of the state."""
        has_limits = np.isfinite(self.limits).any()
        has_losses = self.friction.any() or self.drag.any() or self.back_emf.any()
        return not (has_limits or has_losses)

    @property
    def delays(self) -> Array:
        """Delays (C,) of the commands beyond their common latency [s]."""
        return delays(self.variables[self.state_size :], self.inputs)

    @property
    def drivers(self) -> NDArray[np.intp]:
        """Index (S,) of the command that moves each state most, over the recorded range of X."""
        largest = np.maximum(np.abs(self.low), np.abs(self.high))
        largest_features = np.prod(largest**self.powers, axis=1)
        effect = np.abs(self.coefficients[3:]) * largest_features
        has_command = self.powers[:, self.state_size :] > 0
        return np.asarray(np.argmax(effect @ has_command, axis=1))

    def apply_curves(self, command: ArrayLike) -> Array:
        """Returns the effects (..., C) of delayed commands (..., C) through the input curves."""
        return apply_curves(command, self.variables[self.state_size :], self.inputs)

    def rates(self, x: ArrayLike) -> Array:
        """Returns dQ/dt (..., D) in a step from X (..., V), whose commands are those in effect."""
        x = np.asarray(x, dtype=np.float64)
        dq = self._evaluate_terms(x)
        if not self.is_free:
            state = x[..., : self.state_size]
            moved = self._move_states(state, dq[..., 3:] * self.dt)
            dq[..., 3:] = (moved - state) / self.dt
        return dq

    def _evaluate_terms(self, x: Array) -> Array:
        """Returns dQ/dt (..., D) from the terms and the back-EMF."""
        dq = evaluate(x, self.powers) @ self.coefficients.T
        states = self.state_size
        damping = np.abs(x[..., states:]) @ self.back_emf.T
        dq[..., 3:] -= damping * x[..., :states]
        return dq

    def _move_states(self, state: Array, change: Array) -> Array:
        """Returns states (..., S) after a step's change, by limits, drag and friction."""
        moved = state + np.clip(change, *(self.dt * self.limits.T))
        moved = moved / (1.0 + self.dt * self.drag * np.abs(moved))
        stick = self.dt * self.friction
        return np.asarray(np.maximum(moved - stick, np.minimum(moved + stick, 0.0)))

    def step(
        self,
        pose: ArrayLike,
        state: ArrayLike,
        command: ArrayLike,
    ) -> tuple[Array, Array]:
        """Returns pose (..., 3) and state (..., S) after a step of `dt` along the exact arc."""
        state = np.asarray(state, dtype=np.float64)
        x = np.concatenate([state, self.apply_curves(command)], axis=-1)
        change = self._evaluate_terms(x) * self.dt
        moved = np.clip(self._move_states(state, change[..., 3:]), *self.state_box)
        return geometry.compose(pose, geometry.exp(change[..., :3])), moved

    @property
    def term_names(self) -> tuple[str, ...]:
        """Names of the K terms: `1`, `speed`, `speed*steering`."""
        return tuple(format_term(row, self.variables) for row in self.powers)

    @property
    def shown_terms(self) -> tuple[str, ...]:
        """Names of the K terms; commands with a curve are primed: `throttle'`."""
        return tuple(format_term(row, self.shown_names) for row in self.powers)

    @property
    def shown_names(self) -> tuple[str, ...]:
        """Names of the variables; commands with a curve are primed."""
        curved = [curve.command for curve in self.inputs]
        return tuple(f"{name}'" if name in curved else name for name in self.variables)

    def describe_limits(self, dof: str) -> str:
        """Returns limits, drag, friction of a degree of freedom as text, starting with a comma."""
        d = self.dofs.index(dof) - 3
        if d < 0:
            return ""
        name = self.variables[d]
        commands = self.shown_names[self.state_size :]
        text = ends(*self.limits[d].tolist())
        for emf, command in zip(self.back_emf[d].tolist(), commands, strict=True):
            if emf:
                text += f", less {emf:.4g}*{name}*|{command}|"
        if self.drag[d]:
            text += f", less {self.drag[d]:.4g}*{name}*|{name}|"
        if self.friction[d]:
            text += f", less dry friction of {self.friction[d]:.4g}"
        return text

    @property
    def named_errors(self) -> dict[str, dict[str, float]]:
        """Known standard errors of the kept terms, by degree of freedom and term."""
        if not self.std_errors.size:
            return {}
        has_error = (self.coefficients != 0.0) & np.isfinite(self.std_errors)
        names = self.term_names
        errors = {}
        for d, dof in enumerate(self.dofs):
            kept = np.flatnonzero(has_error[d])
            if kept.size:
                errors[dof] = {names[k]: float(self.std_errors[d, k]) for k in kept}
        return errors

    def add_errors(self, errors: Mapping[str, Mapping[str, float]]) -> "TaylorModel":
        """Returns the model with standard errors by dof and term; NaN for other kept terms."""
        if not errors:
            return replace(self, std_errors=np.zeros((0, 0)))
        names = self.term_names
        values = np.full(self.coefficients.shape, np.nan)
        for d, dof in enumerate(self.dofs):
            for k, name in enumerate(names):
                values[d, k] = errors.get(dof, {}).get(name, np.nan)
        return replace(self, std_errors=np.where(self.coefficients != 0.0, values, 0.0))

    def equations(self) -> list[str]:
        """Returns a line per curve, and per dof with units: `wz = 4.6*speed*steering  [rad/s]`."""
        lines = [curve.equation for curve in self.inputs]
        for d, dof in enumerate(self.dofs):
            terms = [
                self._describe_term(d, int(k))
                for k in np.flatnonzero(self.coefficients[d])
            ]
            text = " + ".join(terms).replace("+ -", "- ") or "0"
            limits = self.describe_limits(dof)
            lines.append(f"{dof} = {text}{limits}  [{self.dof_units[d]}]")
        return lines

    def _describe_term(self, d: int, k: int) -> str:
        name = self.term_names[k]
        text = f"{self.coefficients[d, k]:.5g}"
        if name != "1":
            text += f"*{self.shown_terms[k]}"
        if (self.dofs[d], name) in self.assumed:
            text += " (assumed)"
        return text

    @property
    def named(self) -> "NamedTaylorModel":
        """The model by names, unchecked; every number is bit-identical."""
        names = self.term_names
        terms = {}
        for dof, row in zip(self.dofs, self.coefficients, strict=True):
            terms[dof] = {names[k]: float(row[k]) for k in np.flatnonzero(row)}
        box = zip(self.low.tolist(), self.high.tolist(), strict=True)
        states = self.variables[: self.state_size]
        limited = zip(states, self.limits.tolist(), strict=True)
        brakes = [
            _name_positive(self.variables[self.state_size :], row)
            for row in self.back_emf
        ]
        return NamedTaylorModel.model_construct(
            dt=self.dt,
            units=dict(zip(self.dofs, self.dof_units, strict=True)),
            terms=terms,
            valid=dict(zip(self.variables, box, strict=True)),
            assumed=self.assumed,
            standard_errors=self.named_errors if self.std_errors.size else None,
            quality=self.quality,
            bounded=self.bounded,
            inputs=self.inputs,
            friction=_name_positive(states, self.friction) or None,
            drag=_name_positive(states, self.drag) or None,
            limits={s: tuple(row) for s, row in limited if np.isfinite(row).any()}
            or None,
            back_emf={s: row for s, row in zip(states, brakes, strict=True) if row}
            or None,
        )


def _name_positive(names: tuple[str, ...], values: Array) -> dict[str, float]:
    """Returns the positive values by name."""
    pairs = zip(names, values.tolist(), strict=True)
    return {name: value for name, value in pairs if value > 0.0}


def list_exponents(variables: int, order: int) -> NDArray[np.int64]:
    """Returns exponents (K, V) of the distinct products of up to `order` of V variables.

    The constant comes first. `chi = vec([1, X] (x) [1, X])` of Eq. 1 contains every mixed product
    twice; here it occurs once.
    """
    rows = []
    for degree in range(order + 1):
        for factors in combinations_with_replacement(range(variables), degree):
            columns = np.array(factors, dtype=np.int64)
            rows.append(np.bincount(columns, minlength=variables))
    return np.array(rows, dtype=np.int64).reshape(len(rows), variables)


def evaluate(x: ArrayLike, powers: NDArray[np.int64]) -> NDArray[np.float64]:
    """Returns the features chi (..., K) of variables x (..., V) for exponents (K, V)."""
    x = np.asarray(x, dtype=np.float64)
    chi = np.ones((*x.shape[:-1], len(powers)))
    for k, row in enumerate(powers):
        for variable in np.flatnonzero(row):
            chi[..., k] *= x[..., variable] ** row[variable]
    return chi


def format_term(row: NDArray[np.int64], names: tuple[str, ...]) -> str:
    """Returns a term as text: `1`, `speed*steering`, `speed^2`."""
    factors = []
    for v in np.flatnonzero(row):
        factors.append(names[v] if row[v] == 1 else f"{names[v]}^{row[v]}")
    return "*".join(factors) or "1"


def make_sort_key(row: NDArray[np.int64]) -> tuple[int, ...]:
    """Returns a key that sorts exponents (V,) as `list_exponents` does: by order, then variable."""
    return (int(row.sum()), *(-int(power) for power in row))


def parse_term(text: str, names: tuple[str, ...]) -> NDArray[np.int64]:
    """Parses a term written by `format_term` into exponents (V,). Raises ValueError otherwise."""
    row = np.zeros(len(names), dtype=np.int64)
    if text == "1":
        return row
    for factor in text.split("*"):
        name, _, power = factor.partition("^")
        if name not in names:
            raise ValueError(f"term {text!r} names the unknown variable {name!r}")
        times = int(power or 1)
        if times < 1:
            raise ValueError(f"term {text!r} has a power below 1")
        row[names.index(name)] += times
    return row


@dataclass(frozen=True)
class EndErrors:
    """Mean errors at the ends of predictions."""

    position_m: float
    heading_rad: float


@dataclass(frozen=True)
class HorizonErrors:
    """Errors of predictions over one horizon on held-out data, and of baselines."""

    __pydantic_config__ = ConfigDict(extra="forbid")  # errors may be inf

    horizon_s: float
    windows: int  # number of predictions
    path_m: float  # mean length of the measured path
    model: EndErrors
    kept_twist: EndErrors  # errors of a robot that keeps its initial twist
    # errors of the textbook model, fitted to the same data; None: not fitted
    textbook: EndErrors | None = None
    band_m: float | None = None  # distance within which 95 % of the ends are expected
    coverage: float | None = None  # fraction of the ends within it
    # Noise of the differences between the model's errors and those of the baselines [m]
    kept_twist_noise_m: float | None = None
    textbook_noise_m: float | None = None
    # errors of a robot that never moves; None in older files
    standing: EndErrors | None = None
    standing_noise_m: float | None = None  # noise of the difference to it [m]


@dataclass(frozen=True)
class Quality:
    """Figures of merit, by degree of freedom where they are mappings."""

    __pydantic_config__ = ConfigDict(extra="forbid")  # a figure of merit may be inf

    samples: int  # number of rows that the fit used
    outliers: dict[str, float]  # fraction of the rows that were dropped as outliers
    condition: dict[str, float]  # condition number of the standardised kept features
    rmse: dict[str, float]  # error of each rate on the training data
    r2: dict[str, float]
    # the same on held-out data; empty if there are none
    held_out_rmse: dict[str, float]
    held_out_r2: dict[str, float]
    # Open-loop predictions on held-out data: mean errors at their ends, mean path; 0 without data
    open_loop_horizon_s: float = 0.0
    open_loop_position_error_m: float = 0.0
    open_loop_heading_error_rad: float = 0.0
    open_loop_path_m: float = 0.0
    judgement: tuple[HorizonErrors, ...] = ()  # by horizon, ascending


Fall = Annotated[float, AllowInfNan(), Field(lt=0.0)]
Rise = Annotated[float, AllowInfNan(), Field(gt=0.0)]


class NamedTaylorModel(Schema):
    """A TaylorModel by names, as `model.yaml` holds it; `valid` is the range of each variable."""

    dt: float = Field(gt=0.0)
    units: dict[str, str]
    terms: dict[str, dict[str, float]]
    valid: dict[str, tuple[float, float]]
    assumed: tuple[tuple[str, str], ...]
    standard_errors: dict[str, dict[str, float]] | None = None
    quality: Quality | None = None
    bounded: bool = False
    inputs: tuple[InputCurve, ...] = ()
    friction: dict[str, NonNegativeFloat] | None = None  # by state
    drag: dict[str, NonNegativeFloat] | None = None  # by state
    # by state and command
    back_emf: dict[str, dict[str, NonNegativeFloat]] | None = None
    limits: dict[str, tuple[Fall, Rise]] | None = None  # by state

    def model(self) -> TaylorModel:
        """Returns the model as arrays. Raises ModelError if its names are inconsistent."""
        variables = tuple(self.valid)
        states = variables[: len(self.terms) - 3]
        commands = variables[len(states) :]
        self._check_stages(states, commands)
        powers = self._parse_terms(variables)
        rows = [
            _list_values(terms, tuple(powers), 0.0) for terms in self.terms.values()
        ]
        box = np.array(list(self.valid.values())).reshape(len(variables), 2)
        brakes = self.back_emf or {}
        return TaylorModel(
            variables,
            tuple(self.terms),
            tuple(self.units[dof] for dof in self.terms),
            np.array(list(powers.values()), np.int64).reshape(
                len(powers), len(variables)
            ),
            np.array(rows).reshape(len(self.terms), len(powers)),
            self.dt,
            box[:, 0],
            box[:, 1],
            self.assumed,
            quality=self.quality,
            bounded=self.bounded,
            inputs=self.inputs,
            friction=_list_values(self.friction, states, 0.0),
            drag=_list_values(self.drag, states, 0.0),
            limits=_list_values(self.limits, states, (-np.inf, np.inf)),
            back_emf=np.array(
                [_list_values(brakes.get(state), commands, 0.0) for state in states]
            ),
        ).add_errors(self.standard_errors or {})

    def _parse_terms(self, variables: tuple[str, ...]) -> dict[str, NDArray[np.int64]]:
        """Returns the exponents (V,) of each term, in the order of `list_exponents`."""
        try:
            parsed = {
                name: parse_term(name, variables)
                for name in chain.from_iterable(self.terms.values())
            }
        except (OverflowError, ValueError) as error:
            raise ModelError(
                f"kinematics: {error}; generate the model again."
            ) from None
        return dict(sorted(parsed.items(), key=lambda item: make_sort_key(item[1])))

    def _check_stages(self, states: tuple[str, ...], commands: tuple[str, ...]) -> None:
        for dof in self.terms:
            if dof not in self.units:
                raise ModelError(
                    f"kinematics: {dof!r} has no unit; generate the model again."
                )
        curved = [curve.command for curve in self.inputs]
        _check_names("inputs", curved, commands)
        for key in ("friction", "drag", "limits", "back_emf"):
            _check_names(key, getattr(self, key) or (), states)
        for row in (self.back_emf or {}).values():
            _check_names("back_emf", row, commands)
        if len(set(curved)) < len(curved):
            raise ModelError("kinematics: key 'inputs' has a command twice; keep one.")


def _list_values(
    by_name: Mapping[str, Any] | None, names: tuple[str, ...], default: Any
) -> Array:
    """Returns values in the order of names."""
    given = by_name or {}
    return np.array([given.get(name, default) for name in names], dtype=np.float64)


def _check_names(key: str, names: Iterable[str], allowed: tuple[str, ...]) -> None:
    for name in names:
        if name not in allowed:
            raise ModelError(
                f"kinematics: key {key!r} has {name!r}, not one of "
                f"({', '.join(allowed)}); correct the name."
            )
