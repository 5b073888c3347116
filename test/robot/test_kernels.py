import numpy as np
import pytest

from nics_drl_bridge import geometry
from nics_drl_bridge.robot import taylor
from nics_drl_bridge.robot.kernels import (
    SERIES,
    advance,
    allocate_scratch,
    find_delayed_command,
    make_terms,
    rates,
    run,
)
from nics_drl_bridge.robot.taylor import TaylorModel


def random_model(state_size, command_size, order, seed):
    """A model of which half of the terms were pruned."""
    rng = np.random.default_rng(seed)
    variables = tuple(f"v{i}" for i in range(state_size + command_size))
    powers = taylor.list_exponents(len(variables), order)
    coefficients = rng.normal(size=(3 + state_size, len(powers)))
    coefficients[rng.random(coefficients.shape) < 0.5] = 0.0
    box = np.ones(len(variables))
    dofs = tuple(f"q{i}" for i in range(3 + state_size))
    return TaylorModel(variables, dofs, dofs, powers, coefficients, 0.01, -box, box)


@pytest.mark.parametrize(
    ("state_size", "command_size"), [(0, 1), (0, 3), (2, 2), (4, 3)]
)
@pytest.mark.parametrize("order", [0, 1, 2, 3])
def test_compiled_rates_are_those_of_the_model(state_size, command_size, order):
    model = random_model(state_size, command_size, order, seed=order)
    x, dq = allocate_scratch(model)
    terms = make_terms(model)
    assert len(terms[0]) == model.terms_kept
    for row in np.random.default_rng(1).normal(size=(50, state_size + command_size)):
        x[:-1] = row
        dq[:] = np.nan
        rates(dq, x, terms)
        assert dq == pytest.approx(model.rates(row), rel=1e-12, abs=1e-12)


@pytest.mark.parametrize("turn", [0.0, 1e-9, 9e-5, 2e-4, 0.05, -0.1])
def test_the_compiled_arc_is_that_of_the_geometry(turn):
    rng = np.random.default_rng(2)
    for start in rng.uniform(-3.0, 3.0, (20, 3)):
        twist = np.array([*rng.normal(size=2), turn / 0.7])
        pose = start.copy()
        advance(pose, twist, 0.7, SERIES)
        expected = geometry.compose(start, geometry.exp(twist * 0.7))
        assert pose[:2] == pytest.approx(expected[:2], abs=1e-11)
        assert abs(np.angle(np.exp(1j * (pose[2] - expected[2])))) < 1e-12


def test_the_compiled_heading_stays_in_its_interval():
    pose = np.array([0.0, 0.0, 3.0])
    for _ in range(1000):
        advance(pose, np.array([0.0, 0.0, 1.7]), 0.1, SERIES)
        assert -np.pi <= pose[2] < np.pi
    assert np.exp(1j * pose[2]) == pytest.approx(np.exp(1j * 173.0), abs=1e-9)


@pytest.mark.parametrize("order", [1, 2, 3])
def test_robots_side_by_side_move_as_the_model_steps_each(order):
    model = random_model(2, 2, order, seed=7)
    rng = np.random.default_rng(3)
    start = rng.uniform(-3.0, 3.0, (37, 3))
    inputs = rng.uniform(-1.0, 1.0, (37, 4))
    pose = np.zeros((6, 37))
    pose[0], pose[1], pose[4] = start.T
    pose[2], pose[3] = np.cos(start[:, 2]), np.sin(start[:, 2])
    x = np.ones((5, 37))
    x[:4] = inputs.T
    terms = make_terms(model)
    lanes = terms._replace(coefficient=np.tile(terms.coefficient[:, None], 37))
    run(pose, x, np.zeros((5, 37)), lanes, SERIES, model.dt, 10)
    moved = start
    state = inputs[:, :2]
    for _ in range(10):
        moved, state = model.step(moved, state, inputs[:, 2:])
    assert np.allclose(x[:2].T, state, rtol=0.0, atol=1e-11)
    assert np.allclose(pose[:2].T, moved[:, :2], rtol=0.0, atol=1e-9)
    assert np.cos(moved[:, 2]) == pytest.approx(pose[2], abs=1e-9)
    assert np.sin(moved[:, 2]) == pytest.approx(pose[3], abs=1e-9)
    assert (pose[5] >= np.hypot(*(moved - start)[:, :2].T) - 1e-12).all()


@pytest.mark.parametrize("delay", [0, 1, 3, 4, 5, 8, 11])
def test_a_delayed_command_takes_effect_after_exactly_its_delay(delay):
    substeps = 4
    periods = -(-delay // substeps) + 1
    for period in range(6):
        sent = period - np.arange(
            periods
        )  # newest first, numbered by the period of sending
        for substep in range(substeps):
            now = period * substeps + substep
            assert (
                sent[find_delayed_command(substep, delay, substeps, periods)]
                == (now - delay) // substeps
            )
