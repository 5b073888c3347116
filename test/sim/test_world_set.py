from __future__ import annotations

import numpy as np
import pytest
import yaml
from robots import circles, field, noisy_model

from nics_drl_bridge.config import dump_yaml
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.sim.scenes import SceneSampler, member_of
from nics_drl_bridge.sim.simulator import FastSimulator
from nics_drl_bridge.sim.world import load_world
from nics_drl_bridge.sim.world_set import WorldSet, load_worlds

MODEL = noisy_model()
MIXED = WorldSet(
    "mixed", tuple(load_world(n) for n in ("crowd", "room", "doorway", "circles"))
)
STEPS = 12
PERIOD = 0.1


def commands(worlds, robots=1):
    low = MODEL.robot.command_low
    high = MODEL.robot.command_high
    shape = STEPS, worlds, robots, len(low)
    return np.random.default_rng(0).uniform(low, high, shape)


def drive(world, seeds, given, **options):
    """Scans, poses and contacts of a drive (T, N, ...)."""
    simulator = FastSimulator(MODEL, world, len(seeds), given.shape[2], **options)
    simulator.reset(seeds)
    seen = []
    for each in given:
        simulator.step(each)
        data = simulator.data
        arrays = data.ranges, data.pose, data.odom, data.collided
        seen.append([array.copy() for array in arrays])
    return [np.array(one) for one in zip(*seen, strict=True)]


@pytest.mark.parametrize(("renderer", "robots"), [("baked", 2), ("exact", 1)])
@pytest.mark.slow
def test_an_episode_in_a_set_is_that_of_its_member_alone_to_the_bit(renderer, robots):
    seeds = np.arange(24)
    given = commands(len(seeds), robots)
    together = drive(MIXED, seeds, given, renderer=renderer, threads=2)
    chosen = np.array([member_of(MIXED, seed) for seed in seeds.tolist()])
    for p, member in enumerate(MIXED.members):
        rows = chosen == p
        assert rows.any()
        alone = drive(member, seeds[rows], given[:, rows], renderer=renderer)
        for one, other in zip(together, alone, strict=True):
            assert np.array_equal(one[:, rows], other)


def test_every_member_has_the_same_chance():
    counts = np.bincount(SceneSampler(MIXED, 0.2).draw(range(1000)).member, minlength=4)
    assert (np.abs(counts - 250) < 5.0 * np.sqrt(187.5)).all()


@pytest.fixture
def folder(tmp_path):
    for name in ("b", "a", "c"):
        world = field(5.0, count=ord(name) - ord("a")).model_copy(update={"name": name})
        (tmp_path / f"{name}.yaml").write_text(dump_yaml(world.model_dump(mode="json")))
    return tmp_path


def names(worlds):
    return [world.name for world in worlds.members]


def test_a_set_is_a_folder_a_glob_a_list_or_a_file(folder):
    file = folder / "sets" / "some.yaml"
    file.parent.mkdir()
    file.write_text("name: some\nworlds: [../*.yaml, circles]\nwithout: [../b.yaml]\n")
    assert (
        names(load_worlds(str(folder)))
        == names(load_worlds(f"{folder}/*.yaml"))
        == ["a", "b", "c"]
    )
    assert load_worlds(folder).name == folder.name
    assert names(load_worlds(f"{folder}/[ac].yaml")) == ["a", "c"]
    assert names(load_worlds(["room", folder / "a.yaml"])) == ["room", "a"]
    assert names(load_worlds(file)) == ["a", "c", "circles"]
    assert load_worlds(file).name == "some"
    assert names(load_worlds("circles")) == ["circles"]


def test_the_maps_of_worlds_in_a_folder_are_no_members(folder):
    (folder / "b_map.yaml").write_text(
        "image: b.png\nresolution: 0.05\norigin: [0, 0, 0]\n"
    )
    assert names(load_worlds(folder)) == ["a", "b", "c"]
    with pytest.raises(ConfigError, match="no world file"):
        load_worlds(f"{folder}/*_map.yaml")


