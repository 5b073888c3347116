import numpy as np
import pytest
from numba import njit
from scipy import stats

from nics_drl_bridge import random_kernels as random


@njit
def draws(function, seeds, streams, counters):
    out = np.empty((len(seeds), len(streams), len(counters)))
    for i in range(len(seeds)):
        for j in range(len(streams)):
            for k in range(len(counters)):
                out[i, j, k] = function(seeds[i], streams[j], counters[k])
    return out


def test_a_draw_depends_on_its_three_numbers_alone():
    seeds = np.arange(5)
    streams = np.arange(3)
    counters = np.arange(7)
    all_of_them = draws(random.normal, seeds, streams, counters)
    assert np.array_equal(
        draws(random.normal, seeds[::-1], streams, counters)[::-1], all_of_them
    )
    assert np.array_equal(
        draws(random.normal, seeds[3:4], streams, counters)[0], all_of_them[3]
    )
    swapped = draws(random.normal, np.array([1]), np.array([2]), np.array([3]))
    assert swapped != draws(random.normal, np.array([2]), np.array([1]), np.array([3]))


@njit
def normals(seeds, counters, count):
    out = np.empty((seeds, counters, count), np.float32)
    for i in range(seeds):
        for j in range(counters):
            by = random.key(i, 3, j)
            for k in range(count):
                run = random.run(by, k // random.RUN)
                out[i, j, k] = random.normal_of(run, k % random.RUN) * random.PER_STD
    return out


@pytest.fixture(scope="module")
def thousands():
    """Normals (30, 60, 1080) of seeds, counters and draws."""
    return normals(30, 60, 1080).astype(np.float64)


@pytest.mark.slow
def test_normals_by_the_thousand_are_standard_normal_far_out_too(thousands):
    sample = thousands.ravel()
    assert stats.kstest(sample, "norm").pvalue > 1e-3
    assert sample.std() == pytest.approx(1.0, abs=4.0 / np.sqrt(2.0 * sample.size))
    assert stats.kurtosis(sample) == pytest.approx(
        0.0, abs=4.0 * np.sqrt(24.0 / sample.size)
    )
    for share in (1e-3, 1e-4):
        far = stats.norm.isf(share)
        expected = share * sample.size
        for tail in (sample > far, sample < -far):
            assert tail.sum() == pytest.approx(expected, abs=4.0 * np.sqrt(expected))


@pytest.mark.slow
def test_bits_of_a_key_are_uniform_and_hardly_repeat():
    @njit
    def drawn(count):
        out = np.empty(count, np.float64)
        for k in range(count):
            out[k] = random.share_of(random.bits(random.key(5, 2, 7), k))
        return out

    sample = drawn(50_000)
    assert stats.kstest(sample, "uniform").pvalue > 1e-3
    assert (sample > 0.0).all()
    assert len(np.unique(sample)) > 0.98 * sample.size


def assert_uncorrelated(values):
    """No draw is correlated with its neighbour along any of three axes."""
    limit = 4.5 * values.var() / np.sqrt(values.size / 2)
    for axis in range(3):
        ahead = np.take(values, np.arange(1, values.shape[axis]), axis=axis)
        behind = np.take(values, np.arange(values.shape[axis] - 1), axis=axis)
        assert abs((ahead * behind).mean()) < limit


@pytest.mark.slow
@pytest.mark.parametrize(
    ("function", "name"), [(random.uniform, "uniform"), (random.normal, "norm")]
)
def test_draws_have_their_distribution_and_are_not_correlated(function, name):
    sample = draws(function, np.arange(40), np.arange(5), np.arange(1000))
    assert stats.kstest(sample.ravel(), name).pvalue > 1e-3
    assert len(np.unique(sample)) == sample.size
    assert_uncorrelated(sample - sample.mean())
    seeds = np.array([0, -1, 2**31 - 1, 2**62, -(2**62)])
    assert len(np.unique(draws(function, seeds, np.arange(1), np.arange(1)))) == 5


@pytest.mark.slow
def test_normals_of_neighbours_in_scan_counter_and_seed_are_not_correlated(thousands):
    assert_uncorrelated(thousands)
    assert_uncorrelated(np.abs(thousands) - np.sqrt(2.0 / np.pi))
