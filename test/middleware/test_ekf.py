"""What is taken for an outlier, for news and for a jump; and that the filter stays healthy."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from robots import direct_model, field
from scipy.stats import chi2

from nics_drl_bridge import geometry
from nics_drl_bridge.env.sim_backend import SimBackend
from nics_drl_bridge.generator import builtin_model
from nics_drl_bridge.interface import Start
from nics_drl_bridge.middleware import kernels
from nics_drl_bridge.middleware.ekf import Estimator
from nics_drl_bridge.middleware.kernels import MotionModel
from nics_drl_bridge.middleware.measurement import Acceptance, Kind, Measurement
from nics_drl_bridge.robot.kernels import SERIES, make_terms
from nics_drl_bridge.robot.noise import Level, Noise
from nics_drl_bridge.sim.randomisation import Randomisation
from nics_drl_bridge.sim.simulator import FastSimulator

ROBOTS = ("ackermann", "differential", "mecanum")
SECOND = 1_000_000_000
PERIOD = SECOND // 10


def numerical_jacobian(function, x, step=1e-6):
    columns = []
    for i in range(len(x)):
        ahead = x.copy()
        behind = x.copy()
        ahead[i] += step
        behind[i] -= step
        columns.append((function(ahead) - function(behind)) / (2.0 * step))
    return np.stack(columns, axis=1)


def correct(estimator, kind, value, std=None):
    """Corrects by a value with deviations, by default those of the model."""
    noise = None if std is None else np.diag(np.atleast_1d(std) ** 2.0)
    measured = np.atleast_1d(value).astype(float)
    return estimator.correct(Measurement(kind, measured, noise))


def random_mean(model, rng):
    state = [rng.uniform(v.min, v.max) / 2.0 for v in model.robot.state]
    return np.array([*rng.normal(size=2), rng.uniform(-2.5, 2.5), *state])


def random_command(model, rng):
    return rng.uniform(model.robot.command_low, model.robot.command_high)


@pytest.mark.parametrize(
    ("robot", "dt", "steps"),
    [("ackermann", 0.003, 1), ("differential", 0.01, 10), ("mecanum", 0.01, 10)],
)
def test_the_transition_is_the_numerical_derivative_of_the_motion(robot, dt, steps):
    model = builtin_model(robot)
    rng = np.random.default_rng(1)
    motion = MotionModel(make_terms(model.kinematics), SERIES, 0, 0)
    for _ in range(10):
        mean = random_mean(model, rng)
        command = random_command(model, rng)
        size = len(mean)

        def of(given, command=command, size=size):
            # of the state's rates
            end = given[:size].copy()
            error = given[size:]
            for _ in range(steps):
                kernels.step_mean(
                    end, kernels.make_transition(size, 0.0), command, dt, 1, motion
                )
                end[3:] += error * dt
            end[2] = given[2] + geometry.wrap_angle(end[2] - given[2])
            return end

        derivative = kernels.make_transition(len(mean), 0.0)
        moved = mean.copy()
        kernels.step_mean(moved, derivative, command, dt, steps, motion)
        start = np.append(mean, np.zeros(len(mean) - 3))
        assert derivative == pytest.approx(numerical_jacobian(of, start), abs=2e-5)


@pytest.mark.parametrize("latency", [0.0, 0.03, 0.25])
def test_a_command_acts_one_latency_after_it_was_sent(latency):
    estimator = Estimator(direct_model(latency))
    estimator.reset(0, np.zeros(3))
    estimator.add_command(PERIOD, [1.0, 0.0, 0.0])
    estimator.add_command(4 * PERIOD, [0.0, 0.0, 0.0])
    for tenths in range(10):
        pose, twist = estimator.look_ahead(tenths * PERIOD)
        now = tenths * 0.1
        assert pose[0] == pytest.approx(
            np.clip(now - 0.1 - latency, 0.0, 0.3), abs=1e-9
        )
        moving = 0.1 + latency < now - 1e-9 <= 0.4 + latency
        assert twist[0] == pytest.approx(float(moving))


def simulated_drive(simulator, seconds, seed, pose_std=None, noise=1.0):
    """Errors (T, 3) of the estimate and their covariances, in the robot's frame."""
    model = simulator.model
    estimator = Estimator(model)
    rng = np.random.default_rng(seed)
    start = np.array([0.0, 0.0, 3.0])
    simulator.reset([seed], starts=start[None, None])
    estimator.reset(0, start)
    errors = []
    covariances = []
    command = random_command(model, rng)
    for step in range(seconds * 10):
        if step % 5 == 0:
            command = random_command(model, rng)
        estimator.add_command(step * PERIOD, command)
        simulator.step(command[None, None])
        now = (step + 1) * PERIOD
        estimator.predict(now)
        correct(estimator, Kind.TWIST, simulator.data.twist[0, 0])
        true = simulator.data.pose[0, 0]
        if pose_std is not None and step % 10 == 9:
            measured = true + rng.normal(size=3) * noise * pose_std
            correct(estimator, Kind.POSE, measured, np.full(3, pose_std))
        errors.append(geometry.between(true, estimator.look_ahead(now)[0]))
        turn = np.eye(3)
        turn[:2, :2] = geometry.rotate(np.eye(2), true[2]).T
        covariances.append(turn.T @ estimator.covariance[:3, :3] @ turn)
    return np.array(errors), np.array(covariances)


