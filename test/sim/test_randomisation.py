from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import yaml
from robots import direct_model, lidar
from scipy import stats

from nics_drl_bridge.config import validate
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.generator import builtin_model
from nics_drl_bridge.lidar import fault_kernels
from nics_drl_bridge.lidar.faults import LidarFaults
from nics_drl_bridge.robot.kernels import make_terms
from nics_drl_bridge.robot.noise import MEASURED, Level, Noise
from nics_drl_bridge.sim.randomisation import (
    LidarRanges,
    Randomisation,
    Sampler,
    load_randomisation,
)

SEEDS = np.arange(4000)
ARRAYS = ("coefficient", "delay", "age", "noise", "faults", "count", "size")


def given(text: str = "{}") -> Randomisation:
    """The ranges of a YAML file."""
    data = {"name": "mine", **yaml.safe_load(text)}
    return validate(data, Randomisation, "mine.yaml")


def model():
    """Noisy odometry, a delay of 7 substeps of 10, and a lidar with faults of its own."""
    sensor = lidar(noise_std=0.01, faults={"dropout": 0.1, "skew": "clockwise"})
    return direct_model(latency=0.07, odometry=(0.05, 0.03), sensor=sensor)


def assert_even(values, low, high):
    assert stats.kstest(values, stats.uniform(low, high - low).cdf).pvalue > 1e-3


def test_nothing_named_is_exactly_the_model():
    drawn = Sampler(given(), model(), 2).draw([3, 4, 5])
    assert drawn.named() == {}
    assert drawn.count is None
    assert drawn.size is None
    for array, value in (
        (drawn.coefficient, make_terms(model().kinematics).coefficient),
        (drawn.noise, [0.05, 0.03, 0.0, 0.0, 0.0]),
        (drawn.faults, model().lidar.fault_parameters),
        (drawn.delay, 7),
        (drawn.age, 0),
    ):
        assert np.array_equal(array, np.broadcast_to(value, array.shape))
        assert array.shape[:2] == (3, 2)
        assert array.flags.c_contiguous


@pytest.mark.parametrize("name", ["mild", "strong"])
@pytest.mark.parametrize("robot", ["ackermann", "differential", "mecanum"])
def test_the_shipped_ranges_fit_every_shipped_robot(name, robot):
    ranges = load_randomisation(name)
    model = builtin_model(robot)
    drawn = Sampler(ranges, model, 2).draw(SEEDS)
    factor = drawn.coefficient / make_terms(model.kinematics).coefficient
    low, high = ranges.kinematics.scale
    assert low * (1.0 - 1e-12) <= factor.min() <= factor.max() <= high * (1.0 + 1e-12)
    assert factor.std(axis=0).min() > 0.2 * (high - low)
    assert {"action_latency_s", "lidar.noise_std"} <= drawn.named().keys()
    assert all(np.isfinite(value).all() for value in drawn.named().values())


def test_a_seed_gives_the_same_bits_in_any_batch_and_among_any_robots():
    ranges = load_randomisation("strong")
    many = Sampler(ranges, model(), 3)
    one = Sampler(ranges, model(), 1)
    together = many.draw([9, 2, 2**63 - 1])
    for row, seed in enumerate([9, 2, 2**63 - 1]):
        alone = many.draw([seed])
        single = one.draw([seed])
        for name in ARRAYS:
            assert np.array_equal(
                getattr(together, name)[row], getattr(alone, name)[0]
            ), name
            whole = getattr(single, name)[0]
            part = getattr(alone, name)[0]
            assert np.array_equal(part[:1] if part.ndim else part, whole), name
    assert len(np.unique(together.coefficient)) == together.coefficient.size


def test_naming_one_range_does_not_shift_the_draws_of_another():
    one = Sampler(given("lidar: {dropout: [0.0, 0.5]}"), model()).draw(SEEDS)
    ranges = given("""
        lidar: {dropout: [0.0, 0.5], noise_std: [0.0, 0.1], skew: [none, clockwise]}
        kinematics: {scale: [0.5, 2.0]}
        action_latency: [0.0, 3.0]
    """)
    more = Sampler(ranges, model()).draw(SEEDS)
    column = fault_kernels.DROPOUT
    assert np.array_equal(one.faults[..., column], more.faults[..., column])


