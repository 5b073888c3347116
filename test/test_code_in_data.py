"""No file of data runs code: it names what is installed, and a path to code is only looked at."""

import json
import pickle
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import onnx
import pytest
import torch
from command_line import nics
from policy.policy_rig import bytes_of, contract_in, export, signed
from robots import direct_model

from nics_drl_bridge.config import share_folder
from nics_drl_bridge.env.registry import make_task
from nics_drl_bridge.env.sim_backend import make_backend
from nics_drl_bridge.errors import BridgeError, ConfigError
from nics_drl_bridge.extras.foreign_policies import import_policy
from nics_drl_bridge.files import SUMS, write_sums
from nics_drl_bridge.gate.limits import load_limits
from nics_drl_bridge.generator import load_model, open_model, save_model
from nics_drl_bridge.lidar.sensor import add_sensor_kind, load_sensor, sensor_of_data
from nics_drl_bridge.policy.file.contract import _hash_task
from nics_drl_bridge.policy.file.policy_file import load_policy
from nics_drl_bridge.policy.policies import open_policy
from nics_drl_bridge.policy.train.checkpoint import read_checkpoint
from nics_drl_bridge.policy.train.run import read_run_settings
from nics_drl_bridge.policy.train.settings import load_training
from nics_drl_bridge.recording.mapping import load_mapping
from nics_drl_bridge.recording.messages import collect_types
from nics_drl_bridge.recording.recording import load_recording
from nics_drl_bridge.robot.spec import load_robot
from nics_drl_bridge.sim.world import load_world

MODULE = "springs_a_trap"
CODE = """
from pathlib import Path

Path({canary!r}).touch()

from nics_drl_bridge.env.tasks.navigation import Navigation
from nics_drl_bridge.lidar.further_lidar import FurtherLidar


class Trap(Navigation):
    pass


class TrapSensor(FurtherLidar):
    kind: str
"""


@pytest.fixture
def trap(tmp_path, monkeypatch):
    """A Python file that leaves a canary if anything runs it, by path or as a module."""
    folder = tmp_path / "trap"
    folder.mkdir()
    file = folder / f"{MODULE}.py"
    file.write_text(CODE.format(canary=str(tmp_path / "canary")))
    monkeypatch.syspath_prepend(str(folder))
    yield SimpleNamespace(file=file, canary=tmp_path / "canary", folder=tmp_path)
    sys.modules.pop(MODULE, None)


PLACES = {
    "a file": lambda trap, name: f"{trap.file}:{name}",
    "a module": lambda trap, name: f"{MODULE}:{name}",
    "a dotted path": lambda trap, name: f"{MODULE}.{name}",
    "a module alone": lambda trap, name: MODULE,
    "a file alone": lambda trap, name: str(trap.file),
}
"""How data might name code."""


def write(folder: Path, name: str, text: str) -> Path:
    path = folder / name
    path.write_text(text)
    return path


def model_with_a_sensor(trap, place):
    """A model whose checksums fit."""
    folder = trap.folder / "model"
    save_model(direct_model(), folder)
    model = folder / "model.yaml"
    model.write_text(
        f"{model.read_text()}\nsensors:\n- {{kind: '{place}', name: rear}}\n"
    )
    (folder / SUMS).unlink()
    write_sums(folder)
    return folder


def policy_with(trap, change):
    path = trap.folder / "policy.onnx"
    export(path)
    proto = onnx.load(path)
    data = contract_in(proto)
    change(data)
    path.write_bytes(bytes_of(signed(proto, data)))
    return path


def policy_with_a_sensor(trap, place):
    def change(data):
        data["sensors"] = [{"kind": place, "name": "rear"}]

    return policy_with(trap, change)


def policy_with_a_task(trap, place):
    def change(data):
        data["task"]["name"] = place
        data["task"]["sha256"] = _hash_task(data["task"], data["observation"])

    return policy_with(trap, change)


def robot_with(trap, key, place):
    shipped = (share_folder() / "config" / "robots" / "differential.yaml").read_text()
    lines = [line for line in shipped.splitlines() if not line.startswith(f"{key}:")]
    return write(trap.folder, "robot.yaml", "\n".join([f"{key}: '{place}'", *lines]))


def run_of_a_task(trap, place):
    folder = trap.folder / "run"
    folder.mkdir()
    write(folder, "settings.yaml", f"task: '{place}'\n")
    return folder


