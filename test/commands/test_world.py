from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from command_line import nics
from PIL import Image
from robots import direct_model

from nics_drl_bridge.config import share_folder
from nics_drl_bridge.env.bridge_env import BridgeEnv
from nics_drl_bridge.lidar.shapes import Circle
from nics_drl_bridge.sim.barn import barn_world
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


def test_without_options_robots_start_and_end_anywhere_in_the_field(tmp_path):
    done("import", sdf(tmp_path, DISC, DISC, DISC), cwd=tmp_path)
    world = load_world(tmp_path / "my.yaml")
    assert (world.name, world.starts, world.goals, world.clearance) == (
        "my",
        None,
        None,
        0.1,
    )
    assert world.bounds == (-0.25, -0.25, 4.25, 0.25)
    assert world.goal_distance == (
        1.132,
        4.528,
    )  # a quarter of the diagonal, and all of it


def test_field_distances_and_height_are_taken_from_options(tmp_path):
    words = ("--bounds", -5, -5, 6, 5, "--goal-distance", 3, 4, "--height", 0.49)
    done("import", sdf(tmp_path, DISC), *words, cwd=tmp_path)
    world = load_world(tmp_path / "my.yaml")
    assert world.bounds == (-5.0, -5.0, 6.0, 5.0)
    assert world.goal_distance == (3.0, 4.0)
    words = ("--height", 0.51, "--out", "high.yaml")
    assert "stands at a height of 0.51 m" in refused(
        "import", "my.world", *words, cwd=tmp_path
    )


def test_bounds_that_leave_an_obstacle_out_are_refused_and_nothing_is_written(tmp_path):
    name = sdf(tmp_path, DISC, DISC)
    sentence = refused("import", name, "--bounds", -1, -1, 1, 1, cwd=tmp_path)
    assert "key 'obstacles.0.at.1'" in sentence
    assert "is outside the world" in sentence
    assert list(tmp_path.glob("*.yaml")) == []


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
    done("import", name, "--without", "m1", "--out", "other", cwd=tmp_path)
    assert len(load_world(tmp_path / "other" / "my.yaml").obstacles[0].at) == 1


def test_several_files_go_to_a_folder_all_or_none(tmp_path):
    for name in ("a.world", "b.sdf"):
        sdf(tmp_path, DISC, name=name)
    sdf(tmp_path, MESH, name="c.world")
    refused("import", "a.world", "b.sdf", "c.world", "--out", "all", cwd=tmp_path)
    assert not (tmp_path / "all").exists()
    done("import", "a.world", "b.sdf", "--out", "all", cwd=tmp_path)
    assert {file.name for file in (tmp_path / "all").iterdir()} == {"a.yaml", "b.yaml"}
    words = ("import", "a.world", "b.sdf")
    assert "is for one file, not for 2" in refused(*words, "--name", "x", cwd=tmp_path)
    assert "--out x.yaml: is for one" in refused(
        *words, "--out", "x.yaml", cwd=tmp_path
    )
    assert "all/a.yaml: is there already" in refused(
        *words, "--out", "all", cwd=tmp_path
    )
    sdf(tmp_path, DISC, name="a.sdf")
    assert "two files would be" in refused("import", "a.world", "a.sdf", cwd=tmp_path)


def test_a_world_keeps_shapes_of_every_kind(tmp_path):
    hall = "<polyline><point>0 0</point><point>3 0</point><point>1 1</point><height>1</height>"
    names = sdf(tmp_path, DISC, "<box><size>1 2 1</size></box>", f"{hall}</polyline>")
    done("import", names, cwd=tmp_path)
    kinds = [shape.kind for shape in load_world(tmp_path / "my.yaml").shapes]
    assert kinds == ["circle", "rectangle", "polygon"]


def test_a_map_of_nav2_becomes_a_world_that_refers_to_it(tmp_path):
    for name in ("room.yaml", "room.pgm"):
        shutil.copy(MAPS / name, tmp_path)
    words = ("--out", "worlds", "--start", 0, 0, 0, "--goal", 3, 3)
    told = done("import", "room.yaml", *words, cwd=tmp_path)
    assert told == "worlds/room_world.yaml: map: 10 m x 8 m\n"
    world = load_world(tmp_path / "worlds" / "room_world.yaml")
    assert Path(world.map).resolve() == tmp_path / "room.yaml"
    assert np.array_equal(world.grid.cells, load_world("room").grid.cells)
    assert world.starts.at == ((0.0, 0.0, 0.0),)
    done("import", "room.pgm", cwd=tmp_path)  # its map lies beside it
    assert load_world(tmp_path / "room_world.yaml").extent == world.extent


def test_a_picture_becomes_a_map_and_a_world(tmp_path):
    pixels = np.full((20, 30), 255, np.uint8)
    pixels[:10, :10] = 0
    Image.fromarray(pixels).save(tmp_path / "plan.png")
    sentence = refused("import", "plan.png", cwd=tmp_path)
    assert sentence.startswith(
        "plan.png: there is no plan.yaml beside the picture; give"
    )
    done("import", "plan.png", "--resolution", 0.1, cwd=tmp_path)
    world = load_world(tmp_path / "plan_world.yaml")
    assert world.extent == pytest.approx((0.0, 0.0, 3.0, 2.0))
    assert np.array_equal(world.grid.blocked, pixels[::-1] == 0)
    words = ("--resolution", 0, "--out", "x.yaml")
    assert "key 'resolution'" in refused("import", "plan.png", *words, cwd=tmp_path)


