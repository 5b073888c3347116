from __future__ import annotations

from math import comb

import numpy as np
import pytest

from nics_drl_bridge.robot.taylor import canonical, evaluate, exponents, parse_term, term_name

NAMES = ("speed", "steering", "push")


@pytest.mark.parametrize("variables", [1, 2, 4, 7])
@pytest.mark.parametrize("order", [0, 1, 2, 3])
def test_every_product_stands_once(variables, order):
    powers = exponents(variables, order)
    assert powers.shape == (comb(variables + order, order), variables)
    assert len({tuple(row) for row in powers}) == len(powers)
    assert (powers.sum(axis=1) <= order).all()


def test_the_constant_comes_first_and_orders_ascend():
    powers = exponents(3, 3)
    assert not powers[0].any()
    assert (np.diff(powers.sum(axis=1)) >= 0).all()


def test_the_features_are_the_distinct_entries_of_the_kronecker_product():
    x = np.random.default_rng(0).normal(size=4)
    with_one = np.concatenate([[1.0], x])
    kronecker = np.unique(np.round(np.kron(with_one, with_one), 12))
    ours = np.unique(np.round(evaluate(x, exponents(4, 2)), 12))
    assert np.array_equal(ours, kronecker)


def test_features_of_a_batch_are_products_of_powers():
    x = np.random.default_rng(1).normal(size=(5, 6, 3))
    powers = exponents(3, 3)
    chi = evaluate(x, powers)
    assert chi.shape == (5, 6, len(powers))
    assert np.allclose(chi, np.prod(x[..., None, :] ** powers, axis=-1))


def test_each_term_has_a_name_of_its_own_that_reads_back():
    powers = exponents(3, 3)
    names = [term_name(row, NAMES) for row in powers]
    assert len(set(names)) == len(names)
    for name, row in zip(names, powers, strict=True):
        assert np.array_equal(parse_term(name, NAMES), row)


def test_names_read_as_formulas():
    assert term_name(np.array([0, 0, 0]), NAMES) == "1"
    assert term_name(np.array([1, 0, 2]), NAMES) == "speed*push^2"


@pytest.mark.parametrize(
    "text", ["", "nonsense", "speed*", "speed^x", "speed^-1", "speed^0.5", "speed^0", "2*speed"]
)
def test_what_is_no_term_is_refused(text):
    with pytest.raises(ValueError, match=r"term|literal"):
        parse_term(text, NAMES)


def test_terms_sort_as_they_are_listed():
    powers = [tuple(row) for row in exponents(3, 3)]
    shuffled = np.random.default_rng(2).permutation(np.array(powers))
    assert [tuple(row) for row in sorted(shuffled, key=canonical)] == powers