def foreign_mapping(trap, key, place):
    data = {"kind": "foreign policy", "network": "n.onnx", "robot": "differential"} | {
        key: place
    }
    data |= {
        "inputs": {"x": {"parts": [{"of": "scan"}]}},
        "outputs": {"forward": {"of": "y"}},
    }
    return write(trap.folder, "foreign.yaml", json.dumps(data))


def leapp_bundle(trap, place):
    parameters = {"model_path": place, "sha256sum": "0" * 64, "backend": "python"}
    node = {"inputs": [], "outputs": [], "parameters": parameters}
    data = {"models": {"a": node}, "pipeline": {"inputs": {}, "outputs": {}}}
    return write(trap.folder, "bundle.yaml", json.dumps(data))


WAYS = {
    "a sensor of a model": lambda t, p: load_model(
        model_with_a_sensor(t, p("TrapSensor"))
    ),
    "a sensor's own file": lambda t, p: load_sensor(
        write(t.folder, "rear.yaml", f"{{kind: '{p('TrapSensor')}', name: rear}}")
    ),
    "a sensor of a policy": lambda t, p: load_policy(
        policy_with_a_sensor(t, p("TrapSensor"))
    ),
    "the task of a policy": lambda t, p: open_policy(
        str(policy_with_a_task(t, p("Trap"))), direct_model()
    ),
    "the robot of a mapping": lambda t, p: load_policy(
        foreign_mapping(t, "robot", p("Trap"))
    ),
    "the network of a mapping": lambda t, p: load_policy(
        foreign_mapping(t, "network", p("Trap"))
    ),
    "the scan of a mapping": lambda t, p: load_policy(
        foreign_mapping(t, "scan", p("Trap"))
    ),
    "a network of a bundle": lambda t, p: import_policy(leapp_bundle(t, p("Trap"))),
    "the textbook of a robot": lambda t, p: load_robot(
        robot_with(t, "textbook", p("KIND"))
    ),
    "the lidar of a robot": lambda t, p: open_model(
        str(robot_with(t, "lidar", p("Trap")))
    ),
    "the task of settings": lambda t, p: open_named_task(
        load_training(write(t.folder, "settings.yaml", f"task: '{p('Trap')}'\n"))
    ),
    "the task of a run": lambda t, p: open_named_task(
        read_run_settings(run_of_a_task(t, p("Trap")))
    ),
    "a backend": lambda t, p: make_backend(
        p("Trap"), direct_model(), load_world("arena")
    ),
    "limits": lambda t, p: load_limits(
        write(t.folder, "l.yaml", f"based_on: '{p('Trap')}'\n"), direct_model().robot
    ),
    "a world": lambda t, p: load_world(
        write(t.folder, "w.yaml", f"kind: '{p('Trap')}'\n")
    ),
    "a mapping": lambda t, p: load_mapping(
        write(t.folder, "m.yaml", f"kind: '{p('Trap')}'\n")
    ),
}


def open_named_task(settings):
    """Settings with a plain word as their task can be read; the word is no task."""
    return make_task(settings.task, direct_model(), settings.task_options)


CASES = [(way, "a file") for way in WAYS]
CASES += [(way, place) for way in list(WAYS)[:2] for place in list(PLACES)[1:]]


@pytest.mark.parametrize(("way", "place"), CASES)
def test_a_name_in_a_file_of_data_runs_nothing(trap, way, place):
    with pytest.raises(BridgeError) as refused:
        WAYS[way](trap, lambda name: PLACES[place](trap, name))
    assert not trap.canary.exists()
    assert MODULE not in sys.modules
    assert "\n" not in str(refused.value).strip()


def test_a_module_of_the_system_is_never_imported_by_name():
    sys.modules.pop("antigravity", None)
    for name in ("os:system", "antigravity", "antigravity:fly_to"):
        with pytest.raises(ConfigError, match="sensor"):
            sensor_of_data({"kind": name, "name": "rear"})
    assert "antigravity" not in sys.modules


# Objects of Python, which would be made as they are read.


class Sprung:
    def __init__(self, canary: Path) -> None:
        self.canary = str(canary)

    def __reduce__(self):
        return open, (self.canary, "w")


PICKLES = {
    "a recording": load_recording,
    "a policy": lambda path: load_policy(path.rename(path.with_suffix(".onnx"))),
    "a checkpoint": read_checkpoint,
}


