"""Textbook terms for inputs that a drive did not move; opt-in only."""

from dataclasses import dataclass, field

import numpy as np

from nics_drl_bridge.identify.verdict import Gap
from nics_drl_bridge.identify.yardstick import probe_structure
from nics_drl_bridge.robot.kinds import Textbook, reach, textbook
from nics_drl_bridge.robot.spec import POSE_RATES, RobotSpec
from nics_drl_bridge.robot.taylor import TaylorModel

MIN_OPERATING_POINT = 1e-3
DIFFERENCE = 1e-4


def assume_textbook(
    model: TaylorModel, spec: RobotSpec, unmoved: tuple[str, ...]
) -> tuple[TaylorModel, tuple[str, ...]]:
    """Adds textbook terms for inputs that never moved; ConfigError if the spec has no textbook."""
    # A fit at a constant input is a section through the full model: `wz = c speed`, measured at
    # the steering angle s0, becomes `wz = (c/s0) speed*steering`; at s0 = 0, the textbook's
    # parameters are used.
    named = model.named
    rows = {dof: dict(terms) for dof, terms in named.terms.items()}
    point = dict(zip(model.variables, (model.low + model.high) / 2.0, strict=True))
    completion = _Completion(
        model.dt, spec, textbook(spec), unmoved, point, rows, list(model.assumed)
    )
    for i, variable in enumerate(spec.state):
        if variable.twist:  # by definition
            rows[variable.twist] = {variable.name: 1.0}
        elif variable.name in unmoved:
            completion.restore_twist(i)
    for i in range(len(spec.state)):
        completion.restore_rate(i)
    update = {
        "terms": rows,
        "assumed": tuple(completion.assumed),
        "valid": completion.widened(named.valid),
    }
    return named.model_copy(update=update).model(), tuple(completion.notes)


@dataclass(frozen=True)
class _Completion:
    dt: float  # step of the model [s]
    spec: RobotSpec
    book: Textbook
    unmoved: tuple[str, ...]
    point: dict[str, float]  # middle of each variable's range
    rows: dict[str, dict[str, float]]  # coefficients by dof and term, to be completed
    assumed: list[tuple[str, str]]  # (dof, term) pairs
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
                learnt = self.rows[dof].pop("*".join(factors) or "1", None)
                value = self.point[name]
                if learnt is not None and abs(value) > MIN_OPERATING_POINT:
                    coefficient = learnt / value
                    source = f"measured at {name} = {value:g}"
                else:
                    coefficient = self._slope(d, product)
                    source = self.source
                if coefficient == 0.0:
                    continue
                self.rows[dof][product] = coefficient
                self.assumed.append((dof, product))
                term = f"{dof} = {coefficient:.4g}*{product} ({source})"
                finding = f"{term}, since {name} never moved"
                advice = f"to learn it, drive with {name} over its whole range"
                self.notes.append(Gap(f"Assumed, not learnt: {finding}; {advice}."))

    def _slope(self, d: int, product: str) -> float:
        """Returns the coefficient of a product of state variables in the textbook twist, at 0."""
        index = [
            i for i, v in enumerate(self.spec.state) if v.name in product.split("*")
        ]
        value = 0.0
        for signs in 1.0 - 2.0 * np.array(list(np.ndindex(*(2,) * len(index)))):
            state = np.zeros(len(self.spec.state))
            state[index] = DIFFERENCE * signs
            value += float(np.prod(signs) * self.book.twist(state)[d])
        return value / (2.0 * DIFFERENCE) ** len(index)

    def widened(
        self, valid: dict[str, tuple[float, float]]
    ) -> dict[str, tuple[float, float]]:
        """Returns the ranges, widened to what commands can reach for assumed parts of the twist."""
        assumed = {dof for dof, _ in self.assumed}
        for variable in self.spec.state:
            if variable.twist and f"d_{variable.name}" in assumed:
                far = float(reach(self.spec)[POSE_RATES.index(variable.twist)])
                low, high = valid[variable.name]
                valid = valid | {variable.name: (min(low, -far), max(high, far))}
        return valid

    @property
    def source(self) -> str:
        """States where the textbook's parameters come from."""
        assumed = ", ".join(self.spec.assumed)
        if not assumed:
            return "from the parameters in the robot's YAML file"
        return f"by default, because the robot's YAML file gives no {assumed}"

    def restore_rate(self, i: int) -> None:
        """Makes a state follow the commands that never moved, with its lag (learnt or nominal)."""
        name = self.spec.state[i].name
        row = self.rows[f"d_{self.spec.state[i].name}"]
        lag = float(self.book.lag[i])
        source = f" ({self.source})"
        rate = float(-np.expm1(-self.dt / lag)) / self.dt
        if name in row:
            rate = -row[name]
            lag = -1.0 / row[name]
            source = ""
        added = self._turning(i, row, rate)
        if added is None:
            added = self._following(i, row, rate)
        if not added:
            return
        if name not in row:
            added[name] = -rate
        row.update(added)
        self.assumed.extend((f"d_{name}", term) for term in added)
        follows = ", ".join(term for term in added if term != name)
        self.notes.append(
            Gap(
                f"Assumed, not learnt: {name} follows {follows} with a lag of {lag:.3g} s{source}."
            )
        )

    def _following(
        self, i: int, row: dict[str, float], rate: float
    ) -> dict[str, float]:
        """Returns the terms by which a state follows commands, one per command."""
        commands = self.spec.command
        target = self.book.target
        here = np.array([self.point[c.name] for c in commands])
        added = {}
        constant = 0.0
        for j, command in enumerate(commands):
            step = np.where(np.arange(len(commands)) == j, DIFFERENCE, 0.0)
            slope = (target(here + step)[i] - target(here - step)[i]) / (
                2.0 * DIFFERENCE
            )
            if command.name in self.unmoved and not abs(slope) < 1e-9:
                added[command.name] = rate * float(slope)
                constant -= added[command.name] * here[j]
        if added:
            constant += row.pop("1", 0.0)
            if self.spec.state[i].name in row and abs(constant) > 1e-9 * rate:
                row["1"] = constant
        return added

    def _turning(
        self, i: int, row: dict[str, float], rate: float
    ) -> dict[str, float] | None:
        """Returns the term by which a car turns whose state is its twist; None for other rates.

        It is the product of speed and steering, measured at a constant if there is one.
        """
        structure = probe_structure(self.spec)
        state = {v.twist: v.name for v in self.spec.state}
        turned = self.spec.state[i].twist == "wz" and "vx" in state
        if structure is None or not structure[1].used or not turned:
            return None
        k = int(np.argmax(np.abs(structure[0][2])))
        names = state["vx"], self.spec.command[k].name
        still = [name for name in names if name in self.unmoved]
        if not still:
            return {}
        learnt = row.pop(
            "*".join(name for name in names if name not in still) or "1", None
        )
        value = float(np.prod([self.point[name] for name in still]))
        if learnt is not None and abs(value) > MIN_OPERATING_POINT:
            return {"*".join(names): learnt / value}
        return {
            "*".join(names): rate * float(structure[0][2, k]) / structure[1].wheelbase
        }
