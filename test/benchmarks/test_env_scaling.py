from __future__ import annotations

import pytest

from .runs import BENCHMARKS, asked, fails

SCRIPT = "env_scaling.py"
FEW = ("--ends-only", "--repeats", "5")
CURVES = {
    "worlds": 16384,
    "robots": 64,
    "obstacles": 256,
    "beams": 2048,
    "members": 250,
}
pytestmark = pytest.mark.timeout(300)  # a cold start compiles


@pytest.fixture
def benchmark(monkeypatch):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    import env_scaling

    return env_scaling


@pytest.mark.campaign
def test_the_curves_are_lists_under_their_names_and_are_drawn(tmp_path):
    picture = tmp_path / "scaling.png"
    _, found = asked(SCRIPT, *FEW, "--picture", str(picture))
    for name, greatest in CURVES.items():
        assert found[name][-1] == greatest
        assert len(found[f"{name}_us"]) == len(found[name]) == 2
        assert min(found[f"{name}_us"]) > 0.0
    assert picture.stat().st_size > 1000


@pytest.mark.campaign
def test_robots_that_each_look_at_each_other_miss_the_bar_of_robots():
    assert any(
        line.startswith("robots: 64 cost ") for line in fails(SCRIPT, "quadratic", *FEW)
    )


@pytest.mark.campaign
def test_worlds_that_are_stepped_one_by_one_miss_the_bar_of_worlds():
    assert any(
        line.startswith("worlds: 16384 cost ") for line in fails(SCRIPT, "slow", *FEW)
    )


@pytest.mark.campaign
def test_worlds_of_a_set_in_a_vector_env_each_miss_the_bars_of_members():
    missed = fails(SCRIPT, "apart", *FEW)
    assert any(line.startswith("members: 250 cost ") for line in missed)
    assert any(line.startswith("members: 250 take ") for line in missed)


@pytest.mark.parametrize("times", [1.6, float("nan")])
def test_a_set_that_takes_much_more_memory_misses_its_bar(benchmark, times):
    result = {name: [1, greatest] for name, greatest in CURVES.items()}
    flat = {"end_to_end": dict.fromkeys(CURVES, 0.4), "members_memory": times}
    (missed,) = benchmark.judge({**result, **flat})
    assert missed.startswith("members: 250 take ")


@pytest.mark.parametrize("name", CURVES)
@pytest.mark.parametrize("times", [13.0, float("nan")])
def test_a_curve_that_grows_too_much_or_is_no_number_misses_its_bar(
    benchmark, name, times
):
    flat = dict.fromkeys(CURVES, 0.4)
    result = {name: [1, greatest] for name, greatest in CURVES.items()}
    result["members_memory"] = 1.2
    assert benchmark.judge({**result, "end_to_end": flat}) == []
    (missed,) = benchmark.judge({**result, "end_to_end": {**flat, name: times}})
    assert missed.startswith(f"{name}: {CURVES[name]} cost ")
