from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.lidar.shapes import Circle, Rectangle
from nics_drl_bridge.sim import sdf
from nics_drl_bridge.sim.barn import barn_world
from nics_drl_bridge.sim.sdf import read_sdf

HERE = Path(__file__).parent / "gazebo"
HEIGHT = 0.2
DISC = "<cylinder><radius>0.1</radius><length>1</length></cylinder>"
POINT = "<polyline><point>0 0</point><height>1</height></polyline>"
ROUND = "".join(
    f"<point>{math.cos(k * math.tau / 20_000):.9f} {math.sin(k * math.tau / 20_000):.9f}</point>"
    for k in range(20_000)
)
FINE = f"<polyline>{ROUND}<height>1</height></polyline>"
CORNERS = "<point>2e4 0</point><point>0 2e4</point><point>0 0</point>"
FAR = f"<polyline>{CORNERS}<height>1</height></polyline>"
MESH = "<mesh><uri>model://table/table.dae</uri></mesh>"


def model(geometry, name="m", pose="<pose>0 0 0 0 0 0</pose>", link=""):
    return (
        f"<model name='{name}'>{pose}<link name='link'>{link}<collision name='c'>"
        f"<geometry>{geometry}</geometry></collision></link></model>"
    )


def posed(rest):
    return model(DISC, pose=f"<pose{rest}")


@pytest.fixture
def write(tmp_path):
    """Writes a world of some elements."""

    def written(inside, version="1.10", name="my.world"):
        file = tmp_path / name
        file.write_text(
            f"<sdf version='{version}'><world name='w'>{inside}</world></sdf>"
        )
        return file

    return written


def only(file, **options):
    """The one shape of a file, and its pose."""
    (placed,) = read_sdf(file, HEIGHT, **options).placed
    return placed


def refused(file, **options):
    with pytest.raises(ConfigError) as caught:
        read_sdf(file, HEIGHT, **options)
    sentence = str(caught.value)
    assert sentence.startswith(str(file))
    return sentence.removeprefix(str(file))


@pytest.mark.parametrize("number", [1, 50, 299])
def test_every_cylinder_of_a_published_world_is_found_where_it_stands(
    shared_barn, number
):
    file = shared_barn / "gazebo" / f"world_{number}.world"
    (group,) = read_sdf(file, HEIGHT).obstacles
    expected = barn_world(number).obstacles[0]
    found, wanted = (np.array(each.at)[:, :2] for each in (group, expected))
    found, wanted = (one[np.lexsort(np.round(one, 3).T)] for one in (found, wanted))
    assert found == pytest.approx(wanted, abs=1e-3)
    assert group.shapes == expected.shapes


def test_frames_degrees_nested_and_included_models_stand_where_their_names_say():
    found = dict(zip(NAMES, read_sdf(HERE / "hall.world", HEIGHT).placed, strict=True))
    wall, place = found["wall"]
    assert wall == Rectangle(size=(4.0, 0.2))
    assert place == pytest.approx((2.0, 3.0, math.radians(30.0)), abs=1e-6)
    assert found["disc"] == (Circle(radius=0.25), pytest.approx((10.0, 1.0, 0.0)))
    assert found["egg"] == (Circle(radius=0.1), pytest.approx((-5.0, 2.0, 0.0)))
    assert found["column"] == (Circle(radius=0.2), pytest.approx((-0.3, -4.0, 0.0)))
    assert found["pillar"] == (Circle(radius=0.2), pytest.approx((0.0, 0.0, 0.0)))


NAMES = ("wall", "disc", "egg", "column", "pillar")


def test_a_saved_state_replaces_the_poses_of_models_and_moves_nothing_twice():
    moved, still = read_sdf(HERE / "classic.world", HEIGHT).placed
    assert moved[1] == pytest.approx((4.0, 1.5, math.pi / 2.0), abs=1e-5)
    assert still[1] == (-3.0, 0.0, 0.0)