def test_sets_of_equal_worlds_share_a_fingerprint_and_others_do_not(folder):
    once = load_worlds(str(folder))
    again = load_worlds(str(folder))
    assert once.fingerprint == again.fingerprint
    (folder / "d.yaml").write_text((folder / "a.yaml").read_text())
    assert load_worlds(str(folder)).fingerprint != once.fingerprint


def test_a_broken_member_is_named(folder):
    broken = yaml.safe_load((folder / "b.yaml").read_text()) | {"size": [5.0, -1.0]}
    (folder / "b.yaml").write_text(yaml.safe_dump(broken))
    with pytest.raises(ConfigError, match=r"b\.yaml: key 'size\.1'"):
        load_worlds(str(folder))


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("name: s\nworlds: []\n", "contains no world"),
        ("name: s\nworlds: [nowhere]\n", "unknown world 'nowhere'"),
        ("name: s\nworlds: [none/*.yaml]\n", "no world file"),
        ("name: s\nworlds: [gone.yaml]\n", "no such file"),
        ("name: s\nworlds: [circles]\nwithout: [circles]\n", "contains no world"),
        ("name: s\nworlds: [circles]\nwithin: [1]\n", "unknown key 'within'"),
        ("name: s\nworlds: [set.yaml]\n", "is a world set, which can't be a member"),
    ],
)
def test_a_wrong_set_is_refused_in_one_sentence(tmp_path, text, reason):
    file = tmp_path / "set.yaml"
    file.write_text(text)
    with pytest.raises(ConfigError, match=reason) as refused:
        load_worlds(file)
    assert str(refused.value).count("\n") == 0


def test_no_name_is_no_world_although_it_would_be_the_present_folder(
    folder, monkeypatch
):
    monkeypatch.chdir(folder)
    (folder / "set.yaml").write_text("name: s\nworlds: ['']\n")
    for given in ("", [""], "set.yaml"):
        with pytest.raises(ConfigError, match="unknown world ''; valid are: 'arena'"):
            load_worlds(given)


def test_what_has_to_be_imported_is_told_with_the_command_for_it(tmp_path):
    (tmp_path / "hall.world").write_text("<sdf/>")
    plan = tmp_path / "plan.yaml"
    plan.write_text("image: plan.png\nresolution: 0.05\norigin: [0, 0, 0]\n")
    for file, kind in (("hall.world", "a Gazebo world"), (str(plan), "a map")):
        for given in (file, [file]):
            told = rf"{file}: is {kind}; convert it by `nics world import {file}`\."
            with pytest.raises(ConfigError, match=told):
                load_worlds(given)
    with pytest.raises(ConfigError, match=r"no world file .* by `nics world import`\."):
        load_worlds(tmp_path)


def test_the_worlds_of_barn_are_a_set_and_each_has_a_name(tmp_path):
    barn = load_worlds("barn")
    assert len(barn.members) == 250
    assert load_worlds("barn/7") == barn.members[names(barn).index("barn_007")]
    file = tmp_path / "fold.yaml"
    file.write_text("name: fold\nworlds: [barn]\nwithout: [barn/1, barn/7]\n")
    assert set(names(barn)) - set(names(load_worlds(file))) == {"barn_001", "barn_007"}
    with pytest.raises(ConfigError, match="no BARN world 6"):
        load_worlds("barn/6")


def test_what_worlds_share_is_stored_once():
    fields = [field(5.0, obstacles=[circles(2, (r,))]) for r in (0.1, 0.12, 0.14)]
    samplers = SceneSampler(WorldSet("alike", tuple(fields)), 0.2).samplers
    assert all(one.plan.space is samplers[0].plan.space for one in samplers)
    rooms = WorldSet("rooms", tuple(load_world(n) for n in ("room", "room", "circles")))
    fixtures = FastSimulator(MODEL, rooms)._world_set.fixtures
    assert fixtures.maps[0].tolist() == fixtures.maps[1].tolist()
    assert fixtures.squares.size == fixtures.maps[0, 1] * fixtures.maps[0, 2]
