"""TaylorModel: rates of pose and state as a short polynomial of state and command (Eq. 1)."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from itertools import combinations_with_replacement
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import AllowInfNan, ConfigDict, Field, NonNegativeFloat

from nics_drl_bridge import geometry
from nics_drl_bridge.config import Schema
from nics_drl_bridge.errors import ModelError
from nics_drl_bridge.geometry import Array
from nics_drl_bridge.robot.curve import InputCurve, apply_curves, delays, ends

BEYOND = 0.25  # share of its range by which a bounded state may leave it, on both ends


@dataclass(frozen=True)
class TaylorModel:
    """`dQ/dt = A chi(X)` without the pruned terms (Eq. 1, 2), and what motors do around them.

    Commands of X are those in effect, after the input curves. A motor pulls the less the faster it
    turns: by its back-EMF. The rate of a state is cut to its limits; then drag by its square slows
    it, and dry friction draws it to zero, where it sticks.
    """

    variables: tuple[str, ...]  # V names of X = [state, command]
    dofs: tuple[
        str, ...
    ]  # D = 3 + S names of dQ/dt: vx, vy, wz, then the state's rates
    dof_units: tuple[str, ...]
    powers: NDArray[
        np.int64
    ]  # (K, V) exponents of the terms that any degree of freedom keeps
    coefficients: Array  # (D, K); zero where a degree of freedom does not keep a term
    dt: float  # the step for which the rates are valid [s]; the simulator's step
    low: Array  # `low`, `high`: (V,) the box of X that the recording covered
    high: Array
    assumed: tuple[
        tuple[str, str], ...
    ] = ()  # terms (dof, term) of the textbook, not of the drive
    # (D, K); NaN for a kept coefficient that was assumed or defined; (0, 0) if none is known
    std_errors: Array = field(default_factory=lambda: np.zeros((0, 0)))
    quality: "Quality | None" = None
    bounded: bool = False  # True if the state is held in the recording's box, widened
    inputs: tuple[InputCurve, ...] = ()  # of the commands that have one
    friction: Array = field(
        default_factory=lambda: np.zeros(0)
    )  # (S,) [unit of the state / s]
    drag: Array = field(
        default_factory=lambda: np.zeros(0)
    )  # (S,) [1 / (unit of the state s)]
    # (S, C) by which each command in effect, of either sign, brakes [1 / (its unit s)]
    back_emf: Array = field(default_factory=lambda: np.zeros((0, 0)))
    # (S, 2) greatest fall and rise of each state's rate [unit of the state / s]
    limits: Array = field(default_factory=lambda: np.zeros((0, 2)))

    def __post_init__(self) -> None:
        for name in ("friction", "drag"):
            if not getattr(self, name).size:
                object.__setattr__(self, name, np.zeros(self.state_size))
        if not self.back_emf.size:
            none = np.zeros((self.state_size, len(self.variables) - self.state_size))
            object.__setattr__(self, "back_emf", none)
        if not self.limits.size:
            object.__setattr__(
                self, "limits", np.tile([-np.inf, np.inf], (self.state_size, 1))
            )

    @property
    def state_size(self) -> int:
        """Number of state variables, S."""
        return len(self.dofs) - 3

    @property
    def state_box(self) -> tuple[Array, Array]:
        """Least and greatest state (S,), at which it is held; infinite unless `bounded`."""
        low, high = (edge[: self.state_size] for edge in (self.low, self.high))
        margin = BEYOND * np.maximum(high - low, 1e-3) if self.bounded else np.inf
        return low - margin, high + margin

    @property
    def terms_kept(self) -> int:
        """Number of non-zero coefficients."""
        return int(np.count_nonzero(self.coefficients))

    @property
    def is_plain(self) -> bool:
        """True if the motors do nothing beside the terms."""
        return not self.inputs and self.is_free

    @property
    def is_free(self) -> bool:
        """True if the rates of the state are those of the terms."""
        still = self.friction, self.drag, self.back_emf, np.isfinite(self.limits)
        return not any(each.any() for each in still)

    @property
    def delays(self) -> Array:
        """Delays (C,) of the commands beyond their common latency [s]."""
        return delays(self.variables[self.state_size :], self.inputs)

    @property
    def drivers(self) -> NDArray[np.intp]:
        """Place (S,) of the command that moves each state most, over the box of X."""
        reach = np.maximum(np.abs(self.low), np.abs(self.high))
        size = np.abs(self.coefficients[3:]) * np.prod(reach**self.powers, axis=1)
        return np.asarray(
            np.argmax(size @ (self.powers[:, self.state_size :] > 0), axis=1)
        )

    def apply_curves(self, command: ArrayLike) -> Array:
        """Returns what commands (..., C) come to after their delays, by the input curves."""
        return apply_curves(command, self.variables[self.state_size :], self.inputs)

    def rates(self, x: ArrayLike) -> Array:
        """Returns dQ/dt (..., D) in a step from X (..., V), whose commands are those in effect."""
        x = np.asarray(x, dtype=np.float64)
        dq = self._free_rates(x)
        if not self.is_free:
            state = x[..., : self.state_size]
            dq[..., 3:] = (self._moved(state, dq[..., 3:] * self.dt) - state) / self.dt
        return dq

    def _free_rates(self, x: Array) -> Array:
        """Returns dQ/dt (..., D) by the terms and the back-EMF."""
        dq = evaluate(x, self.powers) @ self.coefficients.T
        states = self.state_size
        dq[..., 3:] -= np.abs(x[..., states:]) @ self.back_emf.T * x[..., :states]
        return dq

    def _moved(self, state: Array, change: Array) -> Array:
        """Returns states (..., S) that change in a step, as limits, drag and friction let them."""
        moved = state + np.clip(change, *(self.dt * self.limits.T))
        moved = moved / (1.0 + self.dt * self.drag * np.abs(moved))
        stick = self.dt * self.friction
        return np.asarray(np.maximum(moved - stick, np.minimum(moved + stick, 0.0)))

    def step(
        self, pose: ArrayLike, state: ArrayLike, command: ArrayLike
    ) -> tuple[Array, Array]:
        """Returns pose (..., 3) and state (..., S) after a step of `dt` along the exact arc."""
        state = np.asarray(state, dtype=np.float64)
        dq = (
            self._free_rates(
                np.concatenate([state, self.apply_curves(command)], axis=-1)
            )
            * self.dt
        )
        moved = np.clip(self._moved(state, dq[..., 3:]), *self.state_box)
        return geometry.compose(pose, geometry.exp(dq[..., :3])), moved

    @property
    def term_names(self) -> tuple[str, ...]:
        """Names of the K terms: `1`, `speed`, `speed*steering`."""
        return tuple(format_term(row, self.variables) for row in self.powers)

    @property
    def shown_terms(self) -> tuple[str, ...]:
        """Names of the K terms, those of commands in effect primed: `throttle'`."""
        return tuple(format_term(row, self.shown_names) for row in self.powers)

    @property
    def shown_names(self) -> tuple[str, ...]:
        """Names of the variables, those of commands in effect primed."""
        curved = [curve.command for curve in self.inputs]
        return tuple(f"{name}'" if name in curved else name for name in self.variables)

    def restraint(self, dof: str) -> str:
        """Returns limits, drag, friction of a degree of freedom as text, beginning with a comma."""
        d = self.dofs.index(dof) - 3
        if d < 0:
            return ""
        friction = self.friction[d]
        drag = self.drag[d]
        name = self.variables[d]
        emf = zip(
            self.back_emf[d].tolist(), self.shown_names[self.state_size :], strict=True
        )
        less = "".join(f", less {k:.4g}*{name}*|{command}|" for k, command in emf if k)
        less += f", less {drag:.4g}*{name}*|{name}|" if drag else ""
        less += f", less dry friction of {friction:.4g}" if friction else ""
        return ends(*self.limits[d].tolist()) + less

    @property
    def named_errors(self) -> dict[str, dict[str, float]]:
        """Known standard errors of the kept terms: dof -> term -> error."""
        known = self.coefficients != 0.0
        known &= np.isfinite(self.std_errors) if self.std_errors.size else False
        names = self.term_names
        return {
            dof: {
                names[k]: float(self.std_errors[d, k]) for k in np.flatnonzero(known[d])
            }
            for d, dof in enumerate(self.dofs)
            if known[d].any()
        }

    def add_errors(self, errors: Mapping[str, Mapping[str, float]]) -> "TaylorModel":
        """Returns the model with standard errors by dof and term; NaN for kept terms without."""
        if not errors:
            return replace(self, std_errors=np.zeros((0, 0)))
        names = self.term_names
        rows = [
            [errors.get(dof, {}).get(name, np.nan) for name in names]
            for dof in self.dofs
        ]
        known = np.array(rows, dtype=np.float64).reshape(self.coefficients.shape)
        return replace(self, std_errors=np.where(self.coefficients != 0.0, known, 0.0))

    def equations(self) -> list[str]:
        """Returns a line per curve, and per dof with units: `wz = 4.6*speed*steering  [rad/s]`."""
        lines = [curve.equation for curve in self.inputs]
        names = self.term_names
        for d, dof in enumerate(self.dofs):
            terms = [
                f"{self.coefficients[d, k]:.5g}"
                + ("" if names[k] == "1" else f"*{self.shown_terms[k]}")
                + (" (assumed)" if (dof, names[k]) in self.assumed else "")
                for k in np.flatnonzero(self.coefficients[d])
            ]
            text = " + ".join(terms).replace("+ -", "- ")
            lines.append(
                f"{dof} = {text or '0'}{self.restraint(dof)}  [{self.dof_units[d]}]"
            )
        return lines

    @property
    def named(self) -> "NamedTaylorModel":
        """The model by names, unchecked; every number is bit-identical."""
        names = self.term_names
        terms = {
            dof: {names[k]: float(row[k]) for k in np.flatnonzero(row)}
            for dof, row in zip(self.dofs, self.coefficients, strict=True)
        }
        box = zip(self.low.tolist(), self.high.tolist(), strict=True)
        states = self.variables[: self.state_size]
        limits = map(tuple, self.limits.tolist())
        friction, drag = (
            {
                s: each
                for s, each in zip(states, values.tolist(), strict=True)
                if each > 0.0
            }
            for values in (self.friction, self.drag)
        )
        commands = self.variables[len(states) :]
        emf = {
            s: named
            for s, row in zip(states, self.back_emf.tolist(), strict=True)
            if (named := {c: k for c, k in zip(commands, row, strict=True) if k > 0.0})
        }
        limited = {
            s: k for s, k in zip(states, limits, strict=True) if np.isfinite(k).any()
        }
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
            friction=friction or None,
            drag=drag or None,
            limits=limited or None,
            back_emf=emf or None,
        )


def list_exponents(variables: int, order: int) -> NDArray[np.int64]:
    """Exponents (K, V) of the distinct products of up to `order` of V variables, constant first.

    `chi = vec([1, X] (x) [1, X])` of Eq. 1 contains every mixed product twice; here it occurs once.
    """
    rows = [
        np.bincount(np.array(chosen, dtype=np.int64), minlength=variables)
        for degree in range(order + 1)
        for chosen in combinations_with_replacement(range(variables), degree)
    ]
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
    factors = [
        names[v] if row[v] == 1 else f"{names[v]}^{row[v]}" for v in np.flatnonzero(row)
    ]
    return "*".join(factors) or "1"


def canonical(row: NDArray[np.int64]) -> tuple[int, ...]:
    """Returns a sort key for exponents (V,) in the order of `exponents`: order, then variable."""
    return (int(row.sum()), *(-int(power) for power in row))


def parse_term(text: str, names: tuple[str, ...]) -> NDArray[np.int64]:
    """Parses a term written by `term_name` to exponents (V,). Raises ValueError otherwise."""
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
    """Errors of predictions of one length, on data that the fit never saw, and of yardsticks."""

    __pydantic_config__ = ConfigDict(extra="forbid")  # errors may be inf

    horizon_s: float
    windows: int  # number of predictions
    path_m: float  # mean length of the measured path
    model: EndErrors
    kept_twist: EndErrors  # of a robot that keeps the twist of the start
    # of the textbook, fitted to the same part; None: not fitted
    textbook: EndErrors | None = None
    band_m: float | None = None  # distance within which 95 % of the ends are expected
    coverage: float | None = None  # share of the ends within it
    # Noise of the differences between the model's errors and those of the yardsticks [m]
    kept_twist_noise_m: float | None = None
    textbook_noise_m: float | None = None
    # of a robot that never moves; None: an older file
    standing: EndErrors | None = None
    standing_noise_m: float | None = None  # of the difference to it [m]


@dataclass(frozen=True)
class Quality:
    """Figures of merit, by degree of freedom where they are mappings."""

    __pydantic_config__ = ConfigDict(extra="forbid")  # a figure of merit may be inf

    samples: int  # number of rows that the fit used
    outliers: dict[str, float]  # share of the rows that were dropped as outliers
    condition: dict[str, float]  # condition number of the standardised kept features
    rmse: dict[str, float]  # `rmse`, `r2`: of the rates on the training part
    r2: dict[str, float]
    # `held_out_rmse`, `held_out_r2`: the same on data that the fit never saw; empty if none
    held_out_rmse: dict[str, float]
    held_out_r2: dict[str, float]
    # of open-loop predictions on that data, 0 if none; mean errors at the ends, mean path length
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
        """Returns the model as arrays. Raises ModelError if the names do not fit each other."""
        variables = tuple(self.valid)
        dofs = tuple(self.terms)
        every = dict.fromkeys(name for row in self.terms.values() for name in row)
        try:
            units = tuple(self.units[dof] for dof in dofs)
            parsed = {name: parse_term(name, variables) for name in every}
        except KeyError as error:
            raise ModelError(
                f"kinematics: {error} has no unit; generate the model anew."
            ) from None
        except (OverflowError, ValueError) as error:
            raise ModelError(f"kinematics: {error}; generate the model anew.") from None
        names = sorted(parsed, key=lambda name: canonical(parsed[name]))
        powers = np.array([parsed[name] for name in names], dtype=np.int64)
        rows = [[self.terms[dof].get(name, 0.0) for name in names] for dof in dofs]
        low, high = np.array(list(self.valid.values())).reshape(len(variables), 2).T
        states = variables[: len(dofs) - 3]
        friction = self.friction or {}
        drag = self.drag or {}
        limits = self.limits or {}
        commands = variables[len(states) :]
        emf = self.back_emf or {}
        self._check_stages(states, commands)
        return TaylorModel(
            variables,
            dofs,
            units,
            powers.reshape(len(names), len(variables)),
            np.array(rows, dtype=np.float64).reshape(len(dofs), len(names)),
            self.dt,
            low,
            high,
            self.assumed,
            quality=self.quality,
            bounded=self.bounded,
            inputs=self.inputs,
            friction=np.array([friction.get(name, 0.0) for name in states]),
            drag=np.array([drag.get(name, 0.0) for name in states]),
            limits=np.array([limits.get(name, (-np.inf, np.inf)) for name in states]),
            back_emf=np.array(
                [[emf.get(s, {}).get(c, 0.0) for c in commands] for s in states]
            ),
        ).add_errors(self.standard_errors or {})

    def _check_stages(self, states: tuple[str, ...], commands: tuple[str, ...]) -> None:
        curved = [curve.command for curve in self.inputs]
        by_state = {"friction": self.friction, "drag": self.drag, "limits": self.limits}
        emf = self.back_emf or {}
        keys = (
            ("inputs", curved, commands),
            *((k, v, states) for k, v in by_state.items()),
            ("back_emf", emf, states),
            *(("back_emf", row, commands) for row in emf.values()),
        )
        for key, names, known in keys:
            for name in names or ():
                if name not in known:
                    fault = f"key {key!r} has {name!r}, not one of ({', '.join(known)})"
                    raise ModelError(f"kinematics: {fault}; correct the name.")
        if len(set(curved)) < len(curved):
            raise ModelError("kinematics: key 'inputs' has a command twice; keep one.")
