"""The compiled gradients are those that autograd finds for the same layers."""

import itertools

import numpy as np
import pytest
import torch

from nics_drl_bridge.policy.train.kernels import Net, backward, forward


@pytest.mark.parametrize("widths", [(5, 3), (7, 16, 2), (4, 8, 6, 1)])
def test_outputs_and_gradients_of_layers_are_those_of_autograd(widths):
    torch.manual_seed(0)
    parts: list[torch.nn.Module] = []
    for ins, outs in itertools.pairwise(widths):
        parts += [torch.nn.Linear(ins, outs), torch.nn.ReLU()]
    layers = torch.nn.Sequential(*parts[:-1])
    rows = 9
    weights = torch.nn.utils.parameters_to_vector(layers.parameters()).detach().numpy()
    size = rows * max(widths)
    memory = (
        np.full((count, size), np.nan, np.float32) for count in (len(widths) - 1, 2)
    )
    net = Net(weights, np.full_like(weights, np.nan), np.array(widths), *memory)
    seen = torch.randn(rows, widths[0])
    pull = torch.randn(rows, widths[-1])
    wanted = layers(seen)
    wanted.backward(pull)
    assert forward(net, seen.numpy()) == pytest.approx(
        wanted.detach().numpy(), abs=1e-5
    )
    gradient = net.spare[0, : pull.numel()].reshape(pull.shape)
    gradient[...] = pull.numpy()
    backward(net, seen.numpy(), gradient)
    found = torch.cat([each.grad.flatten() for each in layers.parameters()])
    assert net.gradients == pytest.approx(found.numpy(), abs=1e-5)
