from __future__ import annotations

import re
import warnings
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import SyncVectorEnv
from robots import DIRECT, direct_model, field, lidar
from shapely.geometry import LineString, Polygon

from nics_drl_bridge.env.registry import ENVIRONMENTS, TASK, make_task
from nics_drl_bridge.env.task import (
    DRIVES,
    PARTS,
    bearing,
    discrete_commands,
    distance,
    find_contact_ranges,
    still,
)
from nics_drl_bridge.env.tasks.navigation import Navigation
from nics_drl_bridge.env.vector_env import BridgeVectorEnv
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.generator import open_model
from nics_drl_bridge.interface import RobotView
from nics_drl_bridge.lidar.spec import load_lidar
from nics_drl_bridge.robot.spec import load_robot

OWN = Path(__file__).resolve().parents[2] / "examples" / "own_task.py"
PATROL = f"{OWN}:Patrol"


@pytest.mark.parametrize("name", [name for name in ENVIRONMENTS if name != TASK])
@pytest.mark.parametrize("actions", ["continuous", "discrete"])
def test_gymnasiums_checker_finds_nothing_to_warn_of_in_any_task(name, actions):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env = gymnasium.make(
            name, model=direct_model(), world=field(), task_options={"actions": actions}
        )
        check_env(env.unwrapped, skip_render_check=True)
        env.close()


def test_a_task_from_a_file_passes_the_checker_and_steps_alike_alone_and_in_a_vector():
    arguments = {"model": direct_model(), "world": field(), "task": PATROL}
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(gymnasium.make(TASK, **arguments).unwrapped, skip_render_check=True)
    ours = gymnasium.make_vec(TASK, 3, **arguments)
    theirs = SyncVectorEnv([lambda: gymnasium.make(TASK, **arguments)] * 3)
    assert isinstance(ours, BridgeVectorEnv)
    assert np.array_equal(ours.reset(seed=0)[0], theirs.reset(seed=0)[0])
    ours.action_space.seed(0)
    for _ in range(80):
        action = ours.action_space.sample()
        for a, b in zip(ours.step(action)[:4], theirs.step(action)[:4], strict=True):
            assert np.array_equal(a, b)


@pytest.mark.parametrize(
    ("task", "options", "sentence"),
    [
        ("navigtion", None, "unknown task 'navigtion'; did you mean 'navigation'?"),
        ("nowhere.py:Patrol", None, "task 'nowhere.py': no such file"),
        (f"{OWN}:Patrole", None, "has no such Task; did you mean 'Patrol'?"),
        ("cooperative_reaching", {"robots": 2.5}, "robots=2.5: must be a whole number"),
        ("cooperative_reaching", {"robots": 1}, "a team needs at least 2"),
        ("pursuit_evasion", {"evaders": 0}, "at least 1 each"),
        ("navigation", {"scan": {"sectors": 36, "range_max": 9.0}}, "range_max"),
        (
            Navigation(DIRECT, lidar(beams=36)),
            None,
            "make it with model.robot and model.lidar",
        ),
        (Navigation(DIRECT, lidar()), {"goal_radius": 1.0}, "is already made"),
    ],
)
def test_a_wrong_task_gives_one_sentence(task, options, sentence):
    with pytest.raises(ConfigError) as caught:
        make_task(task, direct_model(), options)
    assert sentence in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("text", "name", "told"),
    [
        ("x = 1\nclass Own(:\n", ":Own", "line 2: can't be imported (SyntaxError"),
        (
            "import nowhere_to_be_found\n",
            ":Own",
            "line 1: can't be imported (ModuleNotFoundError",
        ),
        (
            "x = 1\n\ny = 1 / 0\n",
            ":Own",
            "line 3: can't be imported (ZeroDivisionError",
        ),
        ("\0", ":Own", "can't be imported ("),
        ("x = 1", "", "defines no subclass of nics_drl_bridge.env.task.Task"),
        ("x = 1", ":Own", "defines no subclass of nics_drl_bridge.env.task.Task"),
        (OWN.read_text(), "", "name its class, for example"),
        (None, "", "no such file; give path/to/file.py:ClassName"),
    ],
)
def test_a_file_without_a_task_that_can_be_made_is_told_of_in_one_sentence(
    tmp_path, text, name, told
):
    file = tmp_path / "own.py"
    if text is not None:
        file.write_text(text)
    with pytest.raises(ConfigError) as caught:
        make_task(f"{file}{name}", direct_model())
    assert str(file) in str(caught.value)
    assert told in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_robot_without_further_sensors_has_no_fractions_of_them():
    task = make_task("navigation", direct_model())
    pose = np.zeros((4, 2, 3))
    view = RobotView(pose, pose, np.zeros((4, 2, 8), np.float32))
    assert task.sensor_shares(view).shape == (4, 2, 0)


