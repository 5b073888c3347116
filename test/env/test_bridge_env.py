from __future__ import annotations

import contextlib
import copy
import pickle
from dataclasses import replace
from types import SimpleNamespace

import gymnasium
import numpy as np
import pytest
from robots import FOOTPRINT, circles, direct_model, field, lidar

from nics_drl_bridge import extensions
from nics_drl_bridge.defaults import EPISODE_STEPS
from nics_drl_bridge.env.bridge_env import BridgeEnv
from nics_drl_bridge.env.registry import NAVIGATION, register_envs
from nics_drl_bridge.env.sim_backend import SimBackend
from nics_drl_bridge.env.tasks.navigation import Navigation
from nics_drl_bridge.env.vector_env import BridgeVectorEnv
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.lidar.bake import bake
from nics_drl_bridge.lidar.shapes import Circle
from nics_drl_bridge.sim.world_set import WorldSet

STILL = np.zeros(3, np.float32)


@pytest.fixture
def env():
    """The robot whose twist is its command, in a field without obstacles."""
    made = BridgeEnv(model=direct_model(), world=field())
    yield made
    made.close()


def drive(env, seed, actions, between=lambda: None):
    observation, info = env.reset(seed=seed)
    steps = [(observation, 0.0, False, info["pose"])]
    for action in actions:
        between()
        observation, reward, ended, _, info = env.step(action)
        steps.append((observation, reward, ended, info["pose"]))
    return steps


def assert_same(one, other):
    for a, b in zip(one, other, strict=True):
        assert all(np.array_equal(x, y) for x, y in zip(a, b, strict=True))


def random_actions(env, count, seed=0):
    shape = (count, env.action_space.shape[0])
    return np.random.default_rng(seed).uniform(-1.0, 1.0, shape).astype(np.float32)


def test_registering_twice_changes_nothing():
    register_envs()
    spec = gymnasium.spec(NAVIGATION)
    register_envs()
    assert gymnasium.spec(NAVIGATION) is spec
    assert spec.max_episode_steps == EPISODE_STEPS


@pytest.mark.parametrize("make", [gymnasium.make, gymnasium.make_vec])
def test_a_world_may_be_given_by_its_path_or_as_a_list(tmp_path, make):
    file = tmp_path / "small.yaml"
    file.write_text("name: small\nsize: [6.0, 6.0]\ngoal_distance: [1.0, 3.0]\n")
    for world, names in ((file, ["small"]), ([file, "empty"], ["small", "empty"])):
        env = make(NAVIGATION, world=world)
        assert [one.name for one in env.unwrapped.world.members] == names
        env.close()


def test_an_episode_depends_on_seed_and_actions_alone():
    env = BridgeEnv()
    actions = random_actions(env, 25)
    first = drive(env, 3, actions)
    drive(env, 4, random_actions(env, 11, seed=1))
    assert_same(first, drive(env, 3, actions))
    other = BridgeEnv(model=direct_model(), world=field())  # of another lidar
    other.reset(seed=2)
    assert_same(first, drive(BridgeEnv(), 3, actions, lambda: other.step(STILL)))


def test_resets_without_a_seed_follow_from_the_last_seed():
    def starts(env):
        env.reset(seed=5)
        return [env.reset()[1]["episode_seed"] for _ in range(5)]

    one = starts(BridgeEnv())
    other = starts(BridgeEnv())
    assert one == other
    assert len(set(one)) == 5


def test_driving_to_the_goal_ends_in_success(env):
    env.reset(seed=0, options={"start": (0.0, 0.0, 0.0), "goal": (1.05, 0.0)})
    ahead = np.array([0.5, 0.0, 0.0], np.float32)
    for step in range(1, 9):
        _, reward, terminated, truncated, info = env.step(ahead)
        assert reward == pytest.approx(sum(info["reward_terms"].values()))
        assert terminated == (step == 8)
        assert not truncated
    assert info["is_success"]
    assert not info["collision"]


