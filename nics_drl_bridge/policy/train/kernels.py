"""Compiled inner loops of the lean engine: gradients of PPO's loss.

The loss is that of Stable-Baselines3. The kernels release the interpreter lock, so that they do not
keep the collecting thread from running. Shapes: n transitions, O observations,
C outputs of the actor, W weights of a network.
"""

from typing import NamedTuple

import numpy as np

from nics_drl_bridge.kernels import kernel
from nics_drl_bridge.lidar.arrays import Integers, Singles

ONE = np.float32(1.0)
ZERO = np.float32(0.0)
# constant term of the normal distribution's log density
LOG_NORM = np.float32(0.5 * np.log(2.0 * np.pi))


class Net(NamedTuple):
    """Linear layers with ReLU in between, and scratch memory for a batch."""

    # (W,) layer after layer: weights (outs, ins), then biases (outs,)
    weights: Singles
    gradients: Singles  # (W,)
    # (L + 1,) number of inputs, then the number of outputs of each layer
    widths: Integers
    # (L, at least n times the maximum width) outputs of each layer
    layer_outputs: Singles
    output_gradients: Singles  # (2, same size) of two consecutive layers, in turns


class Transitions(NamedTuple):
    """R transitions, step by step."""

    observations: Singles  # (R, O) normalised observations
    actions: Singles  # (R, C), or (R, 1) indices of discrete actions
    log_probs: Singles  # (R,) of the actions when they were drawn
    advantages: Singles  # (R,)
    returns: Singles  # (R,) targets of the critic


@kernel(allocates=True)
def forward(net: Net, observations: Singles) -> Singles:
    """Returns the outputs (n, C) of a network for inputs (n, O); keeps all layers' outputs."""
    n = len(observations)
    at = 0
    rows = observations
    for k in range(len(net.widths) - 1):
        ins = net.widths[k]
        outs = net.widths[k + 1]
        middle = at + ins * outs
        out = net.layer_outputs[k, : n * outs].reshape(n, outs)
        np.dot(rows, net.weights[at:middle].reshape(outs, ins).T, out)
        at = middle + outs
        rows = out
        bias = net.weights[middle:at]
        # ReLU, except after the last layer
        least = ZERO if k + 2 < len(net.widths) else -np.inf
        for i in range(n):
            for j in range(outs):
                out[i, j] = max(out[i, j] + bias[j], np.float32(least))
    return rows


@kernel(allocates=True)
def backward(net: Net, observations: Singles, gradient: Singles) -> None:
    """Writes the gradients of the weights, given the outputs' gradients (n, C), after `forward`.

    `gradient` must be in the first row of `output_gradients`.
    """
    n = len(observations)
    at = len(net.weights)
    side = 0
    for k in range(len(net.widths) - 2, -1, -1):
        ins = net.widths[k]
        outs = net.widths[k + 1]
        middle = at - outs
        at = middle - ins * outs
        rows = (
            net.layer_outputs[k - 1, : n * ins].reshape(n, ins)
            if k > 0
            else observations
        )
        np.dot(gradient.T, rows, net.gradients[at:middle].reshape(outs, ins))
        net.gradients[middle : middle + outs] = gradient.sum(axis=0)
        if k > 0:
            side = 1 - side
            earlier = net.output_gradients[side, : n * ins].reshape(n, ins)
            np.dot(gradient, net.weights[at:middle].reshape(outs, ins), earlier)
            for i in range(n):
                for j in range(ins):
                    earlier[i, j] = earlier[i, j] if rows[i, j] > ZERO else ZERO
            gradient = earlier


@kernel(allocates=True)
def compute_critic_gradients(
    net: Net, batch: Transitions, weight: np.float32
) -> np.float32:
    """Writes the gradients of the critic; returns its weighted loss."""
    values = forward(net, batch.observations)
    n = len(values)
    out = net.output_gradients[0, :n].reshape(n, 1)
    loss = ZERO
    share = weight / np.float32(n)
    for i in range(n):
        off = values[i, 0] - batch.returns[i]
        loss += share * off * off
        out[i, 0] = np.float32(2.0) * share * off
    backward(net, batch.observations, out)
    return loss


@kernel(allocates=True)
def compute_actor_gradients(
    net: Net,
    batch: Transitions,
    log_std: Singles,
    log_std_gradient: Singles,
    clip: np.float32,
    entropy_weight: np.float32,
) -> np.float32:
    """Writes the gradients of the actor and of `log_std` (C,); returns their loss.

    With discrete actions, `log_std` has no gradient.
    """
    outputs = forward(net, batch.observations)
    advantages = batch.advantages
    n = len(outputs)
    actions = batch.actions
    out = net.output_gradients[0, : outputs.size].reshape(outputs.shape)
    share = ONE / np.float32(n)
    mean = ZERO
    scale = ONE
    if n > 1:  # a single advantage has no deviation
        mean = advantages.mean()
        variance = np.square(advantages - mean).sum() / np.float32(n - 1)
        scale = ONE / (np.sqrt(variance) + np.float32(1e-8))
    log_std_gradient[:] = -entropy_weight
    loss = ZERO
    parts = np.empty(outputs.shape[1], np.float32)
    for i in range(n):
        # The log density or log probability of the action, the entropy of all actions, and the
        # deviations or log probabilities in the parts.
        log_prob = entropy = ZERO
        if log_std.size > 0:
            for j in range(len(parts)):
                parts[j] = (actions[i, j] - outputs[i, j]) * np.exp(-log_std[j])
                density = np.float32(0.5) * parts[j] * parts[j] + log_std[j]
                log_prob -= density + LOG_NORM
                entropy += log_std[j] + np.float32(0.5) + LOG_NORM
        else:
            greatest = outputs[i].max()
            total = ZERO
            for j in range(len(parts)):
                total += np.exp(outputs[i, j] - greatest)
            for j in range(len(parts)):
                parts[j] = outputs[i, j] - greatest - np.log(total)
                entropy -= np.exp(parts[j]) * parts[j]
            log_prob = parts[int(actions[i, 0])]
        ratio = np.exp(log_prob - batch.log_probs[i])
        advantage = (advantages[i] - mean) * scale
        bounded = advantage * min(max(ratio, ONE - clip), ONE + clip)
        loss -= share * (min(advantage * ratio, bounded) + entropy_weight * entropy)
        slope = share * advantage * ratio if advantage * ratio <= bounded else ZERO
        for j in range(len(parts)):
            if log_std.size > 0:
                out[i, j] = -slope * parts[j] * np.exp(-log_std[j])
                log_std_gradient[j] -= slope * (parts[j] * parts[j] - ONE)
            else:
                out[i, j] = np.exp(parts[j]) * (
                    slope + share * entropy_weight * (parts[j] + entropy)
                )
        if log_std.size == 0:
            out[i, int(actions[i, 0])] -= slope
    backward(net, batch.observations, out)
    return loss
