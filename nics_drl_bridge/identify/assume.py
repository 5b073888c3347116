"""Textbook terms for inputs that a drive did not move. Opt-in only."""

from __future__ import annotations

import numpy as np

from nics_drl_bridge.geometry import Array
from nics_drl_bridge.robot.kinds import Textbook, textbook
from nics_drl_bridge.robot.spec import RobotSpec
from nics_drl_bridge.robot.taylor import TaylorModel

MIN_OPERATING_POINT = 1e-3
DIFFERENCE = 1e-4


def assume_textbook(
    model: TaylorModel, spec: RobotSpec, unmoved: tuple[str, ...]
) -> tuple[TaylorModel, tuple[str, ...]]:
    """Adds terms for inputs that never moved, from the structure of the textbook kinematics.

    A fit at a constant input is a section through the whole model: `wz = c speed`, measured at the
    steering angle s0, becomes `wz = (c/s0) speed*steering`. At s0 = 0 the section shows nothing of
    the input's effect, so the coefficient comes from the spec's parameters. The model lists the new
    terms in `assumed`; a sentence is returned per change. Raises ConfigError: the spec names no
    textbook kinematics.
    """
    book = textbook(spec)
    named = model.named
    rows = {dof: dict(terms) for dof, terms in named.terms.items()}
    point = dict(zip(model.variables, (model.low + model.high) / 2.0, strict=True))
    assumed: list[tuple[str, str]] = list(model.assumed)
    notes: list[str] = []
    for i, variable in enumerate(spec.state):
        if variable.name in unmoved:
            notes += _twist_of_state(rows, assumed, spec, book, i, point)
    if any(variable.name in unmoved for variable in (*spec.state, *spec.command)):
        notes += _rates_of_state(rows, assumed, model, spec, book, unmoved, point)
    completed = named.model_copy(update={"terms": rows, "assumed": tuple(assumed)})
    return completed.model(), tuple(notes)


def _twist_of_state(
    rows: dict[str, dict[str, float]],
    assumed: list[tuple[str, str]],
    spec: RobotSpec,
    book: Textbook,
    i: int,
    point: dict[str, float],
) -> list[str]:
    """Restores the products with state variable `i` in the body twist."""
    name, notes = spec.state[i].name, []
    for d, dof in enumerate(("vx", "vy", "wz")):
        for product in book.structure[dof]:
            factors = product.split("*")
            if name not in factors:
                continue
            factors.remove(name)
            reduced, value = "*".join(factors) or "1", point[name]
            learnt = rows[dof].pop(reduced, None)
            if learnt is not None and abs(value) > MIN_OPERATING_POINT:
                coefficient, source = learnt / value, f"measured at {name} = {value:g}"
            else:
                coefficient = _slope(book, spec, d, product)
                source = "from the parameters in the robot's YAML file"
            if coefficient == 0.0:
                continue
            rows[dof][product] = coefficient
            assumed.append((dof, product))
            notes.append(
                f"Assumed, not learnt: {dof} = {coefficient:.4g}*{product} ({source}), since "
                f"{name} never moved; drive with {name} changing over its whole range to learn it."
            )
    return notes


def _slope(book: Textbook, spec: RobotSpec, d: int, product: str) -> float:
    """Returns the coefficient of a product of state variables in the textbook twist, at zero."""
    index = [i for i, v in enumerate(spec.state) if v.name in product.split("*")]
    value = 0.0
    for signs in np.ndindex(*(2,) * len(index)):
        state = np.zeros(len(spec.state))
        state[index] = DIFFERENCE * (1.0 - 2.0 * np.array(signs))
        value += float(np.prod(1.0 - 2.0 * np.array(signs)) * book.twist(state)[d])
    return value / (2.0 * DIFFERENCE) ** len(index)


def _rates_of_state(
    rows: dict[str, dict[str, float]],
    assumed: list[tuple[str, str]],
    model: TaylorModel,
    spec: RobotSpec,
    book: Textbook,
    unmoved: tuple[str, ...],
    point: dict[str, float],
) -> list[str]:
    """Makes states follow the commands that never moved, with their lag (learnt or nominal)."""
    notes = []
    here = np.array([point[c.name] for c in spec.command])
    for i, variable in enumerate(spec.state):
        row, name = rows[f"d_{variable.name}"], variable.name
        rate = -row[name] if name in row else float(-np.expm1(-model.dt / book.lag[i])) / model.dt
        missing = [j for j, c in enumerate(spec.command) if c.name in unmoved]
        effect = {j: rate * _target_slope(book, here, i, j) for j in missing}
        added = {spec.command[j].name: e for j, e in effect.items() if e != 0.0}
        if not added:
            continue
        if name not in row:
            added[name] = -rate
        constant = row.pop("1", 0.0) - sum(e * here[j] for j, e in effect.items())
        if name in row and abs(constant) > 1e-9 * rate:
            row["1"] = constant
        row.update(added)
        assumed += [(f"d_{name}", term) for term in added]
        notes.append(
            f"Assumed, not learnt: {name} follows {', '.join(t for t in added if t != name)} with "
            f"a lag of {book.lag[i]:g} s as in the robot's YAML file."
        )
    return notes


def _target_slope(book: Textbook, command: Array, i: int, j: int) -> float:
    step = np.zeros_like(command)
    step[j] = DIFFERENCE
    slope = (book.target(command + step)[i] - book.target(command - step)[i]) / (2.0 * DIFFERENCE)
    return 0.0 if abs(slope) < 1e-9 else float(slope)
