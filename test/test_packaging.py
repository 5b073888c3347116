"""The package as a user gets it: installed with pip, and built with colcon."""

import io
import os
import re
import shutil
import subprocess
import sys
import zipfile
from collections.abc import Sequence
from functools import partial
from importlib.metadata import PackageMetadata
from pathlib import Path
from xml.etree import ElementTree

import pytest
import yaml
from build.util import project_wheel_metadata
from catkin_pkg.package import Package, parse_package
from dockerfile_parse import DockerfileParser
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from nics_drl_bridge.kernels import TARGET, runs_target

pytestmark = [pytest.mark.process, pytest.mark.slow]
ROOT = Path(__file__).resolve().parents[1]
PACKAGE = "nics_drl_bridge"
EXECUTABLES = {
    "nics",
    "simulator_node",
    "mujoco_node",
    "dart_node",
    "middleware_node",
    "policy_node",
    "command_gate",
    "record_node",
}
# As rosdistro's rosdep/python.yaml has them, for Debian and Ubuntu; others are python3-NAME.
ROSDEP_KEYS = {
    "filterpy": "python3-filterpy-pip",
    "gymnasium": "python3-gymnasium-pip",
    "pillow": "python3-pil",
    "pyyaml": "python3-yaml",
}
WITHOUT_KEY = {"threadpoolctl"}
OF_OTHERS = (
    "PYTHONPATH",
    "VIRTUAL_ENV",
    "LD_LIBRARY_PATH",
    "_ROS_WHEELS_BOOTSTRAP_COMPLETE",
)
SHARED = ("config", "launch", "urdf")
INSTRUCTIONS = {"FROM", "WORKDIR", "COPY", "RUN", "ENTRYPOINT", "CMD"}
VERSION = "9.8.7"  # written into the package.xml of the copy, and nowhere else

# Files added to the copy, deeper than any of today's: packaging that lists folders by hand,
# or takes the top level only, loses them.
PROBES = {
    f"{PACKAGE}/probe/__init__.py": "",
    f"{PACKAGE}/probe/inner/__init__.py": "",
    f"{PACKAGE}/probe/inner/leaf.py": "",
    "config/probe/inner/leaf.yaml": "answer: 42\n",
    "launch/probe/leaf.launch.py": "",
    "urdf/probe/leaf.urdf": "",
}

WHERE_AM_I = f"""
import {PACKAGE}
from {PACKAGE}.config import share_folder
print({PACKAGE}.__version__, {PACKAGE}.__file__, share_folder(), sep="\\n")
"""

NOTHING_OF_TRAINING = """
from importlib.util import find_spec
there = [*filter(find_spec, ("torch", "stable_baselines3", "mujoco", "tensorboard"))]
assert not there, there
"""

LOAD_ENTRY_POINTS = f"""
from importlib.metadata import distribution
from types import ModuleType
from {PACKAGE}.errors import ConfigError
for point in distribution("{PACKAGE}").entry_points:
    try:
        loaded = point.load()
        assert callable(loaded) or isinstance(loaded, ModuleType), point
    except ModuleNotFoundError as error:  # a library of an extra that is not installed
        assert not error.name.startswith("{PACKAGE}"), error
        assert ".nodes." in point.value or ".extras." in point.value, error
        continue
    except ConfigError:  # an engine that is not installed
        continue
    print(point.name)
"""


def run(
    *command: str | Path, cwd: Path, without: Sequence[str] = (), **env: str
) -> str:
    """Runs a command; what it printed is returned, or shown when it fails."""
    inherited = {key: value for key, value in os.environ.items() if key not in without}
    done = subprocess.run(
        [str(word) for word in command],
        cwd=cwd,
        env=inherited | env,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        timeout=1700,
    )
    assert done.returncode == 0, (
        f"{command} ended with {done.returncode}:\n{done.stdout}"
    )
    return done.stdout


run_apart = partial(run, without=OF_OTHERS)


def files_below(root: Path, *tops: str) -> set[str]:
    """The files below some folders, relative to the root."""
    paths = (path for top in tops for path in (root / top).rglob("*") if path.is_file())
    return {
        path.relative_to(root).as_posix()
        for path in paths
        if "__pycache__" not in path.parts
    }