def test_the_ending_of_a_file_may_be_in_capitals(tmp_path):
    Image.fromarray(np.full((20, 30), 255, np.uint8)).save(
        tmp_path / "PLAN.PGM", format="PPM"
    )
    done("import", "PLAN.PGM", "--resolution", 0.1, cwd=tmp_path)
    assert load_world(tmp_path / "PLAN_world.yaml").extent == pytest.approx(
        (0.0, 0.0, 3.0, 2.0)
    )


def test_a_file_of_another_kind_is_refused(tmp_path):
    (tmp_path / "my.usd").write_text("")
    sentence = refused("import", "my.usd", cwd=tmp_path)
    assert sentence.startswith(
        "my.usd: unknown kind of file; give one of .world, .sdf, .yaml"
    )
    (tmp_path / "map.yaml").write_text("name: hall\n")
    assert refused("import", "map.yaml", cwd=tmp_path).startswith("map.yaml: ")


@pytest.mark.slow
def test_a_saved_world_of_gazebo_classic_can_be_drawn(tmp_path):
    done("import", HERE / "classic.world", cwd=tmp_path)
    told = done("draw", "classic.yaml", "--footprint", 0.1, "--seed", 7, cwd=tmp_path)
    assert told == "classic_drawn.png: the world 'classic', seed 7\n"
    with Image.open(tmp_path / "classic_drawn.png") as picture:
        assert picture.format == "PNG"
    done("draw", "corridor", "--robot", "ackermann", "--out", "sub/c.png", cwd=tmp_path)
    assert (tmp_path / "sub" / "c.png").is_file()


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (("draw", "arenna"), "unknown world 'arenna'; did you mean 'arena'?"),
        (("draw", "arena", "--out", "a.jpg"), "--out a.jpg: must end in .png."),
        (("draw", "arena", "--footprint", 0), "--footprint 0: must be above 0 m."),
        (
            ("draw", "arena", "--footprint", 9),
            "no free space for a robot of radius 9 m",
        ),
        (("draw", "arena", "--robot", "car"), "unknown robot 'car'"),
    ],
)
def test_a_picture_that_cannot_be_is_refused(tmp_path, words, sentence):
    assert sentence in refused(*words, cwd=tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_an_imported_world_of_barn_is_the_one_that_is_shipped(tmp_path):
    gazebo = Path("/work/shared/barn/gazebo/world_1.world")
    if not gazebo.is_file():
        pytest.skip("the benchmark's worlds are not on this machine")
    words = ("--start", "-2.25", 3, 1.57, "--goal", "-2.25", 13, "--out", "one.yaml")
    done("import", gazebo, *words, cwd=tmp_path)
    world = load_world(tmp_path / "one.yaml")
    shipped = barn_world(1)
    assert set(world.obstacles[0].at) == set(shipped.obstacles[0].at)
    assert (world.bounds, world.starts, world.goals) == (
        shipped.bounds,
        shipped.starts,
        shipped.goals,
    )


def test_the_map_of_a_world_is_a_world_again_with_the_same_walls(tmp_path):
    said = done("map", "arena", "--seed", 1, "--resolution", 0.05, cwd=tmp_path)
    assert "the map of 'arena', seed 1, 122 x 122 cells of 0.05 m" in said
    done("import", "arena_map.yaml", cwd=tmp_path)
    grid = load_world(tmp_path / "arena_map_world.yaml").grid
    assert grid.cells[0].all()
    assert 0.9 < np.mean(grid.free) < 0.97


def test_neither_picture_nor_map_replaces_a_file_that_the_world_is_made_of(tmp_path):
    Image.fromarray(np.full((80, 90), 255, np.uint8)).save(tmp_path / "plan.png")
    words = "--resolution", 0.1, "--name", "../plan", "--out", "plan.yaml"
    done("import", "plan.png", *words, cwd=tmp_path)
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
    done("draw", "plan.yaml", cwd=tmp_path)
    assert set(tmp_path.iterdir()) - set(before) == {tmp_path / "plan_drawn.png"}


def test_a_map_that_can_not_be_written_is_one_sentence(tmp_path):
    for words, sentence in (
        (("--out", "map.png"), "must end in .yaml"),
        (("--resolution", 0), "must be from 0.001 to 100 m"),
    ):
        ran = nics("world", "map", "arena", *words, cwd=tmp_path)
        assert ran.returncode == 2
        assert sentence in ran.stderr
        assert len(ran.stderr.strip().splitlines()) == 1


def test_what_is_written_is_told_as_json_too(tmp_path):
    drawn = json.loads(done("draw", "arena", "--seed", 1, "--json", cwd=tmp_path))
    assert drawn == {"file": "arena_drawn.png", "world": "arena", "seed": 1}
    words = "map", "arena", "--seed", 1, "--resolution", 0.05, "--json"
    mapped = json.loads(done(*words, cwd=tmp_path))
    assert (mapped["file"], mapped["cells"]) == ("arena_map.yaml", [122, 122])
    assert mapped["resolution_m"] == pytest.approx(0.05, rel=0.01)
    (imported,) = json.loads(done("import", "arena_map.yaml", "--json", cwd=tmp_path))[
        "worlds"
    ]
    assert imported["file"] == "arena_map_world.yaml"
    assert (tmp_path / imported["file"]).is_file()


@pytest.mark.slow
def test_a_world_of_too_many_bodies_is_refused_by_the_file_that_holds_them(tmp_path):
    boxes = [f"<box><size>{0.1 + 1e-5 * k:.5f} 0.1 1</size></box>" for k in range(6000)]
    many = refused("import", sdf(tmp_path, *boxes), "--out", "made.yaml", cwd=tmp_path)
    assert many.startswith(
        "my.world: its 6000 bodies make a larger file than is read; "
    )
    assert not (tmp_path / "made.yaml").exists()
