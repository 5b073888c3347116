from __future__ import annotations

import pytest

from nics_drl_bridge.bake_order import BakeOrder, run
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.lidar.scanner import Scanner
from nics_drl_bridge.lidar.shapes import Circle, Rectangle
from nics_drl_bridge.lidar.spec import load_lidar
from nics_drl_bridge.lidar.table import LidarTable

SHAPES = """
shapes:
  - {kind: circle, radius: 0.15}
  - {kind: rectangle, size: [0.3, 0.3]}
"""


@pytest.fixture
def shapes(tmp_path):
    path = tmp_path / "shapes.yaml"
    path.write_text(SHAPES)
    return path


def test_a_table_is_baked_within_a_budget_and_can_be_loaded(shapes, tmp_path):
    out, told = tmp_path / "sub" / "table.npz", []
    lines = run(BakeOrder(shapes=shapes, budget="300kB", out=out), lambda *what: told.append(what))
    table = LidarTable.load(out)
    assert table.shapes == (Circle(radius=0.15), Rectangle(size=(0.3, 0.3)))
    assert out.stat().st_size <= 300_000
    Scanner(load_lidar("paper"), table)
    text = "\n".join(lines)
    assert f"{table.density.distances} distances x {table.density.rotations} rotations" in text
    assert "expected RMSE   0.0" in text
    assert f"size            {out.stat().st_size / 1e6:.2f} MB" in text
    assert lines[-1] == f"table written to {out}"
    assert told[0][0].startswith("trying ")


def test_a_density_can_be_given_and_the_bar_runs_to_its_end(shapes, tmp_path):
    out, told = tmp_path / "table.npz", []
    order = BakeOrder(
        world="arena", robot="ackermann", shapes=shapes, density={"distances": 7}, out=out
    )
    run(order, lambda *what: told.append(what))
    table = LidarTable.load(out)
    assert (table.density.distances, table.density.rotations) == (7, 240)
    assert set(order.all_shapes()) == set(table.shapes)
    assert len(table.shapes) >= 3
    assert told[-1][1] == told[-1][2] > 0


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"shapes": None}, "there is nothing to bake; give --world, --shapes or --robot."),
        ({"budget": "8MB", "density": {"phases": 2}}, "--budget finds the density; "),
        ({"budget": "8 tons"}, "budget '8 tons': is no size; "),
        ({"budget": "2kB"}, "a budget of 2,000 bytes is too small: "),
        ({"density": {"distances": 1}}, "density: key 'distances': "),
        ({"lidar": "papper"}, "unknown lidar 'papper'; did you mean 'paper'"),
        ({"world": "aren"}, "unknown world 'aren'; did you mean 'arena'"),
    ],
)
def test_a_wrong_order_is_refused_and_writes_nothing(shapes, tmp_path, changes, sentence):
    out = tmp_path / "table.npz"
    order = BakeOrder(**({"shapes": shapes, "out": out} | changes))
    with pytest.raises(ConfigError) as caught:
        run(order, lambda *what: None)
    assert str(caught.value).startswith(sentence)
    assert not out.exists()


@pytest.mark.parametrize("text", ["shapes: []", "shapes: [{kind: blob}]", "circles: []", ""])
def test_a_wrong_file_of_shapes_is_named(shapes, tmp_path, text):
    shapes.write_text(text)
    with pytest.raises(ConfigError, match=str(shapes)):
        run(BakeOrder(shapes=shapes, out=tmp_path / "table.npz"), lambda *what: None)


def test_a_folder_is_not_taken_for_a_file(shapes, tmp_path):
    with pytest.raises(ConfigError, match="is a folder; give the name of a file"):
        run(BakeOrder(shapes=shapes, out=tmp_path), lambda *what: None)


def test_a_place_that_can_not_be_written_is_told_before_the_work(shapes, tmp_path):
    (tmp_path / "file").write_text("")
    done = []
    with pytest.raises(ConfigError, match="is a file, not a folder; choose another place"):
        run(
            BakeOrder(shapes=shapes, out=tmp_path / "file" / "t.npz"),
            lambda *what: done.append(what),
        )
    assert not done


def test_a_sensor_model_of_a_file_is_baked_in_place_of_the_lidars(shapes, tmp_path):
    path, out = tmp_path / "dull.yaml", tmp_path / "table.npz"
    path.write_text("sensor_model: [{kind: intensity, gain: 50, threshold: 4}]\n")
    order = BakeOrder(shapes=shapes, density={"distances": 7}, out=out, sensor_model=path)
    lines = run(order, lambda *what: None)
    assert "sensor model    intensity 50 at 1 m, below 4 nothing, reflectivity 0.5" in lines
    table = LidarTable.load(out)
    assert table.sensor_model == order.spec().sensor_model
    assert table.reflectance is not None
    with pytest.raises(ConfigError, match=r"no\.yaml: no such file"):
        BakeOrder(shapes=shapes, sensor_model=tmp_path / "no.yaml").spec()