def test_the_env_answers_to_the_command_just_given(env):
    env.reset(seed=0, options={"start": (0.0, 0.0, 0.0), "goal": (2.0, 0.0)})
    for share in (0.1, 0.4, -0.2):
        before = env.step(STILL)[4]["true_pose"]
        observation, *_, info = env.step(np.array([share, 0.0, 0.0], np.float32))
        assert info["true_pose"][0] - before[0] == pytest.approx(2.0 * share * 0.1)
        assert observation[-3] == pytest.approx(2.0 * share, abs=1e-3)
        assert info["scan_age_s"] == info["odom_age_s"] == 0.0


def test_infos_and_snapshots_of_earlier_steps_do_not_change(env):
    _, first = env.reset(seed=0)
    kept = {name: np.array(first[name]) for name in ("goal", "pose", "start")}
    observation, *_, second = env.step(np.ones(3, np.float32))
    seen = observation.copy()
    shot = env.snapshot()
    shown = copy.deepcopy(shot)
    pose = second["true_pose"].copy()
    env.step(np.ones(3, np.float32))
    env.reset(seed=1)
    assert all(np.array_equal(first[name], array) for name, array in kept.items())
    assert np.array_equal(observation, seen)
    assert np.array_equal(second["true_pose"], pose)
    np.testing.assert_equal(vars(shot), vars(shown))


@pytest.mark.parametrize(
    "copied", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))]
)
def test_a_copy_of_an_env_goes_on_by_itself(copied):
    worlds = WorldSet("two", (field(size=5.0), field(count=3)))
    env = BridgeEnv(model=direct_model(), world=worlds)
    env.reset(seed=0, options={"start": (0.0, 0.0, 0.0), "goal": (2.0, 0.0)})
    ahead = np.array([0.2, 0.1, 0.0], np.float32)
    env.step(ahead)
    other = copied(env)
    steps = [env.step(ahead) for _ in range(3)]
    np.testing.assert_equal([other.step(ahead) for _ in range(3)], steps)


def test_a_goal_that_is_moved_amid_an_episode_counts_from_the_next_step_on(env):
    env.reset(seed=0, options={"start": (0.0, 0.0, 0.0), "goal": (2.0, 0.0)})
    env.memory["goal"][...] = 0.0, 1.5
    assert env.step(STILL)[0][-6] == 1.5
    env.memory["goal"] = np.array([[[0.0, 1.0]]])
    assert env.step(STILL)[0][-6] == 1.0


class Recorder:
    """A backend of one's own: it remembers what it was told."""

    def __init__(self, world=None):
        self.inner = SimBackend(direct_model(), world or field())
        self.commands = []
        self.closed = 0

    def reset(self, start):
        return self.inner.reset(start)

    def step(self, command):
        self.commands.append(command)
        return self.inner.step(command)

    def close(self):
        self.closed += 1


def test_any_backendwith_reset_step_and_close_is_a_backend_that_a_still_command_halts():
    backend = Recorder()
    env = BridgeEnv(backend, model=direct_model(), world=field())
    env.reset(seed=0)
    env.step(np.array([1.0, -1.0, 0.0], np.float32))
    env.halt()
    env.close()
    assert np.array_equal(backend.commands, [[2.0, -2.0, 0.0], [0.0, 0.0, 0.0]])
    assert backend.closed == 1


class Apart(Navigation):
    """Navigation whose steps are taken part by part."""

    def end(self, view, memory):
        return super().end(view, memory)