def test_the_discrete_actions_are_the_papers_drives():
    """efc-robot/MultiVehicleEnv, basic.py: stop, then ahead and back, each straight and turning."""
    car = load_robot("ackermann")  # speed from -0.5 to 1
    assert discrete_commands(car).tolist() == [
        [0, 0],
        [1, 0],
        [1, 0.5],
        [1, -0.5],
        [-0.5, 0],
        [-0.5, 0.5],
        [-0.5, -0.5],
    ]
    mecanum = discrete_commands(load_robot("mecanum"))
    assert mecanum.shape == (9, 3)
    assert mecanum[4].tolist() == [-0.7, 0.0, 0.0]
    assert mecanum[7:].tolist() == [[0.0, 0.7, 0.0], [0.0, -0.7, 0.0]]
    assert len(DRIVES) == 7


def test_a_discrete_action_gives_its_command_for_one_robot_and_for_many():
    task = Navigation(DIRECT, lidar(), actions="discrete")
    table = discrete_commands(DIRECT)
    assert task.action_space.n == len(table) == 9
    assert np.array_equal(task.command(3), table[3])
    assert np.array_equal(task.command([[1], [4]]), table[[[1], [4]]])
    assert still(DIRECT).tolist() == [0.0, 0.0, 0.0]


def test_a_car_by_turn_rates_does_not_learn_to_steer_at_rest():
    car = load_robot("ackermann")
    ahead_only = car.command[0].model_copy(update={"min": 0.0})
    steering = car.model_copy(update={"command": (ahead_only, *car.command[1:])})
    turning = steering.model_copy(update={"angular_is": "turn_rate"})
    ahead, at_rest = [[0.0, 0.6], [-1.0, 0.6]]  # actions; the car's least speed is 0
    for robot, angle in ((steering, 0.3), (turning, 0.0)):
        task = Navigation(robot, lidar())
        assert task.command(ahead) == pytest.approx([0.5, 0.3])
        assert task.command(at_rest) == pytest.approx([0.0, angle])


def test_a_robot_without_cmd_vel_gets_each_command_alone():
    wheels = DIRECT.model_validate(
        {
            "name": "wheels",
            "footprint_radius": 0.2,
            "command": [
                {"name": "left_wheel", "unit": "rad/s", "min": -3.0, "max": 5.0},
                {"name": "right_wheel", "unit": "rad/s", "min": 1.0, "max": 2.0},
            ],
        }
    )
    assert discrete_commands(wheels).tolist() == [
        [0, 1],
        [5, 1],
        [0, 2],
        [-3, 1],
        [0, 1],
    ]


def test_bearing_and_distance_agree_with_plane_geometry():
    rng = np.random.default_rng(0)
    pose = rng.normal(size=(50, 3)) * 3.0
    points = rng.normal(size=(50, 2)) * 3.0
    offset = points - pose[:, :2]
    angle = np.arctan2(offset[:, 1], offset[:, 0]) - pose[:, 2]
    expected = np.stack([np.hypot(*offset.T), np.cos(angle), np.sin(angle)], axis=1)
    assert bearing(pose, points) == pytest.approx(expected, abs=1e-12)
    assert distance(pose, points) == pytest.approx(expected[:, 0])
    assert bearing(np.zeros((4, 1, 3)), np.ones((5, 2))).shape == (4, 5, 3)
    assert bearing([1.0, 2.0, 0.3], [1.0, 2.0]).tolist() == [0.0, 1.0, 0.0]


