"""Counter-based random numbers: the same draw for the same (seed, stream, counter).

No state is kept, so a world draws the same numbers in any batch and thread. SplitMix64 (Steele,
Lea, Flood 2014) mixes the counters; Box-Muller makes normals. Each purpose has a stream of its own.
"""

import math

import numpy as np

from nics_drl_bridge.kernels import kernel

(
    SCENE_STREAM, ODOMETRY_STREAM, RANGE_STREAM, DRIFT_STREAM, DROPOUT_STREAM, GHOST_STREAM,
    RANDOMISATION_STREAM, MOTION_STREAM, EPISODE_STREAM,
) = range(1, 10)  # fmt: skip


@kernel(allocates=True)
def _mix(z):  # type: ignore[no-untyped-def]
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return z ^ (z >> np.uint64(31))


@kernel(allocates=True)
def uniform(seed, stream, counter):  # type: ignore[no-untyped-def]
    """A draw from the uniform distribution over [0, 1)."""
    step = np.uint64(0x9E3779B97F4A7C15)
    z = _mix(np.uint64(seed) * step + step)
    z = _mix(z + (np.uint64(stream) + np.uint64(1)) * step)
    z = _mix(z + (np.uint64(counter) + np.uint64(1)) * step)
    return float(z >> np.uint64(11)) * (1.0 / 9007199254740992.0)


@kernel(allocates=True)
def normal(seed, stream, counter):  # type: ignore[no-untyped-def]
    """A draw from the standard normal distribution."""
    radius = math.sqrt(-2.0 * math.log(1.0 - uniform(seed, stream, 2 * counter)))
    return radius * math.cos(2.0 * math.pi * uniform(seed, stream, 2 * counter + 1))


@kernel(allocates=True)
def episode_seed(seed, number):  # type: ignore[no-untyped-def]
    """Seed of an env's episode: the first is the env's own seed, the others are below 2**53."""
    if number == 0:
        return np.int64(seed)
    return np.int64(uniform(seed, EPISODE_STREAM, number) * 9007199254740992.0)


@kernel
def uniform_between(out, low, high, seeds, stream, first, stride):  # type: ignore[no-untyped-def]
    """Draws out (n, M, Q) in [low, high) (Q,), by seeds (n,) and counters first + m stride + q."""
    for n in range(out.shape[0]):
        for m in range(out.shape[1]):
            for q in range(out.shape[2]):
                out[n, m, q] = low[q]
                if high[q] != low[q]:
                    share = uniform(seeds[n], stream, first + m * stride + q)
                    out[n, m, q] = low[q] + share * (high[q] - low[q])
