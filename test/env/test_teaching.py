from __future__ import annotations

import numpy as np
import pytest
from robots import direct_model, field, lidar

from nics_drl_bridge.env.teaching import Curriculum, Teaching
from nics_drl_bridge.env.vector_env import BridgeVectorEnv
from nics_drl_bridge.errors import ConfigError

BLIND_BEHIND = lidar(beams=37, angle_min=-np.pi / 2.0, angle_max=np.pi / 2.0)
BACK = np.array([[-1.0, 0.0, 0.0]], np.float32)


def env_of(teaching, mode="NextStep", steps=100, **changes):
    """A robot that sees nothing behind, in the middle of a field."""
    places = {"starts": {"at": [[0.0, 0.0, 0.0]]}, "goals": {"at": [[2.0, 0.5]]}}
    world = field(6.0, **(places | changes))
    env = BridgeVectorEnv(
        1,
        direct_model(sensor=BLIND_BEHIND),
        world,
        max_episode_steps=steps,
        autoreset_mode=mode,
    )
    if teaching is not None:
        env.teach(teaching)
    return env


def drive(env, action, steps=80):
    """The outcome of each step until the episode ends."""
    env.reset(seed=0)
    for _ in range(steps):
        _, reward, terminated, _, info = env.step(action)
        yield float(reward[0]), bool(terminated[0]), info
        if terminated[0]:
            return


def test_a_contact_behind_ends_an_episode_with_its_reward_once():
    *before, last = drive(env_of(Teaching(contact=-7.0)), BACK)
    assert last[1]
    assert bool(last[2]["collision"][0])
    assert last[2]["reward_terms"]["contact"][0] == -7.0
    assert all(info["reward_terms"]["contact"][0] == 0.0 for *_, info in before)


def test_without_it_the_task_does_not_notice():
    rest = list(drive(env_of(None), BACK))
    assert len(rest) == 80
    assert bool(rest[-1][2]["true_collision"][0])
    assert "contact" not in rest[-1][2]["reward_terms"]


def test_the_reward_of_the_path_adds_up_to_its_length():
    env = env_of(Teaching(path=2.0))
    terms = [
        info["reward_terms"]["path"][0]
        for *_, info in drive(env, np.array([[0.5, 0.0, 0.0]], np.float32), 10)
    ]
    moved = env.simulator.data.pose[0, 0, :2]
    straight = np.hypot(2.0, 0.5) - np.hypot(*(moved - [2.0, 0.5]))
    assert sum(terms) == pytest.approx(2.0 * straight, rel=0.1)


def test_rewards_of_the_task_stay_as_they_are():
    plain, more = (
        [
            reward
            - sum(info["reward_terms"].get(n, [0.0])[0] for n in ("path", "contact"))
            for reward, _, info in drive(env_of(given), BACK, 10)
        ]
        for given in (None, Teaching(path=1.0, contact=-1.0))
    )
    np.testing.assert_allclose(plain, more, atol=1e-12)


def episodes(env, action, steps):
    """The seeds of the episodes of so many steps."""
    _, info = env.reset(seed=3)
    seeds = [int(info["episode_seed"][0])]
    for _ in range(steps):
        _, _, terminated, truncated, info = env.step(action)
        if (terminated | truncated)[0]:
            seeds.append(int(info["episode_seed"][0]))
    return seeds


def test_an_episode_that_failed_is_driven_again_so_often():
    env = env_of(Teaching(retries=2), "SameStep", steps=5)
    one, *rest = episodes(env, np.zeros((1, 3), np.float32), 20)
    assert [seed == one for seed in rest] == [True, True, False, False]


def test_an_episode_that_succeeded_is_not_driven_again():
    env = env_of(Teaching(retries=2), "SameStep", goals={"at": [[2.0, 0.0]]})
    seeds = episodes(env, np.array([[1.0, 0.0, 0.0]], np.float32), 60)
    assert len(seeds) > 2
    assert len(set(seeds)) == len(seeds)


WIDE = field(9.0, count=4, goal_distance=[2.0, 6.0])
AHEAD = np.array([[1.0, 0.0, 0.0]], np.float32)


def starts_of(level, world=WIDE, worlds=20):
    """Starts (N, 3), goals (N, 2), and the lengths of the ways (N,) at a level."""
    env = BridgeVectorEnv(worlds, direct_model(), world, autoreset_mode="SameStep")
    env.teach(Teaching(path=1.0, curriculum=Curriculum(begin=level)))
    env.reset(seed=2)
    teacher = env._teacher
    return (
        env._starts[:, 0].copy(),
        env.simulator.goals[:, 0].copy(),
        teacher._left[:, 0].copy(),
    )


