from __future__ import annotations

import numpy as np
import pytest
import yaml
from robots import lidar

from nics_drl_bridge.config import find_config, validate
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
    assert np.angle(
        directions[-1] * np.exp(1j * spec.angle_increment) / directions[0]
    ) == (pytest.approx(0.0, abs=1e-9))


@pytest.mark.parametrize("beams", [2, 3, 181])
def test_a_partial_circle_ends_with_a_beam_at_angle_max(beams):
    spec = lidar(beams=beams, angle_min=-1.5, angle_max=2.0)
    assert not spec.full_circle
    assert spec.angles[0] == -1.5
    assert spec.angles[-1] == pytest.approx(2.0)
    assert spec.angle_increment * (beams - 1) == pytest.approx(3.5)
    assert np.allclose(np.diff(spec.angles), spec.angle_increment)


def test_every_shipped_lidar_is_read_by_its_name_and_names_its_source():
    for path in find_config("paper", "lidars").parent.glob("*.yaml"):
        assert load_lidar(path.stem).name == path.stem
        assert path.read_text(encoding="utf-8").startswith("# ")


@pytest.mark.parametrize("start", [-np.pi, 0.0, -1.0])
@pytest.mark.parametrize("full", [True, False])
@pytest.mark.parametrize("beams", [2, 7, 811, 1081, 100_000])
def test_readers_of_the_header_count_the_beams_in_float32(beams, full, start):
    spec = lidar(
        beams=beams, angle_min=start, angle_max=start + (2.0 * np.pi if full else 4.0)
    )
    low, high, step = (np.float32(value) for value in spec.header[:3])
    assert round(float((high - low) / step)) + 1 == beams
    assert round(float(high) - float(low), 12) < round(2.0 * np.pi, 12)


def test_the_header_is_that_of_the_beams():
    spec = lidar(beams=100, angle_min=-1.0, angle_max=2.0, rate=20.0)
    header = spec.header
    assert (header.angle_min, header.angle_max) == (spec.angles[0], spec.angles[-1])
    assert header.angle_increment == spec.angle_increment
    assert header.scan_time == 0.05
    assert (header.range_min, header.range_max) == (spec.range_min, spec.range_max)


@pytest.mark.parametrize(
    ("skew", "sign"), [("counter_clockwise", 1.0), ("clockwise", -1.0), ("none", 0.0)]
)
def test_a_turn_takes_one_scan_time_and_the_increment_has_the_sign_of_the_turn(
    skew, sign
):
    spec = lidar(beams=400, rate=4.0, faults={"skew": skew})
    assert spec.beam_time == pytest.approx(0.25 / 400)
    assert spec.sweep_time == pytest.approx(0.25)
    assert spec.header.time_increment == pytest.approx(sign * 0.25 / 400)


def test_a_part_of_a_turn_takes_a_part_of_the_scan_time():
    hokuyo = load_lidar("hokuyo_ust_10lx")  # a turn of 25 ms has 1440 steps
    assert hokuyo.beam_time == pytest.approx(0.025 / 1440)
    assert hokuyo.sweep_time == pytest.approx(0.025 * 1081 / 1440)


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("beams: 0", "key 'beams'"),
        ("range_min: 3.0", "range_min must be less than range_max"),
        ("range_min: -0.1", "key 'range_min'"),
        ("{angle_min: 1.0, angle_max: 1.0}", "angle_max must exceed angle_min"),
        (
            "{angle_min: -180.0, angle_max: 180.0}",
            "by at most a full circle, in radians",
        ),
        ("{angle_min: 10.0, angle_max: 12.0}", "within -2 pi and 2 pi"),
        ("rate: 0.0", "key 'rate'"),
        ("mount: [0.0, 0.0, 180.0]", "'mount.2': must be in radians, within 2 pi"),
        ("mount: [120.0, 0.0, 0.0]", "'mount.0': must be in metres, within 10"),
        ("range_max: .inf", "key 'range_max'"),
        ("beem: 3", "did you mean 'beams'"),
        ("no_return: minus one", "key 'no_return'"),
        ("{no_return: zero, range_min: 0.0}", "range_min must be greater than 0"),
        ("faults: {dropout: 1.5}", "key 'faults.dropout'"),
        ("faults: {dropout: 0.6, dropout_far: 0.6}", "must add up to at most 1"),
        ("faults: {quantisation: 4.0}", "faults.quantisation must be less than"),
    ],
)
def test_a_lidar_that_cant_be_is_refused_in_one_sentence(text, sentence):
    content = lidar().model_dump() | yaml.safe_load(text)
    with pytest.raises(ConfigError) as caught:
        validate(content, LidarSpec, "lidar.yaml")
    assert sentence in str(caught.value)
    assert "\n" not in str(caught.value)


def test_an_empty_sensor_model_of_an_earlier_version_is_read_and_another_refused():
    content = lidar(beams=4).model_dump(mode="json")
    assert validate(content | {"sensor_model": []}, LidarSpec, "x") == lidar(beams=4)
    models = [{"kind": "incidence_dropout", "greatest_incidence": 1.0}]
    with pytest.raises(ConfigError, match="sensor models are no longer") as refused:
        validate(content | {"sensor_model": models}, LidarSpec, "lidar.yaml")
    assert str(refused.value).startswith("lidar.yaml: ")
    assert "\n" not in str(refused.value)