def test_models_are_looked_for_on_the_paths_of_gazebo(write, tmp_path, monkeypatch):
    file = write(
        "<include><uri>model://pillar</uri><pose>1 2 0.5 0 0 0</pose></include>"
    )
    assert (
        "'model://pillar', which is neither beside the file nor on GZ_SIM"
        in refused(file)
    )
    for key in ("GZ_SIM_RESOURCE_PATH", "GAZEBO_MODEL_PATH"):
        with monkeypatch.context() as patch:
            patch.setenv(key, f"{tmp_path}:{HERE / 'models'}")
            assert only(file)[1] == (1.0, 2.0, 0.0)


def test_a_file_of_models_without_a_world_is_read_too(tmp_path):
    file = tmp_path / "pile.sdf"
    file.write_text(
        f"<sdf version='1.9'>{model(DISC, pose='<pose>1 2 0 0 0 0</pose>')}</sdf>"
    )
    assert only(file) == (Circle(radius=0.1), (1.0, 2.0, 0.0))


@pytest.mark.parametrize(
    ("pose", "place"),
    [
        ("<pose>1 2 0 0 0 0.5</pose>", (1.0, 2.0, 0.5)),
        ("<pose degrees='true'>1 2 0 0 0 90</pose>", (1.0, 2.0, math.pi / 2.0)),
        ("<pose degrees='false'>1 2 0 0 0 0.5</pose>", (1.0, 2.0, 0.5)),
        (
            "<pose rotation_format='quat_xyzw'>1 2 0  0 0 0.6 0.8</pose>",
            (1.0, 2.0, 1.287002),
        ),
        ("<pose frame=''>1 2 0 0 -0 0</pose>", (1.0, 2.0, 0.0)),
        ("<pose/>", (0.0, 0.0, 0.0)),
        ("", (0.0, 0.0, 0.0)),
        ("<pose relative_to='f'>1 0 0 0 0 0</pose>", (3.0, 1.0, math.pi / 2.0)),
        ("<pose frame='f'>1 0 0 0 0 0</pose>", (3.0, 1.0, math.pi / 2.0)),
    ],
)
def test_poses_are_read_in_each_of_their_forms(write, pose, place):
    frame = "<frame name='f'><pose degrees='1'>3 0 0 0 0 90</pose></frame>"
    box = "<box><size>1 2 1</size></box>"
    assert only(write(frame + model(box, pose=pose)))[1] == pytest.approx(
        place, abs=1e-5
    )


def test_a_pose_may_be_relative_to_a_link_of_another_model_or_to_a_joint(write):
    first = (
        "<model name='first'><pose>1 0 0 0 0 0</pose>"
        "<link name='arm'><pose>0 2 0 0 0 0</pose></link>"
        "<link name='base'/><joint name='elbow' type='fixed'><parent>base</parent>"
        "<child>arm</child><pose>0 0.5 0 0 0 0</pose></joint></model>"
    )
    for frame, y in (("first::arm", 2.0), ("first::elbow", 2.5), ("first", 0.0)):
        pose = f"<pose relative_to='{frame}'>3 0 0 0 0 0</pose>"
        assert only(write(first + model(DISC, pose=pose)))[1] == pytest.approx(
            (4.0, y, 0.0)
        )
    attached = (
        "<frame name='f' attached_to='first::arm'><pose>0 1 0 0 0 0</pose></frame>"
    )
    pose = "<pose relative_to='f'/>"
    assert only(write(first + attached + model(DISC, pose=pose)))[1] == (1.0, 3.0, 0.0)


def test_several_models_may_stand_in_one_frame(write):
    pose = "<pose relative_to='f'>1 0 0 0 0 0</pose>"
    inside = model(DISC, "m", pose) + model(DISC, "n", pose)
    file = write("<frame name='f'><pose>3 0 0 0 0 0</pose></frame>" + inside)
    places = [place for _, place in read_sdf(file, HEIGHT).placed]
    assert places == [(4.0, 0.0, 0.0)] * 2


