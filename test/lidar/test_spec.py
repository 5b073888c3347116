from __future__ import annotations

import numpy as np
import pytest
from robots import lidar

from nics_drl_bridge.config import validate
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.lidar.spec import LidarSpec, load_lidar


@pytest.mark.parametrize("start", [-np.pi, 0.0, -2.0 * np.pi, -1.0])
@pytest.mark.parametrize("beams", [1, 2, 7, 720])
def test_a_full_circle_has_no_double_beam(beams, start):
    spec = lidar(beams=beams, angle_min=start, angle_max=start + 2.0 * np.pi)
    assert spec.full_circle
    assert spec.angle_increment == pytest.approx(2.0 * np.pi / beams)
    directions = np.exp(1j * spec.angles)
    gaps = np.abs(directions[:, None] - directions) + 9.0 * np.eye(beams)
    assert gaps.min() > 1e-3
    assert np.angle(directions[-1] * np.exp(1j * spec.angle_increment) / directions[0]) == (
        pytest.approx(0.0, abs=1e-9)
    )


@pytest.mark.parametrize("beams", [2, 3, 181])
def test_a_partial_circle_ends_with_a_beam_at_angle_max(beams):
    spec = lidar(beams=beams, angle_min=-1.5, angle_max=2.0)
    assert not spec.full_circle
    assert spec.angles[0] == -1.5
    assert spec.angles[-1] == pytest.approx(2.0)
    assert spec.angle_increment * (beams - 1) == pytest.approx(3.5)
    assert np.allclose(np.diff(spec.angles), spec.angle_increment)


def test_directions_are_cosine_and_sine_of_the_angles():
    spec = lidar(beams=100, angle_min=0.1, angle_max=2.3)
    assert spec.directions.shape == (100, 2)
    assert np.allclose(spec.directions[:, 0], np.cos(spec.angles), atol=1e-6)
    assert np.allclose(spec.directions[:, 1], np.sin(spec.angles), atol=1e-6)


def test_the_papers_lidar_is_shipped():
    spec = load_lidar("paper")
    assert (spec.beams, spec.range_max, spec.full_circle) == (720, 3.0, True)


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"beams": 0}, "key 'beams'"),
        ({"range_min": 3.0}, "range_min must be less than range_max"),
        ({"range_min": -0.1}, "key 'range_min'"),
        ({"angle_max": -np.pi}, "angle_max must exceed angle_min"),
        ({"angle_min": -180.0, "angle_max": 180.0}, "by at most a full circle, in radians"),
        ({"angle_min": 10.0, "angle_max": 12.0}, "within -2 pi and 2 pi"),
        ({"angle_min": -12.0, "angle_max": -10.0}, "within -2 pi and 2 pi"),
        ({"rate": 0.0}, "key 'rate'"),
        ({"mount": [0.0, 0.0]}, "key 'mount"),
        ({"noise_std": -1.0}, "key 'noise_std'"),
        ({"range_max": float("inf")}, "key 'range_max'"),
        ({"beem": 3}, "did you mean 'beams'"),
    ],
)
def test_a_lidar_that_cant_be_is_refused_in_one_sentence(changes, sentence):
    with pytest.raises(ConfigError) as caught:
        validate(lidar().model_dump() | changes, LidarSpec, "lidar.yaml")
    assert sentence in str(caught.value)
    assert "\n" not in str(caught.value)


def test_two_lidars_keep_their_own_beams():
    one, other = lidar(beams=10), lidar(beams=20)
    assert (len(one.angles), len(other.angles), len(one.angles)) == (10, 20, 10)
