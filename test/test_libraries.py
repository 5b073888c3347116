"""A library that is missing or too old, as a system's own packages may be, is one sentence."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

import nics_drl_bridge
from nics_drl_bridge import extensions

# No distribution has these as packages of its own.
FOREIGN = ("filterpy", "gymnasium")
NEED_THEM = ("load_policy", "make", "make_vec")
WITHOUT = f"""
import sys

class Absent:
    def find_spec(self, name, *_):
        if name.partition(".")[0] in {FOREIGN}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)

sys.meta_path.insert(0, Absent())
"""


def python(code, *words, path=None):
    """What a process says that runs some code; its libraries may be other ones."""
    before = [str(path)] if path else []
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([*before, *sys.path[1:]])}
    command = [sys.executable, "-c", code, *words]
    return subprocess.run(
        command,
        env=environment,
        capture_output=True,
        text=True,
        timeout=240,
        check=False,
    )


def pretend(monkeypatch, **versions):
    """Lets libraries have other versions, none if ""."""
    real = extensions.version

    def version(name):
        if name not in versions:
            return real(name)
        if not versions[name]:
            raise extensions.PackageNotFoundError(name)
        return versions[name]

    monkeypatch.setattr(extensions, "version", version)


def test_all_that_is_missing_or_of_a_wrong_version_is_told_at_once(monkeypatch):
    unfit = ImportError("cannot import name", name="pydantic")
    assert extensions.explain_unmet(unfit) is None
    mujoco = extensions.explain_unmet(ModuleNotFoundError("", name="mujoco"))
    assert mujoco == "needs the module 'mujoco'; pip install 'nics_drl_bridge[mujoco]'."
    pretend(monkeypatch, pydantic="1.10.4", gymnasium="1.10.0", filterpy="")
    own = ModuleNotFoundError("no module", name="nics_drl_bridge.env.nothing")
    assert extensions.explain_unmet(own) is None
    told = extensions.explain_unmet(unfit)
    for part in ("filterpy>=2.0 (missing)", "pydantic>=2.6 (1.10.4)", "(1.10.0)"):
        assert part in told
    assert "pip install 'filterpy>=2.0' " in told


@pytest.mark.process
@pytest.mark.slow
def test_the_core_does_without_what_no_system_brings():
    names = [name for name in nics_drl_bridge.__all__ if name not in NEED_THEM]
    code = f"{WITHOUT}\nimport nics_drl_bridge\nfor name in {names}: getattr(nics_drl_bridge, name)"
    done = python(code)
    assert done.returncode == 0, done.stderr


@pytest.mark.process
@pytest.mark.parametrize(
    "words", [("--help",), ("generate", "--help"), ("urdf", "{out}")]
)
def test_nics_does_without_what_no_system_brings(words, tmp_path):
    given = [word.replace("{out}", "ackermann") for word in words]
    given += ["--out", str(tmp_path / "car.urdf")] if words[0] == "urdf" else []
    done = python(
        f"{WITHOUT}\nfrom nics_drl_bridge.commands.start import main\nmain()", *given
    )
    assert done.returncode == 0, done.stderr


@pytest.mark.process
def test_nics_says_in_one_sentence_what_a_command_needs(tmp_path):
    code = f"{WITHOUT}\nfrom nics_drl_bridge.commands.start import main\nmain()"
    done = python(
        code, "evaluate", "straight", "--episodes", "1", "--out", str(tmp_path / "out")
    )
    assert done.returncode == 2
    (sentence,) = done.stderr.splitlines()
    assert sentence == "nics: needs the module 'gymnasium'; install it."


@pytest.mark.process
@pytest.mark.parametrize(
    ("module", "what", "library", "extra"),
    [
        ("env.pettingzoo_env", "BridgeParallelEnv", "pettingzoo", "multi"),
        ("policy.train.vec_env", "TrainVecEnv", "stable_baselines3", "train"),
        ("policy.train.export", "the export of a policy", "onnx", "deploy"),
        ("policy.train.export", "the export of a policy", "torch", "train"),
    ],
)
def test_a_module_whose_extra_is_missing_names_it(module, what, library, extra):
    code = WITHOUT.replace(repr(FOREIGN), repr((library,)))
    done = python(f"{code}\nimport nics_drl_bridge.{module}")
    fix = f"pip install 'nics_drl_bridge[{extra}]'."
    last = done.stderr.splitlines()[-1]
    assert last.endswith(f"ConfigError: {what} needs the module {library!r}; {fix}")


@pytest.mark.process
@pytest.mark.parametrize("start", ["commands.start", "nodes.start"])
def test_an_old_library_is_one_sentence(tmp_path, start):
    (tmp_path / "pydantic").mkdir()
    (tmp_path / "pydantic" / "__init__.py").touch()
    facts = tmp_path / "pydantic-1.10.4.dist-info"
    facts.mkdir()
    (facts / "METADATA").write_text(
        "Metadata-Version: 2.1\nName: pydantic\nVersion: 1.10.4\n"
    )
    command = start == "commands.start"
    call = "main()" if command else "command_gate()"
    code = f"from nics_drl_bridge.{start} import *\n{call}"
    done = python(code, *(["urdf", "ackermann"] if command else []), path=tmp_path)
    if "rclpy" in done.stderr:
        pytest.skip("needs ROS 2: rclpy is not installed")
    assert done.returncode == 2, done.stderr
    *before, sentence = done.stderr.splitlines()
    assert len(before) == (0 if command else 1)  # a node says at once that it starts
    assert "needs pydantic>=2.6 (1.10.4); pip install 'pydantic>=2.6'." in sentence