@pytest.mark.parametrize(
    "name", ["navigation", "cooperative_reaching", "pursuit_evasion"]
)
def test_a_task_sees_sectors_where_a_layout_is_given_and_judges_touches_by_beams(name):
    model = direct_model(sensor=lidar(beams=720))
    own = make_task(name, model)
    sectors = make_task(name, model, {"scan": "around"})
    width = own.observation_space.shape[0] - 720
    assert sectors.observation_space.shape == (72 + width,)
    ranges = np.full((5, 720), np.inf, np.float32)
    ranges[1, 100], ranges[2], ranges[3, 7], ranges[4, :30] = 1.5, np.nan, 0.21, -np.inf
    shares = sectors.free_share(ranges)
    assert shares[0].tolist() == [1.0] * 72
    assert sorted(set(shares[1])) == [0.5, 1.0]
    assert shares[2].tolist() == [0.0] * 72
    assert shares[4, :3].tolist() == [0.0] * 3
    assert sectors.touches(ranges).tolist() == own.touches(ranges).tolist()


TRUCK = ((0.5, 0.2), (0.5, -0.2), (-0.3, -0.2), (-0.3, 0.2))
ARROW = ((0.6, 0.0), (-0.3, -0.3), (0.0, 0.0), (-0.3, 0.3))
MARGIN = 0.02


def robot(footprint):
    about = {**load_robot("differential").model_dump(), "footprint": footprint}
    about.pop("footprint_radius")
    return type(load_robot("differential")).model_validate(about)


def mounted(mount):
    spec = load_lidar("paper")
    return type(spec).model_validate({**spec.model_dump(), "mount": mount})


@pytest.mark.parametrize("footprint", [TRUCK, ARROW], ids=["truck", "arrow"])
@pytest.mark.parametrize("mount", [(0.2, 0.0, 0.0), (0.1, 0.02, 1.3)])
def test_a_return_within_the_corners_of_a_footprint_is_a_touch(footprint, mount):
    spec = mounted(mount)
    found = find_contact_ranges(robot(footprint), spec, MARGIN)
    outline = Polygon(footprint).boundary
    for angle, leaves in zip(spec.angles[::7] + mount[2], found[::7], strict=True):
        far = (mount[0] + 3.0 * np.cos(angle), mount[1] + 3.0 * np.sin(angle))
        crossed = LineString([mount[:2], far]).intersection(outline)
        points = [crossed] if crossed.geom_type == "Point" else list(crossed.geoms)
        last = max(np.hypot(p.x - mount[0], p.y - mount[1]) for p in points)
        assert leaves == pytest.approx(last + MARGIN, abs=1e-5)


def test_beams_that_do_not_cross_a_footprint_touch_nothing():
    spec = mounted((1.0, 0.0, 0.0))
    found = find_contact_ranges(robot(TRUCK), spec, MARGIN)
    ahead = np.abs(spec.angles) < 1.0
    assert (found[ahead] == -np.inf).all()
    assert (found[~ahead] > 0.0).any()


def test_a_top_speed_limits_commands_in_m_per_s_and_no_others():
    jackal = open_model("jackal")
    slow = Navigation(jackal.robot, jackal.lidar, top_speed=0.4)
    assert slow.command([[-1.0, -1.0], [1.0, 1.0]]).tolist() == [
        [-0.4, -2.5],
        [0.4, 2.5],
    ]
    assert np.abs(slow.discrete_commands[:, 0]).max() == 0.4
    free = Navigation(jackal.robot, jackal.lidar)
    fast = Navigation(jackal.robot, jackal.lidar, top_speed=9.0)
    for task in (free, fast):
        assert task.command([1.0, 1.0]).tolist() == [2.0, 2.5]


class Counting(Navigation):
    """Counts the steps of an episode, in an array that each rebinds."""

    shown = ("count",)

    def reset(self, episodes):
        return super().reset(episodes) | {"count": np.zeros(episodes.starts.shape[:2])}

    def update(self, before, after, memory):
        memory["count"] = memory["count"] + 1.0


