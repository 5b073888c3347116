"""One drive of a car whose motors do more than its terms: every room predicts the same path."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from robots import field, lidar

from nics_drl_bridge import geometry
from nics_drl_bridge.errors import ModelError
from nics_drl_bridge.generator import SimulatorModel, load_model, save_model
from nics_drl_bridge.identify.calibration import Calibration
from nics_drl_bridge.identify.drive import Drive
from nics_drl_bridge.identify.open_loop import predict, select_windows
from nics_drl_bridge.interface import NS_PER_S
from nics_drl_bridge.lidar.bake import bake
from nics_drl_bridge.lidar.shapes import Circle
from nics_drl_bridge.middleware import kernels
from nics_drl_bridge.middleware.ekf import Estimator
from nics_drl_bridge.middleware.kernels import MotionModel
from nics_drl_bridge.recording.recording import Recording, Stream
from nics_drl_bridge.robot.curve import InputCurve
from nics_drl_bridge.robot.kernels import SERIES, make_terms, simulate_rollouts
from nics_drl_bridge.robot.noise import Noise
from nics_drl_bridge.robot.spec import build_robot
from nics_drl_bridge.robot.taylor import NamedTaylorModel, TaylorModel
from nics_drl_bridge.sim.simulator import CommandRange, FastSimulator

CAR = build_robot(
    {
        "kind": "ackermann_throttle",
        "footprint_radius": 0.2,
        "parameters": {"wheelbase": 0.26},
        "state": [{"name": "vx"}, {"name": "wz"}],
    },
    {"throttle": (-1.0, 1.0), "steering": (-1.0, 1.0)},
)
DEAD = 0.12
PERIODS = 60
SUBSTEPS = 10


def motors() -> TaylorModel:
    """vx' = 5 throttle - 0.8 vx, wz' = 8 vx steering - 5 wz, behind motors that bend all of it."""
    powers = np.array([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [1, 0, 0, 1]])
    rows = [
        [1.0, 0, 0, 0],
        [0.0] * 4,
        [0, 1.0, 0, 0],
        [-0.8, 0, 5.0, 0],
        [0, -5.0, 0, 8.0],
    ]
    return TaylorModel(
        CAR.variable_names,
        CAR.dof_names,
        CAR.dof_units,
        powers,
        np.array(rows),
        0.01,
        np.array([-1.0, -1.0, -0.6, -1.0]),
        np.array([2.0, 1.0, 0.7, 1.0]),
        inputs=(
            InputCurve(
                command="throttle",
                dead=DEAD,
                least=-0.5,
                most=0.8,
                back=0.6,
                delay=0.02,
            ),
            InputCurve(command="steering", dead=0.02, delay=0.13),
        ),
        friction=np.array([0.2, 0.0]),
        drag=np.array([0.4, 0.0]),
        limits=np.array([[-2.5, 1.5], [-np.inf, 6.0]]),
        back_emf=np.array([[1.1, 0.0], [0.0, 0.7]]),
    )


@pytest.fixture(scope="module")
def model() -> SimulatorModel:
    sensor = lidar()
    table = bake(sensor, (Circle(radius=0.2),))
    return SimulatorModel(CAR, motors(), Calibration(), sensor, table, Noise())


@pytest.fixture(scope="module")
def commands() -> np.ndarray:
    """Commands (T, C) of each period that reach every stage: it stands, slips out, saturates."""
    rng = np.random.default_rng(4)
    held = rng.uniform(-1.0, 1.0, (PERIODS // 6, 2))
    held[::3, 0] *= 0.1
    return np.repeat(held, 6, axis=0)


@pytest.fixture(scope="module")
def path(commands) -> tuple[np.ndarray, np.ndarray]:
    """Poses (T + 1, 3) and states (T + 1, S) at the ends of periods, step by step of the model."""
    car = motors()
    pose = np.zeros(3)
    state = np.zeros(2)
    poses = [pose]
    states = [state]
    for command in late(car, commands):
        pose, state = car.step(pose, state, command)
        poses.append(pose)
        states.append(state)
    return np.array(poses)[::SUBSTEPS], np.array(states)[::SUBSTEPS]


def late(car, commands):
    """Commands (T SUBSTEPS, C) that act in each step, of those (T, C) sent in each period."""
    every = np.repeat(commands, SUBSTEPS, axis=0)
    delays = np.round(car.delays / car.dt).astype(int)
    ahead = (
        np.concatenate([np.zeros(n), row[: -n or None]])
        for n, row in zip(delays, every.T, strict=True)
    )
    return np.stack(list(ahead), axis=1)


def rolled(car, every):
    """Poses and states at the end of each step of commands (T, 2) in effect."""
    poses = np.zeros((1, len(every) + 1, 3))
    states = np.zeros((1, len(every) + 1, 2))
    simulate_rollouts(poses, states, every[None], make_terms(car), SERIES, car.dt)
    return poses[0], states[0]


def test_the_drive_shows_every_stage(commands, path):
    car = motors()
    assert (path[1][:, 0] == 0.0).sum() > 5
    assert (np.abs(commands[:, 0]) < DEAD).any()
    assert (np.abs(commands[:, 0]) > 0.8).any()
    nothing = dict.fromkeys(("friction", "drag"), np.zeros(2))
    nothing |= {"inputs": (), "back_emf": np.zeros((2, 2))}
    nothing |= {"limits": np.tile([-np.inf, np.inf], (2, 1))}
    for stage, absent in nothing.items():
        other = replace(car, **{stage: absent})
        ends = rolled(other, other.apply_curves(late(other, commands)))[0]
        assert np.hypot(*(ends[-1] - path[0][-1])[:2]) > 0.02, stage


def assert_same_path(poses, expected):
    apart = np.asarray(poses) - expected
    apart[:, 2] = geometry.wrap_angle(apart[:, 2])
    assert np.abs(apart).max() < 1e-9


def roll_out(model, commands):
    car = model.kinematics
    return rolled(car, car.apply_curves(late(car, commands)))[0][::SUBSTEPS]


def simulate(worlds, model, commands):
    simulator = FastSimulator(model, field(60.0), worlds=worlds)
    simulator.reset(np.arange(worlds), starts=np.zeros((worlds, 1, 3)))
    poses = [simulator.data.pose[-1, 0].copy()]
    for command in commands:
        simulator.step(np.tile(command, (worlds, 1, 1)))
        poses.append(simulator.data.pose[-1, 0].copy())
    return poses


def estimate(model, commands):
    estimator = Estimator(model)
    estimator.reset(0, np.zeros(3))
    poses = [estimator.belief.mean[:3]]
    for k, command in enumerate(commands):
        estimator.add_command(k * NS_PER_S // 10, command)
        estimator.predict((k + 1) * NS_PER_S // 10)
        poses.append(estimator.belief.mean[:3])
    return poses


@pytest.mark.parametrize(
    "predict_path",
    [roll_out, partial(simulate, 1), partial(simulate, 3), estimate],
    ids=["identification", "simulator", "simulator of three worlds", "estimator"],
)
def test_every_room_predicts_the_path_of_the_model(model, commands, path, predict_path):
    assert_same_path(predict_path(model, commands), path[0])


def test_an_open_loop_prediction_of_a_recorded_drive_follows_the_model(commands, path):
    t = 0.1 * np.arange(PERIODS + 1)
    streams = Stream(t[:-1], commands), Stream(t, path[0]), Stream(t, path[1])
    drive = Drive(Recording(*streams), CAR)
    chosen = select_windows(drive, Calibration(), 0.0, t[-1], 2.0, 0.3)
    ends = predict(motors(), Calibration(), drive, chosen)
    assert len(ends) > 10
    assert_same_path(ends, chosen.end)


def test_robots_that_might_touch_follow_the_model_too(model):
    simulator = FastSimulator(model, field(60.0), robots=2)
    start = np.array([[0.0, 0.0, 0.0], [0.0, 0.41, 0.0]])
    simulator.reset([0], starts=start[None])
    pose = start
    state = np.zeros((2, 2))
    commands = np.array(
        [[throttle, 0.0] for throttle in (0.7, 0.7, 0.7, 0.2, -0.9, -0.9)]
    )
    for command in commands:
        simulator.step(np.tile(command, (1, 2, 1)))
    for command in late(model.kinematics, commands):
        pose, state = model.kinematics.step(pose, state, np.tile(command, (2, 1)))
    assert not simulator.data.collided.any()
    assert np.abs(pose[:, 0]).min() > 0.1
    assert_same_path(simulator.data.pose[0], pose)


@pytest.mark.parametrize("throttle", [0.0, -0.3])
def test_the_estimator_knows_how_drag_and_back_emf_dampen_an_error_of_the_speed(
    throttle,
):
    motion = MotionModel(make_terms(motors()), SERIES, 0, 0)

    def ahead(speed: float) -> tuple[float, float]:
        mean = np.array([0.0, 0.0, 0.0, speed, 0.0])
        transition = kernels.make_transition(5, 0.0)
        kernels.step_mean(mean, transition, np.array([throttle, 0.0]), 0.01, 10, motion)
        return mean[3], transition[3, 3]

    slight = 1e-6
    (speed, slope), (faster, _) = ahead(1.2), ahead(1.2 + slight)
    assert slope == pytest.approx((faster - speed) / slight, rel=1e-4)


def test_the_estimator_expects_the_twist_of_a_command_in_effect(model):
    powers = np.eye(4, dtype=np.int64)[[0, 2]]
    coefficients = np.array([[0.0, 1.0], [0, 0], [0, 0], [0, 0], [0, 0]])
    kinematics = replace(motors(), powers=powers, coefficients=coefficients)
    sent = replace(model, kinematics=kinematics)
    estimator = Estimator(sent)
    estimator.reset(0, np.zeros(3))
    estimator.add_command(0, np.array([0.3, 0.0]))
    for time, speed in ((0.01, 0.0), (0.02, 0.0), (0.021, 0.3 - DEAD)):
        twist = estimator.look_ahead(round(time * NS_PER_S))[1]
        assert twist == pytest.approx([speed, 0.0, 0.0]), (
            f"the throttle acts after 0.02 s: {time}"
        )


def test_a_model_that_is_written_steps_as_it_did(model, tmp_path, commands):
    save_model(model, tmp_path / "car")
    read = load_model(tmp_path / "car")
    assert read.fingerprint == model.fingerprint
    pose = [np.zeros((PERIODS, 3)), np.full((PERIODS, 2), 0.3), commands]
    steps = (each.kinematics.step(*pose) for each in (model, read))
    for one, other in zip(*steps, strict=True):
        assert np.array_equal(one, other)
    limits = model.kinematics.describe_limits("d_vx")
    assert "less 0.4*vx*|vx|, less dry friction of 0.2" in limits


def test_a_warning_is_of_the_command_that_was_sent(model):
    said: list[str] = []
    checked = CommandRange(motors(), CAR, said.append)
    checked.check(np.array([[0.85, 0.0]]))  # in effect 0.68: more than 0.8 does no more
    assert not said
    slow = replace(motors(), high=np.array([2.0, 1.0, 0.3, 1.0]))
    CommandRange(slow, CAR, said.append).check(np.array([[0.6, 0.0]]))
    assert "throttle is 0.6, but the model was fitted to -inf to 0.42 only" in said[0]


@pytest.mark.parametrize(
    ("key", "value", "said"),
    [
        ("inputs", ({"command": "gas"},), "'gas', not one of"),
        ("inputs", ({"command": "throttle"},) * 2, "a command twice"),
        ("drag", {"speed": 0.1}, "'speed'"),
        ("back_emf", {"vx": {"gas": 0.1}}, "'gas'"),
        ("limits", {"throttle": (-1.0, 1.0)}, "'throttle'"),
    ],
)
def test_a_stage_of_an_unknown_variable_is_one_sentence(key, value, said):
    changed = motors().named.model_dump() | {key: value}
    with pytest.raises(ModelError, match=f"key '{key}' has {said}"):
        NamedTaylorModel.model_validate(changed).model()
