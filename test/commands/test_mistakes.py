"""Typical mistakes, each told in one sentence: a wrong name, key, shape, unit, place, or module."""

from __future__ import annotations

import errno
import json
import re
import signal
import subprocess
import sys
from unittest import mock

import numpy as np
import pytest
import typer
from command_line import nics
from numba.core.caching import CacheImpl

from nics_drl_bridge.commands import console, doctor, evaluate, interrupts, start, watch
from nics_drl_bridge.config import share_folder
from nics_drl_bridge.kernels import kernel
from nics_drl_bridge.recording import textbook
from nics_drl_bridge.recording.recording import save_recording
from nics_drl_bridge.recording.write import write_drive
from nics_drl_bridge.robot.spec import load_robot

ROBOT = (share_folder() / "config" / "robots" / "differential.yaml").read_text(
    encoding="utf-8"
)
FILES = {
    "text.txt": "hello\n",
    "text.onnx": "hello\n",
    "table.csv": "t,x\n0.0,1.0\n0.1,1.1\n0.2,1.2\n",
    "begun.yaml": "robot: differential\n",
    "listed.yaml": "- name: differential\n",
    "settings.yaml": "tsak: navigation\n",
    "stop.jsonl": "not a black box\n",
    "paced.yaml": "robot: differential\nworlds: {circles: 4}\ntask_options: {top_speed: 0.5 m/s}\n",
    "shapeless.yaml": "name: mine\nkind: differential\nfootprint: wide\n",
    "units.yaml": "robot: differential\npose: {x: x, y: x, heading: x, unit: [m, m, rad]}\n",
    "taken/note.txt": "mine\n",
    "run/settings.yaml": "robot: ackermann\n",
    "mine.py": "x = 1\n",
    "good.yaml": "time: 0\npose: {x: 1, y: 2, heading: 3}\ncommand: {v: 4}\n",
    "robot/model.yaml": ROBOT,
    "robot/model/model.yaml": ROBOT,
}
MISTAKES = {
    # Names of commands, and of options.
    "bake " + "x" * 5000: "No such command",
    "evaluate": "Missing argument 'POLICY...'",
    "train --steps many": "'--steps': ",
    # What is shipped, by its name.
    "train navigation": "a task is given as --task navigation",
    "train --task nowhere.py:Mine": "'nowhere.py': no such file",
    "train --model ./nowhere": "./nowhere: no such folder",
    "train --robot taken": "taken: contains no model.yaml",
    "train --settings nowhere.yaml": "--settings nowhere.yaml: no such file",
    f"train --seeds {2**64}": "seed 18446744073709551616: must be",
    f"evaluate straight --in fast --seed {2**63}": "seed|'--seed'",
    "train --out mine.py": "--out mine.py: is a file, not a folder",
    "train --watch --engine ray": "worlds in other processes can't be shown",
    "record --out d.npz --preview --remap odom=x": "--remap 'odom=x': must be NAME:=OTHER",
    "demo --recording empty --out d": "empty",
    "watch --record a.avi": "--record 'a.avi': ",
    "watch --bag nowhere --world arena --world room": "a robot is in one",
    "evaluate diferential": "unknown policy 'diferential'; did you mean 'differential'?",
    "evaluate differential --in fasst": "there is no such simulator; did you mean 'fast'?",
    "evaluate differential --in fast --gate mechanum": "did you mean 'mecanum'?",
    "watch --bag bag --topic odom": "--topic 'odom': must be ROLE=TOPIC, as odom=/my_odom",
    "demo --policy text.onnx --out d": "text.onnx: field 'file': does not end with the checksum",
    # Keys, values and units of files.
    "drive --robot listed.yaml --out m": "the top level must be `key: value` lines",
    "train --settings settings.yaml": "unknown key 'tsak'; did you mean 'task'",
    "train --settings paced.yaml": "task option top_speed='0.5 m/s': must be a finite number",
    "drive --robot shapeless.yaml --out m": "key 'footprint': must be a list such as .*'wide'",
    "import table.csv --map units.yaml --out d.npz": "is no known unit .*not \\['m', 'm', 'rad'\\]",
    "generate drive.npz --out m --order five": "order is 'five'; it must be 1, 2, 3 or 4",
    "generate drive.npz --out m --alpha 2": "alpha",
    "world draw clutter --footprint -1": "--footprint -1: must be above 0 m",
    "record --out d.npz --preview --speed 3": "speed",
    # Files that are not there, or are something else.
    "generate nothing.npz --out m": "nothing.npz: no such file",
    "generate table.csv --map good.yaml --topic pose=/p --out m": "name the topics in the map",
    "inspect table.csv --map begun.yaml": "already exists; give another name",
    "import table.csv --map begun.yaml --out d.csv": "must end in .npz",
    "explain nothing.jsonl": "no such file",
    "explain stop.jsonl": "stop.jsonl: is not JSON, line by line",
    "generate drive.npz drive.npz --out m": "drive.npz: is given twice; name each recording once",
    "generate drive.npz --robot robot/model.yaml --out robot": "robot/model.yaml: was not written",
    "policy export differential --leapp robot/model": "robot/model/model.yaml: was not written",
    "evaluate differential --shadow table.csv": "table.csv: is not a bag; a bag is the folder",
    "policy import text.txt --robot differential --out p.bin": "a policy file ends with '.onnx'",
    "world draw clutter --out clutter.jpg": "must end in .png",
    "drive --robot differential --out m --recording d.csv": "must end in .npz",
    # Places that are taken, or can't be written to.
    "generate drive.npz --out taken": "taken",
    # Options that do not go together.
    "--sensor-kind mine.py list robots": "sensor 'mine.py': give path/to/file.py:ClassName",
    "train --robot differential --out run": "run: contains a run with other settings",
    "evaluate differential --backend dds": "--backend dds drives the vehicle: add --hardware",
    "evaluate differential --hardware --goal 2": "--goal",
    "evaluate differential --hardware --start presnt": "'--start': .*'presnt'.*'present'",
    "evaluate differential ackermann": "evaluate them one by one",
    "doctor --model differential --policy differential": "give only one",
    "doctor --namespace a/-b": "namespace 'a/-b': must be words of letters, digits and _",
    # Numbers that are none.
    "world import house.world --start 0 nan 0": "--start nan: must be a finite number",
    # Evidence for a policy behind the gate.
    "assure random --limits differential": "'random' is a baseline",
    "assure differntial --limits differential": "unknown policy 'differntial'",
    "assure no.onnx --limits differential": "no.onnx",
    "assure differential --limits mecanum": "the limits are for 'mecanum'",
    "assure differential --limits nothing": "unknown limits 'nothing'",
    "assure differential --limits differential --world no": "unknown world 'no'",
    "assure differential --limits differential --replay 1": "assurance.json",
    f"assure differential --limits differential --seed {2**63 - 8}": "seed",
    "assure differential --limits differential --randomisation hot": "randomisation 'hot'",
    # What a policy sees, and where results go.
    "evaluate differential --lidar hokuyo_ust_10lx --in fast": "does not suit this "
    "lidar: .* in base_link, the scan layout needs .*; use another lidar, or a policy trained for",
    "evaluate straight --in fast --out text.txt": "text.txt is a file, not a folder",
    "evaluate straight --backend sim": "--backend 'sim'",
    "evaluate straight random --backend dds --hardware": "one policy at a time",
}
HEAVY = {"torch", "stable_baselines3", "rclpy", "matplotlib", "onnxruntime"}
MODULES = {
    (
        "train",
        "filelock",
    ): r"training needs the module 'filelock'; pip install 'nics_drl_bridge\[train\]'",
    (
        "train",
        "onnx",
    ): r"training needs the module 'onnx'; pip install 'nics_drl_bridge\[deploy\]'",
    ("train", "onnxruntime"): r"pip install 'nics_drl_bridge\[deploy\]'",
    ("evaluate straight --in dds", "rclpy"): r"pip install 'nics_drl_bridge\[ros\]'",
    (
        "train --engine sb3",
        "stable_baselines3",
    ): r"pip install 'nics_drl_bridge\[sb3\]'",
    (
        "train --engine ray",
        "ray",
    ): r"pip install 'nics_drl_bridge\[sb3,train,distributed\]'",
}


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    path = tmp_path_factory.mktemp("drive") / "drive.npz"
    car = load_robot("differential")
    save_recording(textbook.record(car, np.random.default_rng(0), duration=10.0), path)
    return path


