"""Builds message packages that have no wheels, on top of ROS 2's wheels.

The code generators are wheels, too. They need older libraries than the rest, so they run in a
temporary environment; cmake and a C++ compiler compile their output. Python's messages need only
the C code, so the C++ code, which takes longest to compile, is left out.
"""

import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from graphlib import CycleError, TopologicalSorter
from importlib.metadata import version
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

from nics_drl_bridge.config import read_text
from nics_drl_bridge.errors import ConfigError, shorten
from nics_drl_bridge.nodes.message_packages import Wheels

# The generators use an interface that newer versions no longer have.
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
PROGRAMS = ("cmake", "make")
FOLDERS = ("msg", "srv", "action")
NAME_ELEMENT = re.compile(r"<name>\s*([^<]*?)\s*</name>")
PACKAGE_NAME = re.compile(r"[a-z][a-z0-9_]*")
USED_PACKAGE = re.compile(r"^([a-z][a-z0-9_]*)/", re.MULTILINE)
# a type at the start of a line, with or without its package
USED_TYPE = re.compile(r"^(?:([a-z][a-z0-9_]*)/(?:msg/)?)?([A-Z]\w*)", re.MULTILINE)
BUILT_ON = re.compile(r"/opt/python/[^;\"]*?/(site-packages|include/python[0-9.]*)")
PYTHON = f"python{sys.version_info[0]}.{sys.version_info[1]}"
REASON_LINES = 3  # last lines of a failed command that are reported
# Set by the wheels' bootstrapper; in child processes they would hide the generators' libraries.
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
export PYTHONPATH={modules}"${{PYTHONPATH:+:$PYTHONPATH}}"
export LD_LIBRARY_PATH={libraries}"${{LD_LIBRARY_PATH:+:$LD_LIBRARY_PATH}}"
"""
Say = Callable[[str], None]


class Source(NamedTuple):
    """A message package to build."""

    name: str
    folder: Path  # with subfolders msg, srv and action

    def list_files(self) -> list[Path]:
        """Returns the files of its messages, services and actions."""
        return sorted(
            file for kind in FOLDERS for file in self.folder.glob(f"{kind}/*.{kind}")
        )

    def find_used_packages(self, file: Path) -> set[str]:
        """Returns the other packages whose messages a file uses."""
        used = set(USED_PACKAGE.findall(file.read_text(encoding="utf-8")))
        return used - {self.name}

    def find_used_types(self, file: Path) -> set[str]:
        """Returns the messages of this package that a file uses."""
        types = USED_TYPE.findall(file.read_text(encoding="utf-8"))
        return {name for package, name in types if package in ("", self.name)}


def read_source(folder: Path) -> Source:
    """Returns the package in a folder, named as in any package.xml. Raises ConfigError."""
    manifest = folder / "package.xml"
    name = folder.name
    if manifest.is_file():
        match = NAME_ELEMENT.search(read_text(manifest))
        name = match[1] if match else ""
    if not PACKAGE_NAME.fullmatch(name):
        fix = "set a lower-case name in its package.xml, such as my_messages"
        raise ConfigError(f"{folder}: {name!r} is not a valid package name; {fix}.")
    source = Source(name, folder)
    if not source.list_files():
        kinds = ", ".join(f"{kind}/*.{kind}" for kind in FOLDERS)
        fix = "give the folder of a package with messages"
        raise ConfigError(f"{folder}: contains none of {kinds}; {fix}.")
    return source


def sort_by_use(sources: Sequence[Source]) -> list[Source]:
    """Sorts packages so that each follows those it uses. Raises ConfigError for a cycle."""
    by_name = {source.name: source for source in sources}
    uses = {
        source.name: {
            name
            for file in source.list_files()
            for name in source.find_used_packages(file)
        }
        for source in sources
    }
    try:
        order = list(TopologicalSorter(uses).static_order())
    except CycleError as error:
        cycle = " and ".join(sorted(set(error.args[1])))
        raise ConfigError(f"{cycle} depend on each other; break the cycle.") from None
    return [by_name[name] for name in order if name in by_name]


@dataclass(frozen=True)
class Interfaces:
    """The files of a message package, divided into those that can be built and the rest."""

    name: str
    files: Sequence[Path]  # absolute
    needed: Sequence[str]  # other message packages
    # file that can't be built -> the missing package that it needs, maybe indirectly
    left_out: Mapping[str, str]


def check_programs() -> None:
    """Raises ConfigError if cmake, make or a C++ compiler is missing."""
    missing = [name for name in PROGRAMS if shutil.which(name) is None]
    packages = [*missing]
    if not any(shutil.which(name) for name in COMPILERS):
        missing.append("a C++ compiler")
        packages.append("g++")
    if missing:
        needed = "building messages needs cmake, make and a C++ compiler"
        fix = f"(Debian, Ubuntu: sudo apt install {' '.join(packages)})"
        raise ConfigError(f"{needed}; install {' and '.join(missing)} {fix}.")


def find_modules_folder(prefix: Path) -> Path:
    """Returns the folder of Python modules below a prefix."""
    return prefix / "lib" / PYTHON / "site-packages"


class Generators(AbstractContextManager["Generators", None]):
    """A temporary environment with ROS 2's code generators; the end of the block removes it."""

    def __init__(self, wheels: Wheels, say: Say) -> None:
        check_programs()
        self._folder = TemporaryDirectory(prefix="nics_messages_")
        self._work = Path(self._folder.name)
        self._prefix = self._work / "env"
        self._built = set[str]()
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
            [base, "-m", "venv", str(self._prefix)], "the environment can't be created"
        )
        pins = self._work / "pins.txt"
        lines = [f"{name}=={number}" for name, number in wheels.versions.items()]
        lines.append(f"numpy=={version('numpy')}")  # compiled against its headers
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
        """Replaces paths of the machine that built the wheels by this environment's paths."""
        include = f"{sys.base_prefix}/include/{PYTHON}"

        def here(match: re.Match[str]) -> str:
            if match[1].startswith("include"):
                return include
            return str(find_modules_folder(self._prefix))

        for file in (self._prefix / "share").rglob("*.cmake"):
            text = file.read_text(encoding="utf-8")
            if "/opt/python/" in text:
                file.write_text(BUILT_ON.sub(here, text), encoding="utf-8")

    def find_interfaces(self, source: Source) -> Interfaces:
        """Returns which files of a message package can be built. Raises ConfigError if none can."""
        files = source.list_files()
        left_out = dict[Path, str]()
        for file in files:
            for name in sorted(source.find_used_packages(file), reverse=True):
                is_there = (self._prefix / "share" / name).is_dir()
                if name not in self._built and not is_there:
                    left_out[file] = name
        _leave_out_users(source, files, left_out)
        kept = [file.resolve() for file in files if file not in left_out]
        if not kept:
            needed_files = "msg/*.msg, srv/*.srv or action/*.action"
            raise ConfigError(
                f"{source.folder}: contains no {needed_files} that can be built."
            )
        needed = {name for file in kept for name in source.find_used_packages(file)}
        if any(file.suffix == ".action" for file in kept):
            needed.add("action_msgs")
        names = {file.name: missing for file, missing in left_out.items()}
        return Interfaces(source.name, kept, sorted(needed), names)

    def build(self, interfaces: Interfaces, prefix: Path) -> None:
        """Builds a message package, and installs it below a prefix. Raises ConfigError."""
        place = self._work / interfaces.name
        write_package(interfaces, place)
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
        self._built.add(interfaces.name)
        for variable in ("AMENT_PREFIX_PATH", "CMAKE_PREFIX_PATH"):
            folders = self._environment[variable].split(os.pathsep)
            if str(prefix) not in folders:  # appended: the generators' own packages win
                folders.append(str(prefix))
                self._environment[variable] = os.pathsep.join(folders)

    def _run(self, command: Sequence[str], failed: str) -> None:
        done = subprocess.run(
            command, env=self._environment, capture_output=True, text=True
        )
        if done.returncode:
            lines = filter(str.strip, (done.stdout + done.stderr).splitlines())
            reason = shorten(" | ".join([*lines][-REASON_LINES:]), 500)
            raise ConfigError(
                f"{failed}: `{command[0]}` ended with {done.returncode}: {reason}"
            )

    def __exit__(self, *_: object) -> None:
        self._folder.cleanup()


