"""Counter-based random numbers: the same draw for the same (seed, stream, counter).

No state is kept, so a world draws the same numbers in any batch and thread. SplitMix64 (Steele,
Lea, Flood 2014) mixes the counters; Box-Muller makes normals. Each purpose has a stream of its own.

Thousands of draws at once, as for the beams of a scan, share one `key`. A uniform draw then uses
`bits`, and `RUN` normal draws use one `run`. Neither branches, so LLVM can vectorise them.
"""

import math

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.kernels import kernel

Array = NDArray[np.float64]
# signs of a run's draws, and the two offsets of their numbers in the pool
Run = tuple[np.uint32, np.uintp, np.uintp]

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
# standard deviations per unit of the pool: the sum of two of its numbers fits 16 bits
PER_STD = 1.0 / 5300.0


@kernel(allocates=True)
def _mix(z: np.uint64) -> np.uint64:
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return z ^ (z >> np.uint64(31))


def _pool() -> NDArray[np.int16]:
    """Returns normal integers, shuffled; PER_STD times the sum of two is about standard normal."""
    maximum = math.ceil(3.3 / PER_STD)
    values = np.arange(-maximum, maximum + 1)
    cumulative = [0.5 + 0.5 * math.erf((k + 0.5) * PER_STD) for k in values[:-1]]
    edges = np.rint(POOL_SIZE * np.array([0.0, *cumulative, 1.0]))
    counts = np.diff(edges).astype(np.int64)
    mixed_order = np.argsort(_mix.py_func(np.arange(POOL_SIZE, dtype=np.uint64)))
    pool = np.repeat(values, counts)[mixed_order]
    return np.concatenate([pool, pool[:RUN]]).astype(np.int16)


POOL = _pool()


@kernel(allocates=True)
def uniform(seed: int, stream: int, counter: int) -> float:
    """Returns a draw from the uniform distribution over [0, 1)."""
    return float(uniform_of(source(seed, stream), counter))


@kernel(allocates=True)
def source(seed: int, stream: int) -> np.uint64:
    """Returns the part of the hash that all draws of a seed and stream share, for `uniform_of`."""
    z = _mix(np.uint64(seed) * GOLDEN + GOLDEN)
    return np.uint64(_mix(z + (np.uint64(stream) + np.uint64(1)) * GOLDEN))


@kernel(allocates=True)
def uniform_of(source: np.uint64, counter: int) -> float:
    """Returns the same draw as `uniform`, from the `source` of its seed and stream."""
    z = _mix(source + (np.uint64(counter) + np.uint64(1)) * GOLDEN)
    return float(z >> np.uint64(11)) * (1.0 / 9007199254740992.0)


@kernel(allocates=True)
def normal(seed: int, stream: int, counter: int) -> float:
    """Returns a draw from the standard normal distribution."""
    radius = math.sqrt(-2.0 * math.log(1.0 - uniform(seed, stream, 2 * counter)))
    return radius * math.cos(2.0 * math.pi * uniform(seed, stream, 2 * counter + 1))


@kernel(allocates=True)
def key(seed: int, stream: int, counter: int) -> np.uint64:
    """Returns a 64-bit key for many draws."""
    z = source(seed, stream) + (np.uint64(counter) + np.uint64(1)) * GOLDEN
    return np.uint64(_mix(z))


@kernel(inline=True)
def bits(key: np.uint64, i: int) -> np.uint32:
    """Returns the i-th 32 random bits of a key."""
    low = np.uint32(key)
    high = np.uint32(key >> np.uint64(32))
    z = np.uint32(np.uint32(i) * np.uint32(0x9E3779B9) + low)
    z = np.uint32((z ^ (z >> np.uint32(16))) * np.uint32(0x7FEB352D))
    z = np.uint32((z ^ (z >> np.uint32(15)) ^ high) * np.uint32(0x846CA68B))
    return np.uint32(z ^ (z >> np.uint32(16)))


@kernel(contracts=True, inline=True)
def share_of(random_bits: np.uint32) -> np.float32:
    """Converts 32 random bits to a uniform draw between 0 and 1."""
    integer = np.float32(np.int32(random_bits >> np.uint32(1)))
    return (integer + np.float32(0.5)) * np.float32(2.0**-31)


@kernel(inline=True)
def run(key: np.uint64, k: int) -> Run:
    """Returns the k-th run of normal draws of a key: their signs and two offsets in the pool."""
    z = _mix(key + np.uint64(k) * GOLDEN)
    offset = (z >> np.uint64(32)) & np.uint64(POOL_SIZE - 1)
    second_offset = z >> np.uint64(48)
    return np.uint32(z), np.uintp(offset), np.uintp(second_offset)


@kernel(contracts=True, inline=True)
def normal_of(run: Run, j: int) -> np.float32:
    """Returns the j-th draw of a run; times PER_STD it is standard normal, and below 6.2.

    The sum of two normal numbers from a pool (Wallace 1996) is normal. Each draw has its own sign,
    so that no two draws are correlated.
    """
    signs, offset, second_offset = run
    first = POOL[offset + np.uintp(j)]
    second = POOL[second_offset + np.uintp(j)]
    total = np.float32(np.int16(first + second))
    sign = np.int32(signs << np.uint32(j)) & np.int32(-(2**31))
    return np.int32(total.view(np.int32) ^ sign).view(np.float32)


@kernel(allocates=True)
def episode_seed(seed: int, number: int) -> np.int64:
    """Returns the seed of an env's episode: the env's own seed, later draws below 2**53."""
    if number == 0:
        return np.int64(seed)
    return np.int64(uniform(seed, EPISODE_STREAM, number) * 9007199254740992.0)


@kernel
def uniform_between(
    out: Array,
    low: Array,
    high: Array,
    seeds: NDArray[np.int64],
    stream: int,
    first: int,
    stride: int,
) -> None:
    """Fills out (n, M, Q) with draws in [low, high) (Q,), by seeds (n,) and counters.

    The counters are first + m stride + q.
    """
    for n in range(out.shape[0]):
        for m in range(out.shape[1]):
            for q in range(out.shape[2]):
                out[n, m, q] = low[q]
                if high[q] != low[q]:
                    fraction = uniform(seeds[n], stream, first + m * stride + q)
                    out[n, m, q] = low[q] + fraction * (high[q] - low[q])