def test_steps_are_the_same_in_one_call_over_another_backend_and_part_by_part():
    world = field(count=4)
    given = {"model": direct_model(), "world": world}
    envs = [BridgeEnv(**given), BridgeEnv(Recorder(world), **given)]
    envs.append(BridgeEnv(**given, task=Apart))
    ends = []
    for seed in range(8):
        begun = [env.reset(seed=seed)[0] for env in envs]
        np.testing.assert_equal(begun, begun[:1] * 3)
        for action in random_actions(envs[0], 40, seed):
            steps = [env.step(action) for env in envs]
            np.testing.assert_equal(steps, steps[:1] * 3)
            if steps[0][2]:
                ends.append(steps[0][4]["is_success"])
                break
    assert [env._direct is not None for env in envs] == [True, False, False]
    assert False in ends  # with a contact, at least


def test_facts_of_a_backend_of_ones_own_are_those_of_its_last_step_unless_it_has_some():
    class Knowing(Recorder):
        def facts(self):
            return self.inner.facts()

    for backend, knows in ((Recorder(), False), (Knowing(), True)):
        env = BridgeEnv(backend, model=direct_model(), world=field())
        env.reset(seed=0)
        info = env.step(np.array([1.0, -1.0, 0.0], np.float32))[4]
        facts = env._backend.facts()
        assert np.array_equal(facts["true_pose"], info["true_pose"])
        assert ("bodies" in facts) == knows


def test_a_randomised_backend_gives_the_same_episode_as_an_backendas_by_its_name():
    model = direct_model()
    world = field(count=4)
    strong = "strong"
    backend = SimBackend(model, world, randomisation=strong)
    given = (
        BridgeEnv("sim", model, world, randomisation=strong),
        BridgeEnv(backend, model, world),
    )
    infos = [env.reset(seed=3)[1] for env in given]
    assert infos[0]["randomisation"]
    for name, value in infos[0].items():
        assert np.all(value == infos[1][name]), name
    assert np.array_equal(infos[0]["bodies"], backend.facts()["bodies"])
    assert np.array_equal(infos[0]["start"], backend.facts()["true_pose"])


def test_a_backend_that_does_not_take_what_it_is_told_is_named(monkeypatch):
    point = SimpleNamespace(load=lambda: lambda model, world: Recorder())
    known = extensions.find_extensions("backends") | {"mine": point}
    monkeypatch.setattr(extensions, "find_extensions", lambda group: known)
    BridgeEnv("mine", direct_model(), field()).reset(seed=0)
    for backend, option, words in (
        ("mine", {"randomisation": "mild"}, "got an unexpected .*'randomisation'; che"),
        ("sim", {"backend_options": {"sead": 3}}, "unknown argument 'sead'; valid are"),
    ):
        with pytest.raises(ConfigError, match=rf"backend '{backend}': {words}"):
            BridgeEnv(backend, direct_model(), field(), **option)


def test_what_is_no_backend_is_refused_with_what_it_lacks():
    with pytest.raises(
        ConfigError, match=r"backend of type object: has no reset, no step, no clo"
    ):
        BridgeEnv(object())


def test_a_task_has_judged_a_step_before_a_robot_is_asked_for_anything():
    """What it compiles then is not compiled while a robot drives."""
    told = []

    class Judging(Navigation):
        def step_into(self, *given):
            told.append("judged")
            return super().step_into(*given)

    class Robot(Recorder):
        def reset(self, start):
            told.append("reset")
            return super().reset(start)

    env = BridgeEnv(Robot(), model=direct_model(), world=field(), task=Judging)
    env.reset(seed=0)
    env.reset()
    assert told == ["judged", "reset", "reset"]


def test_the_pose_is_that_of_odometry_unless_an_estimator_is_asked_for():
    model = direct_model(odometry=(0.1, 0.1))
    plain = BridgeEnv(model=model, world=field())
    estimated = BridgeEnv(model=model, world=field(), estimator=True)
    ahead = np.array([0.2, 0.0, 0.1], np.float32)
    starts = {"start": (0.0, 0.0, 0.0), "goal": (2.0, 2.0)}
    paths = []
    for env in (plain, estimated):
        env.reset(seed=4, options=starts)
        infos = [env.step(ahead)[4] for _ in range(10)]
        odometry = env._backend.simulator.data.odom[0, 0]
        assert np.array_equal(infos[-1]["pose"], odometry) == (env is plain)
        paths.append([info["true_pose"] for info in infos])
    assert np.array_equal(*paths)


