from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from robots import circles, direct_model, field

from nics_drl_bridge import generator
from nics_drl_bridge.config import dump_yaml, parse_yaml
from nics_drl_bridge.errors import BridgeError, ConfigError, ModelError
from nics_drl_bridge.generator import (
    MODEL_FILE,
    REPORT_FILE,
    TABLE_FILE,
    builtin_model,
    load_model,
    open_model,
    save_model,
)
from nics_drl_bridge.identify.calibration import Calibration
from nics_drl_bridge.robot.noise import Delay, Latency, Level
from nics_drl_bridge.sim.simulator import FastSimulator

ROBOTS = ("ackermann", "differential", "mecanum")


@pytest.fixture
def saved(tmp_path):
    folder = tmp_path / "model"
    save_model(builtin_model("ackermann"), folder)
    return folder


def change(folder, edit):
    path = folder / MODEL_FILE
    data = parse_yaml(path.read_text(), "model")
    edit(data)
    path.write_text(dump_yaml(data))


@pytest.mark.parametrize("robot", ROBOTS)
def test_a_saved_model_is_the_same_to_the_bit(robot, tmp_path):
    model = builtin_model(robot)
    save_model(model, tmp_path / "model")
    back = load_model(tmp_path / "model")
    assert back.text == model.text
    assert back.fingerprint == model.fingerprint
    assert back.report == model.report
    assert back.timing == model.timing
    assert (back.table.shapes, back.table.density) == (model.table.shapes, model.table.density)
    for name in ("grid", "start", "cell", "rows"):
        assert np.array_equal(getattr(back.table, name), getattr(model.table, name))
    commands = np.random.default_rng(0).uniform(-0.3, 0.5, (20, 1, 1, len(model.robot.command)))
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


def test_a_measured_latency_is_kept_and_one_that_nothing_showed_leaves_no_trace(tmp_path):
    model = builtin_model("ackermann")
    late = replace(model, latency=Latency(scan=Delay(least=0.012, jitter=0.01)))
    save_model(late, tmp_path / "model")
    assert load_model(tmp_path / "model").latency == late.latency
    assert "latency:" in (tmp_path / "model" / MODEL_FILE).read_text()
    assert "\nlatency:" not in model.text
    assert late.fingerprint != model.fingerprint


def test_saving_twice_gives_the_same_bytes(saved, tmp_path):
    save_model(load_model(saved), tmp_path / "again")
    for name in (MODEL_FILE, TABLE_FILE, REPORT_FILE):
        assert (saved / name).read_bytes() == (tmp_path / "again" / name).read_bytes()


def test_the_fingerprint_is_the_same_in_another_process():
    code = (
        "from nics_drl_bridge.generator import builtin_model\n"
        "print(builtin_model('differential').fingerprint)"
    )
    answers = {
        subprocess.run(
            [sys.executable, "-c", code],
            env=os.environ | {"PYTHONHASHSEED": seed},
            capture_output=True,
            text=True,
            check=True,
        ).stdout.strip()
        for seed in ("1", "2")
    }
    assert answers == {builtin_model("differential").fingerprint}


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


def test_any_flipped_bit_in_the_table_is_refused(saved):
    path = saved / TABLE_FILE
    content = path.read_bytes()
    for place in np.random.default_rng(1).integers(len(content), size=20):
        damaged = bytearray(content)
        damaged[place] ^= 1
        path.write_bytes(damaged)
        with pytest.raises(ModelError, match="does not match its checksum"):
            load_model(saved)


@pytest.mark.parametrize("name", [MODEL_FILE, TABLE_FILE, REPORT_FILE])
def test_a_missing_file_is_named(saved, name):
    (saved / name).unlink()
    with pytest.raises(BridgeError, match=name):
        load_model(saved)


KEYS = (
    "control_period",
    "robot",
    "kinematics",
    "calibration",
    "lidar",
    "noise",
    "lidar_table_sha256",
)


@pytest.mark.parametrize("key", KEYS)
def test_a_missing_key_is_one_sentence_with_file_and_key(saved, key):
    change(saved, lambda data: data.pop(key))
    with pytest.raises(ConfigError, match=f"{MODEL_FILE}: the key '{key}' is missing"):
        load_model(saved)


@pytest.mark.parametrize(
    ("part", "key"),
    [
        *(("kinematics", key) for key in ("dt", "units", "terms", "valid", "assumed")),
        *(("calibration", key) for key in Calibration().to_dict()),
    ],
)
def test_a_missing_key_of_a_part_is_one_sentence(saved, part, key):
    change(saved, lambda data: data[part].pop(key))
    with pytest.raises(ModelError, match=f"{MODEL_FILE}: {part}: '{key}' is missing") as caught:
        load_model(saved)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("value", ["other/1", None, 7])
def test_another_format_is_refused(saved, value):
    change(saved, lambda data: data.update(format=value))
    with pytest.raises(ModelError, match="key 'format' is"):
        load_model(saved)


@pytest.mark.parametrize("dof", ["vx", "wz", "d_steering"])
def test_kinematics_that_lack_a_degree_of_freedom_are_refused(saved, dof):
    change(saved, lambda data: data["kinematics"]["terms"].pop(dof))
    with pytest.raises(ModelError, match="generate the model anew"):
        load_model(saved)


def test_kinematics_of_another_robot_are_refused():
    car, mecanum = builtin_model("ackermann"), builtin_model("mecanum")
    with pytest.raises(ModelError, match="the robot 'ackermann' has"):
        replace(car, kinematics=mecanum.kinematics)


@pytest.mark.parametrize("period", [0.015, 0.001, 0.1001])
def test_a_control_period_that_is_no_multiple_of_the_step_is_refused(period):
    with pytest.raises(ModelError, match="is no multiple of the model's step"):
        replace(direct_model(), control_period=period)


@pytest.mark.parametrize(
    ("latency", "delay"), [(0.0, 0), (0.014, 1), (0.016, 2), (0.25, 25), (-0.1, 0)]
)
def test_the_latency_is_counted_in_steps_of_the_model(latency, delay):
    assert direct_model(latency=latency).timing == (0.01, 10, delay)


def test_a_crash_while_saving_leaves_the_old_model(saved, monkeypatch):
    before = {path.name: path.read_bytes() for path in saved.iterdir()}

    def crash(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(generator, "write_bytes", crash)
    with pytest.raises(KeyboardInterrupt):
        save_model(builtin_model("mecanum"), saved)
    assert {path.name: path.read_bytes() for path in saved.iterdir()} == before
    assert [path.name for path in saved.parent.iterdir()] == ["model"]


def test_a_folder_with_other_files_is_never_replaced(tmp_path):
    (tmp_path / "notes").write_text("mine")
    with pytest.raises(ConfigError, match="holds other files"):
        save_model(direct_model(), tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["notes"]


def test_a_model_is_opened_by_folder_or_by_the_name_of_a_robot(saved):
    assert open_model(str(saved)).fingerprint == open_model("ackermann").fingerprint


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
