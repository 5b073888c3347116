from __future__ import annotations

import os
import shutil
import subprocess
import sys
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from robots import circles, direct_model, field

from nics_drl_bridge import generator
from nics_drl_bridge.config import dump_yaml, find_config, parse_yaml
from nics_drl_bridge.errors import BridgeError, ConfigError, ModelError
from nics_drl_bridge.files import SUMS
from nics_drl_bridge.generator import (
    MODEL_FILE,
    MODEL_FILES,
    MOTORS,
    TABLE_FOLDER,
    builtin_model,
    load_model,
    open_model,
    save_model,
)
from nics_drl_bridge.identify.calibration import Calibration, Response
from nics_drl_bridge.lidar.spec import load_lidar
from nics_drl_bridge.robot.noise import Delay, Latency, Level
from nics_drl_bridge.sim.simulator import FastSimulator

ROBOTS = ("ackermann", "differential", "mecanum")


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


def contents(folder):
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.slow
@pytest.mark.parametrize("robot", ROBOTS)
def test_a_saved_model_is_the_same_to_the_bit(robot, tmp_path):
    model = builtin_model(robot)
    save_model(model, tmp_path / "model")
    back = load_model(tmp_path / "model")
    assert back.text == model.text
    assert back.fingerprint == model.fingerprint
    assert back.report == model.report
    assert back.timing == model.timing
    assert (back.table.shapes, back.table.density) == (
        model.table.shapes,
        model.table.density,
    )
    for name in ("grid", "start", "cell", "rows"):
        assert np.array_equal(getattr(back.table, name), getattr(model.table, name))
    commands = np.random.default_rng(0).uniform(
        -0.3, 0.5, (20, 1, 1, len(model.robot.command))
    )
    ends = []
    for one in (model, back):
        simulator = FastSimulator(one, field(obstacles=one_radius(one)))
        simulator.reset([3])
        for command in commands:
            simulator.step(command)
        ends.append((simulator.data.pose.copy(), simulator.data.ranges.copy()))
    assert np.array_equal(ends[0][0], ends[1][0])
    assert np.array_equal(ends[0][1], ends[1][1])


def one_radius(model):
    return [circles(2, (model.table.shapes[0].radius,))]


def test_a_measured_latency_is_kept_and_one_that_nothing_showed_leaves_no_trace(
    tmp_path,
):
    model = builtin_model("ackermann")
    late = replace(model, latency=Latency(scan=Delay(least=0.012, jitter=0.01)))
    save_model(late, tmp_path / "model")
    assert load_model(tmp_path / "model").latency == late.latency
    assert "latency:" in (tmp_path / "model" / MODEL_FILE).read_text()
    assert "\nlatency:" not in model.text
    assert late.fingerprint != model.fingerprint


def test_saving_twice_gives_the_same_bytes(saved, tmp_path):
    save_model(load_model(saved), tmp_path / "again")
    for name in (*MODEL_FILES, SUMS):
        assert (saved / name).read_bytes() == (tmp_path / "again" / name).read_bytes()
    assert len(contents(saved)) == len(MODEL_FILES) + 1


def test_a_model_over_an_older_one_keeps_what_the_user_put_there_and_nothing_else(
    tmp_path,
):
    folder = tmp_path / "model"
    model = direct_model()
    save_model(model, folder)
    own = {path.relative_to(folder).as_posix() for path in folder.rglob("*")}
    (folder / "pictures").mkdir()
    drawn = ("report.html", "pictures/accuracy.png")  # of the older one's fit
    users = (
        "notes.md",
        "pictures/robot.jpg",
        "lidar_table/why.txt",
        "drives/monday.npz",
    )
    (folder / "drives").mkdir()
    for name in (*drawn, *users):
        (folder / name).write_text(name)
    save_model(replace(model, report="another"), folder)
    assert load_model(folder).report == "another"
    found = {
        path.relative_to(folder).as_posix()
        for path in folder.rglob("*")
        if path.is_file()
    }
    assert found == {name for name in own if (folder / name).is_file()} | set(users)
    for name in users:
        assert (folder / name).read_text() == name


def test_sha256sum_checks_a_model(saved):
    check = ["sha256sum", "--strict", "-c", SUMS]
    done = subprocess.run(check, cwd=saved, capture_output=True, check=True)
    assert done.stdout.count(b": OK") == len(MODEL_FILES)


