"""Textbook terms for inputs that a drive did not move. Opt-in only."""

from dataclasses import dataclass, field

import numpy as np

from nics_drl_bridge.robot.kinds import Textbook, textbook
from nics_drl_bridge.robot.spec import RobotSpec
from nics_drl_bridge.robot.taylor import TaylorModel

MIN_OPERATING_POINT = 1e-3
DIFFERENCE = 1e-4


def assume_textbook(
    model: TaylorModel, spec: RobotSpec, unmoved: tuple[str, ...]
) -> tuple[TaylorModel, tuple[str, ...]]:
    """Adds textbook terms for inputs that never moved; ConfigError: the spec names no textbook."""
    # A fit at a constant input is a section through the whole model: `wz = c speed`, measured at
    # the steering angle s0, becomes `wz = (c/s0) speed*steering`; at s0 = 0 by the parameters.
    named = model.named
    rows = {dof: dict(terms) for dof, terms in named.terms.items()}
    point = dict(zip(model.variables, (model.low + model.high) / 2.0, strict=True))
    found = _Completion(model.dt, spec, textbook(spec), unmoved, point, rows, list(model.assumed))
    for i, variable in enumerate(spec.state):
        if variable.name in unmoved:
            found.restore_twist(i)
    for i in range(len(spec.state)):
        found.restore_rate(i)
    completed = named.model_copy(update={"terms": rows, "assumed": tuple(found.assumed)})
    return completed.model(), tuple(found.notes)


@dataclass(frozen=True)
class _Completion:
    dt: float  # step of the model [s]
    spec: RobotSpec
    book: Textbook
    unmoved: tuple[str, ...]
    point: dict[str, float]  # middle of the range of each variable
    rows: dict[str, dict[str, float]]  # coefficients by dof and term, to be completed
    assumed: list[tuple[str, str]]  # dof and term
    notes: list[str] = field(default_factory=list)

    def restore_twist(self, i: int) -> None:
        """Restores the products with state variable `i` in the body twist."""
        name = self.spec.state[i].name
        for d, dof in enumerate(("vx", "vy", "wz")):
            for product in self.book.structure[dof]:
                factors = product.split("*")
                if name not in factors:
                    continue
                factors.remove(name)
                learnt, value = self.rows[dof].pop("*".join(factors) or "1", None), self.point[name]
                if learnt is not None and abs(value) > MIN_OPERATING_POINT:
                    coefficient, source = learnt / value, f"measured at {name} = {value:g}"
                else:
                    coefficient = self._slope(d, product)
                    source = "from the parameters in the robot's YAML file"
                if coefficient == 0.0:
                    continue
                self.rows[dof][product] = coefficient
                self.assumed.append((dof, product))
                self.notes.append(
                    f"Assumed, not learnt: {dof} = {coefficient:.4g}*{product} ({source}), since "
                    f"{name} never moved; to learn it, drive with {name} over its whole range."
                )

    def _slope(self, d: int, product: str) -> float:
        """Returns the coefficient of a product of state variables in the textbook twist, at 0."""
        index = [i for i, v in enumerate(self.spec.state) if v.name in product.split("*")]
        value = 0.0
        for signs in 1.0 - 2.0 * np.array(list(np.ndindex(*(2,) * len(index)))):
            state = np.zeros(len(self.spec.state))
            state[index] = DIFFERENCE * signs
            value += float(np.prod(signs) * self.book.twist(state)[d])
        return value / (2.0 * DIFFERENCE) ** len(index)

    def restore_rate(self, i: int) -> None:
        """Makes a state follow the commands that never moved, with its lag (learnt or nominal)."""
        book, name, commands = self.book, self.spec.state[i].name, self.spec.command
        row, here = self.rows[f"d_{name}"], np.array([self.point[c.name] for c in commands])
        rate = -row[name] if name in row else float(-np.expm1(-self.dt / book.lag[i])) / self.dt
        added, constant = {}, 0.0
        for j, command in enumerate(commands):
            step = np.where(np.arange(len(commands)) == j, DIFFERENCE, 0.0)
            slope = (book.target(here + step)[i] - book.target(here - step)[i]) / (2.0 * DIFFERENCE)
            if command.name in self.unmoved and not abs(slope) < 1e-9:
                added[command.name] = rate * float(slope)
                constant -= added[command.name] * here[j]
        if not added:
            return
        if name not in row:
            added[name] = -rate
        constant += row.pop("1", 0.0)
        if name in row and abs(constant) > 1e-9 * rate:
            row["1"] = constant
        row.update(added)
        self.assumed.extend((f"d_{name}", term) for term in added)
        self.notes.append(
            f"Assumed, not learnt: {name} follows {', '.join(t for t in added if t != name)} with "
            f"a lag of {book.lag[i]:g} s as in the robot's YAML file."
        )
