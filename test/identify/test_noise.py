from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from identify.drives import drive, fit_trial, slipping_car
from nics_drl_bridge import geometry
from nics_drl_bridge.config import dump_yaml, parse_yaml
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.files import SUMS
from nics_drl_bridge.generator import builtin_model, load_model, save_model
from nics_drl_bridge.identify.drive import Drive
from nics_drl_bridge.identify.identify import identify
from nics_drl_bridge.identify.noise import list_claimed_levels, measure_sensor_noise
from nics_drl_bridge.recording.recording import Recording, Stream
from nics_drl_bridge.recording.textbook import record
from nics_drl_bridge.robot.noise import MEASURED, Level, Noise

ODOMETRY = 0.03, 0.05  # m/s, rad/s
DRIFT = 0.02, 0.03  # m/sqrt(s), rad/sqrt(s)
TOLERANCE = 0.2


def measured(std: float, unit: str) -> Level:
    return Level(std=std, unit=unit, source=MEASURED)


NOISE = Noise(
    odom_linear=measured(ODOMETRY[0], "m/s"),
    odom_angular=measured(ODOMETRY[1], "rad/s"),
    position_drift=measured(DRIFT[0], "m/sqrt(s)"),
    heading_drift=measured(DRIFT[1], "rad/sqrt(s)"),
)


def drifting(spec, seed: int, duration: float = 150.0) -> Recording:
    """A textbook drive that drifts, with noisy odometry."""
    rng = np.random.default_rng(seed)
    clean = record(spec, rng, duration)
    pose = clean.pose.values
    dt = float(clean.pose.t[1] - clean.pose.t[0])
    step = geometry.between(pose[:-1], pose[1:])
    push = rng.normal(size=step.shape) * np.sqrt(dt) * np.array([DRIFT[0], *DRIFT])
    path = [pose[0]]
    for relative in geometry.compose(step, push):
        path.append(geometry.compose(path[-1], relative))
    twist = geometry.log(step) / dt
    twist += rng.normal(size=twist.shape) * np.array([ODOMETRY[0], *ODOMETRY])
    return replace(
        clean,
        pose=replace(clean.pose, values=np.array(path)),
        odometry=Stream(clean.pose.t[:-1] + dt / 2.0, twist),
    )


def levels(noise: Noise) -> np.ndarray:
    return np.array(
        [*noise.odometry, noise.position_drift.std, noise.heading_drift.std]
    )


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.campaign)])
def test_a_drive_of_known_noise_gives_it_back(differential, seed):
    found = fit_trial(
        drifting(differential, seed), differential, order=1, train_until=20.0
    )
    known = np.array([*ODOMETRY, *DRIFT])
    assert levels(found.noise) == pytest.approx(known, rel=TOLERANCE)


@pytest.mark.campaign
def test_the_uncertainty_of_a_level_covers_its_error(differential):
    found = [
        identify(drifting(differential, seed, 90.0), differential) for seed in range(3)
    ]
    for name, known in (("position_drift", DRIFT[0]), ("heading_drift", DRIFT[1])):
        found_levels = [getattr(f.noise, name) for f in found]
        away = [(level.std - known) / level.uncertainty for level in found_levels]
        assert np.abs(away).max() < 4.0
        assert all(0.0 < level.uncertainty < 0.3 * known for level in found_levels)


@pytest.mark.slow
def test_noise_of_the_pose_is_no_drift_of_the_robot(differential):
    recording = drive(differential, duration=90.0, noise=(0.005, 0.01))
    found = fit_trial(recording, differential, order=1, train_until=30.0).noise
    assert found.pose_position.std == pytest.approx(0.005, rel=TOLERANCE)
    assert found.pose_heading.std == pytest.approx(0.01, rel=TOLERANCE)
    assert found.position_drift.std < 0.003
    assert found.heading_drift.std < 0.009


def test_without_odometry_its_noise_is_assumed_and_the_report_says_so(differential):
    found = identify(record(differential, np.random.default_rng(0), 30.0), differential)
    assert not found.noise.odom_linear.measured
    assert found.noise.odometry == Noise().odometry
    lines = found.noise.sentences()
    assert sum(line.endswith("assumed") for line in lines) == 2


def test_the_levels_are_saved_with_unit_and_source(tmp_path):
    model = replace(builtin_model("differential"), noise=NOISE)
    save_model(model, tmp_path / "model")
    text = (tmp_path / "model" / "model.yaml").read_text()
    row = parse_yaml(text, "model")["noise"]["odom_linear"]
    assert (row["std"], row["unit"], row["source"]) == (ODOMETRY[0], "m/s", "measured")
    assert load_model(tmp_path / "model").noise == NOISE


def test_a_level_in_another_unit_is_refused(tmp_path):
    save_model(builtin_model("differential"), tmp_path / "model")
    path = tmp_path / "model" / "model.yaml"
    data = parse_yaml(path.read_text(), "model")
    data["noise"]["odom_angular"]["unit"] = "deg/s"
    path.write_text(dump_yaml(data))
    sums = path.with_name(SUMS)
    lines = sums.read_text().splitlines(keepends=True)
    sums.write_text("".join(line for line in lines if "model.yaml" not in line))
    with pytest.raises(ConfigError, match="odom_angular must be in rad/s"):
        load_model(tmp_path / "model")


def test_the_noise_of_a_pose_is_no_less_than_its_covariances_say():
    spec, recording = slipping_car(duration=10.0)
    pose = recording.pose
    shown = measure_sensor_noise(Drive(recording, spec))
    assert shown.pose_position.std < 0.001
    sigma = np.tile([0.02, 0.03, 0.05], (len(pose.t), 1))
    sigma[::2], sigma[1, 0], sigma[:, 1] = np.nan, np.inf, 0.0  # unknown
    sigma[1::2, 1] = 0.03
    told = shown.model_copy(update=list_claimed_levels(shown, sigma))
    assert told.pose == pytest.approx((0.025, 0.025, 0.05))
    assert not told.pose_position.measured
    for none in (None, 1e-9 * sigma, np.nan * sigma):
        assert list_claimed_levels(shown, none) == {}
