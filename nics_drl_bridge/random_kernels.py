"""Counter-based random numbers: the same draw for the same (seed, stream, counter).

No state is kept, so a world draws the same numbers in any batch and thread. SplitMix64 (Steele,
Lea, Flood 2014) mixes the counters; Box-Muller makes normals. Each purpose has a stream of its own.

Draws by the thousand, as for the beams of a scan, take a `key` once: uniform draws then `bits` for
each, normal ones a `run` for each `RUN` of them, without branches, so that LLVM vectorises them.
"""

import math

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.kernels import kernel

(
    SCENE_STREAM,
    ODOMETRY_STREAM,
    RANGE_STREAM,
    DRIFT_STREAM,
    DROPOUT_STREAM,
    GHOST_STREAM,
    RANDOMISATION_STREAM,
    MOTION_STREAM,
    EPISODE_STREAM,
    MEMBER_STREAM,
    PLANNER_STREAM,
) = range(1, 12)

GOLDEN = np.uint64(0x9E3779B97F4A7C15)
RUN = 32
POOL_SIZE = 2**16
PER_STD = 1.0 / 5300.0  # so that the sum of two numbers of the pool fits 16 bits


@kernel(allocates=True)
def _mix(z):  # type: ignore[no-untyped-def]
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return z ^ (z >> np.uint64(31))


def _pool() -> NDArray[np.int16]:
    """Normal whole numbers, mixed; the sum of two, times PER_STD, is a draw."""
    most = math.ceil(3.3 / PER_STD)
    below = [0.5 + 0.5 * math.erf((k + 0.5) * PER_STD) for k in range(-most, most)]
    often = np.diff(np.rint(POOL_SIZE * np.array([0.0, *below, 1.0]))).astype(np.int64)
    mixed = np.argsort(_mix.py_func(np.arange(POOL_SIZE, dtype=np.uint64)))
    pool = np.repeat(np.arange(-most, most + 1), often)[mixed]
    return np.concatenate([pool, pool[:RUN]]).astype(np.int16)


POOL = _pool()


@kernel(allocates=True)
def uniform(seed, stream, counter):  # type: ignore[no-untyped-def]
    """A draw from the uniform distribution over [0, 1)."""
    return uniform_of(source(seed, stream), counter)


@kernel(allocates=True)
def source(seed, stream):  # type: ignore[no-untyped-def]
    """Returns what all draws of a seed and stream have in common, for `uniform_of`."""
    z = _mix(np.uint64(seed) * GOLDEN + GOLDEN)
    return _mix(z + (np.uint64(stream) + np.uint64(1)) * GOLDEN)


@kernel(allocates=True)
def uniform_of(source, counter):  # type: ignore[no-untyped-def]
    """The same draw as `uniform`."""
    z = _mix(source + (np.uint64(counter) + np.uint64(1)) * GOLDEN)
    return float(z >> np.uint64(11)) * (1.0 / 9007199254740992.0)


@kernel(allocates=True)
def normal(seed, stream, counter):  # type: ignore[no-untyped-def]
    """A draw from the standard normal distribution."""
    radius = math.sqrt(-2.0 * math.log(1.0 - uniform(seed, stream, 2 * counter)))
    return radius * math.cos(2.0 * math.pi * uniform(seed, stream, 2 * counter + 1))


@kernel(allocates=True)
def key(seed, stream, counter):  # type: ignore[no-untyped-def]
    """Returns 64 bits, the key of many draws."""
    return _mix(source(seed, stream) + (np.uint64(counter) + np.uint64(1)) * GOLDEN)


@kernel(inline=True)
def bits(by, i):  # type: ignore[no-untyped-def]
    """Returns 32 random bits, the i-th of a key."""
    z = np.uint32(np.uint32(i) * np.uint32(0x9E3779B9) + np.uint32(by))
    z = np.uint32((z ^ (z >> np.uint32(16))) * np.uint32(0x7FEB352D))
    other = np.uint32(by >> np.uint64(32))
    z = np.uint32((z ^ (z >> np.uint32(15)) ^ other) * np.uint32(0x846CA68B))
    return np.uint32(z ^ (z >> np.uint32(16)))


@kernel(contracts=True, inline=True)
def share_of(drawn):  # type: ignore[no-untyped-def]
    """A uniform draw between 0 and 1, float32, of 32 random bits."""
    whole = np.float32(np.int32(drawn >> np.uint32(1)))
    return (whole + np.float32(0.5)) * np.float32(2.0**-31)


@kernel(inline=True)
def run(by, k):  # type: ignore[no-untyped-def]
    """Returns the k-th run of normal draws of a key: their signs, and two places in the pool."""
    z = _mix(by + np.uint64(k) * GOLDEN)
    one = (z >> np.uint64(32)) & np.uint64(POOL_SIZE - 1)
    two = z >> np.uint64(48)
    return np.uint32(z), np.uintp(one), np.uintp(two)


@kernel(contracts=True, inline=True)
def normal_of(run, j):  # type: ignore[no-untyped-def]
    """The j-th draw of a run, times PER_STD standard normal, float32; below 6.2 / PER_STD.

    The sum of two normal numbers, from a pool (Wallace 1996), is normal. Signs of their own leave
    no two draws correlated.
    """
    total = np.float32(
        np.int16(POOL[run[1] + np.uintp(j)] + POOL[run[2] + np.uintp(j)])
    )
    sign = np.int32(run[0] << np.uint32(j)) & np.int32(-(2**31))
    return np.int32(total.view(np.int32) ^ sign).view(np.float32)


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
