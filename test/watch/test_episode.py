from __future__ import annotations

import re
from contextlib import closing
from types import SimpleNamespace

import numpy as np
import pytest

from nics_drl_bridge.errors import BridgeError, ConfigError
from nics_drl_bridge.geometry import wrap_angle
from nics_drl_bridge.lidar.exact_kernels import HEADING, RADIUS, X, Y
from nics_drl_bridge.seeds import GREATEST_SEED
from nics_drl_bridge.sim.world import load_world
from nics_drl_bridge.watch.episode import copy_world
from nics_drl_bridge.watch.server import Request
from watch.rig import shown, source


@pytest.fixture
def driven():
    with closing(source()) as made:
        yield made


def bodies(made):
    shot = made.lanes[0].env.snapshot()
    return shot.bodies[shot.bodies[:, RADIUS] > 0.0]


def pose(made):
    return made.lanes[0].env.snapshot().poses[0]


def free_spot(made):
    """A place amid the field that no disc and no robot is near."""
    spots = np.stack(np.meshgrid(*[np.linspace(-2.0, 2.0, 9)] * 2), axis=-1).reshape(
        -1, 2
    )
    taken = np.concatenate([bodies(made)[:, [X, Y]], pose(made)[None, :2]])
    apart = np.linalg.norm(spots[:, None] - taken, axis=-1).min(axis=1)
    return spots[apart.argmax()].tolist()


def test_the_policy_drives_and_the_trail_shows_where(driven):
    begin = pose(driven)
    for _ in range(3):
        driven.advance()
    frame = driven.frame()
    assert frame.time_s == pytest.approx(0.3)
    (way,) = frame.worlds[0].trails
    assert way.shape == (4, 2)
    assert way[0] == pytest.approx(begin[:2])
    assert way[-1] == pytest.approx(pose(driven)[:2])
    assert frame.worlds[0].shot.commands == pytest.approx(np.array([[2.0, 0.0, 0.0]]))
    assert frame.worlds[0].shot.covariance.shape == (1, 3, 3)


@pytest.mark.parametrize(
    ("x", "reason"),
    [(1e7, "lies outside the world"), (3.0, "is in a wall"), (-3.0, "is in a wall")],
)
def test_a_goal_off_the_field_is_refused_and_all_else_goes_on(driven, x, reason):
    driven.take(Request(kind="goal", x=1.25, y=-0.5))
    told = re.escape(
        f"goal: ({x:g}, 0) m {reason}; the field is -3 to 3 m by -3 to 3 m."
    )
    with pytest.raises(ConfigError, match=f"^{told}$"):
        driven.take(Request(kind="goal", x=x))
    assert driven.frame().worlds[0].shot.goals.tolist() == [[1.25, -0.5]]
    assert driven.take(Request(kind="policy", name="other"))
    driven.take(Request(kind="clear"))


@pytest.mark.parametrize("shape", ["circle", "box"])
def test_an_obstacle_is_added_while_all_else_stays_where_it_is(driven, shape):
    driven.take(Request(kind="goal", x=1.25, y=-0.5))
    driven.advance()
    x, y = free_spot(driven)
    before = bodies(driven)
    stood = pose(driven)
    assert driven.take(Request(kind="obstacle", x=x, y=y, shape=shape))
    after = bodies(driven)
    assert len(after) == len(before) + 1
    assert pose(driven) == pytest.approx(stood)
    assert driven.frame().worlds[0].shot.goals.tolist() == [[1.25, -0.5]]
    places = {tuple(body) for body in after[:, [X, Y]].round(9)}
    assert places == {(x, y), *(tuple(body) for body in before[:, [X, Y]].round(9))}
    assert len(driven.stage().worlds[0].shapes) == 2
    with pytest.raises(ConfigError, match="touches the robot; move it"):
        driven.take(Request(kind="obstacle", x=stood[0], y=stood[1]))
    assert len(bodies(driven)) == len(after)
    seen = driven.frame().worlds[0].shot.ranges
    driven.take(Request(kind="clear"))
    assert len(bodies(driven)) == 0
    assert (driven.frame().worlds[0].shot.ranges > seen).any()
    assert driven.take(Request(kind="seed", value=GREATEST_SEED))
    assert len(bodies(driven)) == len(before)
    assert driven.frame().worlds[0].name.endswith(f"episode {GREATEST_SEED}")
    with pytest.raises(ConfigError, match=r"seed 1\.5: must be a whole number"):
        driven.take(Request(kind="seed", value=1.5))