def test_each_range_alone_leaves_the_others_as_they_are():
    whole = load_randomisation("mild")
    alone = whole.alone()
    named = ["kinematics", "action_latency", "observation_latency", "odometry", "lidar"]
    assert list(alone) == named
    for name, one in alone.items():
        assert getattr(one, name) == getattr(whole, name)
        assert one == Randomisation(**{"name": name, name: getattr(whole, name)})
    assert given().alone() == {}


def test_each_coefficient_is_scaled_evenly_and_on_its_own():
    drawn = Sampler(
        given("kinematics: {scale: [0.5, 2.0]}"), builtin_model("ackermann")
    ).draw(SEEDS)
    nominal = make_terms(builtin_model("ackermann").kinematics).coefficient
    factor = (drawn.coefficient / nominal)[:, 0]
    for column in factor.T:
        assert_even(column, 0.5, 2.0)
    related = np.corrcoef(factor.T) - np.eye(len(nominal))
    assert np.abs(related).max() < 5.0 / np.sqrt(len(SEEDS))
    assert (np.sign(drawn.coefficient) == np.sign(nominal)).all()


def test_a_slower_response_scales_all_rates_of_the_state_alike():
    model = builtin_model("ackermann")
    ranges = given("kinematics: {response: [1.0, 3.0]}")
    drawn = Sampler(ranges, model, 2).draw(SEEDS[:50])
    of_state = np.nonzero(model.kinematics.coefficients)[0] >= 3
    factor = make_terms(model.kinematics).coefficient / drawn.coefficient
    response = drawn.named()["kinematics.response"]
    assert np.allclose(factor[..., ~of_state], 1.0)
    assert np.allclose(factor[..., of_state], response[..., None])
    assert response.min() < 1.2
    assert response.max() > 2.8


def test_a_rate_and_a_term_may_have_ranges_of_their_own():
    ranges = given("""
        kinematics:
          scale: [0.9, 1.1]
          dofs: {wz: [2.0, 2.0]}
          terms: {wz: {steering*speed: [3.0, 4.0]}}
    """)
    nominal = builtin_model("ackermann").kinematics
    named = Sampler(ranges, builtin_model("ackermann")).draw(SEEDS).named()
    assert "kinematics.wz.speed*steering_command" not in named  # always twice as much
    for dof, term, span in (
        ("wz", "speed*steering", (3, 4)),
        ("vx", "speed", (0.9, 1.1)),
    ):
        place = nominal.dofs.index(dof), nominal.term_names.index(term)
        factor = named[f"kinematics.{dof}.{term}"][:, 0] / nominal.coefficients[place]
        assert_even(factor, *span)


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("kinematics: {dofs: {d_sped: [1, 2]}}", "did you mean 'd_speed'"),
        ("kinematics: {terms: {vy: {speed: [1, 2]}}}", "the rate has no terms"),
        ("kinematics: {terms: {wz: {speed: [1, 2]}}}", "no term 'speed' there"),
        ("kinematics: {scale: [1.0, 30.0]}", "the robot diverges"),
        ("odometry: {drift: [0.5, 2.0]}", "no measured drift to scale"),
        ("lidar: {dropout: [0.0, 0.4], dropout_far: [0.0, 0.7]}", "at most 1"),
        # beside the dropout of the lidar itself
        ("lidar: {dropout_far: [0.0, 0.95]}", "must add up to at most 1"),
    ],
)
def test_a_range_that_the_model_cannot_take_is_refused_by_its_key(text, match):
    car = dataclasses.replace(builtin_model("ackermann"), lidar=model().lidar)
    bare = dataclasses.replace(car, noise=model().noise)
    with pytest.raises(ConfigError, match=match):
        Sampler(given(text), bare)


@pytest.mark.parametrize(
    ("text", "key"),
    [
        ("kinematics: {scale: [1.1, 0.9]}", "'kinematics.scale'"),
        ("kinematics: {scale: [0.0, 0.9]}", "'kinematics.scale.0'"),
        ("kinematics: {dofs: {wz: [-1.0, 0.9]}}", "'kinematics.dofs.wz.0'"),
        ("action_latency: [-0.1, 0.9]", "'action_latency.0'"),
        ("observation_latency: [0, 51]", "'observation_latency.1'"),
        ("lidar: {dropuot: [0, 1]}", "did you mean 'dropout'?"),
        ("lidar: {skew: [anticlockwise]}", "'lidar.skew.0'"),
        ("odometry: {noise: [1, 2], odom_linear: [0, 1]}", "either the factor"),
        ("obstacles: {count: [4, 3]}", "count must be [minimum, maximum]"),
        ("obstacles: {size: [-1.0, 3]}", "'obstacles.size.0'"),
    ],
)
def test_a_wrong_range_is_refused_by_its_key(text, key):
    with pytest.raises(ConfigError) as caught:
        given(text)
    assert key in str(caught.value)