@pytest.mark.process
@pytest.mark.slow
def test_the_fingerprint_is_the_same_in_another_process():
    code = (
        "from nics_drl_bridge.generator import builtin_model\n"
        "print(builtin_model('differential').fingerprint)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        env=os.environ | {"PYTHONHASHSEED": "1"},
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.strip() == builtin_model("differential").fingerprint


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


@pytest.mark.parametrize("name", [*MODEL_FILES, SUMS])
def test_any_flipped_bit_is_refused(saved, name):
    path = saved / name
    content = path.read_bytes()
    for place in np.random.default_rng(1).integers(len(content), size=10):
        damaged = bytearray(content)
        damaged[place] ^= 1
        path.write_bytes(damaged)
        with pytest.raises(BridgeError, match=str(saved)):
            load_model(saved)


def test_the_table_of_another_model_is_refused(saved, tmp_path):
    save_model(builtin_model("mecanum"), tmp_path / "other")
    shutil.rmtree(saved / TABLE_FOLDER)
    shutil.copytree(tmp_path / "other" / TABLE_FOLDER, saved / TABLE_FOLDER)
    with pytest.raises(ModelError, match=r"does not match its checksum in SHA256SUMS"):
        load_model(saved)


def test_an_edited_model_is_read_once_its_line_is_removed(saved):
    path = saved / MODEL_FILE
    path.write_text(
        path.read_text().replace("control_period: 0.1", "control_period: 0.2")
    )
    with pytest.raises(
        ModelError, match=r"model\.yaml: .* if you changed it yourself, remove its"
    ):
        load_model(saved)
    change(saved, lambda data: None)
    assert load_model(saved).control_period == 0.2


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


@pytest.mark.parametrize("name", [*MODEL_FILES, SUMS])
def test_a_missing_file_is_named(saved, name):
    (saved / name).unlink()
    with pytest.raises(BridgeError, match=name):
        load_model(saved)


KEYS = ("control_period", "robot", "kinematics", "calibration", "lidar", "noise")


@pytest.mark.parametrize("key", KEYS)
def test_a_missing_key_is_one_sentence_with_file_and_key(saved, key):
    change(saved, lambda data: data.pop(key))
    with pytest.raises(ConfigError, match=f"{MODEL_FILE}: the key '{key}' is missing"):
        load_model(saved)


@pytest.mark.parametrize(
    ("part", "key"),
    [
        *(("kinematics", key) for key in ("dt", "units", "terms", "valid", "assumed")),
        *(
            ("calibration", key.name)
            for key in fields(Calibration)
            if key.name not in MOTORS
        ),
    ],
)
def test_a_missing_key_of_a_part_is_one_sentence(saved, part, key):
    change(saved, lambda data: data[part].pop(key))
    with pytest.raises(
        ConfigError, match=f"the key '{part}.{key}' is missing; add"
    ) as caught:
        load_model(saved)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("place", "value", "sentence"),
    [
        ("calibration.burst_period_s", -1.0, "should be greater than or equal to 0"),
        ("calibration.burst_period_s", True, "should be a number, not True"),
        ("calibration.burst_period_s", "0.1", "should be a number, not '0.1'"),
        ("calibration.rotation_rad", float("nan"), "should be a finite number"),
        ("calibration.lever_arm_m", [0.0], "lever_arm_m"),
        ("calibration.notes", 3, "must be a list, as"),
        ("calibration.colour", 3, "unknown key 'calibration.colour'"),
        (
            "calibration.responses",
            [{"state": "speed"}],
            "the key 'calibration.responses.0.",
        ),
        ("calibration", 3, "key 'calibration'"),
        ("kinematics.dt", 0.0, "should be greater than 0"),
        ("kinematics.colour", 3, "unknown key 'kinematics.colour'; valid are"),
        ("kinematics.terms.vx", {"ghost": 1.0}, "unknown variable 'ghost'; generate"),
        ("kinematics.units.vx", None, "key 'kinematics.units.vx'"),
        ("kinematics.quality.colour", 3, "unknown key 'kinematics.quality.colour'"),
        ("kinematics.quality.samples", "many", "key 'kinematics.quality.samples'"),
    ],
)
def test_a_wrong_value_is_one_sentence_with_file_and_key(saved, place, value, sentence):
    *parts, last = place.split(".")

    def edit(data):
        for part in parts:
            data = data[part]
        data[last] = value

    change(saved, edit)
    with pytest.raises(BridgeError, match=f"{MODEL_FILE}: ") as caught:
        load_model(saved)
    assert sentence in str(caught.value)


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
    "value", ["other/1", "nics_drl_bridge/simulator_model/3", None, 7]
)
def test_another_format_is_refused(saved, value):
    change(saved, lambda data: data.update(format=value))
    with pytest.raises(ModelError, match="key 'format' is"):
        load_model(saved)


@pytest.mark.parametrize("dof", ["vx", "wz", "d_steering"])
def test_kinematics_that_lack_a_degree_of_freedom_are_refused(saved, dof):
    change(saved, lambda data: data["kinematics"]["terms"].pop(dof))
    with pytest.raises(ModelError, match="generate the model again"):
        load_model(saved)


def test_kinematics_of_another_robot_are_refused():
    car = builtin_model("ackermann")
    mecanum = builtin_model("mecanum")
    with pytest.raises(ModelError, match="robot 'ackermann' needs"):
        replace(car, kinematics=mecanum.kinematics)


