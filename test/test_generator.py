import re
import shutil
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from robots import circles, direct_model, field

from nics_drl_bridge import generator
from nics_drl_bridge.config import (
    dump_yaml,
    find_config,
    list_shipped,
    parse_yaml,
)
from nics_drl_bridge.errors import BridgeError, ConfigError, ModelError
from nics_drl_bridge.files import SUMS
from nics_drl_bridge.generator import (
    MODEL_FILE,
    TABLE_FOLDER,
    builtin_model,
    generate_textbook_model,
    load_model,
    mount_lidar,
    open_model,
    save_model,
)
from nics_drl_bridge.identify.calibration import Calibration, Response
from nics_drl_bridge.lidar.spec import load_lidar
from nics_drl_bridge.robot.noise import Delay, Latency, Level
from nics_drl_bridge.robot.spec import load_robot
from nics_drl_bridge.sim.simulator import FastSimulator

NUMBER = re.compile(r"\s*[-+]?\d[\d.e+-]*")  # with the space that aligns it


@pytest.fixture(scope="module")
def original(tmp_path_factory):
    """A model that no test changes."""
    folder = tmp_path_factory.mktemp("original") / "model"
    save_model(builtin_model("ackermann"), folder)
    return folder


@pytest.fixture
def saved(original, tmp_path):
    return Path(shutil.copytree(original, tmp_path / "model"))


def change(folder, edit):
    """Edits a model by hand: its line in the manifest is removed."""
    path = folder / MODEL_FILE
    manifest = folder / SUMS
    data = parse_yaml(path.read_text(), "model")
    edit(data)
    path.write_text(dump_yaml(data))
    lines = manifest.read_text().splitlines(keepends=True)
    manifest.write_text(
        "".join(line for line in lines if not line.endswith(f"  {MODEL_FILE}\n"))
    )


@pytest.mark.slow
@pytest.mark.parametrize("robot", ["ackermann", "mecanum"])
def test_a_saved_model_is_the_same_to_the_bit(robot, tmp_path):
    late = Latency(scan=Delay(least=0.012, jitter=0.01))
    model = replace(builtin_model(robot), latency=late)
    save_model(model, tmp_path / "model")
    back = load_model(tmp_path / "model")
    for name in ("latency", "text", "fingerprint", "report", "timing"):
        assert getattr(back, name) == getattr(model, name), name
    commands = np.random.default_rng(0).uniform(
        -0.3, 0.5, (20, 1, 1, len(model.robot.command))
    )
    ends = []
    obstacles = [circles(2, (model.table.shapes[0].radius,))]
    for one in (model, back):
        simulator = FastSimulator(one, field(obstacles=obstacles))
        simulator.reset([3])
        for command in commands:
            simulator.step(command)
        ends.append(np.append(simulator.data.pose, simulator.data.ranges))
    assert np.array_equal(*ends)


def test_every_part_that_the_simulator_uses_changes_the_fingerprint():
    model = direct_model()
    noise = model.noise.model_copy(update={"odom_linear": Level(std=0.5, unit="m/s")})
    table = replace(model.table, rows=model.table.rows * np.float32(1.01))
    others = [
        direct_model(latency=0.1),
        replace(model, noise=noise),
        replace(model, table=table),
        replace(model, control_period=0.2),
        replace(model, kinematics=replace(model.kinematics, dt=0.02)),
    ]
    assert len({model.fingerprint, *(other.fingerprint for other in others)}) == 6
    assert direct_model().fingerprint == model.fingerprint


def test_a_model_that_is_replaced_while_it_is_read_is_refused(saved, monkeypatch):
    def meanwhile(*given, **named):
        save_model(builtin_model("mecanum"), saved)
        check_sums(*given, **named)

    check_sums = generator.files.check_sums
    monkeypatch.setattr(generator.files, "check_sums", meanwhile)
    with pytest.raises(
        ModelError, match="was replaced while it was read; open it again"
    ):
        load_model(saved)