@pytest.fixture
def folder(drive, tmp_path):
    """A folder of files with which mistakes are made."""
    for name, text in FILES.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text, encoding="utf-8")
    (tmp_path / "drive.npz").write_bytes(drive.read_bytes())
    (tmp_path / "empty").mkdir()
    return tmp_path


def sentence_of(done, code=2):
    """The one sentence that a command ended with."""
    assert done.returncode == code, done.stdout + done.stderr
    assert "Traceback" not in done.stderr
    *_, sentence = done.stderr.splitlines()
    assert sentence.startswith("nics: ")
    return sentence


@pytest.mark.parametrize("words", MISTAKES)
def test_a_mistake_is_one_sentence(words, folder):
    before = {path for path in folder.rglob("*") if path.is_file()}
    sentence = sentence_of(nics(*words.split(), cwd=folder))
    assert re.search(MISTAKES[words], sentence), sentence
    after = {path for path in folder.rglob("*") if path.is_file()}
    assert after >= before
    assert {file.relative_to(folder).parts[0] for file in after - before} <= {
        "runs",
        "__pycache__",
    }


@pytest.mark.parametrize(
    ("command", "option", "partners", "rule"),
    [
        (command, option, partners, rule)
        for rule in ("NEEDED", "APART")
        for command, options in getattr(console, rule).items()
        if command != "replay"
        for option, partners in options.items()
    ],
)
def test_an_option_without_its_partner_or_with_a_foe_is_refused(
    command, option, partners, rule, capsys
):
    modules = {"doctor": doctor, "evaluate": evaluate, "watch": watch}
    function = getattr(modules[command], command)
    given = [option] if rule == "NEEDED" else [option, partners[0]]
    with pytest.raises(typer.Exit):
        console.check_options(function)(**dict.fromkeys(given, "x"))
    sentence = capsys.readouterr().err
    words = "requires" if rule == "NEEDED" else "can't be combined with"
    assert words in sentence
    assert console._format_option(partners[0]) in sentence