@pytest.mark.parametrize("kind", ["pickle", "npz", "torch"])
@pytest.mark.parametrize("reader", PICKLES)
def test_no_object_of_python_is_made_from_a_file(tmp_path, reader, kind):
    canary = tmp_path / "canary"
    path = tmp_path / "drive.npz"
    if kind == "pickle":
        path.write_bytes(pickle.dumps(Sprung(canary)))
    elif kind == "npz":
        np.savez(path, format=np.array([Sprung(canary)], dtype=object))
    else:
        torch.save({"format": Sprung(canary)}, path)
    canary.unlink(missing_ok=True)  # writing one may open it
    with pytest.raises(BridgeError):
        PICKLES[reader](path)
    assert not canary.exists()


def test_a_table_of_a_model_holds_no_objects(tmp_path):
    canary = tmp_path / "canary"
    folder = tmp_path / "model"
    save_model(direct_model(), folder)
    for file in sorted((folder / "lidar_table").glob("*.npy")):
        np.save(file, np.array([Sprung(canary)], dtype=object))
    for sums in (folder / "lidar_table", folder):
        (sums / SUMS).unlink(missing_ok=True)
        write_sums(sums)
    canary.unlink(missing_ok=True)
    with pytest.raises(BridgeError):
        load_model(folder)
    assert not canary.exists()


@pytest.mark.parametrize(
    "name",
    [
        "pkg/msg/X:\n    pass\nopen({canary!r}, 'w')\nclass Y",
        'pkg/msg/X"""\nopen({canary!r}, "w")\n"""',
        "pkg/msg/X': ([], []),\n}}\nopen({canary!r}, 'w')\nA = {{'b",
    ],
)
def test_the_name_of_a_type_in_a_bag_is_no_program(tmp_path, name):
    """The library that decodes messages compiles Python from the definitions in a bag."""
    canary = tmp_path / "canary"
    given = SimpleNamespace(msgdef=(definition_format(), "int32 a\n"))
    given.msgtype = name.format(canary=str(canary))
    collect_types([given])
    given.msgdef = (
        definition_format(),
        f"string A=x'+open('{canary}','w')+'\nint32 b\n",
    )
    given.msgtype = "pkg/msg/Fine"
    collect_types([given])
    assert not canary.exists()


def definition_format():
    from rosbags.interfaces import MessageDefinitionFormat

    return MessageDefinitionFormat.MSG


# What a caller names is run.


def test_a_sensor_of_ones_own_is_given_by_the_caller_and_named_by_files(trap):
    kind = add_sensor_kind(f"{trap.file}:TrapSensor")
    assert trap.canary.exists()
    rear = {
        "name": "rear",
        "lidar": {**direct_model().lidar.model_dump(), "frame": "back"},
    }
    sensor = sensor_of_data({"kind": "TrapSensor", **rear})
    assert type(sensor) is kind
    assert sensor.kind == "TrapSensor", "a model that is written names no path"


def test_the_command_line_imports_a_kind_of_sensor(trap):
    done = nics(
        "--sensor-kind", f"{trap.file}:TrapSensor", "list", "robots", cwd=trap.folder
    )
    assert done.returncode == 0, done.stderr
    assert trap.canary.exists()
    done = nics("--sensor-kind", f"{trap.file}:Trap", "list", "robots", cwd=trap.folder)
    assert done.returncode == 2
    assert "is not a subclass of lidar.sensor.Sensor" in done.stderr


def test_a_task_of_ones_own_is_opened_where_the_caller_names_it(trap):
    path = policy_with_a_task(trap, "Trap")
    model = direct_model()
    with pytest.raises(
        BridgeError, match=r"give --task path/to/file\.py:Trap, or task= in Python"
    ):
        open_policy(str(path), model)
    assert not trap.canary.exists()
    _, task = open_policy(str(path), model, kind=f"{trap.file}:Trap")
    assert type(task).__name__ == "Trap"


def test_a_run_of_a_task_of_ones_own_is_resumed_where_the_caller_names_it(trap):
    place = f"{trap.file}:Trap"
    folder = run_of_a_task(trap, place)
    assert read_run_settings(folder, place).task == place
    assert load_training(folder / "settings.yaml", task=place).task == place
    done = nics("train", "--resume", "--out", "run", cwd=trap.folder)
    assert "is code, which a data file must not run; name it yourself" in done.stderr
    done = nics("train", "--resume", "--out", "run", "--task", place, cwd=trap.folder)
    assert "run: contains no checkpoint of these seeds" in done.stderr
