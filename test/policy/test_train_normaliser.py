from __future__ import annotations

import gymnasium
import numpy as np
import pytest

from nics_drl_bridge.policy.train.normaliser import Normaliser

SPACE = gymnasium.spaces.Box(np.zeros(2, np.float32), np.array([1.0, 9.0], np.float32))
SCALE = np.array([0.5, 3.0]), np.array([0.25, 0.5])
SEEN = np.array([[0.1, 4.0], [0.0, 9.0], [1.0, -9.0]], np.float32)


def test_it_bends_what_lies_between_0_and_1_and_cuts_what_is_far_off():
    seen = Normaliser.of(SPACE, *SCALE)(SEEN)
    assert seen == pytest.approx(np.array([[0.2, 2.0], [-2.0, 5.0], [2.0, -5.0]]))
    assert seen.dtype == np.float32


def test_the_layer_of_torch_does_the_same():
    torch = pytest.importorskip("torch", reason="needs the extra sb3")
    from nics_drl_bridge.extras.sb3.layers import NormaliserLayer

    layer = NormaliserLayer(SPACE, *SCALE)
    theirs = layer(torch.as_tensor(SEEN)).numpy()
    assert Normaliser.of(SPACE, *SCALE)(SEEN) == pytest.approx(theirs, abs=1e-6)
