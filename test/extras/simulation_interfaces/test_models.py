from __future__ import annotations

import pytest

from nics_drl_bridge.config import find_config, read_text, share_folder
from nics_drl_bridge.errors import BridgeError, ConfigError
from nics_drl_bridge.extras.simulation_interfaces.models import (
    MOST_PARTS,
    model_of_sdf,
    model_of_yaml,
)
from nics_drl_bridge.lidar.shapes import Circle, Rectangle
from nics_drl_bridge.sim.sdf import AssetsError

CRATE = (
    "<sdf version='1.9'><model name='crate'><pose>7 7 0 0 0 0</pose><link name='l'>"
    "<collision name='c'><geometry>{}</geometry></collision></link></model></sdf>"
)
BOX = "<box><size>0.4 0.2 0.3</size></box>"


def test_a_single_shape_is_an_entity():
    model = model_of_yaml("kind: circle\nradius: 0.3\n")
    assert model.parts == ((Circle(radius=0.3), (0.0, 0.0, 0.0)),)


def test_shapes_have_places_in_the_entity():
    text = "name: two\nshapes: [{kind: circle, radius: 0.1}, {kind: circle, radius: 0.2}]\n"
    model = model_of_yaml(text + "at: [[1, 0, 0], [2, 0, 0]]\n")
    assert model.name == "two"
    assert [pose for _, pose in model.parts] == [(1.0, 0.0, 0.0), (2.0, 0.0, 0.0)]
    with pytest.raises(ConfigError, match="at must hold 2 poses"):
        model_of_yaml(text + "at: [[1, 0, 0]]\n")


def test_the_pose_of_an_sdf_model_gives_way_to_that_of_the_request():
    model = model_of_sdf(CRATE.format(BOX), 0.15)
    assert model.name == "crate"
    assert model.parts == ((Rectangle(size=(0.4, 0.2)), (0.0, 0.0, 0.0)),)


def test_an_sdf_model_that_is_low_counts_at_its_own_height():
    assert model_of_sdf(CRATE.format(BOX), 0.0).parts


@pytest.mark.parametrize(
    ("text", "why"),
    [
        (
            CRATE.replace("</model>", "</model><model name='b'/>").format(BOX),
            "holds 2 models",
        ),
        ("<sdf version='1.9'>", "resource_string, line 1"),
        ("<!DOCTYPE a><sdf version='1.9'/>", "document type"),
    ],
)
def test_what_is_no_model_is_refused_by_name(text, why):
    with pytest.raises(ConfigError, match=why):
        model_of_sdf(text, 0.0)


def test_a_mesh_is_refused_as_an_asset():
    mesh = CRATE.format("<mesh><uri>model://a.dae</uri></mesh>")
    with pytest.raises(AssetsError, match="a mesh") as caught:
        model_of_sdf(mesh, 0.0)
    assert not caught.value.missing


def test_every_shipped_entity_is_read():
    files = sorted((share_folder() / "config" / "entities").glob("*.yaml"))
    assert files
    for file in files:
        assert model_of_yaml(
            read_text(find_config(file.stem, "entities")), str(file)
        ).parts


def test_an_sdf_model_may_hold_prefixes_that_nothing_binds():
    text = CRATE.replace("</model>", "<gz:x>1</gz:x></model>").format(BOX)
    assert model_of_sdf(text, 0.15) == model_of_sdf(CRATE.format(BOX), 0.15)


def test_an_sdf_model_of_too_many_shapes_is_refused():
    collision = f"<collision name='{{}}'><geometry>{BOX}</geometry></collision>"
    head, tail = CRATE.format(BOX).split("</link>")

    def of(count):
        return (
            head + "".join(map(collision.format, range(count - 1))) + f"</link>{tail}"
        )

    assert len(model_of_sdf(of(MOST_PARTS), 0.15).parts) == MOST_PARTS
    with pytest.raises(
        BridgeError, match=f"holds more than {MOST_PARTS} shapes; split it"
    ):
        model_of_sdf(of(MOST_PARTS + 1), 0.15)
