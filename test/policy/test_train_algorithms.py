from __future__ import annotations

import gymnasium
import numpy as np
import torch

from nics_drl_bridge.policy.train.algorithms import Normaliser


def test_a_normaliser_bends_what_lies_between_0_and_1_and_cuts_what_is_far_off():
    space = gymnasium.spaces.Box(
        np.zeros(2, np.float32), np.array([1.0, 9.0], np.float32)
    )
    see = Normaliser(space, np.array([0.5, 3.0]), np.array([0.25, 0.5]))
    seen = see(torch.tensor([[0.1, 4.0], [0.0, 9.0], [1.0, -9.0]]))
    torch.testing.assert_close(
        seen, torch.tensor([[0.2, 2.0], [-2.0, 5.0], [2.0, -5.0]])
    )
