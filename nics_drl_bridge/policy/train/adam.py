"""Adam (Kingma and Ba 2015) for one vector of weights."""

import numpy as np

from nics_drl_bridge.lidar.arrays import Singles

MEAN_DECAY = 0.9
SQUARE_DECAY = 0.999
EPSILON = 1e-5  # as in Stable-Baselines3's PPO
GRADIENT_LIMIT = 0.5  # maximum norm of a gradient


class Adam:
    """Steps `weights` (n,) in place, by the `gradients` (n,) that others write."""

    def __init__(self, weights: Singles, gradients: Singles) -> None:
        self.weights = weights
        self.gradients = gradients
        self.steps = 0
        self.mean = np.zeros_like(weights)
        self.square = np.zeros_like(weights)

    def step(self, rate: float) -> None:
        """Takes one step at a learning rate."""
        self.steps += 1
        norm = float(np.linalg.norm(self.gradients))
        gradients = self.gradients * np.float32(
            GRADIENT_LIMIT / max(norm, GRADIENT_LIMIT)
        )
        self.mean += np.float32(1.0 - MEAN_DECAY) * (gradients - self.mean)
        self.square += np.float32(1.0 - SQUARE_DECAY) * (gradients**2 - self.square)
        unbiased = np.sqrt(self.square / np.float32(1.0 - SQUARE_DECAY**self.steps))
        size = np.float32(rate / (1.0 - MEAN_DECAY**self.steps))
        self.weights -= size * self.mean / (unbiased + np.float32(EPSILON))
