from __future__ import annotations

import numpy as np
import pytest

from nics_drl_bridge.sim.obstacle_kernels import FAR, repulsion

STRENGTH, REACH = 2.1, 0.3


def potential(r, v, foresight):
    """Equations 3 and 4 of Helbing and Molnar (1995), as they stand there."""
    step = v * foresight
    both = np.linalg.norm(r) + np.linalg.norm(r - step)
    return STRENGTH * np.exp(-0.5 * np.sqrt(both**2 - step @ step) / REACH)


@pytest.mark.parametrize("foresight", [0.0, 0.4, 2.0])
def test_the_force_is_the_downhill_slope_of_the_potential(foresight):
    rng, delta = np.random.default_rng(0), 1e-6
    for _ in range(300):
        r, v = rng.uniform(-1.0, 1.0, 2), rng.uniform(-1.5, 1.5, 2)
        slope = [
            (potential(r + d, v, foresight) - potential(r - d, v, foresight)) / (2.0 * delta)
            for d in delta * np.eye(2)
        ]
        force = np.array(repulsion(*r, *v, foresight, STRENGTH, REACH))
        if potential(r, v, foresight) < STRENGTH * np.exp(-FAR):
            assert (force == 0.0).all()  # so far away that it is left out
        else:
            assert np.allclose(force, -np.array(slope), rtol=1e-4, atol=1e-6)


def test_the_force_is_that_of_the_library_socialforce():
    torch = pytest.importorskip("torch")
    potentials = pytest.importorskip("socialforce.potentials")
    rng, count = np.random.default_rng(1), 6
    model = potentials.PedPedPotential(v0=STRENGTH, sigma=REACH)
    places, v = rng.uniform(-1.0, 1.0, (count, 2)), rng.uniform(-1.5, 1.5, (count, 2))
    state = np.concatenate([places, v, 0.0 * v, places + 10.0 * v], axis=1)
    expected = -model.grad_r_ab(torch.tensor(state)).detach().numpy()
    for a in range(count):
        for b in range(count):
            if a != b:
                r = places[a] - places[b]
                force = repulsion(*r, *v[b], model.delta_t_step, STRENGTH, REACH)
                assert np.allclose(force, expected[a, b], rtol=1e-3, atol=5e-3)
