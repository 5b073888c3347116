"""Building of message packages over the wheels of ROS 2, which have no wheels of their own.

The generators of code are wheels, too. They are installed into an environment apart, as they need
older libraries than others do, and removed afterwards; cmake and a C++ compiler compile what they
wrote. Python's messages are C below, so that the C++ ones are left out, which would take most of
the time.
"""

import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from tempfile import TemporaryDirectory

from nics_drl_bridge.errors import ConfigError, shorten
from nics_drl_bridge.nodes.message_packages import Wheels

# Newer ones have another interface than the generators call.
EMPY = "empy==3.3.4"
LIBRARIES = ("catkin_pkg", "numpy", "setuptools<80")
ROS_TOOLS = (
    "rclpy",
    "common-interfaces",
    "rmw-fastrtps-cpp",
    "ament-package",
    "ament-cmake",
    "ament-cmake-ros",
    "ament-cmake-ros-core",
    "ament-cmake-include-directories",
    "ament-cmake-gmock",
    "ament-cmake-gtest",
    "ament-cmake-pytest",
    "rosidl-default-generators",
    "rosidl-core-generators",
    "python-cmake-module",
    "fastrtps-cmake-module",
)
COMPILERS = ("c++", "g++", "clang++")
PROGRAMS = {
    "cmake": "cmake",
    "make": "make",
}  # and the wheel, or Debian's package, of each
FOLDERS = ("msg", "srv", "action")
USED_PACKAGE = re.compile(r"^([a-z][a-z0-9_]*)/", re.MULTILINE)
BUILT_ON = re.compile(r"/opt/python/[^;\"]*?/(site-packages|include/python[0-9.]*)")
REASON_LINES = 3  # last lines of a failed command that are told
# What the wheels' bootstrapper leaves to children, where the generators' libraries must be found.
UNSET = (
    "LD_LIBRARY_PATH",
    "_ROS_WHEELS_BOOTSTRAP_COMPLETE",
    "PYTHONPATH",
    "AMENT_PREFIX_PATH",
)

CMAKE_LISTS = """\
cmake_minimum_required(VERSION 3.20)
project({name})
find_package(ament_cmake REQUIRED)
find_package(rosidl_default_generators REQUIRED)
{find}
list(FILTER AMENT_EXTENSIONS_rosidl_generate_idl_interfaces EXCLUDE REGEX "_cpp:")
rosidl_generate_interfaces({name} {files} DEPENDENCIES {needed})
ament_package()
"""
PACKAGE_XML = """\
<package format="3"><name>{name}</name><version>0.0.0</version>
<description>Messages, built over the wheels of ROS 2</description>
<maintainer email="maintainers@example.org">maintainers</maintainer>
<license>MIT</license><buildtool_depend>ament_cmake</buildtool_depend>
<buildtool_depend>rosidl_default_generators</buildtool_depend>
{depend}
<exec_depend>rosidl_default_runtime</exec_depend>
<member_of_group>rosidl_interface_packages</member_of_group>
<export><build_type>ament_cmake</build_type></export></package>
"""
SETUP = """\
export PYTHONPATH={modules}${{PYTHONPATH:+:$PYTHONPATH}}
export LD_LIBRARY_PATH={libraries}${{LD_LIBRARY_PATH:+:$LD_LIBRARY_PATH}}
"""
Say = Callable[[str], None]


@dataclass(frozen=True)
class Interfaces:
    """The files of a message package that can be built."""

    name: str
    files: Sequence[Path]  # absolute
    needed: Sequence[str]  # other message packages
    left_out: Mapping[
        str, str
    ]  # package that a file needs and that is missing, by file


def check_programs() -> None:
    """Raises ConfigError if the programs that compile are missing."""
    missing = [name for name in PROGRAMS if shutil.which(name) is None]
    packages = [PROGRAMS[name] for name in missing]
    if not any(shutil.which(name) for name in COMPILERS):
        missing.append("a C++ compiler")
        packages.append("g++")
    if missing:
        needed = "building messages needs cmake, make and a C++ compiler"
        fix = f"(Debian, Ubuntu: sudo apt install {' '.join(packages)})"
        raise ConfigError(f"{needed}; install {' and '.join(missing)} {fix}.")


def find_modules_folder(prefix: Path) -> Path:
    """Returns the folder of Python's modules below a prefix."""
    return (
        prefix
        / "lib"
        / f"python{sys.version_info[0]}.{sys.version_info[1]}"
        / "site-packages"
    )


