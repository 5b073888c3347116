"""A release as a user gets it: wheel and source archive, in an environment of their own."""

from __future__ import annotations

import io
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).resolve().parents[1]
OF_OTHERS = (
    "PYTHONPATH",
    "VIRTUAL_ENV",
    "LD_LIBRARY_PATH",
    "_ROS_WHEELS_BOOTSTRAP_COMPLETE",
)
INSTRUCTIONS = {"FROM", "WORKDIR", "COPY", "RUN", "ENTRYPOINT", "CMD"}


def text_of(name: str) -> str:
    return (ROOT / name).read_text(encoding="utf-8")


def run(*command: str | Path, cwd: Path) -> str:
    """Runs a command away from this repository; what it printed is returned, or shown."""
    clean = {key: value for key, value in os.environ.items() if key not in OF_OTHERS}
    done = subprocess.run(
        [str(word) for word in command],
        cwd=cwd,
        env=clean,
        text=True,
        timeout=1700,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
    )
    assert done.returncode == 0, (
        f"{command} ended with {done.returncode}:\n{done.stdout}"
    )
    return done.stdout


@pytest.fixture(scope="module")
def dist(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the source archive, and the wheel that is made of it."""
    folder = tmp_path_factory.mktemp("dist")
    run(
        sys.executable,
        "-m",
        "build",
        "--no-isolation",
        "--outdir",
        folder,
        ROOT,
        cwd=folder,
    )
    return folder


@pytest.mark.process
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("kind", ["*.whl", "*.tar.gz"])
def test_a_release_runs_the_demo_outside_of_the_repository(dist, kind, tmp_path):
    archive = next(dist.glob(kind))
    uv = Path(sys.executable).with_name("uv")
    python = tmp_path / "venv" / "bin" / "python"
    run(uv, "venv", "--python", sys.executable, tmp_path / "venv", cwd=tmp_path)
    install = (
        uv,
        "pip",
        "install",
        "--python",
        python,
        "--constraints",
        ROOT / "constraints.txt",
    )
    run(*install, f"{archive}[ros,deploy]", cwd=tmp_path)
    where = run(
        python, "-c", "import nics_drl_bridge as n; print(n.__file__)", cwd=tmp_path
    )
    assert str(tmp_path) in where
    words = ["demo", "--policy", "differential", "--episodes", "2", "--out", "demo"]
    told = run(python.with_name("nics"), *words, cwd=tmp_path)
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


@pytest.mark.process
@pytest.mark.timeout(3600)
def test_a_wheel_with_machine_code_compiles_nothing_and_gives_the_same_bits(tmp_path):
    from nics_drl_bridge.kernels import TARGET, runs_target

    if not runs_target():
        pytest.skip(f"this machine does not run {TARGET}")
    made = (f"WHEEL={tmp_path / 'made'}", f"DIST={tmp_path}")
    run("make", "--old-file", "setup", "wheel", *made, cwd=ROOT)
    uv = Path(sys.executable).with_name("uv")
    python = tmp_path / "venv" / "bin" / "python"
    run(uv, "venv", "--python", sys.executable, tmp_path / "venv", cwd=tmp_path)
    install = (uv, "pip", "install", "--compile-bytecode", "--python", python)
    pins = ("--constraints", ROOT / "constraints.txt")
    run(*install, *pins, next(tmp_path.glob("*.whl")), cwd=tmp_path)
    spent_s, compiled, digest = run(python, "-c", FIRST_STEPS, cwd=tmp_path).split()
    assert int(compiled) == 0
    assert float(spent_s) < 5.0  # of CPU, a twentieth of what compiling takes
    from_source = run(sys.executable, "-c", FIRST_STEPS, cwd=tmp_path).split()
    assert digest == from_source[-1]


def test_the_container_file_copies_what_there_is_and_runs_what_is_installed():
    parser = pytest.importorskip(
        "dockerfile_parse", reason="needs dockerfile-parse of `test`"
    )
    file = io.BytesIO((ROOT / "Containerfile").read_bytes())
    every = parser.DockerfileParser(fileobj=file).structure
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
    extras = re.findall(r'^    "([a-z-]+)": \[', text_of("setup.py"), re.MULTILINE)
    assert set(asked[1].split(",")) <= set(extras)
    assert dict(lines)["ENTRYPOINT"] == '["nics"]'


def test_the_citation_has_the_version_of_the_package_and_what_its_format_needs():
    citation = yaml.safe_load(text_of("CITATION.cff"))
    assert {"cff-version", "message", "title", "authors"} <= set(citation)
    assert all(one["authors"] for one in (citation, *citation["references"]))
    (version,) = re.findall("<version>(.*)</version>", text_of("package.xml"))
    assert citation["version"] == version
    assert f"{citation['license']}" in text_of("LICENSE")