def test_the_height_decides_what_counts(write):
    low = model("<box><size>1 1 0.1</size></box>", "low")
    table = model(
        "<box><size>2 1 0.1</size></box>", "table", "<pose>0 0 0.7 0 0 0</pose>"
    )
    file = write(low + table)
    assert read_sdf(file, 0.04).placed[0][0] == Rectangle(size=(1.0, 1.0))
    assert read_sdf(file, 0.7).placed[0][0] == Rectangle(size=(2.0, 1.0))
    sentence = "none of its 2 collision geometries is at height 0.2 m; choose another"
    assert sentence in refused(file)


def test_the_ground_is_nothing_to_run_into(write):
    plane = "<plane><normal>0 0 1</normal><size>100 100</size></plane>"
    assert only(write(model(plane, "ground") + model(DISC)))[0] == Circle(radius=0.1)
    upright = model("<plane><normal>1 0 0</normal></plane>", "pane")
    assert "model 'pane' has a tilted plane" in refused(write(upright))


@pytest.mark.parametrize(
    ("inside", "what"),
    [
        (
            model(MESH, "table"),
            "model 'table' has a mesh model://table/table.dae, which a world",
        ),
        (
            model("<heightmap><uri>hill.png</uri></heightmap>"),
            "model 'm' has a heightmap hill.png",
        ),
        (posed(">0 0 0 0.3 0 0</pose>"), "model 'm' has a tilted cylinder"),
        (
            model("<ellipsoid><radii>1 2 3</radii></ellipsoid>"),
            "model 'm' has an ellipsoid",
        ),
        (f"<model name='a'>{model(MESH, 'b')}</model>", "model 'a::b' has a mesh"),
        (
            "<actor name='walker'/>",
            "model 'walker' has an actor, which follows a script",
        ),
        ("<population name='cans'/>", "model 'cans' has a population of models"),
        (
            "<include><uri>model://desk</uri></include>",
            "model 'desk' has 'model://desk', which is",
        ),
        (
            "<include><uri>https://fuel.org/1.0/x/models/Desk</uri></include>",
            "model 'Desk' has",
        ),
        (model(2 * POINT), "model 'm' has a polyline with holes, which"),
    ],
)
def test_what_is_no_shape_is_named_in_one_sentence_or_left_out_and_listed(
    write, inside, what
):
    file = write(inside + model(DISC, "disc"))
    sentence = refused(file)
    assert what in sentence
    assert "leave it out by --skip-unknown or --without MODEL" in sentence
    standing = read_sdf(file, HEIGHT, skip_unknown=True)
    assert [shape for shape, _ in standing.placed] == [Circle(radius=0.1)]
    (left_out,) = standing.left_out
    assert left_out in sentence


def test_a_model_may_be_left_out_by_its_name(write):
    file = write(model(MESH, "robot_1") + model(MESH, "robot_2") + model(DISC, "disc"))
    assert "robot_2" in refused(file, without=("robot_1",))
    assert only(file, without=("robot_*",))[0] == Circle(radius=0.1)
    include = "<include><uri>model://desk</uri></include>"
    assert only(write(include + model(DISC)), without=("desk",))[0] == Circle(
        radius=0.1
    )


CYCLE = (
    "<frame name='a'><pose relative_to='b'/></frame><frame name='b' attached_to='a'/>"
)