@pytest.mark.parametrize("period", [0.015, 0.001, 0.1001, 1e308])
def test_a_control_period_that_is_no_multiple_of_the_step_is_refused(period):
    with pytest.raises(ModelError, match="is no multiple of the model's step"):
        replace(direct_model(), control_period=period)


@pytest.mark.parametrize(
    ("latency", "delay"), [(0.0, 0), (0.014, 1), (0.016, 2), (0.25, 25), (-0.1, 0)]
)
def test_the_latency_is_counted_in_steps_of_the_model(latency, delay):
    assert direct_model(latency=latency).timing == (0.01, 10, delay)


def test_a_crash_while_saving_leaves_the_old_model(saved, monkeypatch):
    before = contents(saved)

    def crash(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(generator.files, "write_sums", crash)
    with pytest.raises(KeyboardInterrupt):
        save_model(builtin_model("mecanum"), saved)
    assert contents(saved) == before
    assert [path.name for path in saved.parent.iterdir()] == ["model"]


def test_a_folder_with_other_files_is_never_replaced(tmp_path):
    (tmp_path / "notes").write_text("mine")
    with pytest.raises(ConfigError, match="holds other files"):
        save_model(direct_model(), tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["notes"]


def test_a_model_is_opened_by_folder_or_by_the_name_of_a_robot(saved):
    assert open_model(str(saved)).fingerprint == open_model("ackermann").fingerprint


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


def test_a_robots_file_that_has_changed_is_opened_anew(tmp_path):
    file = tmp_path / "mine.yaml"
    text = find_config("differential", "robots").read_text()
    file.write_text(text)
    assert open_model(file) is open_model(str(file))
    file.write_text(text.replace("wheel_lag: 0.1", "wheel_lag: 0.3"))
    assert open_model(file).robot.parameters["wheel_lag"] == 0.3


def test_no_folder_is_made_that_has_the_name_of_a_shipped_robot():
    for folder in ("jackal", Path("./jackal")):
        with pytest.raises(
            ConfigError, match="jackal: a shipped robot has this name; name another"
        ):
            generator.check_place(folder)


def test_a_robot_has_the_lidar_that_its_file_names_and_else_that_of_the_paper(tmp_path):
    assert builtin_model("ackermann").lidar == load_lidar("paper")
    jackal = builtin_model("jackal")
    assert jackal.lidar == load_lidar("jackal_hokuyo")
    save_model(jackal, tmp_path / "model")
    assert load_model(tmp_path / "model").robot == jackal.robot


def test_a_model_is_opened_with_another_lidar_than_its_own():
    own = open_model("differential")
    other = open_model("differential", "rplidar_a2")
    assert other.lidar == load_lidar("rplidar_a2") != own.lidar
    assert other.kinematics is own.kinematics
    assert other.table.shapes == own.table.shapes


def test_a_lidar_that_a_robots_file_does_not_name_leaves_no_trace_in_its_model():
    assert "lidar" not in builtin_model("ackermann").robot.model_dump()
    assert builtin_model("jackal").robot.model_dump()["lidar"] == "jackal_hokuyo"


def test_a_lidar_that_there_is_not_is_refused(tmp_path):
    data = parse_yaml(find_config("differential", "robots").read_text(), "robot")
    (tmp_path / "mine.yaml").write_text(dump_yaml(data | {"lidar": "papper"}))
    with pytest.raises(ModelError, match="did you mean 'paper'"):
        open_model(tmp_path / "mine.yaml")


def test_a_robots_file_is_a_model_by_any_path(tmp_path):
    shutil.copy(find_config("differential", "robots"), tmp_path / "mine.yaml")
    assert open_model(tmp_path / "mine.yaml").robot.name == "differential"


@pytest.mark.parametrize(
    ("name", "sentence"),
    [
        ("some/where", "some/where: no such folder"),
        ("akermann", "unknown robot 'akermann'; did you mean 'ackermann'?"),
    ],
)
def test_a_name_that_is_no_model_is_refused(name, sentence):
    with pytest.raises(ModelError) as caught:
        open_model(name)
    assert sentence in str(caught.value)
    assert ") (" not in str(caught.value)
    assert not str(caught.value).endswith("..")


def test_a_folder_without_a_model_is_refused(tmp_path):
    with pytest.raises(ModelError, match=f"holds no {MODEL_FILE}"):
        load_model(tmp_path)


def test_a_model_that_is_not_there_is_told_apart_from_a_folder_without_one(tmp_path):
    with pytest.raises(ModelError, match="nothing: no such folder; make one with"):
        load_model(tmp_path / "nothing")
    with pytest.raises(ModelError, match=f"{tmp_path.name}: holds no model.yaml"):
        load_model(tmp_path)
