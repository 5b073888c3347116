"""Environments apart from .venv, for what conflicts with it; `nox --list` shows them.

`make setup` installs nox, so `.venv/bin/nox -s jazzy` runs one of them, and words after `--` go to
pytest. Environments lie in .nox and are used again.
"""

import os
import platform
import shutil
import sys
from pathlib import Path

import nox

nox.options.default_venv_backend = "uv"
nox.options.reuse_venv = "yes"

ROOT = Path(__file__).resolve().parent
# Archives of repositories without wheels.
UPSTREAM = Path(os.environ.get("UPSTREAM", ROOT.parent / "shared" / "upstream"))
CAMPAIGN = "test/campaigns/test_campaigns.py::test_the_short_form_meets_all_bars"
MESSAGES = ROOT / ".nox" / "message_packages"
# The ROS wheels restart Python with these variables; the Python of another environment would load
# the wrong libraries by them.
OF_ROS_WHEELS = ("_ROS_WHEELS_BOOTSTRAP_COMPLETE", "LD_LIBRARY_PATH")


@nox.session
def jazzy(session: nox.Session) -> None:
    """Run the node tests on the wheels of ROS 2 Jazzy."""
    require_wheels(session)
    wheels = (
        "ros-jazzy-rclpy",
        "ros-jazzy-common-interfaces",
        "ros-jazzy-rmw-fastrtps-cpp",
    )
    # The wheels of another distribution have the same names as those in constraints.txt.
    constraints = write_constraints(session, left_out="ros-")
    install(
        session, constraints, ".[bags,dart,deploy,mujoco,multi,test]", "onnx", *wheels
    )
    session.run("pytest", *(session.posargs or ["test/nodes"]))


@nox.session
def ray(session: nox.Session) -> None:
    """Train on a Ray cluster of two nodes on this machine."""
    pins = (ROOT / "constraints-ray.txt").read_text(encoding="utf-8")
    # RLlib pins its own version of Gymnasium.
    constraints = write_constraints(session, left_out="gymnasium==", added=pins)
    install(session, constraints, ".[deploy,distributed,sb3,test,train]")
    tests = ["test/extras/ray/test_engine.py", "test/policy/test_train_vec_env.py"]
    session.run("pytest", *(session.posargs or tests))


@nox.session(venv_backend="none")
def messages(session: nox.Session) -> None:
    """Build message packages without wheels, and run the tests that need them in .venv."""
    build_messages(session)
    tests = [
        "test/nodes/test_simulator_node.py",
        "test/nodes/simulation_interfaces",
        "test/nodes/test_frames.py",
        "test/campaigns/test_parts.py",
        f"{CAMPAIGN}[nav2_standards]",
        f"{CAMPAIGN}[standards]",
    ]
    run_sourced(
        session, MESSAGES, sys.executable, "-m", "pytest", *(session.posargs or tests)
    )


@nox.session
def upstream(session: nox.Session) -> None:
    """Run this package under the real `ros2 run`, `ros2 launch` and more, built by colcon."""
    require_wheels(session)
    if not (UPSTREAM / "launch_ros.tar.gz").exists():
        needed = "the sources of launch, launch_ros and ros2cli"
        session.skip(f"needs {needed} in {UPSTREAM} (or UPSTREAM=folder)")
    build_messages(session)
    constraints = write_constraints(session)
    extras = "bags,dart,deploy,mujoco,multi,ros,test"
    install(session, constraints, f".[{extras}]", "osrf-pycommon", "psutil", "pip")
    session.run("uv", "pip", "uninstall", "nics_drl_bridge")  # colcon installs it
    folder = session.virtualenv.location
    session.run(
        "test/install_upstream_tools.sh",
        folder,
        str(UPSTREAM),
        str(MESSAGES),
        external=True,
    )
    tests = ["test/upstream", "test/nodes/test_launching.py"]
    run_sourced(
        session, Path(folder), "python", "-m", "pytest", *(session.posargs or tests)
    )


@nox.session
def clients(session: nox.Session) -> None:
    """Let other DDS clients, without ROS 2, read a simulator and drive it."""
    session.install("cyclonedds==11.0.1", "rosless==0.5.0")
    session.run(
        sys.executable,
        "-m",
        "pytest",
        "test/nodes/test_other_clients.py",
        *session.posargs,
        env={"OTHER_CLIENTS_PYTHON": f"{session.bin}/python"},
        external=True,
    )


@nox.session
def ament(session: nox.Session) -> None:
    """Run the ament linters, with the plugins that they expect."""
    session.install("--no-deps", "ros-ament-flake8", "ros-ament-lint", "ament-xmllint")
    plugins = "blind-except builtins class-newline comprehensions deprecated docstrings"
    names = [f"flake8-{name}" for name in f"{plugins} import-order quotes".split()]
    session.install("flake8", "setuptools", *names)
    session.run("ament_flake8", "--config", "setup.cfg")
    if shutil.which("xmllint") is None:
        session.warn("ament_xmllint is left out: install xmllint (apt: libxml2-utils)")
        return
    # It skips package.xml, because it would fetch the schema from the network.
    session.run("ament_xmllint", "launch", "config", "nics_drl_bridge")


def require_wheels(session: nox.Session) -> None:
    """Skip the session where ROS 2 can't come from wheels."""
    is_built_for = sys.platform == "linux" and platform.machine() == "x86_64"
    if not is_built_for or "AMENT_PREFIX_PATH" in os.environ:
        session.skip("needs Linux on x86-64 and a shell without a sourced ROS 2")


def write_constraints(session: nox.Session, left_out: str = "", added: str = "") -> str:
    """Return a file with the pins of .venv, but for those whose names begin like `left_out`."""
    lines = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    if left_out:
        lines = [line for line in lines if not line.startswith(left_out)]
    file = Path(session.virtualenv.location) / "constraints.txt"
    file.write_text("\n".join([*lines, added]), encoding="utf-8")
    return str(file)


def install(session: nox.Session, constraints: str, *packages: str) -> None:
    """Install packages, the first of them as editable."""
    options = ("--constraints", constraints)
    session.install(*options, "setuptools")
    session.install(*options, "--no-build-isolation", "--editable", *packages)
    for name in OF_ROS_WHEELS:
        session.env[name] = None


def build_messages(session: nox.Session) -> None:
    """Build the message packages into `MESSAGES`, unless they are newer than their sources."""
    require_wheels(session)
    built = MESSAGES / "setup.bash"
    sources = [
        ROOT / "test" / "build_messages.sh",
        ROOT / "nics_drl_bridge" / "commands" / "message_build.py",
        *ROOT.glob("config/messages/*/msg/*.msg"),
        *UPSTREAM.glob("*_interfaces.tar.gz"),
    ]
    changed_s = max(source.stat().st_mtime for source in sources)
    if built.exists() and built.stat().st_mtime > changed_s:
        return
    nics = Path(sys.executable).with_name("nics")
    session.run(
        "test/build_messages.sh",
        str(nics),
        str(MESSAGES),
        str(UPSTREAM),
        env=dict.fromkeys(OF_ROS_WHEELS),
        external=True,
    )


def run_sourced(session: nox.Session, folder: Path, *command: str) -> None:
    """Run a command after `setup.bash` of a folder."""
    session.run(
        "bash",
        "-c",
        'source "$0" && exec "$@"',
        str(folder / "setup.bash"),
        *command,
        env=dict.fromkeys(OF_ROS_WHEELS),
        external=True,
    )