def test_starts_of_a_curriculum_leave_a_share_of_the_way_with_the_headings_and_goals_as_drawn():
    drawn, goals, whole = starts_of(1.0)
    for level in (0.3, 0.7):
        starts, same, left = starts_of(level)
        np.testing.assert_array_equal(same, goals)
        np.testing.assert_array_equal(starts[:, 2], drawn[:, 2])
        moved = (starts != drawn).any(axis=1)
        assert moved.mean() > 0.8
        assert (left[moved] <= level * whole[moved] + 0.15).all()
        assert left[moved].mean() > (level - 0.1) * whole[moved].mean()


def test_a_start_moves_along_the_way_around_a_wall():
    places = {"starts": {"at": [[-3.0, 0.0, 0.0]]}, "goals": {"at": [[3.0, 0.0]]}}
    apart = {"goal_distance": [1.0, 9.0], "clearance": 0.0, "obstacles": []}
    wall = field(9.0, walls=[[0.0, -4.5, 0.0, 2.0]], **places, **apart)
    (half,), _, _ = starts_of(0.5, wall, 1)
    assert half[1] > 2.0
    assert abs(half[0]) < 0.5


def test_a_start_stays_as_drawn_where_there_is_no_room_on_the_way():
    places = {"starts": {"at": [[-2.0, 0.0, 0.0]]}, "goals": {"at": [[2.0, 0.0]]}}
    moving = {
        "shapes": [{"kind": "circle", "radius": 0.4}],
        "at": [[0.0, 0.0, 0.0]],
        "motion": {"kind": "pedestrian", "speed": [0.2, 0.4]},
    }
    apart = {"goal_distance": [1.0, 9.0], "clearance": 0.0}
    crowd = field(9.0, obstacles=[moving], **places, **apart)
    free = field(9.0, obstacles=[], **places, **apart)
    assert starts_of(0.5, crowd, 1)[0][0].tolist() == [-2.0, 0.0, 0.0]
    assert abs(starts_of(0.5, free, 1)[0][0, 0]) < 0.2


def test_a_start_that_a_user_names_is_not_moved():
    env = BridgeVectorEnv(1, direct_model(), WIDE, autoreset_mode="SameStep")
    env.teach(Teaching(curriculum=Curriculum()))
    _, info = env.reset(seed=2, options={"start": [0.5, 0.25, 1.0]})
    assert info["start"][0].tolist() == [0.5, 0.25, 1.0]


def levels(action, steps, success=0.7):
    """The level after each step, in worlds whose goals lie ahead."""
    places = {"starts": {"at": [[-2.0, 0.0, 0.0]]}, "goals": {"at": [[2.0, 0.0]]}}
    world = field(9.0, goal_distance=[1.0, 9.0], obstacles=[], **places)
    env = BridgeVectorEnv(
        120, direct_model(), world, max_episode_steps=30, autoreset_mode="SameStep"
    )
    env.teach(Teaching(curriculum=Curriculum(begin=0.4, step=0.3, success=success)))
    env.reset(seed=0)
    for _ in range(steps):
        env.step(np.tile(action, (120, 1)))
        yield round(env.level, 9)


def test_the_level_rises_with_success_and_does_not_without():
    reached = list(levels(AHEAD, 70))
    assert reached == sorted(reached)
    assert set(reached) == {0.4, 0.7, 1.0}
    assert set(levels(BACK, 70)) == {0.4}


def test_only_episodes_that_began_at_a_level_count_for_it():
    env = BridgeVectorEnv(120, direct_model(), WIDE, autoreset_mode="SameStep")
    env.teach(Teaching(curriculum=Curriculum(begin=0.2, step=0.1)))
    env.reset(seed=0)
    all_of_them = np.ones(120, np.bool_)
    found = []
    for anew in (False, False, True):
        if anew:
            env.reset(seed=0)
        env._teacher.again(all_of_them, all_of_them)
        found.append(round(env.level, 9))
    assert found == [0.3, 0.3, 0.4]


def test_a_curriculum_is_for_one_robot():
    env = BridgeVectorEnv(2, direct_model(), WIDE, "cooperative_reaching")
    with pytest.raises(ConfigError, match="moves a single robot's start; leave it out"):
        env.teach(Teaching(curriculum=Curriculum()))


def test_levels_do_not_depend_on_the_number_of_threads():
    def driven(threads):
        env = BridgeVectorEnv(
            120,
            direct_model(),
            WIDE,
            max_episode_steps=20,
            autoreset_mode="SameStep",
            threads=threads,
        )
        env.teach(Teaching(path=1.0, retries=1, curriculum=Curriculum(success=0.05)))
        env.reset(seed=0)
        for _ in range(50):
            seen = env.step(np.tile(AHEAD, (120, 1)))[0]
        return seen, env.level, env._starts.copy()

    one = driven(1)
    three = driven(3)
    assert 0.2 < one[1] == three[1]
    np.testing.assert_array_equal(one[0], three[0])
    np.testing.assert_array_equal(one[2], three[2])