@pytest.mark.parametrize(
    ("part", "mixed_in"),
    [
        *((part, False) for part in PARTS),
        *((part, True) for part in ("step_into", "take_step", "command", "drive")),
        ("reward", True),
    ],
)
def test_each_step_calls_a_method_that_overrides_that_of_navigation(part, mixed_in):
    called = []

    def call(self, *given):
        called.append(part)
        return getattr(Navigation, part)(self, *given)

    bases = (Navigation,)
    if mixed_in:  # by a class that is no task
        bases = (type("Mixin", (), {part: call}), Navigation)
    task = type("Calling", bases, {} if mixed_in else {part: call})
    env = gymnasium.make(TASK, model=direct_model(), world=field(), task=task)
    env.reset(seed=0)
    called.clear()
    env.step(np.zeros(3, np.float32))
    assert called


class Shifting(Navigation):
    """Remembers the count of the step before, and what nothing bounds."""

    shown = ("older", "last", "nearest")

    def reset(self, episodes):
        rows = np.zeros((3, *episodes.starts.shape[:2]))
        return super().reset(episodes) | {
            "last": rows[0],
            "older": rows[1],
            "nearest": rows[2] + np.inf,
        }

    def update(self, before, after, memory):
        memory["older"] = memory["last"]
        memory["last"] = memory["last"] + 1.0
        memory["nearest"] = np.minimum(memory["nearest"], np.inf)


@pytest.mark.parametrize("make", [gymnasium.make, gymnasium.make_vec])
def test_a_memory_that_update_shifts_holds_what_was_there(make):
    env = make(TASK, model=direct_model(), world=field(), task=Shifting)
    env.reset(seed=0)
    for step in range(3):
        info = env.step(np.zeros(env.action_space.shape, np.float32))[4]
        assert (info["older"], info["last"]) == (step, step + 1.0)
        assert np.isposinf(info["nearest"])


@pytest.mark.parametrize(
    ("method", "wrong", "sentence"),
    [
        (
            "update",
            lambda _: {"gaol": 1},
            "task Wrong: its memory ['count', 'gaol', 'goal'] must",
        ),
        (
            "update",
            lambda _: {"count": np.ones(5)},
            "its memory 'count' must stay float64 of shape (",
        ),
        (
            "update",
            lambda rows: {"count": rows + 0.5j},
            "in `update`, not complex128 of shape (",
        ),
        (
            "info",
            lambda _: {"battery": 0.5},
            "info 'battery' must be an array whose shape",
        ),
        ("info", lambda _: None, "its info must be a dictionary of arrays"),
        (
            "reset",
            lambda rows: {"count": rows, "goal": [[1.0, 2.0]]},
            "memory 'goal' must be an",
        ),
        (
            "reset",
            lambda rows: {"goal": rows},
            "reset must return a dictionary of arrays with",
        ),
        (
            "reset",
            lambda rows: {"count": rows[:, 0]},
            "memory 'count', which is shown, must be",
        ),
        ("reset", lambda _: None, "reset must return a dictionary of arrays"),
        (
            "end",
            lambda pose: 0.0 * pose[..., 0],
            "its end must be True or False for each robot, not float64",
        ),
        (
            "reward",
            lambda pose: {"progress": np.full(pose.shape[:-1], "x")},
            "its reward term 'progress' must be finite",
        ),
        ("observation", lambda pose: {"scan": pose}, "its observation must be finite"),
    ],
)
@pytest.mark.parametrize("make", [gymnasium.make, gymnasium.make_vec])
def test_a_method_of_an_own_task_that_gives_what_no_env_can_use_is_named(
    make, method, wrong, sentence
):
    def update(self, before, after, memory):
        memory.update(wrong(memory["count"]))

    def reset(self, episodes):
        return wrong(np.zeros(episodes.starts.shape[:2]))

    def judge(self, view, *_):
        return wrong(view.pose)

    own = {"update": update, "reset": reset}.get(method, judge)
    task = type("Wrong", (Counting,), {method: own})
    env = make(TASK, model=direct_model(), world=field(), task=task)

    def drive():
        env.reset(seed=0)
        env.step(np.zeros(env.action_space.shape, np.float32))

    with pytest.raises(ConfigError, match=re.escape(sentence)):
        drive()