def write_setup(prefix: Path) -> Path:
    """Writes a `setup.bash` for a prefix outside this environment, and returns its path."""
    file = prefix / "setup.bash"
    text = SETUP.format(
        modules=shlex.quote(str(find_modules_folder(prefix))),
        libraries=shlex.quote(str(prefix / "lib")),
    )
    file.write_text(text, encoding="utf-8")
    return file


def _leave_out_users(
    source: Source, files: Sequence[Path], left_out: dict[Path, str]
) -> None:
    """Leaves out files that use a left-out message, too."""
    is_complete = False
    while not is_complete:
        is_complete = True
        types = {file.stem: missing for file, missing in left_out.items()}
        for file in files:
            broken = sorted(source.find_used_types(file) & types.keys())
            if broken and file not in left_out:
                left_out[file] = types[broken[0]]
                is_complete = False


def write_package(interfaces: Interfaces, folder: Path) -> None:
    """Writes a package of messages that CMake can build."""
    names = []
    for file in interfaces.files:
        name = f"{file.parent.name}/{file.name}"
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(file, folder / name)
        names.append(name)
    needed = interfaces.needed
    lists = CMAKE_LISTS.format(
        name=interfaces.name,
        find="\n".join(f"find_package({name} REQUIRED)" for name in needed),
        files=" ".join(names),
        needed=" ".join(needed),
    )
    depend = "".join(f"<depend>{name}</depend>" for name in needed)
    manifest = PACKAGE_XML.format(name=interfaces.name, depend=depend)
    (folder / "CMakeLists.txt").write_text(lists, encoding="utf-8")
    (folder / "package.xml").write_text(manifest, encoding="utf-8")
