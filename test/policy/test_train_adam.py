"""The optimiser takes the steps of torch's Adam with a limited gradient."""

import numpy as np
import pytest

from nics_drl_bridge.policy.train.adam import EPSILON, GRADIENT_LIMIT, Adam

torch = pytest.importorskip("torch")
RATES = (3e-4, 1e-2, 1e-3)


def step_torch(weights, gradients, steps):
    """Returns the weights after steps of torch's optimiser."""
    parameter = torch.nn.Parameter(torch.tensor(weights))
    optimiser = torch.optim.Adam([parameter], eps=EPSILON)
    for gradient, rate in steps(gradients):
        parameter.grad = torch.tensor(gradient)
        torch.nn.utils.clip_grad_norm_(parameter, GRADIENT_LIMIT)
        optimiser.param_groups[0]["lr"] = rate
        optimiser.step()
    return parameter.detach().numpy()


@pytest.mark.parametrize(
    "size", [0.001, 0.4, 50.0], ids=["small", "allowed", "limited"]
)
def test_steps_are_those_of_torch(size):
    rng = np.random.default_rng(5)
    weights = rng.normal(size=300).astype(np.float32)
    drawn = (size / 300**0.5 * rng.normal(size=(30, 300))).astype(np.float32)
    expected = step_torch(weights, drawn, lambda g: zip(g, RATES * 10, strict=True))
    adam = Adam(weights.copy(), np.zeros_like(weights))
    for gradients, rate in zip(drawn, RATES * 10, strict=True):
        adam.gradients[:] = gradients
        adam.step(rate)
    assert np.allclose(adam.weights, expected, rtol=0, atol=2e-6)
    assert np.abs(expected - weights).max() > 0.01


def test_a_gradient_of_zero_moves_nothing():
    adam = Adam(np.ones(3, np.float32), np.zeros(3, np.float32))
    adam.step(0.1)
    assert (adam.weights == 1.0).all()
