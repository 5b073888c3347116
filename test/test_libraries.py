"""A library that is missing or too old, as a system's own packages may be, is one sentence."""

import os
import subprocess
import sys
from importlib import import_module

import pytest

import nics_drl_bridge
from nics_drl_bridge import extensions
from nics_drl_bridge.errors import ConfigError

NEED_GYMNASIUM = ("load_policy", "make", "make_vec")
ROS = ("rclpy", "rosidl_runtime_py", "ament_index_python", "launch", "tf2_ros")
ROS += ("builtin_interfaces", "_msgs", "_srvs")
WITHOUT = """
import sys

class Without:
    def __init__(self, finder):
        self.finder = finder

    def find_spec(self, name, path=None, target=None):
        absent = name.partition(".")[0].endswith({names})
        return None if absent else self.finder.find_spec(name, path, target)

    def __getattr__(self, name):
        return getattr(self.finder, name)

sys.meta_path[:] = [Without(finder) for finder in sys.meta_path]
"""
NICS = """
from nics_drl_bridge.commands.start import main

def nics(*words):
    sys.argv = ["nics", *words]
    try:
        main()
    except SystemExit as end:
        return end.code
"""
SETTINGS = (
    "{worlds: {empty: 32}, steps: 2048, hidden: [16], ppo: {rollout: 16, batch: 256}}"
)


def python(code, *words, path=None, cwd=None):
    """What a process says that runs some code; its libraries may be other ones."""
    before = [str(path)] if path else []
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([*before, *sys.path[1:]])}
    command = [sys.executable, "-c", code, *words]
    return subprocess.run(
        command,
        cwd=cwd,
        env=environment,
        capture_output=True,
        text=True,
        timeout=800,
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
def test_the_core_does_without_what_no_system_brings(tmp_path):
    names = [name for name in nics_drl_bridge.__all__ if name not in NEED_GYMNASIUM]
    car = str(tmp_path / "car.urdf")
    code = f"""{WITHOUT.format(names=("filterpy", "gymnasium"))}{NICS}
import nics_drl_bridge
for name in {names}:
    getattr(nics_drl_bridge, name)
for words in (["--help"], ["generate", "--help"], ["urdf", "ackermann", "--out", {car!r}]):
    assert not nics(*words), words
assert nics("evaluate", "straight", "--episodes", "1", "--out", {str(tmp_path)!r}) == 2
"""
    done = python(code)
    assert done.returncode == 0, done.stderr
    sentence = done.stderr.splitlines()[-1]
    assert sentence == "nics: needs the module 'gymnasium'; install it."


@pytest.mark.parametrize(
    ("module", "what", "library", "extra"),
    [
        ("env.pettingzoo_env", "BridgeParallelEnv", "pettingzoo", "multi"),
        ("policy.train.export", "the export of a policy", "onnx", "deploy"),
        ("policy.train.vec_env", "TrainVecEnv", "stable_baselines3", "sb3"),
        ("extras.dart", "DART", "dartpy", "dart"),
        ("extras.mujoco", "MuJoCo", "mujoco", "mujoco"),
    ],
)
def test_a_module_whose_extra_is_missing_names_it(
    monkeypatch, module, what, library, extra
):
    name = f"nics_drl_bridge.{module}"
    monkeypatch.delitem(sys.modules, name, raising=False)
    for loaded in [library, *(m for m in sys.modules if m.startswith(f"{library}."))]:
        monkeypatch.setitem(sys.modules, loaded, None)
    with pytest.raises(ConfigError) as refused:
        import_module(name)
    sentence = str(refused.value)
    assert sentence.startswith(f"{what} needs the module '{library}")
    assert sentence.endswith(f"pip install 'nics_drl_bridge[{extra}]'.")


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


@pytest.mark.package
@pytest.mark.process
@pytest.mark.timeout(900)  # a cold start compiles
def test_without_ros_2_a_policy_is_trained_and_evaluated(tmp_path):
    (tmp_path / "short.yaml").write_text(SETTINGS, encoding="utf-8")
    train = "train --settings short.yaml --seeds 0 --episodes 8 --out run"
    evaluate = "evaluate run/seed_0/policy.onnx --world empty --episodes 2 --out seen"
    code = f"""{WITHOUT.format(names=ROS)}{NICS}
from importlib.util import find_spec
assert not any(map(find_spec, ("rclpy", "sensor_msgs", "std_srvs")))
for line in ({train!r}, {evaluate!r} + " --in fast"):
    assert not nics(*line.split()), line
assert nics(*{evaluate!r}.split(), "--in", "dds") == 2
"""
    done = python(code, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "seen" / "evaluation.json").is_file()
    sentence = done.stderr.splitlines()[-1]
    assert sentence.startswith("nics: ")
    assert "rclpy" in sentence
