"""Counter-based random numbers: the same draw for the same (seed, stream, counter).

No state is kept, so a world draws the same numbers in any batch and thread. SplitMix64 (Steele,
Lea, Flood 2014) mixes the counters; Box-Muller makes normals. Each purpose has a stream of its own.

Draws by the thousand, as for the beams of a scan, take a `key` once and `bits` for each: whole
numbers of 32 bits and functions without branches, which LLVM vectorises.
"""

import math

import numpy as np

from nics_drl_bridge.kernels import kernel

(
    SCENE_STREAM, ODOMETRY_STREAM, RANGE_STREAM, DRIFT_STREAM, DROPOUT_STREAM, GHOST_STREAM,
    RANDOMISATION_STREAM, MOTION_STREAM, EPISODE_STREAM, MEMBER_STREAM,
    PLANNER_STREAM,
) = range(1, 12)  # fmt: skip

# From scaled sums of four bytes to the standard normal distribution: 1.2e-4 off its shares.
PER_STD = 1.0 / 18992.5
N1, N3, N5, N7, N9 = 0.96324387, 7.0641293e-3, 3.1552132e-3, -6.4405445e-4, 5.5402501e-5


@kernel(allocates=True)
def _mix(z):  # type: ignore[no-untyped-def]
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return z ^ (z >> np.uint64(31))


@kernel(allocates=True)
def uniform(seed, stream, counter):  # type: ignore[no-untyped-def]
    """A draw from the uniform distribution over [0, 1)."""
    return uniform_of(source(seed, stream), counter)


@kernel(allocates=True)
def source(seed, stream):  # type: ignore[no-untyped-def]
    """Returns what all draws of a seed and stream have in common, for `uniform_of`."""
    step = np.uint64(0x9E3779B97F4A7C15)
    z = _mix(np.uint64(seed) * step + step)
    return _mix(z + (np.uint64(stream) + np.uint64(1)) * step)


@kernel(allocates=True)
def uniform_of(source, counter):  # type: ignore[no-untyped-def]
    """The same draw as `uniform`."""
    z = _mix(source + (np.uint64(counter) + np.uint64(1)) * np.uint64(0x9E3779B97F4A7C15))
    return float(z >> np.uint64(11)) * (1.0 / 9007199254740992.0)


@kernel(allocates=True)
def normal(seed, stream, counter):  # type: ignore[no-untyped-def]
    """A draw from the standard normal distribution."""
    radius = math.sqrt(-2.0 * math.log(1.0 - uniform(seed, stream, 2 * counter)))
    return radius * math.cos(2.0 * math.pi * uniform(seed, stream, 2 * counter + 1))


@kernel(allocates=True)
def key(seed, stream, counter):  # type: ignore[no-untyped-def]
    """Returns two numbers of 32 bits, the key of many draws by `bits`."""
    step = np.uint64(0x9E3779B97F4A7C15)
    z = _mix(source(seed, stream) + (np.uint64(counter) + np.uint64(1)) * step)
    return np.uint32(z), np.uint32(z >> np.uint64(32))


@kernel(inline=True)
def bits(by, i):  # type: ignore[no-untyped-def]
    """Returns 32 random bits, the i-th of a key."""
    z = np.uint32(np.uint32(i) * np.uint32(0x9E3779B9) + by[0])
    z = np.uint32((z ^ (z >> np.uint32(16))) * np.uint32(0x7FEB352D))
    z = np.uint32((z ^ (z >> np.uint32(15)) ^ by[1]) * np.uint32(0x846CA68B))
    return np.uint32(z ^ (z >> np.uint32(16)))


@kernel(contracts=True, inline=True)
def share_of(drawn):  # type: ignore[no-untyped-def]
    """A uniform draw between 0 and 1, float32, of 32 random bits."""
    whole = np.float32(np.int32(drawn >> np.uint32(1)))
    return (whole + np.float32(0.5)) * np.float32(2.0**-31)


@kernel(contracts=True, inline=True)
def normal_of(drawn):  # type: ignore[no-untyped-def]
    """A draw from the standard normal distribution, float32, of 32 random bits; below 5.3.

    The sum of four uniform draws, a byte each, is nearly normal; a polynomial takes it there
    (Teichroew 1953). Two of the bytes count 129/128, so that few sums are the same.
    """
    even = np.uint32(0xFF00FF)
    pairs = np.uint32((drawn & even) + ((drawn >> np.uint32(8)) & even))
    low, high = np.int32(pairs & np.uint32(0xFFFF)), np.int32(pairs >> np.uint32(16))
    total = np.int32((low + high) * np.int32(128) + high - np.int32(65535))
    x = np.float32(total) * np.float32(PER_STD)
    square = x * x
    value = np.float32(N5) + square * (np.float32(N7) + square * np.float32(N9))
    return x * (np.float32(N1) + square * (np.float32(N3) + square * value))


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