def test_a_person_drives_while_keys_are_held_and_the_robot_stops_once_they_are_silent(
    driven, monkeypatch
):
    clock = [100.0]
    monkeypatch.setattr(
        "nics_drl_bridge.watch.episode.time.monotonic", lambda: clock[0]
    )
    driven.take(Request(kind="drive", twist=(-0.5, 0.0, 1.0)))
    driven.advance()
    assert driven.frame().worlds[0].shot.commands[0] == pytest.approx(
        [-1.0, 0.0, 2.0], abs=1e-6
    )
    clock[0] += 0.6
    driven.advance()
    assert driven.frame().worlds[0].shot.commands[0] == pytest.approx(
        [0.0, 0.0, 0.0], abs=1e-6
    )
    driven.take(Request(kind="drive", on=False))
    driven.advance()
    assert driven.frame().worlds[0].shot.commands[0] == pytest.approx([2.0, 0.0, 0.0])


def test_another_policy_goes_on_from_here_and_one_that_does_not_open_changes_nothing(
    driven,
):
    driven.advance()
    stood = pose(driven)
    assert driven.take(Request(kind="policy", name="other"))
    assert pose(driven) == pytest.approx(stood)
    assert driven.stage().chosen["policy"] == "other"
    with pytest.raises(BridgeError, match="does not open"):
        driven.take(Request(kind="policy", name="broken"))
    assert driven.stage().chosen["policy"] == "other"
    driven.advance()


def test_an_episode_that_ended_is_shown_for_a_while_and_the_next_one_begins(driven):
    driven.take(Request(kind="clear"))
    for _ in range(100):
        if driven.lanes[0].state:
            break
        driven.advance()
    assert driven.lanes[0].state in ("collision", "success")
    assert driven.unfinished(1)
    while driven.lanes[0].seed == 3:
        driven.advance()
    assert driven.lanes[0].seed == 4
    assert not driven.lanes[0].state
    assert len(bodies(driven)) == 2


def test_a_page_asks_for_all_of_it_over_its_socket():
    with closing(source()) as made, shown(made) as (_, client):
        stage = client.next("stage")
        assert {"goal", "obstacle", "drive", "policy", "speed"} <= set(stage["can"])
        client.ask("obstacle", x=50.0, y=0.0)
        assert "outside the world" in client.next("notice")["text"]
        for kind, name in (("world", "../worlds/room"), ("policy", "/etc/hostname")):
            client.ask(kind, name=name)
            told = client.next("notice")["text"]
            assert told.startswith(f"{kind} {name!r}: is not on the page's list; ")
        client.ask("clear")
        client.next("stage")
        client.next("frame", lambda frame: frame["worlds"][0]["bodies"] == [])
        for world in ("room", stage["chosen"]["world"]):
            client.ask("world", name=world)
            assert client.next("stage")["places"][0]["name"] == world


def test_an_obstacle_that_has_turned_round_and_round_stands_in_a_world():
    world = load_world("crowd")
    count = sum(group.counts[1] for group in world.obstacles)
    bodies = np.zeros((count, 7))
    bodies[:, [HEADING, RADIUS]] = 40.0, 0.2
    env = SimpleNamespace(
        snapshot=lambda: SimpleNamespace(member=0, bodies=bodies), world=world
    )
    (_, _, heading), *_ = copy_world(env).obstacles[0].at
    assert heading == pytest.approx(wrap_angle(40.0))