@pytest.mark.parametrize("given", MODULES, ids=" without ".join)
def test_a_missing_module_is_one_sentence_with_what_to_install(
    given, folder, monkeypatch
):
    words, module = given
    monkeypatch.setitem(sys.modules, module, None)
    sentence = sentence_of(nics(*words.split(), cwd=folder))
    assert re.search(MODULES[given], sentence), sentence


def test_a_full_disk_is_one_sentence_and_leaves_nothing(folder):
    full = OSError(errno.ENOSPC, "No space left on device", "m/model.yaml")
    with mock.patch("nics_drl_bridge.files.write_text", side_effect=full):
        done = nics("drive --robot differential --out m", cwd=folder)
    assert "m/model.yaml: No space left on device; choose another place" in sentence_of(
        done
    )
    assert not (folder / "m").exists()


@pytest.mark.process
@pytest.mark.parametrize(
    "words", ["train --world corridr", "record --out d.npz --speed 3"]
)
def test_a_mistake_is_told_before_anything_heavy_is_loaded(words, tmp_path):
    ask = (
        "import sys\nfrom nics_drl_bridge.commands.cli import main\ntry:\n    main()\n"
        f"except SystemExit as end:\n    print(end.code, set(sys.modules) & {HEAVY})\n"
    )
    command = [sys.executable, "-c", ask, *words.split()]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert done.stdout == "2 set()\n", done.stderr


@pytest.mark.parametrize(
    "command",
    ["train", "world draw room"],
)
def test_robot_and_model_are_one_option_of_every_command(command, tmp_path):
    done = nics(*command.split(), "--robot jackal --model=mecanum", cwd=tmp_path)
    assert "--robot and --model are the same option" in sentence_of(done)


@pytest.fixture
def signals():
    """Handlers of signals as they were before a test that takes them."""
    numbers = list(interrupts.ENDING)
    before = [signal.getsignal(number) for number in numbers]
    yield
    for number, handler in zip(numbers, before, strict=True):
        signal.signal(number, handler)


def test_ctrl_c_before_a_command_has_begun_is_one_sentence(signals, capsys):
    with (
        mock.patch("nics_drl_bridge.commands.cli.main", side_effect=KeyboardInterrupt),
        pytest.raises(SystemExit) as end,
    ):
        start.main()
    assert end.value.code == 130
    assert capsys.readouterr().err == "nics: interrupted; nothing was started.\n"


def test_where_no_kernel_can_be_kept_the_sentence_names_the_variable(signals, capsys):
    def import_kernel():
        kernel(lambda x: x)

    with (
        mock.patch("nics_drl_bridge.commands.cli.main", import_kernel),
        mock.patch.object(CacheImpl, "_locator_classes", []),
        pytest.raises(SystemExit) as end,
    ):
        start.main()
    assert end.value.code == 2
    assert "set NUMBA_CACHE_DIR to a folder that can" in capsys.readouterr().err


def test_ctrl_c_does_not_reach_the_processes_that_compile_ahead(tmp_path):
    pools = mock.Mock(**{"return_value.Pool.side_effect": KeyboardInterrupt})
    with mock.patch("nics_drl_bridge.commands.warmup.get_context", pools):
        done = nics("warmup", cwd=tmp_path)
    assert "interrupted" in sentence_of(done, code=130)
    _, begin, arguments = pools.return_value.Pool.call_args.args
    with mock.patch("signal.signal") as handle:
        begin(*arguments)
    handle.assert_called_once_with(signal.SIGINT, signal.SIG_IGN)


def test_a_first_mapping_is_written_beside_json_too(folder):
    told = json.loads(
        nics("inspect table.csv --map first.yaml --json", cwd=folder).stdout
    )
    assert told["mapping"] == "first.yaml"
    assert "\nrobot: " in (folder / "first.yaml").read_text(encoding="utf-8")


def test_a_recording_of_this_package_gets_no_mapping_and_says_so(tmp_path):
    robot = load_robot("differential")
    driven = textbook.record(robot, np.random.default_rng(0), 5.0)
    write_drive(driven, tmp_path / "own.npz", robot)
    said = nics("inspect own.npz --map my.yaml", cwd=tmp_path).stdout
    assert said.startswith(
        "own.npz: was written by this package, and needs no mapping: nics gen"
    )
    assert not (tmp_path / "my.yaml").exists()


def test_columns_of_text_are_null_in_json(folder):
    rows = "".join(f"2024-01-01 10:00:00.{k},{k}.0\n" for k in range(3))
    (folder / "dates.csv").write_text(f"stamp,x\n{rows}", encoding="utf-8")
    told = nics("inspect dates.csv --json", cwd=folder).stdout
    (table,) = json.loads(told, parse_constant=pytest.fail)["tables"]
    assert [None, None] in [column[1:] for column in table["columns"]]
