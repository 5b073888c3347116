from __future__ import annotations

import numpy as np
import pytest

from nics_drl_bridge.policy.train.networks import ActorCritic, draw_orthogonal


def make_networks(is_discrete):
    networks = ActorCritic(4, 3, [8, 5], is_discrete)
    rng = np.random.default_rng(0)
    networks.weights[:] = rng.normal(size=networks.weights.shape)
    return networks


def test_a_network_is_its_layers_with_relu_in_between():
    actor = make_networks(False).actor
    rows = np.random.default_rng(1).normal(size=(6, 4)).astype(np.float32)
    first, second, last = actor.layers
    expected = np.maximum(rows @ first.matrix.T + first.bias, 0.0)
    expected = np.maximum(expected @ second.matrix.T + second.bias, 0.0)
    expected = expected @ last.matrix.T + last.bias
    assert actor(rows) == pytest.approx(expected, abs=1e-6)


def test_a_copy_has_weights_of_its_own():
    networks = make_networks(False)
    copy = networks.copy()
    rows = np.ones((1, 4), np.float32)
    before = networks.critic(rows)
    assert copy.critic(rows) == before
    copy.weights[:] = 0.0
    assert copy.critic(rows) == 0.0
    assert networks.critic(rows) == before


@pytest.mark.parametrize("shape", [(3, 8), (8, 3), (5, 5)])
def test_drawn_matrices_are_orthogonal(shape):
    drawn = draw_orthogonal(shape, np.random.default_rng(2))
    assert drawn.shape == shape
    if shape[0] < shape[1]:
        products = drawn @ drawn.T
    else:
        products = drawn.T @ drawn
    assert products == pytest.approx(np.eye(min(shape)), abs=1e-12)


def test_discrete_actions_are_drawn_with_the_probabilities_that_are_told():
    networks = make_networks(True)
    raw = np.repeat(np.array([[0.0, 1.0, -2.0]], np.float32), 20_000, axis=0)
    actions = networks.draw(raw, np.random.default_rng(3))
    shares = np.bincount(actions, minlength=3) / len(actions)
    expected = np.exp(networks.compute_log_probs(raw[:3], np.arange(3)))
    assert expected.sum() == pytest.approx(1.0, abs=1e-6)
    assert shares == pytest.approx(expected, abs=0.015)


def test_continuous_actions_have_the_mean_and_deviation_that_are_told():
    networks = make_networks(False)
    networks.log_std[:] = np.log([0.5, 1.0, 2.0])
    raw = np.repeat(np.array([[1.0, 0.0, -1.0]], np.float32), 20_000, axis=0)
    actions = networks.draw(raw, np.random.default_rng(4))
    assert actions.mean(axis=0) == pytest.approx(raw[0], abs=0.06)
    assert actions.std(axis=0) == pytest.approx([0.5, 1.0, 2.0], rel=0.02)