def test_poses_with_four_times_the_noise_that_was_told_keep_the_estimate_at_the_truth():
    std = 0.02
    simulator = FastSimulator(builtin_model("mecanum"), field(60.0))
    errors, covariances = simulated_drive(simulator, 20, 1, std, 4.0)
    assert np.abs(errors[100:]).max() < 0.4
    assert np.sqrt((errors[100:, :2] ** 2).mean()) < 2.0 * std
    assert np.linalg.eigvalsh(covariances).min() > 0.0


@pytest.mark.parametrize(
    ("std", "truth", "seconds"),
    [(1e-3, (0.5, -0.3, 2.9), 60), ((100.0, 100.0, np.pi), (40.0, -70.0, 2.9), 1)],
    ids=["wrong", "unknown"],
)
def test_a_wrong_or_unknown_start_is_mended_by_measured_poses(std, truth, seconds):
    estimator = Estimator(builtin_model("ackermann"))
    estimator.reset(0, np.zeros(3), std)
    for second in range(1, seconds + 1):
        estimator.predict(second * SECOND)
        correct(estimator, Kind.POSE, truth, [0.01] * 3)
    found = estimator.look_ahead(estimator.time_ns)[0]
    assert geometry.between(np.array(truth), found) == pytest.approx(0.0, abs=0.01)


def test_the_covariance_stays_positive_definite_over_a_thousand_random_steps():
    model = builtin_model("mecanum")
    rng = np.random.default_rng(3)
    estimator = Estimator(model)
    now = 0
    estimator.reset(now, np.zeros(3))
    for step in range(1_000):
        now += int(rng.integers(1, PERIOD))
        kind = step % 4 if step % 7 else 4
        if kind < 2:
            estimator.add_command(now, random_command(model, rng))
        estimator.predict(now)
        if kind in (1, 2):
            correct(estimator, Kind.TWIST, rng.normal(size=3))
        elif kind == 3:
            correct(
                estimator,
                Kind.POSE,
                rng.normal(size=3),
                10.0 ** rng.uniform(-4.0, 1.0, 3),
            )
        if step % 100 == 99:
            covariance = estimator.covariance
            assert np.isfinite(estimator.look_ahead(now)[0]).all()
            assert covariance == pytest.approx(covariance.T, abs=1e-9)
            scale = np.sqrt(np.diag(covariance))
            assert np.linalg.eigvalsh(covariance / np.outer(scale, scale)).min() > 0.0


NOISY = Noise(
    odom_linear=Level(std=0.05, unit="m/s", source="measured"),
    odom_angular=Level(std=0.05, unit="rad/s", source="measured"),
    position_drift=Level(std=0.03, unit="m/sqrt(s)", source="measured"),
    heading_drift=Level(std=0.03, unit="rad/sqrt(s)", source="measured"),
)
RUNS = 30


