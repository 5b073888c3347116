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

# Coefficients of least greatest error: sine and cosine of y quarters of a turn, |y| <= 1/2, and
# log(1 + f) / f from the root of a half to the root of 2.
S1, S3, S5 = 1.57078847, -0.64571199, 0.07766739
C0, C2, C4, C6 = 0.99999997, -1.23369701, 0.25359864, -0.02040835
L0, L1, L2, L3 = 1.0000008774, -0.5000139831, 0.333160293, -0.2489679282
L4, L5, L6 = 0.2045475802, -0.1878272899, 0.1221096843
LN2 = math.log(2.0)
HALF_ROOT = 0x3F3504F3  # bits of the root of a half, float32


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
def two_normals(by, i):  # type: ignore[no-untyped-def]
    """Two draws from the standard normal distribution, float32: the i-th pair of a key.

    Logarithm, sine and cosine are polynomials, 1e-6 off at most.
    """
    size, turn = bits(by, np.uint32(2 * i)), bits(by, np.uint32(2 * i + 1))
    y = share_of(turn) - np.float32(0.5)  # a quarter of a turn from its middle
    square = y * y
    sine = y * (np.float32(S1) + square * (np.float32(S3) + square * np.float32(S5)))
    cosine = np.float32(C2) + square * (np.float32(C4) + square * np.float32(C6))
    cosine = np.float32(C0) + square * cosine
    radius = math.sqrt(-_log(share_of(size)))
    return _signed(radius * (cosine - sine), size), _signed(radius * (cosine + sine), turn)


@kernel(contracts=True, inline=True)
def _log(x):  # type: ignore[no-untyped-def]
    """Natural logarithm of a normal number above 0, float32."""
    whole = np.int32(np.float32(x).view(np.int32) - np.int32(HALF_ROOT))
    exponent = np.int32(whole >> np.int32(23))
    part = np.int32((whole & np.int32(0x7FFFFF)) + np.int32(HALF_ROOT)).view(np.float32)
    f = part - np.float32(1.0)  # from the root of a half to the root of 2, less 1
    low = np.float32(L0) + f * (np.float32(L1) + f * np.float32(L2))
    high = np.float32(L3) + f * (np.float32(L4) + f * (np.float32(L5) + f * np.float32(L6)))
    return np.float32(exponent) * np.float32(LN2) + f * (low + f * f * f * high)


@kernel(inline=True)
def _signed(value, drawn):  # type: ignore[no-untyped-def]
    """Returns a value above 0 with a sign by the last of 32 bits, which `share_of` does not use."""
    turned = np.float32(value).view(np.int32) ^ np.int32(np.uint32(drawn << np.uint32(31)))
    return np.int32(turned).view(np.float32)


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
