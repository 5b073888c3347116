from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from command_line import nics
from PIL import Image
from robots import direct_model

from nics_drl_bridge import config
from nics_drl_bridge.config import share_folder
from nics_drl_bridge.env.bridge_env import BridgeEnv
from nics_drl_bridge.lidar.shapes import Circle
from nics_drl_bridge.sim.world import load_world

HERE = Path(__file__).parents[1] / "sim" / "gazebo"
MAPS = share_folder() / "config" / "maps"
DISC = "<cylinder><radius>0.25</radius><length>1</length></cylinder>"
MESH = "<mesh><uri>chair.dae</uri></mesh>"
PLACES = ("--start", -2, -1, 0.5, "--goal", 3, "-2.5")


def sdf(folder, *geometries, name="my.world"):
    """A world file of a model m0, m1, ... for each geometry, 2 m apart."""
    models = "".join(
        f"<model name='m{n}'><pose>{2 * n} 0 0 0 0 0</pose><link name='l'><collision name='c'>"
        f"<geometry>{geometry}</geometry></collision></link></model>"
        for n, geometry in enumerate(geometries)
    )
    (folder / name).write_text(
        f"<sdf version='1.9'><world name='w'>{models}</world></sdf>"
    )
    return name


def done(*words, cwd):
    ran = nics("world", *words, cwd=cwd)
    assert ran.returncode == 0, ran.stderr
    return ran.stdout


def refused(*words, cwd):
    ran = nics("world", *words, cwd=cwd)
    assert ran.returncode == 2
    (sentence,) = ran.stderr.splitlines()
    return sentence.removeprefix("nics: ")


def test_a_world_of_gazebo_becomes_a_world_file_that_an_env_drives_in(tmp_path):
    words = ("--out", "own.yaml", "--name", "own", *PLACES, "--clearance", "0.15")
    told = done("import", sdf(tmp_path, DISC, DISC), *words, cwd=tmp_path)
    assert told == "own.yaml: obstacles: 2, field: 7 m x 3.75 m\n"
    world = load_world(tmp_path / "own.yaml")
    assert (world.name, world.clearance) == ("own", 0.15)
    assert world.bounds == (-3.0, -3.5, 4.0, 0.25)
    assert world.goal_distance[0] == 0.0  # start and goal are given, however near
    assert world.shapes == (Circle(radius=0.25),)
    assert world.obstacles[0].at == ((0.0, 0.0, 0.0), (2.0, 0.0, 0.0))
    env = BridgeEnv(model=direct_model(), world=str(tmp_path / "own.yaml"))
    _, info = env.reset(seed=3)
    assert info["pose"] == pytest.approx((-2.0, -1.0, 0.5), abs=1e-6)
    assert info["goal"] == pytest.approx((3.0, -2.5))


def test_a_mesh_is_refused_or_left_out_and_listed_in_the_file_too(tmp_path):
    name = sdf(tmp_path, DISC, MESH)
    sentence = refused("import", name, cwd=tmp_path)
    assert sentence.startswith(
        "my.world: model 'm1' has a mesh chair.dae, which a world can't"
    )
    told = done("import", name, "--skip-unknown", cwd=tmp_path)
    assert told.endswith("\n  left out: model 'm1' has a mesh chair.dae\n")
    assert (
        "# Left out: model 'm1' has a mesh chair.dae.\n"
        in (tmp_path / "my.yaml").read_text()
    )
    done("import", name, "--without m1 --out other", cwd=tmp_path)
    assert len(load_world(tmp_path / "other" / "my.yaml").obstacles[0].at) == 1


def test_several_files_go_to_a_folder_all_or_none(tmp_path):
    for name in ("a.world", "b.sdf"):
        sdf(tmp_path, DISC, name=name)
    sdf(tmp_path, MESH, name="c.world")
    refused("import a.world b.sdf c.world --out all", cwd=tmp_path)
    assert not (tmp_path / "all").exists()
    done("import a.world b.sdf --out all", cwd=tmp_path)
    assert {file.name for file in (tmp_path / "all").iterdir()} == {"a.yaml", "b.yaml"}
    words = "import a.world b.sdf"
    assert "is for one file, not for 2" in refused(words, "--name x", cwd=tmp_path)
    assert "--out x.yaml: is for one" in refused(words, "--out x.yaml", cwd=tmp_path)
    assert "all/a.yaml: already exists" in refused(words, "--out all", cwd=tmp_path)
    sdf(tmp_path, DISC, name="a.sdf")
    assert "two worlds would be" in refused("import a.world a.sdf", cwd=tmp_path)


def test_a_map_of_nav2_becomes_a_world_that_refers_to_it(tmp_path):
    for name in ("room.yaml", "room.pgm"):
        shutil.copy(MAPS / name, tmp_path)
    words = "--out worlds --start 0 0 0 --goal 3 3"
    told = done("import room.yaml", words, cwd=tmp_path)
    assert told == "worlds/room_world.yaml: map: 10 m x 8 m\n"
    world = load_world(tmp_path / "worlds" / "room_world.yaml")
    assert Path(world.map).resolve() == tmp_path / "room.yaml"
    assert np.array_equal(world.grid.cells, load_world("room").grid.cells)
    assert world.starts.at == ((0.0, 0.0, 0.0),)
    done("import room.pgm", cwd=tmp_path)  # its map lies beside it
    assert load_world(tmp_path / "room_world.yaml").extent == world.extent