def noisy_model(robot):
    """The built-in robot; its state drifts by two per cent of its range within a second."""
    model = builtin_model(robot)
    states = {
        v.name: Level(
            std=0.02 * (v.max - v.min), unit=f"{v.unit}/sqrt(s)", source="measured"
        )
        for v in model.robot.state
    }
    return replace(model, noise=NOISY.model_copy(update={"state_drift": states}))


CORNERS = [("ackermann", None), ("mecanum", 0.02)]
REST = [
    (robot, std)
    for robot in ROBOTS
    for std in (None, 0.02)
    if (robot, std) not in CORNERS
]


@pytest.mark.parametrize(
    ("robot", "pose_std"),
    [
        *(pytest.param(*each, marks=pytest.mark.slow) for each in CORNERS),
        *(pytest.param(*each, marks=pytest.mark.campaign) for each in REST),
    ],
)
def test_the_estimate_is_as_uncertain_as_it_claims(robot, pose_std):
    """The mean NEES of many drives lies within the 95 % band of chi-squared."""
    simulator = FastSimulator(noisy_model(robot), field(60.0))
    nees = []
    for seed in range(RUNS):
        errors, covariances = simulated_drive(simulator, 8, seed, pose_std)
        nees.append(errors[-1] @ np.linalg.solve(covariances[-1], errors[-1]))
    low, high = chi2.ppf([0.025, 0.975], 3 * RUNS) / RUNS
    assert low < np.mean(nees) < high


SCALED = {"scale": [0.95, 1.05]}
NOISY_WHEELS = {"odom_linear": (0.04, 0.04), "odom_angular": (0.04, 0.04)}
WRONG = [
    ("ackermann", {"kinematics": SCALED}, 0.03),
    ("differential", {"kinematics": SCALED, "action_latency": (0.5, 0.5)}, 0.03),
    ("mecanum", {"kinematics": SCALED, "action_latency": (0.5, 0.5)}, 0.03),
    (
        "ackermann",
        {"kinematics": {"response": [0.8, 0.8]}, "action_latency": (1.0, 1.0)},
        0.1,
    ),
    ("differential", {"odometry": NOISY_WHEELS}, 0.1),
]


@pytest.mark.parametrize(("robot", "changes", "bound"), WRONG)
def test_a_wrong_model_leaves_the_estimate_where_odometry_is(robot, changes, bound):
    """Its terms, its response or its noise may be wrong; it reverses now and then."""
    model = builtin_model(robot)
    wrong = Randomisation(name="wrong", **changes)
    backend = SimBackend(model, field(60.0), estimator=True, randomisation=wrong)
    backend.reset(Start(0, np.array([0.0, 0.0, 1.0])))
    rng = np.random.default_rng(7)
    for step in range(150):
        if step % 7 == 0:
            command = random_command(model, rng)
        view, _ = backend.step(command)
        odometry = backend.simulator.data.odom[0, 0]
        assert np.abs(geometry.between(odometry, view.pose)).max() < bound


def stepped(estimator, stamp, twist, odom):
    estimator.predict(stamp)
    estimator.correct(Measurement(Kind.TWIST, np.asarray(twist), odom=np.asarray(odom)))


def test_a_way_that_belies_the_twists_is_left_out():
    estimator = driven("differential")
    begin, twist = estimator.look_ahead(estimator.time_ns)
    estimator.clone_state(np.zeros(3), np.zeros(3))
    for step in range(1, 11):
        stepped(estimator, 2 * SECOND + step * PERIOD, twist, np.zeros(3))
    moved = geometry.between(begin, estimator.look_ahead(estimator.time_ns)[0])
    assert np.hypot(*moved[:2]) > 0.9 * np.hypot(*twist[:2])


def test_an_outlier_after_a_silence_is_where_the_next_way_begins():
    """A way from before the silence, which nothing bridged, must not come back."""
    estimator = Estimator(builtin_model("differential"))
    estimator.clone_state(np.array([3.0, 2.0, 1.0]), np.zeros(3))
    late = 11 * SECOND
    stepped(estimator, late, [0.0, 0.5, 0.0], [500.0, 0.0, 0.0])
    assert estimator.belief.outliers[Kind.TWIST] == 1
    before = estimator.look_ahead(late)[0]
    stepped(estimator, late + PERIOD, np.zeros(3), [500.0, 0.0, 0.0])
    assert estimator.look_ahead(late + PERIOD)[0] == pytest.approx(before, abs=0.05)


