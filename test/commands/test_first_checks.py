"""`nics train` and `nics record` refuse wrong names and places before they load anything heavy."""

import subprocess
import sys
from pathlib import Path

import pytest
from command_line import nics

from nics_drl_bridge.commands import first_checks
from nics_drl_bridge.errors import ConfigError

HEAVY = ("torch", "stable_baselines3", "rclpy", "matplotlib", "onnxruntime")
PROGRAM = f"""
import sys
from nics_drl_bridge.commands.cli import main
try:
    main()
except SystemExit as end:
    loaded = [name for name in {HEAVY} if name in sys.modules]
    print("ended with", end.code, "loaded", loaded)
"""
REFUSED = {
    "train --robot diferential": "unknown robot 'diferential'; did you mean 'differential'",
    "train --model ./nowhere": "./nowhere: no such folder",
    "train --robot empty": "empty: holds no model.yaml",
    "train --world corridr": "unknown world 'corridr'; did you mean 'corridor'",
    "train --settings nowhere.yaml": "--settings nowhere.yaml: no such file",
    "train --settings navigation_mecanun": "unknown settings 'navigation_mecanun'",
    "train --task navigate": "unknown task 'navigate'; did you mean 'navigation'",
    "train --task nowhere.py:Mine": "'nowhere.py': no such file",
    "train --task mine.py": "defines no subclass",
    "train navigation": "a task is given as --task navigation",
    "train --seeds -1": "seed -1: must be a whole number",
    "train --seeds 1 1": "none twice",
    "train --out mine.py": "--out mine.py: is a file, not a folder",
    "train --out mine.py/run": "mine.py",
    "train --out /proc/run": "/proc",
    "train --algorithm dqn": "input should be 'ppo' or 'sac'",
    "train --engine sb4": "unknown engine 'sb4'",
    "record --out d.npz --robot diferential": "did you mean 'differential'",
    "record --out d.txt": "unknown kind of recording '.txt'",
    "record --out /proc/d.npz": "/proc",
    "record --out mine.py": "is there already",
    "record --out d.npz --topics nowhere.yaml": "nowhere.yaml",
    "record --out d.npz --speed 3": "speed 3: must be from",
    "record --out d.npz --seed -1": "seed -1",
}


@pytest.mark.parametrize(("words", "sentence"), REFUSED.items(), ids=str)
def test_a_wrong_name_or_place_is_refused_before_anything_heavy_is_loaded(
    tmp_path: Path, words: str, sentence: str
) -> None:
    (tmp_path / "mine.py").write_text("x = 1\n")
    (tmp_path / "empty").mkdir()
    command = [
        sys.executable,
        "-B",
        "-c",
        PROGRAM,
        *words.split(),
    ]  # without __pycache__
    done = subprocess.run(
        command, cwd=tmp_path, capture_output=True, text=True, timeout=120, check=False
    )
    assert sentence in " ".join(done.stderr.split()), done.stderr
    assert done.stderr.count("\n") == 1
    assert done.stdout == "ended with 2 loaded []\n"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["empty", "mine.py"]


@pytest.mark.parametrize(
    "command",
    [
        "train",
        "record --out d.npz",
        "generate d.npz --out m",
        "drive",
        "demo",
        "doctor",
        "watch",
        "evaluate straight",
        "policy import x.yaml --out p.onnx",
        "world draw room",
        "world map room",
        "bag replay b",
        "bag export b",
    ],
)
def test_robot_and_model_are_one_option_of_every_command(
    tmp_path: Path, command: str
) -> None:
    done = nics(*command.split(), "--robot", "jackal", "--model=mecanum", cwd=tmp_path)
    assert done.returncode == 2
    assert "--robot and --model are the same option, but got" in done.stderr
    for word in ("--robot", "--model"):
        shown = nics(*command.split(), word, "jackal", "--help", cwd=tmp_path)
        assert "No such option" not in shown.stderr
        assert word in shown.stdout


@pytest.mark.parametrize("task", ["evil.py\n", "navigaton"])
def test_settings_for_an_unknown_task_are_refused_at_once(tmp_path, task):
    file = tmp_path / "settings.yaml"
    file.write_text(f"task: {task!r}\n".replace("'", '"'))
    with pytest.raises(ConfigError, match="unknown task"):
        first_checks.check_settings("navigation", str(file), {})