def test_a_picture_becomes_a_map_and_a_world(tmp_path):
    pixels = np.full((20, 30), 255, np.uint8)
    pixels[:10, :10] = 0
    Image.fromarray(pixels).save(tmp_path / "PLAN.PNG")
    sentence = refused("import PLAN.PNG", cwd=tmp_path)
    assert "there is no PLAN.yaml beside the picture; give" in sentence
    done("import PLAN.PNG --resolution 0.1", cwd=tmp_path)
    world = load_world(tmp_path / "PLAN_world.yaml")
    assert world.extent == pytest.approx((0.0, 0.0, 3.0, 2.0))
    assert np.array_equal(world.grid.blocked, pixels[::-1] == 0)
    words = "--resolution 0 --out x.yaml"
    assert "key 'resolution'" in refused("import PLAN.PNG", words, cwd=tmp_path)


def test_neither_picture_nor_map_replaces_a_file_that_the_world_is_made_of(tmp_path):
    Image.fromarray(np.full((80, 90), 255, np.uint8)).save(tmp_path / "plan.png")
    words = "--resolution", 0.1, "--name", "../plan", "--out", "plan.yaml"
    done("import plan.png", *words, cwd=tmp_path)
    (tmp_path / "set.yaml").write_text("name: set\nworlds: [plan.yaml]\n")
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    for words, file in (
        (("draw", "plan.yaml", "--out", "plan.png"), "plan.png"),
        (("map", "plan.yaml"), "plan_map.yaml"),
        (("map", "pl*n.yaml", "--out", "plan.yaml"), "plan.yaml"),  # a set of one
        (("map", "set.yaml", "--out", "set.yaml"), "set.yaml"),
    ):
        sentence = refused(*words, cwd=tmp_path)
        assert (
            sentence
            == f"{tmp_path / file}: is a file of the world itself; give another --out."
        )
        assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before
    done("draw plan.yaml", cwd=tmp_path)
    assert set(tmp_path.iterdir()) - set(before) == {tmp_path / "plan_drawn.png"}


def test_a_world_of_too_many_bodies_is_refused_by_the_file_that_holds_them(
    tmp_path, monkeypatch
):
    monkeypatch.setattr(config, "MAX_VALUES", 200)
    boxes = [f"<box><size>{0.1 + 1e-5 * k:.5f} 0.1 1</size></box>" for k in range(40)]
    many = refused("import", sdf(tmp_path, *boxes), "--out made.yaml", cwd=tmp_path)
    assert many.startswith(
        "my.world: its 40 bodies make a file that is too large to be read; "
    )
    assert not (tmp_path / "made.yaml").exists()


def test_field_distances_height_and_shapes_are_taken_from_options_or_the_file(tmp_path):
    hall = "<polyline><point>0 0</point><point>3 0</point><point>1 1</point><height>1</height>"
    box = "<box><size>1 2 1</size></box>"
    name = sdf(tmp_path, DISC, box, f"{hall}</polyline>")
    done("import", name, cwd=tmp_path)
    world = load_world(tmp_path / "my.yaml")
    assert [shape.kind for shape in world.shapes] == ["circle", "rectangle", "polygon"]
    assert (world.name, world.starts, world.goals) == ("my", None, None)
    assert world.goal_distance[1] == pytest.approx(4.0 * world.goal_distance[0], 1e-3)
    words = "--bounds -5 -5 9 5 --goal-distance 3 4 --out own.yaml"
    done("import", name, words, cwd=tmp_path)
    world = load_world(tmp_path / "own.yaml")
    assert world.bounds == (-5.0, -5.0, 9.0, 5.0)
    assert world.goal_distance == (3.0, 4.0)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("import my.world --bounds -1 -1 1 1", "key 'obstacles.0.at.1'.* is outside"),
        ("import my.world --height 0.51", "is at height 0.51 m"),
        ("import my.usd", "my.usd: unknown kind of file; give one of .world"),
        ("import hall.yaml", "hall.yaml: "),
        ("draw arenna", "unknown world 'arenna'; did you mean 'arena'"),
        ("draw arena --footprint 9", "no free space for a robot of radius 9 m"),
        ("draw arena --robot car", "unknown robot 'car'"),
        ("map arena --out map.png", "--out map.png: must end in .yaml"),
        ("map arena --resolution 0", "must be from 0.001 to 100 m"),
    ],
)
def test_what_can_not_be_made_is_one_sentence_and_nothing_is_written(
    tmp_path, words, said
):
    sdf(tmp_path, DISC, DISC)
    (tmp_path / "my.usd").write_text("")
    (tmp_path / "hall.yaml").write_text("name: hall\n")
    before = set(tmp_path.iterdir())
    assert re.search(said, refused(*words.split(), cwd=tmp_path))
    assert set(tmp_path.iterdir()) == before


@pytest.mark.slow
def test_worlds_are_drawn_and_mapped_and_a_map_is_a_world_again(tmp_path):
    done("import", HERE / "classic.world", cwd=tmp_path)
    told = done("draw classic.yaml --footprint 0.1 --seed 7", cwd=tmp_path)
    assert told == "classic_drawn.png: the world 'classic', seed 7\n"
    with Image.open(tmp_path / "classic_drawn.png") as picture:
        assert picture.format == "PNG"
    drawn = json.loads(done("draw arena --seed 1 --json", cwd=tmp_path))
    assert drawn == {"file": "arena_drawn.png", "world": "arena", "seed": 1}
    words = "map arena --seed 1 --resolution 0.05 --json"
    mapped = json.loads(done(words, cwd=tmp_path))
    assert (mapped["file"], mapped["cells"]) == ("arena_map.yaml", [122, 122])
    told = json.loads(done("import arena_map.yaml --json", cwd=tmp_path))
    grid = load_world(tmp_path / told["worlds"][0]["file"]).grid
    assert grid.cells[0].all()
    assert 0.9 < np.mean(grid.free) < 0.97