@pytest.mark.parametrize("heading", [0.0, 0.3])
def test_the_way_goes_on_from_a_pose_that_was_measured_in_between(heading):
    estimator = Estimator(direct_model())
    estimator.reset(0, np.zeros(3), 2.0)
    estimator.clone_state(np.zeros(3), np.zeros(3))
    estimator.add_command(0, [1.0, 0.0, 0.0])
    there = np.array([1.5, 0.5, heading])
    estimator.predict(PERIOD // 2)
    correct(estimator, Kind.POSE, there, np.full(3, 1e-3))
    stepped(estimator, PERIOD, [1.0, 0.0, 0.0], [0.1, 0.0, 0.0])
    ahead = geometry.compose(there, np.array([0.05, 0.0, 0.0]))
    assert estimator.look_ahead(PERIOD)[0] == pytest.approx(ahead, abs=0.01)


def driven(robot="ackermann", seconds=2):
    """An estimator of a robot that drives as it should, at the end."""
    estimator = Estimator(builtin_model(robot))
    estimator.reset(0, np.zeros(3))
    command = estimator._log.commands[0] * 0.0
    command[0] = 0.5
    estimator.add_command(0, command)
    for step in range(1, seconds * 10 + 1):
        estimator.predict(step * PERIOD)
        verdict = correct(estimator, Kind.TWIST, estimator.look_ahead(step * PERIOD)[1])
        assert verdict.outcome is Acceptance.USED
    return estimator


def assert_same_belief(estimator, before):
    assert np.array_equal(estimator.belief.mean, before.mean)
    assert np.array_equal(estimator.belief.covariance, before.covariance)


def test_a_twist_that_is_slower_than_expected_is_news_at_once():
    estimator = driven()
    assert correct(estimator, Kind.TWIST, np.zeros(3)).outcome is Acceptance.NEWS
    assert estimator.belief.outliers == (0, 0, 0)
    assert abs(estimator.look_ahead(estimator.time_ns)[1][0]) < 0.01


def test_impossible_twists_are_believed_from_the_third_in_a_row_until_one_fits_again():
    estimator = driven()
    before = estimator.belief
    pose = estimator.look_ahead(estimator.time_ns)[0]
    outcomes = []
    for count in range(1, 6):
        outcomes.append(correct(estimator, Kind.TWIST, [0.5, 0.8, 0.0]).outcome)
        if count < 3:
            assert_same_belief(estimator, before)
            assert estimator.belief.outliers == (count, 0, 0)
    assert outcomes == [Acceptance.OUTLIER] * 2 + [Acceptance.JUMP] * 3
    assert np.array_equal(estimator.look_ahead(estimator.time_ns)[0], pose)
    fitting = correct(estimator, Kind.TWIST, [0.5, 0.0, 0.0]).outcome
    assert fitting is not Acceptance.OUTLIER
    assert estimator.belief.outliers == (0, 0, 0)
    assert correct(estimator, Kind.TWIST, [0.5, 0.8, 0.0]).outcome is Acceptance.OUTLIER


def test_a_pose_far_off_is_refused_and_the_fifth_in_a_row_is_taken_as_a_jump():
    estimator = driven()
    far = [30.0, 2.0, -3.0]
    good = estimator.look_ahead(estimator.time_ns)[0]
    for _ in range(2):  # outliers are counted in a row only
        assert (
            correct(estimator, Kind.POSE, good, [0.02] * 3).outcome is Acceptance.USED
        )
        before = estimator.belief
        for _ in range(4):
            judged = correct(estimator, Kind.POSE, far, [0.02] * 3)
            assert judged.outcome is Acceptance.OUTLIER
            assert_same_belief(estimator, before)
    assert correct(estimator, Kind.POSE, far, [0.02] * 3).outcome is Acceptance.JUMP
    pose, twist = estimator.look_ahead(estimator.time_ns)
    assert pose == pytest.approx(far)
    assert twist[0] == pytest.approx(0.5, abs=0.1)  # it still drives
    assert np.sqrt(np.diag(estimator.covariance)[:3]) == pytest.approx(0.02)
    assert (estimator.covariance[:3, 3:] == 0.0).all()  # it says nothing of the state
    assert np.linalg.eigvalsh(estimator.covariance).min() > 0.0
    assert correct(estimator, Kind.POSE, far, [0.02] * 3).outcome is Acceptance.USED


def test_a_yaw_rate_moves_nothing_by_itself_and_is_refused_beyond_the_robots_reach():
    estimator = driven()
    before = estimator.belief
    assert correct(estimator, Kind.YAW_RATE, 0.03, 0.01).outcome is Acceptance.USED
    assert correct(estimator, Kind.YAW_RATE, 40.0).outcome is Acceptance.OUTLIER
    assert_same_belief(estimator, before)


@pytest.mark.parametrize("value", [1e9, 1e308])
def test_what_is_beyond_all_bounds_is_never_believed_however_often_it_comes(value):
    estimator = driven()
    before = estimator.belief
    for _ in range(7):
        for kind, measured in (
            (Kind.TWIST, [value, 0.0, 0.0]),
            (Kind.POSE, [0.0, -value, 0.0]),
            (Kind.YAW_RATE, value),
        ):
            assert correct(estimator, kind, measured).outcome is Acceptance.OUTLIER
    assert_same_belief(estimator, before)


@pytest.mark.parametrize(("robot", "value"), [("ackermann", 1e3), ("mecanum", -1e308)])
def test_absurd_commands_leave_the_filter_sound(robot, value):
    estimator = driven(robot)
    for k in range(1, 8):
        now = estimator.time_ns
        estimator.add_command(now, np.full(len(estimator._log.commands[0]), value))
        estimator.predict(now + k * PERIOD)
        correct(estimator, Kind.TWIST, np.zeros(3))
        for ahead_s in (9, 90):
            found = np.concatenate(estimator.look_ahead(now + ahead_s * SECOND))
            assert np.isfinite(found).all()
        np.linalg.cholesky(estimator.covariance)


@pytest.mark.parametrize(("believed", "measured"), [(3.13, -3.14), (-3.13, 3.14)])
def test_a_heading_beyond_the_seam_is_near_and_no_outlier(believed, measured):
    estimator = Estimator(builtin_model("differential"))
    estimator.reset(0, [0.0, 0.0, believed], 0.02)
    verdict = correct(estimator, Kind.POSE, [0.0, 0.0, measured], [0.02] * 3)
    assert verdict.outcome is Acceptance.USED
    assert verdict.nis == pytest.approx((2.0 * np.pi - 6.27) ** 2 / (2 * 0.02**2))
    assert abs(estimator.look_ahead(0)[0][2]) > 3.13


@pytest.mark.parametrize(
    ("fraction", "outcome"), [(0.9989, Acceptance.USED), (0.9991, Acceptance.OUTLIER)]
)
def test_a_gate_refuses_one_good_measurement_in_a_thousand(fraction, outcome):
    estimator = driven()
    covariance = estimator.belief.covariance[:3, :3] + np.eye(3) * 0.05**2
    away = np.linalg.cholesky(covariance) @ np.full(
        3, np.sqrt(chi2.ppf(fraction, 3) / 3)
    )
    verdict = correct(
        estimator, Kind.POSE, estimator.belief.mean[:3] + away, [0.05] * 3
    )
    assert verdict.nis == pytest.approx(chi2.ppf(fraction, 3))
    assert verdict.outcome is outcome


def test_a_covariance_that_rounding_made_indefinite_is_mended():
    low = np.full(2, -1.0)
    high = np.full(2, 1.0)
    mean = np.array([0.0, 0.0, 4.0, 5.0, -0.5])
    covariance = np.ones((5, 5)) - 1e-13 * np.eye(5)
    covariance[0, 4] += 1e-12
    kernels.repair_estimate(mean, covariance, low, high)
    assert mean == pytest.approx([0.0, 0.0, 4.0 - 2.0 * np.pi, 1.0, -0.5])
    assert np.array_equal(covariance, covariance.T)
    np.linalg.cholesky(covariance)
    assert covariance == pytest.approx(np.ones((5, 5)), abs=1e-8)
