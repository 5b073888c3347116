from __future__ import annotations

import numpy as np
import pytest

from nics_drl_bridge.errors import FitError
from nics_drl_bridge.identify.fit import fit, prune
from nics_drl_bridge.recording.recording import Samples
from nics_drl_bridge.robot import taylor
from nics_drl_bridge.robot.spec import RobotSpec

PAIR = RobotSpec.model_validate(
    {
        "name": "pair",
        "footprint_radius": 0.1,
        "command": [
            {
                "name": "a",
                "unit": "m/s",
                "min": -1.0,
                "max": 1.0,
                "cmd_vel": "linear.x",
            },
            {
                "name": "b",
                "unit": "rad/s",
                "min": -1.0,
                "max": 1.0,
                "cmd_vel": "angular.z",
            },
        ],
    }
)


def samples_of(x, dq, dt=0.01):
    t = np.arange(len(x)) * dt
    return Samples(t, np.zeros((len(x), dq.shape[1])), x, dq, dt)


def random_x(count=400, seed=0):
    return np.random.default_rng(seed).uniform(-1.0, 1.0, (count, 2))


def rates_of(x):
    a, b = x.T
    return np.stack([2.0 * a - 0.5 * a * b, 0.3 + b**2, -1.5 * b], axis=1)


def term(model, dof, name):
    return model.named.terms[dof].get(name, 0.0)


def test_a_polynomial_of_second_order_is_found_with_its_own_terms_only():
    x = random_x()
    result = fit(samples_of(x, rates_of(x)), PAIR, alpha=1.0)
    terms = result.model.named.terms
    assert {dof: set(named) for dof, named in terms.items()} == {
        "vx": {"a", "a*b"},
        "vy": {"1", "b^2"},
        "wz": {"b"},
    }
    assert term(result.model, "vx", "a*b") == pytest.approx(-0.5, abs=1e-12)
    assert term(result.model, "vy", "1") == pytest.approx(0.3, abs=1e-12)
    assert result.rmse.max() < 1e-12
    assert result.r2.min() > 1.0 - 1e-12
    assert result.regression.terms_total == 18
    assert (result.unmoved, result.regression.dependent) == ((), ())


@pytest.mark.parametrize(
    ("beta", "alpha", "kept"),
    [
        ([4.0, 3.0, 2.0, 1.0], 0.35, [0]),  # 4 crosses 3.5
        ([4.0, 3.0, 2.0, 1.0], 0.45, [0, 1]),  # 4 < 4.5 < 7
        ([-4.0, 3.0, -2.0, 1.0], 0.75, [0, 1, 2]),  # signs do not matter
        ([1.0, 2.0, 3.0, 4.0], 0.75, [1, 2, 3]),  # nor does the order
        ([4.0, 3.0, 2.0, 1.0], 1.0, [0, 1, 2, 3]),
        ([1.0, 1.0], 0.99, [0, 1]),  # the wheels of a differential robot
        ([1.0, 0.0], 1.0, [0]),
        ([0.0, 0.0], 1.0, []),
    ],
)
def test_eq_2_keeps_the_largest_terms_and_the_one_that_crosses(beta, alpha, kept):
    assert np.flatnonzero(prune(np.array(beta), alpha)).tolist() == kept


def test_rounding_errors_never_count_as_terms():
    assert prune(np.array([1.0, 1e-12]), 1.0, noise_floor=1e-9).tolist() == [
        True,
        False,
    ]


def test_the_weight_of_a_term_does_not_depend_on_its_unit():
    x = random_x()
    plain = fit(samples_of(x, rates_of(x)), PAIR, alpha=0.8).model
    scaled = PAIR.model_dump()
    forward, turn = scaled["command"]
    scaled["command"] = [forward | {"min": -1000.0, "max": 1000.0}, turn]
    wide = RobotSpec.model_validate(scaled)
    larger = fit(samples_of(x * [1000.0, 1.0], rates_of(x)), wide, alpha=0.8).model
    assert term(larger, "vx", "a") == pytest.approx(term(plain, "vx", "a") / 1000.0)
    assert larger.terms_kept == plain.terms_kept < 5


def test_a_drive_of_constant_commands_is_refused():
    x = np.full((400, 2), 0.3)
    with pytest.raises(FitError, match="no command ever changed"):
        fit(samples_of(x, rates_of(x)), PAIR)


def test_too_few_samples_are_refused():
    x = random_x(29)
    with pytest.raises(FitError, match="29 samples are too few for 6 terms"):
        fit(samples_of(x, rates_of(x)), PAIR)


def test_terms_that_noise_could_have_made_are_dropped_from_a_noisy_fit():
    x = random_x(4000)
    dq = rates_of(x)
    dq += np.random.default_rng(4).normal(size=dq.shape) * 0.1
    clean = fit(samples_of(x, dq), PAIR, alpha=1.0, noisy=True)
    assert (
        clean.model.terms_kept <= 7
    )  # 5 are true, two in 18 may slip through three sigma
    for dof, name in (
        ("vx", "a"),
        ("vx", "a*b"),
        ("vy", "1"),
        ("vy", "b^2"),
        ("wz", "b"),
    ):
        assert term(clean.model, dof, name) != 0.0
    assert fit(samples_of(x, dq), PAIR, alpha=1.0).model.terms_kept == 18
    assert clean.rmse == pytest.approx([0.1, 0.1, 0.1], rel=0.05)


def test_the_errors_are_those_of_the_pruned_model():
    x = random_x()
    dq = rates_of(x)
    result = fit(samples_of(x, dq), PAIR, alpha=0.3)
    residual = (
        dq - taylor.evaluate(x, result.model.powers) @ result.model.coefficients.T
    )
    assert result.model.terms_kept < 5
    assert result.rmse == pytest.approx(np.sqrt((residual**2).mean(axis=0)))
    assert result.r2 == pytest.approx(
        1.0 - residual.var(axis=0) / dq.var(axis=0), abs=0.02
    )