@pytest.mark.parametrize(
    ("inside", "sentence"),
    [
        (
            posed(" unit='deg'>0 0 0 0 0 0</pose>"),
            "unknown attribute 'unit' of a <pose>",
        ),
        (posed(" degree='true'>0 0 0 0 0 0</pose>"), "did you mean 'degrees'?"),
        (
            posed(" degrees='yes'>0 0 0 0 0 0</pose>"),
            "attribute degrees='yes' of a <pose>",
        ),
        (posed(" rotation_format='quat'>0 0 0 0</pose>"), "did you mean 'quat_xyzw'?"),
        (posed(" rotation_format='quat_xyzw'>0 0 0 0 0 0 0</pose>"), "quaternion"),
        (posed(">0 0 0</pose>"), "<pose> must be 6 numbers, not '0 0 0'."),
        (posed(">0 0 x 0 0 0</pose>"), "model 'm': <pose> must be 6 numbers"),
        (posed(">0 0 nan 0 0 0</pose>"), "<pose> must be 6 numbers"),
        (
            posed(" relative_to='stag'/>") + "<frame name='stage'/>",
            "did you mean 'stage'?",
        ),
        (posed(" relative_to='a'/>") + CYCLE, "relative to itself"),
        (model("<box/>"), "collision 'c': <size> of its <box> is missing; add it."),
        (model("<box><size>1 1</size></box>"), "must be 3 numbers, not '1 1'"),
        (model("<sphere><radius>-1</radius></sphere>"), "must be above 0 and at most"),
        (model(POINT), "needs at least three different points"),
        (
            model(FINE),
            "collision 'c': <polyline> has 20000 points; the maximum is 16384; simplify",
        ),
        (
            model(FAR),
            "collision 'c': its shape at a height of 0.2 m can't stand in a world (Input",
        ),
        ("", "none of its 0 collision geometries"),
        ("</world><world name='v'>", "holds 2 worlds; give a file with one."),
    ],
)
def test_a_wrong_file_is_refused_with_what_to_mend(write, inside, sentence):
    assert sentence in refused(write(inside))


def test_a_world_of_too_many_bodies_is_refused_by_its_own_name(write, monkeypatch):
    monkeypatch.setattr(sdf, "MOST_OBSTACLES", 2)
    bodies = "".join(model(DISC, f"m{k}") for k in range(3))
    assert "holds more than 2 bodies at a height of 0.2 m" in refused(write(bodies))


@pytest.mark.parametrize("version", ["1.3", "2.0", "", "x"])
def test_another_version_of_sdf_is_refused(write, version):
    assert f"SDF version {version!r} is not supported, only 1.4 to 1.12" in refused(
        write("", version)
    )


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        (
            "<sdf version='1.6'>\n<a></b></sdf>",
            ", line 2, column 6: is not valid XML: mismatched tag",
        ),
        ("", ", line 1, column 1: is not valid XML: no element found"),
        ("<robot name='r'/>", ": is not SDF but <robot>"),
        ("<sdf version='1.6'/>", ": holds 0 worlds"),
        (
            "<?xml version='1.0' encoding='klingon'?><sdf/>",
            "is not valid XML: unknown encoding",
        ),
        (
            "<!DOCTYPE s [<!ENTITY c 'dd'>]>\n<sdf>&c;</sdf>",
            ", line 1: declares a document type",
        ),
        (
            "<!DOCTYPE s SYSTEM '/etc/passwd'><sdf/>",
            ", line 1: declares a document type",
        ),
    ],
)
def test_broken_and_malicious_xml_is_refused_with_its_line(tmp_path, text, sentence):
    file = tmp_path / "my.world"
    file.write_text(text)
    assert sentence in refused(file)


def test_a_file_that_is_missing_a_folder_or_too_large_is_refused(tmp_path, monkeypatch):
    assert ": can't be read (No such file" in refused(tmp_path / "none.world")
    (tmp_path / "folder.world").mkdir()
    assert ": can't be read (Is a directory" in refused(tmp_path / "folder.world")
    monkeypatch.setattr(sdf, "MOST_BYTES", 10)
    (tmp_path / "my.world").write_text("<sdf version='1.6'/>")
    assert ": is larger than 0 MB" in refused(tmp_path / "my.world")


def test_models_that_include_themselves_or_without_end_are_refused(
    write, tmp_path, monkeypatch
):
    include = "<include><uri>loop.sdf</uri></include>"
    (tmp_path / "loop.sdf").write_text(
        f"<sdf version='1.7'><model name='a'>{include}{include}</model></sdf>"
    )
    assert "is nested too deeply" in refused(write(include))
    monkeypatch.setattr(sdf, "MOST_MODELS", 5)
    sentence = refused(write("".join(model(DISC, f"m{i}") for i in range(6))))
    assert "holds more than 5 models" in sentence
