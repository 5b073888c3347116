import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from nics_drl_bridge.errors import FitError
from nics_drl_bridge.identify.fit import fit
from nics_drl_bridge.identify.identify import identify
from nics_drl_bridge.threads import one_blas_thread, run_parts


def blas_threads() -> set[int]:
    """Of each BLAS that is loaded."""
    np.ones((2, 2)) @ np.ones((2, 2))
    return {
        pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"
    }


@pytest.fixture(autouse=True)
def two_threads():
    with threadpool_limits(limits=2, user_api="blas"):
        if blas_threads() != {2}:
            pytest.skip("this BLAS has one thread only")
        yield


def test_linear_algebra_has_one_thread_for_as_long_as_the_function_runs():
    assert one_blas_thread(blas_threads)() == {1}
    assert blas_threads() == {2}


@pytest.mark.parametrize("function", [fit, identify])
def test_whatever_solves_many_small_systems_is_limited(function):
    seen = []

    class Given:
        """Not what the function takes: it only tells how many threads there are when used."""

        def __getattr__(self, name):
            seen.append(blas_threads())
            raise FitError("seen.")

    with pytest.raises(FitError, match="seen"):
        function(Given(), Given())
    assert seen[0] == {1}


@pytest.mark.parametrize("parts", [1, 2, 7])
def test_parts_give_their_results_in_order(parts):
    for _ in range(3):
        assert run_parts(lambda part: part * part, range(parts)) == [
            n * n for n in range(parts)
        ]


@pytest.mark.parametrize("broken", [0, 1])
def test_an_error_in_a_part_is_raised_after_all_have_ended(broken):
    ended = []

    def work(part: int) -> None:
        if part == broken:
            raise ValueError(f"part {part}")
        ended.append(part)

    with pytest.raises(ValueError, match=f"part {broken}"):
        run_parts(work, range(2))
    assert ended == [1 - broken]