def test_latencies_are_rounded_to_substeps_and_added_to_the_model():
    ranges = given("{action_latency: [0.25, 1.5], observation_latency: [0.0, 0.5]}")
    sampler = Sampler(ranges, model(), 2)
    drawn = sampler.draw(SEEDS)
    assert (sampler.longest_delay, sampler.longest_age) == (7 + 15, 5)
    assert drawn.delay.min() == 7 + 3  # 2.5 substeps at least, rounded up
    counts = np.bincount(drawn.delay[:, 1] - 10)
    width = np.array([1.0] * 12 + [0.5])  # of the range that each is rounded from
    assert stats.chisquare(counts, width / width.sum() * len(SEEDS)).pvalue > 1e-3
    assert set(np.unique(drawn.age)) == set(range(6))
    named = drawn.named()
    assert np.allclose(named["action_latency_s"], drawn.delay * 0.01)
    assert named["observation_latency_s"].shape == (len(SEEDS), 2)


def test_odometry_is_scaled_or_given():
    drifting = dataclasses.replace(
        model(),
        noise=Noise(
            odom_linear=Level(std=0.05, unit="m/s"),
            position_drift=Level(std=0.02, unit="m/sqrt(s)", source=MEASURED),
        ),
    )
    ranges = given("odometry: {noise: [0.5, 2.0], drift: [1.0, 3.0]}")
    noise = Sampler(ranges, drifting).draw(SEEDS).noise[:, 0]
    assert_even(noise[:, 0], 0.025, 0.1)
    assert_even(noise[:, 2], 0.02, 0.06)
    assert np.array_equal(noise[:, 2], noise[:, 3])
    assert (noise[:, 4] == 0.0).all()  # the drift of the heading was not measured
    ranges = given("odometry: {odom_angular: [0.1, 0.2], heading_drift: [0.3, 0.4]}")
    noise = Sampler(ranges, drifting).draw(SEEDS).noise[:, 0]
    assert_even(noise[:, 1], 0.1, 0.2)
    assert_even(noise[:, 4], 0.3, 0.4)
    assert (noise[:, 0] == 0.05).all()


def test_every_fault_of_a_lidar_may_be_drawn():
    assert set(LidarRanges.model_fields) == {"noise_std", *LidarFaults.model_fields}


def test_the_lidar_gets_faults_within_the_ranges_and_keeps_the_others():
    ranges = given("lidar: {noise_std: [0.0, 0.05], too_close: [ghost, no_return]}")
    sampler = Sampler(ranges, model(), 2)
    drawn = sampler.draw(SEEDS)
    assert_even(drawn.faults[:, 1, fault_kernels.NOISE_STD], 0.0, 0.05)
    assert (drawn.faults[..., fault_kernels.DROPOUT] == 0.1).all()
    words, counts = np.unique(
        drawn.faults[..., fault_kernels.TOO_CLOSE], return_counts=True
    )
    assert words.tolist() == [fault_kernels.AS_NO_RETURN, fault_kernels.AS_GHOST]
    assert abs(counts[0] - len(SEEDS)) < 5.0 * np.sqrt(len(SEEDS) / 2.0)
    assert drawn.named().keys() == {"lidar.noise_std", "lidar.too_close"}


def test_number_and_size_of_the_obstacles_are_each_as_likely():
    ranges = given("obstacles: {count: [4, 6], size: [0.7, 1.3], rungs: 3}")
    assert np.allclose(ranges.sizes, [0.7, 1.0, 1.3])
    drawn = Sampler(ranges, model(), 2).draw(SEEDS)
    for whole, values in ((drawn.count, [4, 5, 6]), (drawn.size, [0, 1, 2])):
        found, counts = np.unique(whole, return_counts=True)
        assert found.tolist() == values
        assert stats.chisquare(counts).pvalue > 1e-3
    assert np.array_equal(
        drawn.named()["obstacles.size"], np.array(ranges.sizes)[drawn.size]
    )
    assert np.array_equal(drawn.named()["obstacles.count"], drawn.count)