def test_a_calibration_and_figures_of_merit_that_are_inf_are_kept(saved, tmp_path):
    model = load_model(saved)
    calibration = Calibration(
        clock_offset_s=0.1,
        lever_arm_m=(0.1, -0.2),
        responses=(Response("speed", "speed_c", 0.2),),
        wheels_swapped=True,
        wheel_scale=0.1 / 3.0,
        uncertainty={"clock_offset_s": float("inf")},
        notes=("one", "two"),
    )
    quality = replace(model.kinematics.quality, condition={"vx": float("inf")})
    kinematics = replace(model.kinematics, quality=quality)
    save_model(
        replace(model, calibration=calibration, kinematics=kinematics), tmp_path / "new"
    )
    back = load_model(tmp_path / "new")
    assert back.calibration == calibration
    assert back.kinematics.quality == quality


@pytest.mark.parametrize(
    ("latency", "delay"), [(0.0, 0), (0.014, 1), (0.016, 2), (0.25, 25), (-0.1, 0)]
)
def test_the_latency_is_counted_in_steps_of_the_model(latency, delay):
    assert direct_model(latency=latency).timing == (0.01, 10, delay)


def test_a_shipped_robot_goes_before_a_folder_of_its_name_which_is_told(
    tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    save_model(builtin_model("ackermann"), "differential")
    builtin_model.cache_clear()  # which tells it once
    assert open_model("differential").robot.name == "differential"
    assert open_model("differential", "rplidar_a2").robot.name == "differential"
    (line,) = capsys.readouterr().err.splitlines()
    assert line.endswith("'differential' is shipped; the folder is ./differential")
    assert open_model("./differential").robot.name == "ackermann"
    assert (
        open_model(Path("./differential")).robot.name == "ackermann"
    )  # which drops the "./"
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize("name", list_shipped("robots"))
def test_a_shipped_model_is_what_is_generated(name, monkeypatch):
    """After a change of the generator or of a robot: `make models`."""
    made = generate_textbook_model(load_robot(name))
    monkeypatch.setattr(generator, "generate_textbook_model", None)
    shipped = builtin_model.__wrapped__(name)
    assert NUMBER.sub("0", shipped.report) == NUMBER.sub("0", made.report)
    assert parse_yaml(shipped.text, "shipped") == approx(parse_yaml(made.text, "made"))
    assert shipped.table.fingerprint == made.table.fingerprint


def approx(data):
    """Nested data whose numbers may differ by rounding, as on another machine."""
    if isinstance(data, dict):
        return {key: approx(value) for key, value in data.items()}
    if isinstance(data, list):
        return [approx(value) for value in data]
    if isinstance(data, float):
        return pytest.approx(data, rel=1e-6, abs=1e-9)
    return data


def test_an_edited_robot_gets_a_model_of_its_own(monkeypatch):
    edited = load_robot("differential").model_copy(update={"footprint_radius": 0.5})
    monkeypatch.setattr(generator, "load_robot", lambda name: edited)
    model = builtin_model.__wrapped__("differential")
    assert model.robot == edited
    assert (model.table.shapes[0].radius, model.report == "") == (0.5, False)


def test_an_edited_lidar_gets_a_model_of_its_own(monkeypatch):
    robot = load_robot("differential")
    edited = mount_lidar(robot).model_copy(update={"range_max": 2.5})
    monkeypatch.setattr(generator, "mount_lidar", lambda *_: edited)
    model = builtin_model.__wrapped__("differential")
    assert (model.robot, model.lidar) == (robot, edited)


def test_a_robots_file_that_has_changed_is_opened_anew(tmp_path):
    file = tmp_path / "mine.yaml"
    text = find_config("differential", "robots").read_text()
    file.write_text(text)
    assert open_model(file) is open_model(str(file))
    file.write_text(text.replace("wheel_lag: 0.1", "wheel_lag: 0.3"))
    assert open_model(file).robot.parameters["wheel_lag"] == 0.3


GONE = "gone"
PLACES = [
    *((key, GONE) for key in ("control_period", "robot", "kinematics", "calibration")),
    *((f"kinematics.{key}", GONE) for key in ("dt", "units", "terms", "valid")),
    *(
        (f"calibration.{key.name}", GONE)
        for key in fields(Calibration)
        if key.name != "inputs"
    ),
    ("format", "nics_drl_bridge/simulator_model/3"),
    ("calibration.burst_period_s", -1.0),
    ("calibration.burst_period_s", "0.1"),
    ("calibration.rotation_rad", float("nan")),
    ("calibration.lever_arm_m", [0.0]),
    ("calibration.colour", 3),
    ("calibration.responses", [{"state": "speed"}]),
    ("calibration", 3),
    ("kinematics.dt", 0.0),
    ("kinematics.terms.d_steering", GONE),
    ("kinematics.terms.vx", {"ghost": 1.0}),
    ("kinematics.units.vx", None),
    ("kinematics.quality.colour", 3),
]


@pytest.mark.parametrize(("place", "value"), PLACES, ids=str)
def test_a_wrong_or_missing_value_is_one_sentence_with_file_and_key(
    saved, place, value
):
    *parts, last = place.split(".")

    def edit(data):
        for part in parts:
            data = data[part]
        if value is GONE:
            del data[last]
        else:
            data[last] = value

    change(saved, edit)
    with pytest.raises(BridgeError, match=f"{MODEL_FILE}: ") as caught:
        load_model(saved)
    sentence = str(caught.value)
    assert "\n" not in sentence
    assert last in sentence or "generate the model again" in sentence


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("some/where", "some/where: no such folder"),
        ("akermann", "did you mean 'ackermann'"),
    ],
)
def test_a_name_that_is_no_model_is_refused(name, said, tmp_path):
    with pytest.raises(ModelError, match=said):
        open_model(name)
    with pytest.raises(ModelError, match="nothing: no such folder; make one with"):
        load_model(tmp_path / "nothing")
    with pytest.raises(ModelError, match=f"{tmp_path.name}: contains no {MODEL_FILE}"):
        load_model(tmp_path)


