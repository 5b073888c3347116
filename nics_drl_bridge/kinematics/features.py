"""Features of the Taylor model: the products of the variables up to an order (Eq. 1)."""

from __future__ import annotations

from itertools import combinations_with_replacement

import numpy as np
from numpy.typing import ArrayLike, NDArray


def exponents(variables: int, order: int) -> NDArray[np.int64]:
    """The distinct products of up to `order` variables.

    `chi = vec([1, X] (x) [1, X])` of Eq. 1 holds every mixed product twice; each stands here
    once.

    Args:
        variables: V, the size of X.
        order: of the Taylor expansion; the paper's is 2.

    Returns:
        (K, V) exponent of each variable in each term: the constant first, then by order.
    """
    rows = []
    for degree in range(order + 1):
        for chosen in combinations_with_replacement(range(variables), degree):
            rows.append(np.bincount(np.array(chosen, dtype=np.int64), minlength=variables))
    return np.array(rows, dtype=np.int64).reshape(len(rows), variables)


def evaluate(x: ArrayLike, powers: NDArray[np.int64]) -> NDArray[np.float64]:
    """The features chi (..., K) of variables x (..., V) for exponents (K, V)."""
    x = np.asarray(x, dtype=np.float64)
    chi = np.ones((*x.shape[:-1], len(powers)))
    for k, row in enumerate(powers):
        for variable in np.flatnonzero(row):
            chi[..., k] *= x[..., variable] ** row[variable]
    return chi


def term_name(row: NDArray[np.int64], names: tuple[str, ...]) -> str:
    """A term as text: `1`, `speed`, `speed*steering`, `speed^2`."""
    factors = [names[v] if row[v] == 1 else f"{names[v]}^{row[v]}" for v in np.flatnonzero(row)]
    return "*".join(factors) or "1"


def canonical(row: NDArray[np.int64]) -> tuple[int, ...]:
    """Sorts exponents (V,) as `exponents` lists them: by order, then by variable."""
    return (int(row.sum()), *(-int(power) for power in row))


def parse_term(text: str, names: tuple[str, ...]) -> NDArray[np.int64]:
    """The exponents (V,) of a term that `term_name` wrote. Raises ValueError otherwise."""
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
