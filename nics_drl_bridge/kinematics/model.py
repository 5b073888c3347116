"""TaylorModel: the rates of pose and state as a short polynomial of state and command."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from nics_drl_bridge import geometry
from nics_drl_bridge.errors import ModelError
from nics_drl_bridge.kinematics import features
from nics_drl_bridge.kinematics.quality import Quality

Array = NDArray[np.float64]


def _unknown() -> Array:
    return np.zeros((0, 0))


@dataclass(frozen=True)
class TaylorModel:
    """`dQ/dt = A chi(X)` with the pruned terms left out (Eq. 1, 2).

    Attributes:
        variables: V names of X = [state, command].
        dofs: D = 3 + S names of dQ/dt: vx, vy, wz of the body twist, then the state's rates.
        dof_units: D units.
        powers: (K, V) exponents of the terms that any degree of freedom keeps.
        coefficients: (D, K); zero where a degree of freedom does not keep a term.
        dt: the step for which the rates hold [s]; the simulator steps by it.
        low, high: (V,) the box of X that the recording covered.
        assumed: terms (dof, term) that the drive could not show, filled in from the
            textbook's structure on request.
        std_errors: (D, K) standard errors of the coefficients; NaN where a kept one was not
            estimated but assumed or fixed by definition. Empty, (0, 0), where none is known.
        quality: how well it fits; None where not known.
    """

    variables: tuple[str, ...]
    dofs: tuple[str, ...]
    dof_units: tuple[str, ...]
    powers: NDArray[np.int64]
    coefficients: Array
    dt: float
    low: Array
    high: Array
    assumed: tuple[tuple[str, str], ...] = ()
    std_errors: Array = field(default_factory=_unknown)
    quality: Quality | None = None

    @property
    def state_size(self) -> int:
        """S."""
        return len(self.dofs) - 3

    @property
    def terms_kept(self) -> int:
        """Number of coefficients that are not zero."""
        return int(np.count_nonzero(self.coefficients))

    def rates(self, x: ArrayLike) -> Array:
        """dQ/dt (..., D) at X (..., V)."""
        return features.evaluate(x, self.powers) @ self.coefficients.T

    def step(self, pose: ArrayLike, state: ArrayLike, command: ArrayLike) -> tuple[Array, Array]:
        """One step of `dt`; the readable reference of the simulator's kernel.

        Args:
            pose: (..., 3).
            state: (..., S).
            command: (..., C).

        Returns:
            Pose (..., 3), moved along the exact arc of the body twist, and state (..., S).
        """
        state = np.asarray(state, dtype=np.float64)
        x = np.concatenate([state, np.asarray(command, dtype=np.float64)], axis=-1)
        dq = self.rates(x) * self.dt
        return geometry.compose(pose, geometry.exp(dq[..., :3])), state + dq[..., 3:]

    @property
    def term_names(self) -> tuple[str, ...]:
        """K names: `1`, `speed`, `speed*steering`."""
        return tuple(features.term_name(row, self.variables) for row in self.powers)

    @property
    def named_errors(self) -> dict[str, dict[str, float]]:
        """Standard errors that are known, of the kept terms: dof -> term -> error."""
        known = self.coefficients != 0.0
        known &= np.isfinite(self.std_errors) if self.std_errors.size else False
        names = self.term_names
        return {
            dof: {names[k]: float(self.std_errors[d, k]) for k in np.flatnonzero(known[d])}
            for d, dof in enumerate(self.dofs)
            if known[d].any()
        }

    def with_errors(self, errors: Mapping[str, Mapping[str, float]]) -> TaylorModel:
        """The model with standard errors by dof and term; NaN where a kept term has none."""
        if not errors:
            return replace(self, std_errors=_unknown())
        names = self.term_names
        rows = [[errors.get(dof, {}).get(name, np.nan) for name in names] for dof in self.dofs]
        known = np.array(rows, dtype=np.float64).reshape(self.coefficients.shape)
        return replace(self, std_errors=np.where(self.coefficients != 0.0, known, 0.0))

    def equations(self) -> list[str]:
        """One line per degree of freedom, with units: `wz = 4.6*speed*steering  [rad/s]`."""
        lines = []
        for d, dof in enumerate(self.dofs):
            text = ""
            for k in np.flatnonzero(self.coefficients[d]):
                value, name = (
                    self.coefficients[d, k],
                    features.term_name(self.powers[k], self.variables),
                )
                sign = ("-" if value < 0 else "") if not text else (" - " if value < 0 else " + ")
                mark = " (assumed)" if (dof, name) in self.assumed else ""
                text += f"{sign}{abs(value):.5g}" + ("" if name == "1" else f"*{name}") + mark
            lines.append(f"{dof} = {text or '0'}  [{self.dof_units[d]}]")
        return lines

    def to_dict(self) -> dict[str, Any]:
        """Plain data for YAML; every number reads back to the same bits."""
        terms = {
            dof: {
                features.term_name(self.powers[k], self.variables): float(self.coefficients[d, k])
                for k in np.flatnonzero(self.coefficients[d])
            }
            for d, dof in enumerate(self.dofs)
        }
        box = {
            name: [float(low), float(high)]
            for name, low, high in zip(self.variables, self.low, self.high, strict=True)
        }
        data: dict[str, Any] = {
            "dt": self.dt,
            "units": dict(zip(self.dofs, self.dof_units, strict=True)),
            "terms": terms,
            "valid": box,
            "assumed": [list(pair) for pair in self.assumed],
        }
        if self.std_errors.size:
            data["standard_errors"] = self.named_errors
        if self.quality is not None:
            data["quality"] = self.quality.to_dict()
        return data

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> TaylorModel:
        """Reads what `to_dict` wrote. Raises ModelError with the key that is wrong."""
        try:
            variables, dofs = tuple(data["valid"]), tuple(data["terms"])
            terms = data["terms"]
            parsed = {
                name: features.parse_term(name, variables) for dof in dofs for name in terms[dof]
            }
            names = sorted(parsed, key=lambda name: features.canonical(parsed[name]))
            powers = np.array([parsed[name] for name in names], dtype=np.int64)
            powers = powers.reshape(len(names), len(variables))
            coefficients = np.array(
                [[float(terms[dof].get(name, 0.0)) for name in names] for dof in dofs]
            )
            box = np.array([data["valid"][name] for name in variables], dtype=np.float64)
            box = box.reshape(len(variables), 2)
            units, dt = tuple(data["units"][dof] for dof in dofs), float(data["dt"])
            assumed = tuple((str(dof), str(term)) for dof, term in data["assumed"])
            errors = {
                str(dof): {str(term): float(value) for term, value in row.items()}
                for dof, row in data.get("standard_errors", {}).items()
            }
            quality = Quality.from_dict(data["quality"]) if "quality" in data else None
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise ModelError(
                f"kinematics: {error!s} is missing or wrong; generate the model anew."
            ) from None
        if not (np.isfinite(coefficients).all() and np.isfinite(box).all() and 0.0 < dt < np.inf):
            raise ModelError("kinematics: holds NaN, inf or dt <= 0; generate the model anew.")
        return cls(
            variables, dofs, units, powers, coefficients.reshape(len(dofs), len(names)), dt,
            box[:, 0], box[:, 1], assumed, quality=quality,
        ).with_errors(errors)  # fmt: skip