BLOCK = {"shapes": [{"kind": "rectangle", "size": [2.0, 1.0]}], "at": [[1.0, 1.0, 0.3]]}
CORNER = [[0.0, 0.0], [2.0, 0.0], [2.0, 0.4], [0.4, 0.4], [0.4, 2.0], [0.0, 2.0]]
NOTCHED = {"shapes": [{"kind": "polygon", "points": CORNER}], "at": [[-2.5, -2.5, 0.0]]}
BLOCKED = field(obstacles=[BLOCK, NOTCHED])
MODEL = replace(
    direct_model(), table=bake(lidar(), (*BLOCKED.shapes, Circle(radius=FOOTPRINT)))
)
SET = WorldSet("two", (BLOCKED, field(obstacles=[BLOCK, NOTCHED], clearance=0.11)))


@pytest.fixture(scope="module")
def envs():
    return (
        BridgeEnv(model=MODEL, world=BLOCKED),
        BridgeEnv(model=MODEL, world=SET),
        BridgeVectorEnv(3, MODEL, SET),
    )


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"start": (2.9, 0, 0)}, r"'start': \(2.9, 0\) m is in a wall; the field is"),
        ({"start": (2.6, -3.1, 0)}, "'start'.*lies outside the world"),
        ({"start": (1, 1, 0)}, "'start'.*is on an obstacle; move it"),  # amid it
        ({"start": (0.3, 1.4, 0)}, "'start'.*is on an obstacle"),  # with its edge
        ({"start": (-2.3, -1, 0)}, "'start'.*is on an obstacle; move it"),
        ({"goal": (4, 0)}, "'goal'.*lies outside the world"),
        ({"goal": (3, 0)}, "'goal'.*is in a wall"),
    ],
)
def test_a_start_or_goal_where_something_stands_is_refused(envs, options, sentence):
    for env in envs:
        with pytest.raises(ConfigError, match=sentence):
            env.reset(seed=0, options=options)
        env.reset(seed=0)


def test_a_start_beside_what_stands_is_taken(envs):
    for start in ((2.7, 0.0, 0.0), (-1.3, -1.3, 0.0), (1.0, 0.2, 0.0)):
        for env in envs:
            _, info = env.reset(seed=0, options={"start": start, "goal": (2.9, -2.9)})
            count = np.size(info["start"]) // 3
            assert np.ravel(info["start"]) == pytest.approx(start * count)
            assert np.ravel(info["goal"]) == pytest.approx((2.9, -2.9) * count)


def test_many_worlds_begin_at_a_start_where_an_obstacle_stands_in_some_of_them():
    world = field(obstacles=[circles(8, (0.5,))])
    model = replace(
        direct_model(), table=bake(lidar(), (*world.shapes, Circle(radius=FOOTPRINT)))
    )
    single = BridgeEnv(model=model, world=world)
    taken = []
    for seed in range(16):
        with contextlib.suppress(ConfigError):
            single.reset(seed=seed, options={"start": (0.0, 0.0, 0.0)})
            taken.append(seed)
    assert 0 < len(taken) < 16
    _, info = BridgeVectorEnv(16, model, world).reset(
        seed=0, options={"start": (0.0, 0.0, 0.0)}
    )
    assert not info["start"].any()


def test_a_reward_of_the_scan_is_not_judged_by_a_view_that_no_step_gives():
    class Clear(Navigation):
        def reward(self, before, after, memory):
            return {"clearance": after.ranges.min(axis=-1)}

    model = direct_model()
    task = Clear(model.robot, model.lidar)
    env = BridgeEnv(task=task, model=model, world=field(count=3))
    env.reset(seed=0)
    assert np.isfinite(env.step(STILL)[1])
