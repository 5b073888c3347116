"""Worlds of Gazebo as DART's own parser reads them, against this package's reading."""

from pathlib import Path

import pytest

pytest.importorskip("dartpy", reason="needs DART: the extra `dart`")

from dart_worlds import compare_readings

BARN = Path(__file__).resolve().parents[4] / "shared" / "barn" / "gazebo"
POSES = 8  # per world
pytestmark = pytest.mark.slow


@pytest.mark.parametrize("number", [1, 2, 50, 151, 200, 299])
def test_a_published_world_looks_the_same_to_dart_and_to_this_package(number):
    path = BARN / f"world_{number}.world"
    if not path.is_file():
        pytest.skip("the benchmark's worlds are not on this machine")
    read = compare_readings(path, number, POSES)
    assert read.by_dart == read.solids
    assert read.hits > 50 * POSES
    assert read.same >= 0.999 * read.beams
