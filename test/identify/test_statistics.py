from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.signal import lfilter

from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.identify.calibration import parse_alpha
from nics_drl_bridge.identify.fit import fit
from nics_drl_bridge.identify.statistics import (
    compute_condition,
    cross_validated,
    estimate_clustered_errors,
    estimate_standard_errors,
    find_correlation_reach,
    find_knee,
    minimise_robustly,
)
from nics_drl_bridge.recording.recording import Samples
from nics_drl_bridge.recording.textbook import record
from nics_drl_bridge.robot import taylor
from nics_drl_bridge.robot.spec import load_robot

RATE = 9.5163
KNOWN = {
    "ackermann": {
        "vx": {"speed": 1.0},
        "wz": {"speed*steering": 5.0},
        "d_speed": {"speed": -RATE, "speed_command": RATE},
        "d_steering": {"steering": -RATE, "steering_command": RATE},
    },
    "differential": {
        "vx": {"left_wheel": 0.025, "right_wheel": 0.025},
        "wz": {"left_wheel": -0.25, "right_wheel": 0.25},
        "d_left_wheel": {
            "left_wheel": -RATE,
            "forward_command": 190.3,
            "turn_command": -19.03,
        },
        "d_right_wheel": {
            "right_wheel": -RATE,
            "forward_command": 190.3,
            "turn_command": 19.03,
        },
    },
    "mecanum": {
        "vx": {"front_left_wheel": 0.025, "front_right_wheel": 0.025},
        "vy": {"front_left_wheel": -0.025, "rear_left_wheel": 0.025},
        "wz": {"front_right_wheel": 0.125, "rear_left_wheel": -0.125},
    },
}


def noisy_samples(spec, seed, alike=0.9, size=0.05):
    """Samples whose rates are known polynomials, with noise like that of smoothed poses."""
    rng = np.random.default_rng(seed)
    drive = record(spec, rng, duration=30.0, dt=0.02)
    x = np.concatenate([drive.state.values, drive.command.values], axis=1)
    dq = np.zeros((len(x), len(spec.dof_names)))
    for dof, row in KNOWN[spec.name].items():
        powers = np.array(
            [taylor.parse_term(term, spec.variable_names) for term in row]
        )
        d = spec.dof_names.index(dof)
        dq[:, d] = taylor.evaluate(x, powers) @ np.array(list(row.values()))
    noise = lfilter([1.0], [1.0, -alike], rng.normal(size=dq.shape), axis=0)
    noise *= 0.5 + np.linspace(0.0, 1.0, len(x))[:, None]
    dq += size * dq.std(axis=0) * noise / np.maximum(noise.std(axis=0), 1e-9)
    return Samples(drive.pose.t, np.zeros_like(dq), x, dq, 0.02)


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(KNOWN))
def test_known_coefficients_lie_within_three_standard_errors(name):
    spec = load_robot(name)
    inside = []
    short = []
    for seed in range(15):
        result = fit(noisy_samples(spec, seed), spec, order=1, noisy=True)
        terms = result.model.named.terms
        errors = result.model.named_errors
        for dof, row in KNOWN[name].items():
            if dof == "wz" and name == "ackermann":
                continue
            for term, value in row.items():
                off = abs(terms[dof].get(term, 0.0) - value) / errors[dof].get(
                    term, 1e-12
                )
                inside.append(off < 3.0)
                short.append(off < 1.0)
    assert np.mean(inside) > 0.95
    assert 0.4 < np.mean(short) < 0.95  # nor are they wide for nothing


def test_errors_of_white_noise_are_the_textbooks():
    rng = np.random.default_rng(0)
    chi = rng.normal(size=(5000, 3)) * [1.0, 10.0, 0.1]
    residual = rng.normal(size=5000) * 0.3
    plain = 0.3 * np.sqrt(np.diag(np.linalg.inv(chi.T @ chi)))
    assert estimate_standard_errors(chi, residual) == pytest.approx(plain, rel=0.15)
    blocks = np.arange(5000) // 50
    assert estimate_clustered_errors(chi, residual, blocks) == pytest.approx(
        plain, rel=0.25
    )


def test_errors_grow_with_residuals_that_resemble_their_neighbours():
    rng = np.random.default_rng(1)
    chi = lfilter([1.0], [1.0, -0.95], rng.normal(size=(4000, 1)), axis=0)
    residual = lfilter([1.0], [1.0, -0.95], rng.normal(size=4000))
    plain = residual.std() * np.sqrt(1.0 / (chi.T @ chi)[0, 0])
    assert estimate_standard_errors(chi, residual)[0] > 3.0 * plain
    assert find_correlation_reach(residual) > 40


def test_the_condition_number_does_not_depend_on_units():
    chi = np.random.default_rng(2).normal(size=(500, 4))
    assert compute_condition(chi * [1.0, 1e3, 1e-3, 1.0]) == pytest.approx(
        compute_condition(chi)
    )
    assert compute_condition(np.zeros((10, 0))) == 1.0


def test_the_knee_is_where_further_terms_gain_nothing():
    none = np.zeros(5)
    assert find_knee(np.array([1.0, 0.5, 0.1, 0.0999, 0.0998]), none) == 2
    assert find_knee(np.array([1.0, 0.5, 0.1, 0.05, 0.049]), none + 0.06) == 2
    assert find_knee(np.array([1.0, 1.1, 1e-9, 1e-9, 2e-9]), none) == 2


def test_cross_validation_is_that_of_separate_fits():
    rng = np.random.default_rng(3)
    chi = rng.normal(size=(100, 3))
    target = rng.normal(size=100)
    squares = cross_validated(chi, target)
    for block, rows in enumerate(np.array_split(np.arange(100), 5)):
        others = np.setdiff1d(np.arange(100), rows)
        for n in range(4):
            beta = np.linalg.lstsq(chi[others, :n], target[others], rcond=None)[0]
            rest = target[rows] - chi[rows, :n] @ beta
            assert squares[block, n] == pytest.approx((rest**2).mean())