@pytest.fixture(scope="module")
def checkout(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of this checkout with the probes and another version."""
    copy = tmp_path_factory.mktemp("workspace") / "src" / PACKAGE
    left_behind = (
        "build",
        "install",
        "log",
        "dist",
        "runs",
        "*.egg-info",
        "__pycache__",
        ".?*",
    )
    shutil.copytree(ROOT, copy, ignore=shutil.ignore_patterns(*left_behind))
    for name, text in PROBES.items():
        (copy / name).parent.mkdir(parents=True, exist_ok=True)
        (copy / name).write_text(text, encoding="utf-8")
    manifest = (copy / "package.xml").read_text(encoding="utf-8")
    manifest = re.sub(
        "<version>.*</version>", f"<version>{VERSION}</version>", manifest
    )
    (copy / "package.xml").write_text(manifest, encoding="utf-8")
    return copy


@pytest.fixture(scope="module")
def dist(checkout: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the source archive, and the wheel that is made of it."""
    folder = tmp_path_factory.mktemp("dist")
    words = ("-m", "build", "--no-isolation", "--outdir", folder, checkout)
    run(sys.executable, *words, cwd=folder)
    return folder


@pytest.fixture(scope="module")
def wheel(dist: Path) -> Path:
    return next(dist.glob("*.whl"))


@pytest.fixture(scope="module")
def metadata(checkout: Path) -> PackageMetadata:
    """The core metadata that a wheel would have."""
    return project_wheel_metadata(checkout, isolated=False)


@pytest.fixture(scope="module")
def environment(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A fresh virtual environment with the wheel; libraries are those of this one."""
    venv = tmp_path_factory.mktemp("environment") / "venv"
    run(sys.executable, "-m", "venv", "--without-pip", venv, cwd=venv.parent)
    libraries = [
        path for path in sys.path if path.endswith(("site-packages", "dist-packages"))
    ]
    site_packages = next(venv.glob("lib/python3.*/site-packages"))
    (site_packages / "libraries.pth").write_text("\n".join(libraries), encoding="utf-8")
    pip = (sys.executable, "-m", "pip", "--python", venv / "bin" / "python")
    # Whatever of this package the libraries beside it hold is to be left alone.
    given = ("--quiet", "--no-deps", "--no-index", "--ignore-installed")
    run(*pip, "install", *given, wheel, cwd=venv.parent)
    return venv


@pytest.fixture(scope="module")
def install_space(checkout: Path) -> Path:
    """The install folder of `colcon build` in a workspace that holds the copy."""
    beside_python = Path(sys.executable).with_name("colcon")
    colcon = beside_python if beside_python.exists() else shutil.which("colcon")
    if colcon is None:
        pytest.skip("colcon is not installed; `make setup` installs it")
    workspace = checkout.parents[1]
    prefix = os.environ.get("AMENT_PREFIX_PATH", sys.prefix)
    run(
        colcon,
        "build",
        "--packages-select",
        PACKAGE,
        cwd=workspace,
        AMENT_PREFIX_PATH=prefix,
    )
    return workspace / "install"


@pytest.mark.package
def test_the_wheel_holds_every_module_config_launch_and_urdf_file(
    checkout: Path, wheel: Path
) -> None:
    modules = files_below(checkout, PACKAGE)
    shared = files_below(checkout, *SHARED) | {"package.xml"}
    assert PROBES.keys() <= modules | shared
    data = f"{PACKAGE}-{VERSION}.data/data/share"
    wanted = modules | {f"{data}/{PACKAGE}/{name}" for name in shared}
    wanted.add(f"{data}/ament_index/resource_index/packages/{PACKAGE}")
    names = zipfile.ZipFile(wheel).namelist()
    assert {name for name in names if ".dist-info/" not in name} == wanted


@pytest.mark.package
def test_a_pip_install_takes_version_and_config_from_itself(environment: Path) -> None:
    answer = run(environment / "bin" / "python", "-c", WHERE_AM_I, cwd=environment)
    version, module, share = answer.splitlines()
    assert version == VERSION
    assert environment in Path(module).parents
    assert Path(share) == environment / "share" / PACKAGE
    assert {path.name for path in (environment / "bin").iterdir()} >= EXECUTABLES
    assert "Usage" in run(environment / "bin" / "nics", "--help", cwd=environment)
    loaded = run(
        environment / "bin" / "python", "-c", LOAD_ENTRY_POINTS, cwd=environment
    )
    assert {"nics", "sim"} <= set(loaded.split())


def test_colcon_installs_everything_where_ros_2_looks(
    checkout: Path, install_space: Path
) -> None:
    folder = install_space / PACKAGE / "lib" / PACKAGE
    assert {path.name for path in folder.iterdir()} == EXECUTABLES
    assert all(os.access(path, os.X_OK) for path in folder.iterdir())
    (module,) = (install_space / PACKAGE).glob(f"lib/python*/site-packages/{PACKAGE}")
    assert files_below(module.parent, PACKAGE) == files_below(checkout, PACKAGE)
    share = install_space / PACKAGE / "share"
    written = files_below(checkout, *SHARED)
    assert files_below(share / PACKAGE, *SHARED) == written
    assert (share / PACKAGE / "package.xml").is_file()
    assert (share / "ament_index" / "resource_index" / "packages" / PACKAGE).is_file()


def test_a_sourced_colcon_install_takes_version_and_config_from_itself(
    install_space: Path,
) -> None:
    ask = f"command -v nics && {sys.executable} -c '{WHERE_AM_I}' && nics --help"
    sourced = f"source {install_space}/setup.bash && {ask}"
    answer = run("bash", "-c", sourced, cwd=install_space)
    nics, version, module, share, *rest = answer.splitlines()
    assert Path(nics) == install_space / PACKAGE / "bin" / "nics"
    assert version == VERSION
    assert install_space in Path(module).parents
    assert Path(share) == install_space / PACKAGE / "share" / PACKAGE
    assert "Usage" in "".join(rest)


def test_package_xml_is_as_its_format_wants_it_and_every_xml_file_is_well_formed() -> (
    None
):
    package_xml().validate()
    for folder in (ROOT / "launch", ROOT / "config", ROOT / PACKAGE):
        for file in folder.rglob("*.xml"):
            ElementTree.parse(file)


def requirements(metadata: PackageMetadata, extra: str = "") -> list[Requirement]:
    """What the wheel requires on this machine, with an extra or without."""
    every = [Requirement(text) for text in metadata.get_all("Requires-Dist", [])]
    return [
        one
        for one in every
        if one.marker is None or one.marker.evaluate({"extra": extra})
    ]


def test_package_xml_has_the_rosdep_key_of_every_python_library(
    metadata: PackageMetadata,
) -> None:
    libraries = {one.name for one in requirements(metadata)}
    assert "numpy" in libraries
    keys = {each.name for each in package_xml().exec_depends}
    for library in libraries - WITHOUT_KEY:
        assert ROSDEP_KEYS.get(library, f"python3-{library}") in keys
    text = (ROOT / "package.xml").read_text(encoding="utf-8")
    assert all(f"no key for {library}" in text for library in WITHOUT_KEY)


def package_xml() -> Package:
    """What package.xml says; what colcon would warn of fails."""
    warnings: list[str] = []
    package = parse_package(ROOT / "package.xml", warnings=warnings)
    assert not warnings
    return package


def test_every_requirement_is_pinned_to_a_version_that_it_allows(
    metadata: PackageMetadata,
) -> None:
    lines = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    every = [Requirement(line) for line in lines if line and not line.startswith("#")]
    pins = {
        canonicalize_name(pin.name): str(pin.specifier).removeprefix("==")
        for pin in every
        if pin.marker is None or pin.marker.evaluate()
    }
    asked = requirements(metadata, extra="dev")
    assert {"numpy", "ruff"} <= {one.name for one in asked}
    for one in asked:
        assert one.specifier.contains(pins[canonicalize_name(one.name)]), one


@pytest.mark.package
def test_the_linter_of_ros_2_finds_nothing_in_the_package() -> None:
    pytest.importorskip("flake8", reason="needs flake8 of the extra `test`")
    run(
        sys.executable,
        "-m",
        "flake8",
        "--config",
        "setup.cfg",
        PACKAGE,
        "launch",
        cwd=ROOT,
    )


def test_a_sourced_ros_2_replaces_the_ros_wheels_and_nothing_else(
    metadata: PackageMetadata,
) -> None:
    core, everything, without_ros, ros = (
        {one.name for one in requirements(metadata, extra)}
        for extra in ("", "dev", "dev-without-ros", "ros")
    )
    assert everything - without_ros == ros - core
    for extra in set(metadata.get_all("Provides-Extra", [])) - {"distributed"}:
        assert {one.name for one in requirements(metadata, extra)} <= everything


@pytest.mark.package
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("kind", ["*.whl", "*.tar.gz"])
def test_a_release_runs_the_demo_outside_of_the_repository(dist, kind, tmp_path):
    python = tmp_path / "venv" / "bin" / "python"
    uv = Path(sys.executable).with_name("uv")
    release = f"{next(dist.glob(kind))}[ros,deploy]"
    constraints = ("--constraints", ROOT / "constraints.txt")
    demo = ["demo", "--policy", "differential", "--episodes", "2", "--out", "demo"]
    for command in (
        (uv, "venv", "--python", sys.executable, tmp_path / "venv"),
        (uv, "pip", "install", "--python", python, *constraints, release),
        (python, "-c", WHERE_AM_I),
        (python, "-c", NOTHING_OF_TRAINING),
        (python.with_name("nics"), *demo),
    ):
        told = run_apart(*command, cwd=tmp_path)
        if WHERE_AM_I in command:
            assert str(tmp_path) in told
    assert "in process 2/2, over DDS 2/2" in told
    assert (tmp_path / "demo" / "paths.png").is_file()
    assert (tmp_path / "demo" / "report.html").is_file()


FIRST_STEPS = """
import time
begin = time.process_time()
import hashlib
from nics_drl_bridge.env.vector_env import BridgeVectorEnv
from nics_drl_bridge.kernels import COMPILING

env = BridgeVectorEnv(512)
env.action_space.seed(0)
env.reset(seed=0)
env.step(env.action_space.sample())
spent = time.process_time() - begin
digest = hashlib.sha256()
for _ in range(200):
    observation, reward, *_ = env.step(env.action_space.sample())
    digest.update(observation.tobytes() + reward.tobytes())
print(spent, COMPILING.count, digest.hexdigest())
"""


@pytest.mark.package
@pytest.mark.timeout(3600)
@pytest.mark.skipif(not runs_target(), reason=f"this machine does not run {TARGET}")
def test_a_wheel_with_machine_code_compiles_nothing_and_gives_the_same_bits(tmp_path):
    made = (f"WHEEL={tmp_path / 'made'}", f"DIST={tmp_path}")
    run_apart("make", "--old-file", "setup", "wheel", *made, cwd=ROOT)
    uv = Path(sys.executable).with_name("uv")
    python = tmp_path / "venv" / "bin" / "python"
    run_apart(
        uv,
        "venv",
        "--python",
        sys.executable,
        tmp_path / "venv",
        cwd=tmp_path,
    )
    install = (uv, "pip", "install", "--compile-bytecode", "--python", python)
    pins = ("--constraints", ROOT / "constraints.txt")
    run_apart(*install, *pins, next(tmp_path.glob("*.whl")), cwd=tmp_path)
    spent_s, compiled, digest = run_apart(
        python, "-c", FIRST_STEPS, cwd=tmp_path
    ).split()
    assert int(compiled) == 0
    assert float(spent_s) < 5.0  # of CPU, a twentieth of what compiling takes
    from_source = run_apart(sys.executable, "-c", FIRST_STEPS, cwd=tmp_path).split()
    assert digest == from_source[-1]


def text_of(name: str) -> str:
    return (ROOT / name).read_text(encoding="utf-8")


def test_the_container_file_copies_what_there_is_and_runs_what_is_installed(metadata):
    file = io.BytesIO((ROOT / "Containerfile").read_bytes())
    every = DockerfileParser(fileobj=file).structure
    lines = [
        (one["instruction"], one["value"])
        for one in every
        if one["instruction"] != "COMMENT"
    ]
    assert lines[0][0] == "FROM"
    assert {name for name, _ in lines} == INSTRUCTIONS
    for name, words in lines:
        if name == "COPY":
            *sources, _ = words.split()
            assert all((ROOT / source).exists() for source in sources), words
    asked = re.search(r"'\.\[(.*?)\]'", text_of("Containerfile"))
    assert set(asked[1].split(",")) <= set(metadata.get_all("Provides-Extra"))
    assert dict(lines)["ENTRYPOINT"] == '["nics"]'


def test_the_citation_has_the_version_of_the_package_and_what_its_format_needs():
    citation = yaml.safe_load(text_of("CITATION.cff"))
    assert {"cff-version", "message", "title", "authors"} <= set(citation)
    assert all(one["authors"] for one in (citation, *citation["references"]))
    (version,) = re.findall("<version>(.*)</version>", text_of("package.xml"))
    assert citation["version"] == version
    assert f"{citation['license']}" in text_of("LICENSE")


@pytest.mark.parametrize("name", ["README.md", "docs/install.md", "Makefile"])
def test_the_versions_of_python_are_those_of_setup(name):
    wanted = r'python_requires=">=3\.(\d+),<3\.(\d+)"'
    low, high = re.search(wanted, text_of("setup.py")).groups()
    told = set(re.findall(r"3\.(\d+) to 3\.(\d+)", text_of(name)))
    assert told == {(low, str(int(high) - 1))}


def test_the_page_on_installing_has_every_extra_that_users_need(metadata):
    extras = set(metadata.get_all("Provides-Extra")) - {"test", "dev-without-ros"}
    page = text_of("docs/install.md")
    assert extras == set(re.findall(r"^\| `([\w-]+)` \|", page, re.MULTILINE))
