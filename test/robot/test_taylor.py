from copy import deepcopy
from math import comb

import numpy as np
import pytest

from nics_drl_bridge import geometry
from nics_drl_bridge.config import dump_yaml, parse_yaml, validate
from nics_drl_bridge.errors import BridgeError, ConfigError
from nics_drl_bridge.robot.taylor import (
    NamedTaylorModel,
    TaylorModel,
    evaluate,
    format_term,
    list_exponents,
    make_sort_key,
    parse_term,
)


@pytest.fixture
def model():
    """vx = 2 s, vy = 0, wz = -s c, ds = -3 s + 3 c."""
    return TaylorModel(
        variables=("s", "c"),
        dofs=("vx", "vy", "wz", "d_s"),
        dof_units=("m/s", "m/s", "rad/s", "m/s/s"),
        powers=np.array([[1, 0], [0, 1], [1, 1]]),
        coefficients=np.array([[2.0, 0, 0], [0, 0, 0], [0, 0, -1.0], [-3.0, 3.0, 0]]),
        dt=0.1,
        low=np.array([-1.0, -2.0]),
        high=np.array([1.0, 2.0]),
        assumed=(("wz", "s*c"),),
    )


def test_rates_are_the_coefficients_times_the_terms(model):
    assert np.allclose(model.rates([0.5, 2.0]), [1.0, 0.0, -1.0, 4.5])
    assert model.rates(np.ones((3, 4, 2))).shape == (3, 4, 4)
    assert (model.state_size, model.terms_kept) == (1, 4)


def test_a_step_follows_the_arc_and_adds_to_the_state(model):
    pose, state = model.step([1.0, 2.0, 0.5], [0.5], [2.0])
    expected = geometry.compose([1.0, 2.0, 0.5], geometry.exp([0.1, 0.0, -0.1]))
    assert np.allclose(pose, expected)
    assert np.allclose(state, [0.95])


def test_the_equations_read_as_formulas_with_units(model):
    assert model.equations() == [
        "vx = 2*s  [m/s]",
        "vy = 0  [m/s]",
        "wz = -1*s*c (assumed)  [rad/s]",
        "d_s = -3*s + 3*c  [m/s/s]",
    ]


def test_a_model_reads_back_from_yaml_to_the_same_bits(model):
    rng = np.random.default_rng(0)
    odd = rng.normal(size=(4, 3)) * 10.0 ** rng.uniform(-12, 12, (4, 3))
    model = TaylorModel(**{**vars(model), "coefficients": odd, "dt": 0.1 / 3.0})
    back = read(model.named.model_dump(exclude_none=True))
    assert back.named == model.named
    for name, value in vars(model).items():
        assert np.array_equal(getattr(back, name), value), name


def read(data):
    """The model in the plain data of a file."""
    plain = parse_yaml(dump_yaml(data), "model.yaml")
    return validate(plain, NamedTaylorModel, "model.yaml").model()


def broken(model, path, value):
    data = deepcopy(model.named.model_dump(exclude_none=True))
    *folders, last = path
    inner = data
    for folder in folders:
        inner = inner[folder]
    if value is KeyError:
        del inner[last]
    else:
        inner[last] = value
    return data


@pytest.mark.parametrize("key", ["dt", "units", "terms", "valid", "assumed"])
def test_a_missing_key_is_named(model, key):
    with pytest.raises(ConfigError, match=f"the key '{key}' is missing; add it"):
        read(broken(model, [key], KeyError))


@pytest.mark.parametrize(
    ("path", "value"),
    [
        (["dt"], 0.0),
        (["dt"], float("nan")),
        (["dt"], float("inf")),
        (["terms", "vx"], None),
        (["terms", "vx", "s"], True),
        (["terms", "vx", "s"], float("nan")),
        (["terms", "vx", "ghost"], 1.0),
        (["terms", "vx", "s^-1"], 1.0),
        (["terms", "vx", f"s^{10**30}"], 1.0),
        (["colour"], "red"),
        (["units", "wz"], KeyError),
        (["valid"], {"s": [0.0], "c": [1.0]}),
        (["assumed"], [["wz"]]),
    ],
)
def test_what_is_wrong_is_one_sentence(model, path, value):
    with pytest.raises(BridgeError, match=r"^(model\.yaml|kinematics): [^\n]*$"):
        read(broken(model, path, value))


NAMES = ("speed", "steering", "push")


@pytest.mark.parametrize("variables", [1, 2, 4, 7])
@pytest.mark.parametrize("order", [0, 1, 2, 3])
def test_every_product_stands_once_the_constant_first_by_order(variables, order):
    powers = list_exponents(variables, order)
    assert powers.shape == (comb(variables + order, order), variables)
    assert len({tuple(row) for row in powers}) == len(powers)
    assert powers[0].sum() == 0
    assert (np.diff(powers.sum(axis=1)) >= 0).all()
    assert powers[-1].sum() == order
    shuffled = np.random.default_rng(2).permutation(powers)
    assert np.array_equal(sorted(shuffled, key=make_sort_key), powers)


def test_features_of_a_batch_are_products_of_powers():
    x = np.random.default_rng(1).normal(size=(5, 6, 3))
    powers = list_exponents(3, 3)
    chi = evaluate(x, powers)
    assert chi.shape == (5, 6, len(powers))
    assert np.allclose(chi, np.prod(x[..., None, :] ** powers, axis=-1))


def test_each_term_has_a_name_of_its_own_that_reads_back():
    powers = list_exponents(3, 3)
    names = [format_term(row, NAMES) for row in powers]
    assert len(set(names)) == len(names)
    assert names[0] == "1"
    assert "speed*push^2" in names
    for name, row in zip(names, powers, strict=True):
        assert np.array_equal(parse_term(name, NAMES), row)


@pytest.mark.parametrize(
    "text", ["", "nonsense", "speed*", "speed^x", "speed^0", "speed^0.5", "2*speed"]
)
def test_what_is_no_term_is_refused(text):
    with pytest.raises(ValueError, match=r"term|literal"):
        parse_term(text, NAMES)
