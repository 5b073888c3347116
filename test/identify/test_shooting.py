"""Models and delays are found by the errors of predictions over seconds."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from identify.drives import make_model, throttle_car
from nics_drl_bridge import geometry
from nics_drl_bridge.identify.shooting import (
    Parameters,
    Shooting,
    fit_to_predictions,
    predict_along_path,
)
from nics_drl_bridge.recording.recording import Samples
from nics_drl_bridge.robot.kernels import SERIES, make_terms, simulate_rollouts
from nics_drl_bridge.robot.taylor import TaylorModel

DT = 0.02
STEPS = 2000
DELAY = 0.1


@pytest.fixture(scope="module")
def car() -> TaylorModel:
    """vx' = 4 throttle - 2 vx, wz' = 8 steering - 5 wz."""
    spec = throttle_car()
    terms = {
        "vx": {"vx": 1.0},
        "wz": {"wz": 1.0},
        "d_vx": {"vx": -2.0, "throttle": 4.0},
        "d_wz": {"wz": -5.0, "steering": 8.0},
    }
    box = np.zeros(5)
    return make_model(spec, terms, dt=DT, low=box, high=box)


def equally(start, end):
    return np.ones((*np.broadcast_shapes(start.shape, end.shape), 3))


@pytest.fixture(scope="module")
def problem(car) -> Shooting:
    """A drive of it, whose commands act after a delay."""
    rng = np.random.default_rng(2)
    t = DT * np.arange(STEPS + 1)
    command = np.repeat(rng.uniform(-1.0, 1.0, (STEPS // 20, 2)), 20, axis=0)
    late = np.roll(command, round(DELAY / DT), axis=0)
    poses = np.zeros((1, STEPS + 1, 3))
    states = np.zeros((1, STEPS + 1, 3))
    simulate_rollouts(poses, states, late[None], make_terms(car), SERIES, DT)
    q = np.concatenate([poses[0], states[0]], axis=1)
    x = np.concatenate([states[0, :-1], command], axis=1)
    samples = Samples(t, q, np.vstack([x, x[-1:]]), np.gradient(q, DT, axis=0), DT)

    def commands(values):
        at = np.arange(STEPS + 1) - values["latency"] / DT
        return np.stack(
            [np.interp(at, np.arange(STEPS), column) for column in command.T], axis=1
        )

    return Shooting(samples, DELAYS, commands, lambda model, values: model, equally)


def parameters(**rows: tuple[float, float, float, float]) -> Parameters:
    """Parameters with their start, scale and bounds."""
    return Parameters(tuple(rows), *np.array(list(rows.values())).T)


DELAYS = parameters(latency=(0.05, 0.05, 0.0, 0.4))


def test_coefficients_and_a_delay_are_found_together(car, problem):
    off = replace(
        car, coefficients=car.coefficients * np.where(car.coefficients == 1.0, 1.0, 1.3)
    )
    free = (car.coefficients != 0.0) & (np.arange(6) >= 3)[:, None]
    found = fit_to_predictions(problem, off, free)
    assert found.model.coefficients[free] == pytest.approx(
        car.coefficients[free], rel=0.02
    )
    assert found.values[0] == pytest.approx(DELAY, abs=0.003)
    assert found.errors["latency"] < 0.01


def test_windows_that_are_predicted_together_end_as_each_alone(car, problem):
    car = replace(
        car,
        drag=np.array([0.3, 0.0, 0.1]),
        friction=np.array([0.2, 0.0, 0.0]),
        limits=np.array([[-1.0, 1.5], [-np.inf, np.inf], [-6.0, 6.0]]),
        back_emf=np.outer([0.5, 0.0, 0.0], [1.0, 0.0]),
    )
    first, steps = problem.list_windows()
    # the last have shorter horizons
    first = first[::-1][:41]
    steps = steps[::-1][:41]
    free = (car.coefficients != 0.0) & (np.arange(6) >= 3)[:, None]
    end, slope = problem.predict(car, np.array([DELAY]), first, steps, free)
    assert np.array_equal(end, problem.predict(car, np.array([DELAY]), first, steps)[0])
    for w in range(len(first)):
        one = slice(w, w + 1)
        alone = problem.predict(car, np.array([DELAY]), first[one], steps[one], free)
        assert np.array_equal(alone[0], end[one])
        assert np.array_equal(alone[1], slope[one])
    assert len(np.unique(steps.max(axis=1))) > 2
    assert (slope[steps > 0] != 0.0).any(axis=(0, 1)).all()


def test_one_path_gives_the_windows_of_states_that_are_known_all_along(car, problem):
    first, steps = problem.list_windows()
    later = first > DELAY / DT
    first = first[later]
    steps = steps[later]
    free = np.zeros(car.coefficients.shape, dtype=np.bool_)
    free[:3] = True
    command = problem.commands({"latency": DELAY})
    x = np.concatenate([problem.samples.q[:, 3:], command], axis=1)
    end, slope = predict_along_path(car, x, first, steps, free)
    ends, slopes = problem.predict(car, np.array([DELAY]), first, steps, free)
    assert end == pytest.approx(ends, abs=1e-9)
    assert slope == pytest.approx(slopes, abs=1e-9)
    assert (np.abs(slopes).max(axis=(0, 1)).any(axis=0)).all()


def test_a_value_between_equal_bounds_stays_and_has_no_error(car, problem):
    known = replace(problem, parameters=parameters(latency=(0.08, 0.05, 0.08, 0.08)))
    found = fit_to_predictions(known, car, car.coefficients == 4.0)
    assert found.named == {"latency": 0.08}
    assert np.isnan(found.errors["latency"])


def test_rows_outside_are_neither_started_from_nor_passed(problem):
    inside = np.ones(STEPS + 1, dtype=np.bool_)
    inside[700:800] = False
    first, steps = problem.list_windows(inside)
    for a, row in zip(first, steps, strict=True):
        assert inside[a : a + row.max() + 1].all()
    assert len(first) < len(problem.list_windows()[0])


def test_a_window_does_not_pass_a_gap(problem):
    t = problem.samples.t + np.where(np.arange(STEPS + 1) >= 1000, 0.5, 0.0)
    first, steps = replace(
        problem, samples=replace(problem.samples, t=t)
    ).list_windows()
    assert not ((first < 1000) & (first + steps.max(axis=1) >= 1000)).any()


def test_predictions_are_seen_from_where_the_tracked_body_is(car, problem):
    first, steps = problem.list_windows()
    values = np.array([DELAY, 0.2, -0.1, 0.3])
    base, _ = problem.predict(car, values[:1], first, steps)
    row = (0.0, 0.1, -1.0, 1.0)
    mounted = parameters(latency=row, x=row, y=row, heading=row)
    seen, _ = replace(problem, parameters=mounted).predict(car, values, first, steps)
    mounting = values[1:]
    expected = geometry.between(mounting, geometry.compose(base, mounting))
    assert seen[..., :2] == pytest.approx(expected[..., :2])


def test_nothing_free_leaves_the_model(car, problem):
    fixed = parameters(latency=(DELAY, 0.05, 0.0, 0.4)).freeze()
    problem = replace(problem, parameters=fixed)
    found = fit_to_predictions(problem, car, np.zeros((6, 4), dtype=np.bool_))
    assert np.array_equal(found.model.coefficients, car.coefficients)
    assert np.sqrt(np.mean(found.residual**2)) < 0.005


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_the_error_of_a_prediction_that_diverged_is_infinite_and_none_is_left_out(
    car, problem
):
    wild = replace(car, coefficients=np.where(car.coefficients > 3.0, 1e300, 1e200))
    error, path = problem.errors(wild, np.array([DELAY]))
    fits = np.isfinite(path)
    assert fits.any()
    assert np.isinf(error[fits]).any(axis=-1).all()


def test_delays_alone_move_to_later_stamps():
    names = ("latency", "throttle.delay", "throttle.dead")
    start = np.array([0.1, 0.2, 0.3])
    sought = Parameters(names, start, np.ones(3), start - 0.1, start + 0.1)
    later = sought.shift_stamps(0.05)
    assert later.start == pytest.approx([0.05, 0.15, 0.3])
    assert later.low == pytest.approx([-0.05, 0.05, 0.2])
    assert later.high == pytest.approx([0.15, 0.25, 0.4])
