import numpy as np
import pytest
from robots import DIRECT

from nics_drl_bridge import geometry
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.identify.fit import list_commands_together, list_unmoved_variables
from nics_drl_bridge.recording.excite import (
    PERIOD_S,
    STILL_S,
    DrivePlan,
    Pattern,
    find_motion,
    predict,
)
from nics_drl_bridge.recording.recording import samples_on_one_clock
from nics_drl_bridge.recording.textbook import record
from nics_drl_bridge.robot.spec import load_robot

ROBOTS = [load_robot(name) for name in ("ackermann", "differential", "mecanum")] + [
    DIRECT
]
STILL = round(STILL_S / PERIOD_S)

PREVIEWS: dict = {}

robots = pytest.mark.parametrize("robot", ROBOTS, ids=lambda robot: robot.name)


def preview(robot, speed=1.0) -> Pattern:
    """The pattern of a drive, made once."""
    key = (robot.name, speed)
    if key not in PREVIEWS:
        PREVIEWS[key] = DrivePlan(robot, 2.0, 30.0, speed, seed=0).preview()
    return PREVIEWS[key]


@pytest.mark.slow
@robots
def test_the_whole_robot_keeps_within_its_circle_and_rests_at_both_ends(robot):
    pattern = preview(robot)
    away = np.hypot(*pattern.pose[:, :2].T) + robot.footprint_radius
    assert 0.8 < away.max() <= 2.0
    assert len(pattern.command) == 30.0 / PERIOD_S
    assert (pattern.command[:STILL] == 0.0).all()
    assert np.abs(pattern.command[-STILL:]).max() < 1e-12
    assert np.abs(pattern.twist[-1]).max() < 1e-3


@pytest.mark.slow
@pytest.mark.parametrize(("robot", "speed"), [(ROBOTS[0], 0.5), (ROBOTS[2], 1.0)])
def test_commands_stay_within_a_share_of_the_limits_that_leaves_angles_alone(
    robot, speed
):
    command = preview(robot, speed).command
    share = np.array([1.0 if c.unit == "rad" else speed for c in robot.command])
    assert (command >= share * robot.command_low - 1e-12).all()
    assert (command <= share * robot.command_high + 1e-12).all()
    width = share * (robot.command_high - robot.command_low)
    assert (np.ptp(command, axis=0) > 0.8 * width).all()


@pytest.mark.slow
@robots
def test_every_command_is_moved_by_the_rules_that_a_fit_judges_a_drive_by(robot):
    pattern = preview(robot)
    t = pattern.period * np.arange(len(pattern.command))
    none = np.zeros((len(t), 0))
    stateless = robot.model_copy(update={"state": ()})
    samples = samples_on_one_clock(t, pattern.pose[:-1], none, pattern.command)
    assert list_unmoved_variables(samples, stateless) == ()
    assert list_commands_together(samples, stateless) == ()
    assert all(len(np.unique(column)) >= 10 for column in pattern.command.T)
    # Each also changes while the others are held: on its own.
    changes = np.abs(np.diff(pattern.command, axis=0)) > 1e-9
    alone = changes & (changes.sum(axis=1) == 1)[:, None]
    assert alone.any(axis=0).all()
    assert (changes.sum(axis=1) == len(robot.command)).any()


def drive_another(robot, really, gain, seed):
    """Greatest distance of a robot that moves otherwise than expected, and is watched."""
    drive = DrivePlan(robot, bound=2.0, duration=20.0, seed=seed).begin()
    motion = find_motion(really)
    pose = np.zeros((1, 3))
    state = np.zeros((1, len(motion.lag)))
    away = 0.0
    while not drive.done:
        command = gain * drive.choose_command()
        poses, states = predict(motion, pose, state, command[None, None], PERIOD_S)
        pose = poses[:, -1]
        state = states[:, -1]
        drive.observe(pose[0])
        away = max(away, float(np.hypot(*pose[0, :2])))
    return away + robot.footprint_radius


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "changes", "gain"),
    [
        ("ackermann", {"wheelbase": 0.24, "speed_lag": 0.2}, (1.1, 1.0)),
        ("mecanum", {"wheel_lag": 0.2}, (1.2, 0.8, 1.2)),
    ],
)
def test_a_robot_that_moves_otherwise_than_expected_is_kept_within_too(
    name, changes, gain
):
    robot = load_robot(name)
    really = robot.model_copy(update={"parameters": {**robot.parameters, **changes}})
    assert drive_another(robot, really, np.array(gain), seed=0) <= 2.0


