"""Residuals that still depend on commands and state are told; noise alone never is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from nics_drl_bridge.identify.fit import fit
from nics_drl_bridge.identify.structure import structures
from nics_drl_bridge.recording.recording import Samples
from nics_drl_bridge.robot.spec import RobotSpec, robot_from
from nics_drl_bridge.robot.taylor import TaylorModel

STEP_S = 0.01


@pytest.fixture
def samples(car) -> Samples:
    """40 s of a car whose every command changes, with noise that lasts for 0.2 s in its rates."""
    rng = np.random.default_rng(4)
    held = np.repeat(rng.uniform(-0.5, 0.5, (100, 4)), 40, axis=0)
    x = held + np.array([0.6, 0.0, 0.6, 0.0])
    noise = np.repeat(rng.normal(size=(200, 5)), 20, axis=0)
    turn = 5.0 * x[:, 0] * x[:, 1]
    rates = np.stack(
        [x[:, 0], 0.0 * turn, turn, x[:, 2] - x[:, 0], x[:, 3] - x[:, 1]], axis=1
    )
    return Samples(
        STEP_S * np.arange(4000.0), np.zeros((4000, 5)), x, rates + 0.05 * noise, STEP_S
    )


def throttled() -> RobotSpec:
    """A car by throttle, whose state is its twist."""
    return robot_from({"kind": "ackermann_throttle", "footprint_radius": 0.2}, {})


def motion_of(spec, friction=0.3, noise=0.05) -> tuple[TaylorModel, Samples]:
    """A model with dry friction, which moves along x only, and 40 s of the rates that it makes."""
    rng = np.random.default_rng(3)
    names = spec.variable_names
    x = 0.01 * rng.normal(size=(4000, len(names)))
    x[:, names.index("vx")] = np.repeat(rng.uniform(-1.0, 1.0, 100), 40)
    x[:, names.index("throttle")] = np.repeat(rng.uniform(-1.0, 1.0, 100), 40)
    low, high = -np.ones((2, len(names))) * [[1.0], [-1.0]]
    first = np.eye(len(names), dtype=np.int64)
    rows = np.eye(6, len(names)) * (np.arange(6) < 3)[:, None]  # the twist is the state
    model = TaylorModel(
        names,
        spec.dof_names,
        spec.dof_units,
        first,
        rows,
        STEP_S,
        low,
        high,
        bounded=True,
    )
    model.coefficients[3, [names.index("vx"), names.index("throttle")]] = -2.0, 3.0
    model = replace(model, friction=np.array([friction, 0.0, 0.0]))
    rates = model.rates(x)
    rates += noise * np.repeat(rng.normal(size=(200, 6)), 20, axis=0)
    return model, Samples(
        STEP_S * np.arange(4000.0), np.zeros((4000, 6)), x, rates, STEP_S
    )


@pytest.mark.parametrize("seed", range(5))
def test_noise_alone_is_no_structure(samples, car, seed):
    rng = np.random.default_rng(seed)
    noise = 0.05 * np.repeat(rng.normal(size=(200, 5)), 20, axis=0)
    noisy = replace(samples, dq=samples.dq + noise)
    assert list(structures(fit(noisy, car, 2).model, noisy, car)) == []


def test_a_term_of_the_next_order_is_named_with_what_to_try(samples, car):
    x = samples.x
    slips = replace(
        samples, dq=samples.dq - 2.0 * np.outer(x[:, 0] * x[:, 1] ** 2, np.eye(5)[0])
    )
    (sentence,) = structures(fit(slips, car, 2).model, slips, car)
    assert sentence.startswith(
        "What the model leaves of vx depends on speed*steering^2 ("
    )
    assert "try order 3" in sentence


def test_a_few_seconds_do_not_tell(samples, car):
    brief = samples.rows(samples.t < 20.0)
    assert list(structures(fit(brief, car, 1).model, brief, car)) == []


def test_friction_is_a_part_of_the_model_that_is_tested():
    spec = throttled()
    model, samples = motion_of(spec)
    assert list(structures(model, samples, spec)) == []
    without = replace(model, friction=np.zeros(3))
    (sentence,) = structures(without, samples, spec)
    assert sentence.startswith("What the model leaves of d_vx depends on")
    assert "mounting" not in sentence  # it does not rest on the terms of a motion


def test_noise_of_a_state_that_never_moved_is_no_structure():
    spec = throttled()
    model, samples = motion_of(spec)
    wz = samples.x[:, 2]
    samples.dq[:, 5] += (
        3.0 * wz**3 / wz.std() ** 2
    )  # noise beyond what a line through it takes
    model.coefficients[5, 2] = 1.0
    assert len(list(structures(model, samples, spec))) == 1
    assert list(structures(model, samples, spec, unmoved=("wz",))) == []


def test_an_order_that_was_tried_is_not_advised(samples, car):
    x = samples.x
    slips = replace(
        samples, dq=samples.dq - 2.0 * np.outer(x[:, 0] * x[:, 1] ** 2, np.eye(5)[0])
    )
    (sentence,) = structures(fit(slips, car, 2).model, slips, car, tried=4)
    assert "no order that was tried predicts better with it" in sentence