def test_an_edited_model_is_read_once_its_line_is_removed(saved):
    path = saved / MODEL_FILE
    path.write_text(path.read_text().replace("period: 0.1", "period: 0.2"))
    with pytest.raises(ModelError, match=r"remove its line"):
        load_model(saved)
    change(saved, lambda data: None)
    assert load_model(saved).control_period == 0.2


def test_a_model_over_an_older_one_keeps_what_the_user_put_there_and_nothing_else(
    tmp_path,
):
    folder = tmp_path / "model"
    save_model(direct_model(), folder)
    files = {path for path in folder.rglob("*") if path.is_file()}
    (folder / "pictures").mkdir()
    users = {folder / "notes.md", folder / "pictures/robot.jpg"}
    drawn = {folder / "report.html", folder / "pictures/accuracy.png"}  # by the older
    for path in (*users, *drawn):
        path.write_text("mine")
    save_model(replace(direct_model(), report="another"), folder)
    assert load_model(folder).report == "another"
    assert {path for path in folder.rglob("*") if path.is_file()} == files | users
    for name in ("jackal", Path("./jackal")):
        with pytest.raises(ConfigError, match="a shipped robot has this name"):
            generator.check_place(name)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        *(
            ({"control_period": period}, "is not a multiple of the model's step")
            for period in (0.015, 0.001, 1e308)
        ),
        ({"kinematics": "mecanum"}, "robot 'direct' needs"),
    ],
)
def test_parts_that_do_not_fit_each_other_are_refused(change, said):
    if "kinematics" in change:
        change = {"kinematics": builtin_model(change["kinematics"]).kinematics}
    with pytest.raises(ModelError, match=said):
        replace(direct_model(), **change)


def test_a_model_has_its_own_lidar_its_robots_or_that_of_the_paper(tmp_path):
    own = open_model("ackermann")
    assert own.lidar == load_lidar("paper")
    jackal = builtin_model("jackal")
    assert jackal.lidar == load_lidar("jackal_hokuyo")
    other = open_model("ackermann", "rplidar_a2")
    assert other.lidar == load_lidar("rplidar_a2")
    assert other.kinematics is own.kinematics
    assert other.table.shapes == own.table.shapes
    text = find_config("differential", "robots").read_text()
    (tmp_path / "mine.yaml").write_text(f"{text}\nlidar: papper\n")
    with pytest.raises(ModelError, match="did you mean 'paper'"):
        open_model(tmp_path / "mine.yaml")


def test_the_table_of_another_model_is_refused(saved, tmp_path):
    save_model(builtin_model("mecanum"), tmp_path / "other")
    shutil.rmtree(saved / TABLE_FOLDER)
    shutil.copytree(tmp_path / "other" / TABLE_FOLDER, saved / TABLE_FOLDER)
    with pytest.raises(ModelError, match=r"does not match its checksum in SHA256SUMS"):
        load_model(saved)