CAR = load_robot("ackermann")


def test_the_drive_that_begins_is_the_one_that_was_previewed():
    plan = DrivePlan(CAR, bound=1.2, duration=20.0, seed=1)
    drive = plan.begin()
    commands = [drive.choose_command() for _ in plan.preview().command]
    assert drive.done
    assert np.array_equal(commands, plan.preview().command)


def test_a_circle_in_which_a_car_can_not_turn_is_refused():
    with pytest.raises(ConfigError, match=r"bound 0\.3"):
        DrivePlan(CAR, bound=0.3).preview()


@pytest.mark.parametrize(
    "changes",
    [
        {"bound": 0.1},
        {"bound": float("nan")},
        {"duration": 5.0},
        {"speed": 0.0},
        {"speed": 1.5},
        {"seed": -1},
    ],
)
def test_a_value_out_of_range_is_named(changes):
    ((name, value),) = changes.items()
    with pytest.raises(ConfigError, match=f"{name} {value:g}: must be"):
        DrivePlan(CAR, **changes)


@pytest.fixture
def quarter_circle():
    """A turn to the left of radius 2 m at 1 m/s, within pi seconds."""
    turn = np.tile([1.0, 0.0, 0.5], (100, 1))
    poses = [np.zeros(3)]
    for twist in turn:
        poses.append(geometry.compose(poses[-1], geometry.exp(twist * np.pi / 100)))
    return Pattern(
        np.pi / 100, turn[:, [0, 2]], np.array(poses), bound=3.5, footprint=0.5
    )


def test_it_tells_duration_path_speeds_and_space(quarter_circle):
    assert quarter_circle.duration == pytest.approx(np.pi)
    assert quarter_circle.speed == pytest.approx(np.ones(100))
    assert quarter_circle.twist[:, 2] == pytest.approx(np.full(100, 0.5))
    assert quarter_circle.box == pytest.approx(np.array([[-0.5, -0.5], [2.5, 2.5]]))
    assert quarter_circle.reach == pytest.approx(2.0 * np.sqrt(2.0) + 0.5)
    drive, space, bound = quarter_circle.describe()
    assert "3 s: a path of 3.1 m, up to 1.00 m/s and 0.50 rad/s" in drive
    assert "x -0.50 to +2.50 m and y -0.50 to +2.50 m" in space
    assert "circle of 3.5 m" in bound


@pytest.mark.slow
@pytest.mark.parametrize("name", ["ackermann", "differential", "mecanum"])
def test_it_is_the_textbook_but_for_a_centimetre(name):
    spec = load_robot(name)
    drive = record(spec, np.random.default_rng(0), 4.0, PERIOD_S, hold=0.4)
    start = np.zeros((1, 3)), np.zeros((1, len(spec.state)))
    command = drive.command.values[None]
    poses, states = predict(find_motion(spec), *start, command, PERIOD_S)
    assert poses.shape == (1, 81, 3)
    assert states[0, :-1] == pytest.approx(drive.state.values)
    off = poses[0, :-1] - drive.pose.values
    assert np.hypot(*off[:, :2].T).max() < 0.01


def test_without_a_textbook_cmd_vel_is_the_twist():
    commands = np.tile([1.0, -0.5, 0.0], (1, 20, 1))
    rest = np.zeros((1, 3))
    poses, states = predict(find_motion(DIRECT), rest, rest, commands, PERIOD_S)
    assert poses[0, -1] == pytest.approx([1.0, -0.5, 0.0])
    assert states.shape == (1, 21, 3)


def test_a_steering_angle_without_a_textbook_can_not_be_predicted():
    car = load_robot("ackermann").model_copy(update={"textbook": None})
    with pytest.raises(
        ConfigError, match=r"'steering_command' in rad.*add `textbook:`"
    ):
        find_motion(car)
