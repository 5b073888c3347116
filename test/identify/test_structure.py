"""Residuals that still depend on commands and state are told; noise alone never is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from nics_drl_bridge.identify.fit import fit
from nics_drl_bridge.identify.structure import structures
from nics_drl_bridge.recording.recording import Samples

STEP_S = 0.01


@pytest.fixture
def samples(car) -> Samples:
    """40 s of a car whose every command changes, with noise that lasts for 0.2 s in its rates."""
    rng = np.random.default_rng(4)
    held = np.repeat(rng.uniform(-0.5, 0.5, (100, 4)), 40, axis=0)
    x = held + np.array([0.6, 0.0, 0.6, 0.0])
    noise = np.repeat(rng.normal(size=(200, 5)), 20, axis=0)
    turn = 5.0 * x[:, 0] * x[:, 1]
    rates = np.stack([x[:, 0], 0.0 * turn, turn, x[:, 2] - x[:, 0], x[:, 3] - x[:, 1]], axis=1)
    return Samples(
        STEP_S * np.arange(4000.0), np.zeros((4000, 5)), x, rates + 0.05 * noise, STEP_S
    )  # fmt: skip


@pytest.mark.parametrize("seed", range(5))
def test_noise_alone_is_no_structure(samples, car, seed):
    rng = np.random.default_rng(seed)
    noise = 0.05 * np.repeat(rng.normal(size=(200, 5)), 20, axis=0)
    noisy = replace(samples, dq=samples.dq + noise)
    assert list(structures(fit(noisy, car, 2), noisy, car)) == []


def test_a_term_of_the_next_order_is_named_with_what_to_try(samples, car):
    x = samples.x
    slips = replace(samples, dq=samples.dq - 2.0 * np.outer(x[:, 0] * x[:, 1] ** 2, np.eye(5)[0]))
    (sentence,) = structures(fit(slips, car, 2), slips, car)
    assert sentence.startswith("What the model leaves of vx depends on speed*steering^2 (")
    assert "try order 3" in sentence


def test_a_few_seconds_do_not_tell(samples, car):
    brief = samples.rows(samples.t < 20.0)
    assert list(structures(fit(brief, car, 1), brief, car)) == []
