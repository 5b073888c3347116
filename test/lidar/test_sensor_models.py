from __future__ import annotations

import numpy as np
import pytest
from pydantic import Field

from nics_drl_bridge.config import Schema, load_yaml, parse_yaml, validate
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.lidar.sensor_models import (
    IncidenceDropout,
    Intensity,
    SensorModels,
    returned,
)
from nics_drl_bridge.lidar.shapes import Circle, describe
from nics_drl_bridge.lidar.spec import LidarSpec
from nics_drl_bridge.sim.world import Obstacles

RANGES = np.array([1.0, 1.0, 2.0, 2.0], np.float32)
INCIDENCE = np.array([0.0, 1.2, 0.0, 1.2])
INF = np.inf


class SensorModelFile(Schema):
    """The part of a lidar's file that is of surfaces."""

    sensor_model: SensorModels = Field(min_length=1)


def test_a_surface_at_a_right_angle_at_one_metre_returns_the_gain():
    model = Intensity(gain=7.0)
    assert model.gain * model.reflectance(1.0, 1.0) == 7.0
    assert model.reflectance(np.cos(1.0), 0.4) == pytest.approx(0.4 * np.cos(1.0))
    assert Intensity(exponent=0.0, reflectivity=0.3).reflectance(0.2, None) == 0.3


def test_each_model_loses_its_own_returns_and_together_they_lose_all_of_them():
    grazing = IncidenceDropout(greatest_incidence=1.0)
    dim = Intensity(gain=1.0, threshold=0.2)  # a half at 1 m, an eighth at 2 m
    for models, expected in (
        ((), [1.0, 1.0, 2.0, 2.0]),
        ((grazing,), [1.0, INF, 2.0, INF]),
        ((dim,), [1.0, INF, INF, INF]),  # cos(1.2) is 0.36
        ((grazing, dim), [1.0, INF, INF, INF]),
    ):
        assert returned(models, RANGES, INCIDENCE, None).tolist() == expected
    assert returned((dim,), RANGES, INCIDENCE, 1.0).tolist() == [1.0, 1.0, 2.0, INF]


def test_a_file_of_sensor_models_reads_to_what_it_says(tmp_path):
    path = tmp_path / "polished.yaml"
    path.write_text(
        "sensor_model:\n"
        "  - {kind: incidence_dropout, greatest_incidence: 1.3}\n"
        "  - {kind: intensity, gain: 200.0, threshold: 0.5}\n"
    )
    grazing, bright = load_yaml(path, SensorModelFile).sensor_model
    assert grazing == IncidenceDropout(greatest_incidence=1.3)
    assert bright == Intensity(gain=200.0, threshold=0.5)
    assert str(grazing) == "nothing from beyond 74.48 deg of incidence"
    assert str(bright) == "intensity 200 at 1 m, below 0.5 nothing, reflectivity 0.5"


@pytest.mark.parametrize(
    ("models", "sentence"),
    [
        (
            "[{kind: intensity, treshold: 1}]",
            "unknown key 'sensor_model.0.intensity.treshold'; did "
            "you mean 'threshold'?",
        ),
        ("[{kind: intensty}]", "unknown kind 'intensty'; did you mean 'intensity'?"),
        ("[{gain: 3}]", "the key 'sensor_model.0.kind' is missing; add it."),
        (
            "[{kind: incidence_dropout, greatest_incidence: 75}]",
            "input should be less than 1.5707963267948966, not 75.",
        ),
        (
            "[{kind: intensity}, {kind: intensity}]",
            "one model of the kind intensity; keep one",
        ),
        ("[{kind: intensity, reflectivity: 0}]", "should be greater than 0, not 0."),
    ],
)
def test_a_wrong_sensor_model_is_one_sentence(models, sentence):
    with pytest.raises(ConfigError) as caught:
        validate(
            parse_yaml(f"sensor_model: {models}", "mine.yaml"),
            SensorModelFile,
            "mine.yaml",
        )
    assert str(caught.value).startswith("mine.yaml: ")
    assert sentence in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_lidar_names_its_sensor_model_and_has_none_by_default():
    about = {
        "beams": 9,
        "angle_min": 0.0,
        "angle_max": 1.0,
        "range_min": 0.1,
        "range_max": 2.0,
        "rate": 10.0,
    }
    assert LidarSpec.model_validate(about).sensor_model == ()
    spec = LidarSpec.model_validate(
        about | {"sensor_model": [{"kind": "intensity", "gain": 3}]}
    )
    assert spec.sensor_model == (Intensity(gain=3.0),)
    assert LidarSpec.model_validate(spec.model_dump(mode="json")) == spec


def test_shapes_of_different_reflectivity_are_different_shapes():
    text = "{kind: circle, radius: 1}, {kind: circle, radius: 1, reflectivity: 0.1}"
    text = f"{{count: 1, shapes: [{text}]}}"
    plain, dark = validate(parse_yaml(text, "s.yaml"), Obstacles, "s.yaml").shapes
    assert plain == Circle(radius=1.0)
    assert plain != dark
    assert describe(dark) == "circle of radius 1 m, reflectivity 0.1"
    with pytest.raises(
        ConfigError, match=r"reflectivity': input should be greater than 0, not -1"
    ):
        validate(parse_yaml(text.replace("0.1", "-1"), "s.yaml"), Obstacles, "s.yaml")