@pytest.mark.parametrize("order", [1, 4])
def test_auto_keeps_what_is_worth_it_at_every_order(order):
    spec = load_robot("differential")
    result = fit(noisy_samples(spec, 1), spec, order=order, alpha="auto", noisy=True)
    terms = result.model.named.terms
    assert set(terms["vx"]) == {"left_wheel", "right_wheel"}
    assert set(terms["wz"]) == {"left_wheel", "right_wheel"}
    for curve in result.curves:
        assert len(curve.error) == len(curve.terms) + 1
        assert curve.error[curve.kept] <= curve.error[0]


@pytest.mark.parametrize("text", ["1.5", "-0.1", "nan", "automatic", ""])
def test_an_alpha_that_is_none_is_refused(text):
    with pytest.raises(ConfigError, match="a number from 0 to 1, or auto"):
        parse_alpha(text)


def test_alpha_is_read_as_written():
    assert parse_alpha("auto") == "auto"
    assert parse_alpha("0.9") == 0.9


UNBOUNDED = np.full(2, np.inf)


def decay(with_outliers: bool):
    """Returns residual and Jacobian of rows that decay, by their size and their rate."""
    t = np.linspace(0.0, 4.0, 60)
    y = 3.0 * np.exp(-0.7 * t) + np.random.default_rng(0).normal(0.0, 0.01, len(t))
    if with_outliers:
        y[::7] += 2.0

    def slopes(theta):
        decayed = np.exp(-theta[1] * t)
        return np.stack([decayed, -theta[0] * t * decayed], axis=1)

    return lambda theta: theta[0] * np.exp(-theta[1] * t) - y, slopes


@pytest.mark.parametrize("with_outliers", [False, True])
def test_a_robust_minimum_is_that_of_another_solver(with_outliers):
    residual, slopes = decay(with_outliers)
    start = np.array([1.0, 0.1])
    ours = minimise_robustly(residual, slopes, start, (-UNBOUNDED, UNBOUNDED), 0.02, 60)
    theirs = least_squares(residual, start, slopes, loss="soft_l1", f_scale=0.02)
    assert ours == pytest.approx(theirs.x, rel=2e-3)
    assert ours == pytest.approx([3.0, 0.7], rel=0.01)


def test_a_robust_minimum_lies_within_its_bounds_and_is_free_to_leave_them():
    residual, slopes = decay(False)
    low = np.array([0.0, 0.9])
    start = np.array([1.0, 2.0])
    at = minimise_robustly(residual, slopes, start, (low, UNBOUNDED), 0.02, 60)
    theirs = least_squares(
        residual, start, slopes, (low, np.inf), loss="soft_l1", f_scale=0.02
    )
    assert at[1] == 0.9
    assert at == pytest.approx(theirs.x, rel=2e-3)
    away = minimise_robustly(residual, slopes, low, (low * 0.1, UNBOUNDED), 0.02, 60)
    assert away == pytest.approx([3.0, 0.7], rel=0.01)


def test_a_robust_search_keeps_to_its_evaluations_and_gets_no_worse():
    residual, slopes = decay(True)
    start = np.array([1.0, 0.1])
    asked = []

    def counted(theta):
        asked.append(theta)
        return residual(theta)

    found = minimise_robustly(counted, slopes, start, (-UNBOUNDED, UNBOUNDED), 0.02, 8)
    assert len(asked) == 8
    assert np.abs(residual(found)).sum() < np.abs(residual(start)).sum()


@pytest.mark.parametrize(
    "columns", [(0, 0), (1, 2), ()], ids=["twice", "with zeros", "none"]
)
def test_a_robust_search_bears_columns_that_tell_nothing(columns):
    t = np.linspace(0.0, 1.0, 20)
    slopes = np.stack([t, np.ones(20), np.zeros(20)], axis=1)[:, list(columns)]
    target = slopes @ np.full(len(columns), 2.0)
    asked = []

    def residual(theta):
        asked.append(theta)
        return slopes @ theta - target

    start = np.zeros(len(columns))
    far = np.full(len(columns), np.inf)
    found = minimise_robustly(residual, lambda _: slopes, start, (-far, far), 1.0, 40)
    assert slopes @ found == pytest.approx(target, abs=1e-3)
    assert len(asked) < 40
    asked.clear()
    minimise_robustly(residual, lambda _: slopes, start, (start, start), 1.0, 9)
    assert len(asked) < 4  # nothing may move


def test_a_robust_search_goes_on_where_a_bound_cuts_a_step_of_correlated_parameters():
    slopes = np.array([[1.0, 0.99], [0.99, 1.0], [0.01, 0.0]])
    target = slopes @ np.array([-3.0, 4.0])
    bounds = np.array([-1.0, -10.0]), np.array([10.0, 10.0])
    found = minimise_robustly(
        lambda z: slopes @ z - target, lambda _: slopes, np.ones(2), bounds, 10.0, 60
    )
    theirs = least_squares(
        lambda z: slopes @ z - target,
        np.ones(2),
        bounds=bounds,
        loss="soft_l1",
        f_scale=10.0,
    )
    assert found == pytest.approx(theirs.x, abs=0.02)


def test_a_robust_search_refuses_a_start_that_is_not_finite():
    with pytest.raises(ValueError, match="not finite"):
        minimise_robustly(
            lambda z: z * np.nan, None, np.ones(2), (-UNBOUNDED, UNBOUNDED), 1.0, 9
        )
