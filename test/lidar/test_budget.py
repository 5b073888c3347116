from __future__ import annotations

import numpy as np
import pytest
from robots import lidar

from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.lidar.bake import bake
from nics_drl_bridge.lidar.budget import (
    SEED,
    choose,
    densest,
    expected_rmse,
    parse_size,
    table_bytes,
)
from nics_drl_bridge.lidar.scanner import Scanner
from nics_drl_bridge.lidar.shapes import SQUARE, STRIP, Circle, Polygon
from nics_drl_bridge.lidar.table import Density

SPEC = lidar(beams=360)
ROUND = Circle(radius=0.15)
MIXTURE = (ROUND, SQUARE, STRIP)
TRIANGLE = Polygon(points=((0.0, 0.0), (0.4, 0.0), (0.1, 0.2)))


@pytest.mark.parametrize(
    ("text", "size"),
    [
        ("8MB", 8_000_000),
        ("500kB", 500_000),
        ("500 kb", 500_000),
        ("8MiB", 8 * 2**20),
        ("1.5GB", 1_500_000_000),
        ("2GiB", 2 * 2**30),
        ("4096", 4096),
        ("4096B", 4096),
    ],
)
def test_a_size_is_read_with_its_unit(text, size):
    assert parse_size(text) == size


@pytest.mark.parametrize(
    "text", ["", "MB", "8XB", "-8MB", "8 M B", "0MB", "nan", "1e400", "9" * 99]
)
def test_nonsense_is_no_size(text):
    with pytest.raises(ConfigError, match=r"^budget '.*': is no size; give one like 8MB, 500kB"):
        parse_size(text)


@pytest.mark.parametrize("shapes", [(), (ROUND,), MIXTURE, (TRIANGLE, SQUARE, SQUARE)])
@pytest.mark.parametrize(
    "density", [Density(distances=3, rotations=8, phases=1), Density(distances=40, rotations=50)]
)
def test_the_size_of_a_table_is_known_before_it_is_baked(shapes, density):
    assert table_bytes(SPEC, shapes, density) == bake(SPEC, shapes, density).memory


@pytest.mark.parametrize("budget", [200_000, 700_000, 4_000_000])
def test_as_many_distances_as_fit_are_taken(budget):
    density = densest(SPEC, MIXTURE, budget, 40, 2)
    more = density.model_copy(update={"distances": round(density.distances * 1.03) + 1})
    assert table_bytes(SPEC, MIXTURE, density) <= budget < table_bytes(SPEC, MIXTURE, more)
    assert densest(SPEC, MIXTURE, 1000, 40, 2) is None


@pytest.fixture(scope="module")
def chosen():
    return choose(SPEC, MIXTURE, 1_000_000)


def test_the_chosen_table_fits_and_errs_less_than_others_of_its_size(chosen):
    assert 900_000 < len(chosen.table.dump()) <= 1_000_000
    assert chosen.rmse == expected_rmse(SPEC, chosen.table)
    assert chosen.tried > 5
    for rotations, phases in ((12, 4), (60, 4), (240, 4), (240, 1), (1000, 1), (60, 1)):
        density = densest(SPEC, MIXTURE, 1_000_000, rotations, phases)
        other = expected_rmse(SPEC, bake(SPEC, MIXTURE, density))
        assert chosen.rmse <= 1.02 * other, density


def test_the_expected_error_agrees_with_scenes_that_it_has_not_seen(chosen):
    exact, baked = (Scanner(SPEC, chosen.table, renderer) for renderer in ("exact", "baked"))
    rng = np.random.default_rng(99)
    squares = []
    for _ in range(600):
        shapes = [MIXTURE[i] for i in rng.integers(3, size=10)]
        poses = rng.uniform(-1.0, 1.0, (10, 3)) * [3.2, 3.2, np.pi]
        poses = poses[np.hypot(*poses[:, :2].T) > [shape.radius for shape in shapes]]
        bodies = exact.place(shapes[: len(poses)], poses)
        one, other = (
            np.nan_to_num(scanner.scan(np.zeros(3), bodies), posinf=SPEC.range_max, neginf=0.0)
            for scanner in (baked, exact)
        )
        squares.append(np.mean((one - other) ** 2))
    assert np.sqrt(np.mean(squares)) == pytest.approx(chosen.rmse, rel=0.35)
    assert expected_rmse(SPEC, chosen.table, SEED + 1) == pytest.approx(chosen.rmse, rel=0.35)


def test_a_choice_is_the_same_each_time(chosen):
    again = choose(SPEC, MIXTURE, 1_000_000)
    assert again.rmse == chosen.rmse
    assert again.table.dump() == chosen.table.dump()


def test_more_memory_never_errs_more_and_circles_are_baked_at_one_rotation():
    errors = [choose(SPEC, (ROUND,), budget).rmse for budget in (20_000, 100_000, 1_000_000)]
    assert errors == sorted(errors, reverse=True)
    assert choose(SPEC, (ROUND,), 20_000).tried <= 8


def test_what_is_tried_is_told():
    told = []
    found = choose(SPEC, (SQUARE,), 60_000, told.append)
    assert len(told) == sum(1 for _ in told) <= found.tried
    assert all(line.count(" x ") == 2 for line in told)


def test_a_budget_that_is_too_small_names_the_least():
    with pytest.raises(ConfigError, match=r"^a budget of 1,000 bytes is too small: .* takes") as e:
        choose(SPEC, MIXTURE, 1000)
    least = int(str(e.value).split("takes ")[1].split(" bytes")[0].replace(",", ""))
    assert len(choose(SPEC, MIXTURE, least).table.dump()) <= least
    with pytest.raises(ConfigError, match="too small"):
        choose(SPEC, MIXTURE, least - 1)