class Generators(AbstractContextManager["Generators", None]):
    """An environment with the generators of ROS 2's code, until the block ends."""

    def __init__(self, wheels: Wheels, say: Say) -> None:
        check_programs()
        self._folder = TemporaryDirectory(prefix="nics_messages_")
        self._work = Path(self._folder.name)
        self._prefix = self._work / "env"
        self._environment = {
            k: value for k, value in os.environ.items() if k not in UNSET
        }
        say(
            "installing the generators of ROS 2 into a temporary folder, a minute or so"
        )
        try:
            self._install(wheels)
        except BaseException:
            self._folder.cleanup()
            raise

    def _install(self, wheels: Wheels) -> None:
        base = getattr(sys, "_base_executable", sys.executable)
        self._run(
            [base, "-m", "venv", str(self._prefix)], "an environment can't be made"
        )
        pins = self._work / "pins.txt"
        lines = [f"{name}=={number}" for name, number in wheels.versions.items()]
        lines.append(f"numpy=={version('numpy')}")  # whose headers are compiled against
        pins.write_text("\n".join(lines), encoding="utf-8")
        tools = [EMPY, *LIBRARIES, *(f"{wheels.prefix}{name}" for name in ROS_TOOLS)]
        python = str(self._prefix / "bin" / "python")
        pip = [python, "-m", "pip", "install", "-qq", "--disable-pip-version-check"]
        self._run([*pip, "-c", str(pins), *tools], "the generators can't be installed")
        self._name_own_folders()
        modules = find_modules_folder(self._prefix)
        self._environment["AMENT_PREFIX_PATH"] = str(self._prefix)
        self._environment["CMAKE_PREFIX_PATH"] = f"{self._prefix}{os.pathsep}{modules}"
        path = os.environ.get("PATH", os.defpath)
        self._environment["PATH"] = f"{self._prefix / 'bin'}{os.pathsep}{path}"

    def _name_own_folders(self) -> None:
        """Replaces the folders of the machine that the wheels were built on."""
        include = f"{sys.base_prefix}/include/python{sys.version_info[0]}.{sys.version_info[1]}"

        def here(match: re.Match[str]) -> str:
            return (
                include
                if match[1].startswith("include")
                else str(find_modules_folder(self._prefix))
            )

        for file in (self._prefix / "share").rglob("*.cmake"):
            text = file.read_text(encoding="utf-8")
            if "/opt/python/" in text:
                file.write_text(BUILT_ON.sub(here, text), encoding="utf-8")

    def interfaces(self, source: Path) -> Interfaces:
        """Returns what can be built of the folder of a message package. Raises ConfigError."""
        files = []
        needed = set[str]()
        left_out = {}
        for file in sorted(
            file for kind in FOLDERS for file in source.glob(f"{kind}/*.{kind}")
        ):
            used = set(USED_PACKAGE.findall(file.read_text(encoding="utf-8"))) - {
                source.name
            }
            missing = [name for name in sorted(used) if not self._has(name)]
            if missing:
                left_out[file.name] = missing[0]
                continue
            if file.suffix == ".action":
                used.add("action_msgs")
            files.append(file.resolve())
            needed |= used
        if not files:
            needed_files = "msg/*.msg, srv/*.srv or action/*.action"
            raise ConfigError(f"{source}: holds no {needed_files} that could be built.")
        return Interfaces(source.name, files, sorted(needed), left_out)

    def _has(self, package: str) -> bool:
        return (self._prefix / "share" / package).is_dir()

    def build(self, interfaces: Interfaces, prefix: Path) -> None:
        """Builds a message package and installs it below a prefix. Raises ConfigError."""
        place = self._work / interfaces.name
        names = []
        for file in interfaces.files:
            name = f"{file.parent.name}/{file.name}"
            (place / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(file, place / name)
            names.append(name)
        needed = interfaces.needed
        lists = CMAKE_LISTS.format(
            name=interfaces.name,
            find="\n".join(f"find_package({each} REQUIRED)" for each in needed),
            files=" ".join(names),
            needed=" ".join(needed),
        )
        depend = "".join(f"<depend>{each}</depend>" for each in needed)
        manifest = PACKAGE_XML.format(name=interfaces.name, depend=depend)
        (place / "CMakeLists.txt").write_text(lists, encoding="utf-8")
        (place / "package.xml").write_text(manifest, encoding="utf-8")
        python = self._prefix / "bin" / "python"
        build = str(place / "build")
        chosen = [f"-DCMAKE_INSTALL_PREFIX={prefix}", f"-DPython3_EXECUTABLE={python}"]
        failed = f"{interfaces.name} can't be built"
        self._run(
            ["cmake", "-S", str(place), "-B", build, "-DCMAKE_C_FLAGS=-O1", *chosen],
            failed,
        )
        cores = str(os.cpu_count() or 1)
        self._run(["cmake", "--build", build, "--parallel", cores], failed)
        self._run(
            ["cmake", "--install", build], f"{interfaces.name} can't be installed"
        )

    def _run(self, command: Sequence[str], failed: str) -> None:
        done = subprocess.run(
            command, env=self._environment, capture_output=True, text=True
        )
        if done.returncode:
            lines = [
                line
                for line in (done.stdout + done.stderr).splitlines()
                if line.strip()
            ]
            reason = shorten(" | ".join(lines[-REASON_LINES:]), 500)
            raise ConfigError(
                f"{failed}: `{command[0]}` ended with {done.returncode}: {reason}"
            )

    def __exit__(self, *_: object) -> None:
        self._folder.cleanup()


def write_setup(prefix: Path) -> Path:
    """Writes a file to be sourced, for a prefix that is not that of this environment."""
    file = prefix / "setup.bash"
    text = SETUP.format(modules=find_modules_folder(prefix), libraries=prefix / "lib")
    file.write_text(text, encoding="utf-8")
    return file
