"""`nics install`: message packages that ROS 2's wheels lack."""

import os
import shlex
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from typer import Argument

from nics_drl_bridge import extensions
from nics_drl_bridge.commands.console import JsonOption, print_line
from nics_drl_bridge.errors import ConfigError, suggest
from nics_drl_bridge.nodes.message_packages import find_wheels, list_shipped_packages

if TYPE_CHECKING:
    from nics_drl_bridge.commands.message_build import Source


def install(
    packages: Annotated[
        list[str],
        Argument(
            metavar="PACKAGE...",
            autocompletion=lambda incomplete: [
                name for name in list_shipped_packages() if name.startswith(incomplete)
            ],
        ),
    ],
    prefix: Path | None = None,
    as_json: JsonOption = False,
) -> None:
    """Builds message packages that are missing from ROS 2's wheels.

    Args:
        packages: tf2_msgs, ackermann_msgs, or the folder of another package with its msg, srv and
            action.
        prefix: Folder to install into, with a setup.bash to source. Default: this environment.

    Examples:
        nics install tf2_msgs
        nics install tf2_msgs --prefix messages
    """
    from nics_drl_bridge.commands.message_build import (
        Generators,
        check_programs,
        sort_by_use,
        write_setup,
    )

    sources = [find_source(name) for name in packages]
    if prefix is None:
        installed = [source.name for source in sources if is_installed(source.name)]
        for name in installed:
            print_line(
                as_json, f"{name} is already installed", package=name, prefix=None
            )
        sources = [source for source in sources if source.name not in installed]
    if not sources:
        return
    wheels = find_wheels()
    if wheels is None:
        extensions.require("nics install", "rclpy")
        name = sources[0].name
        distribution = os.environ.get("ROS_DISTRO", "DISTRO")
        debian = f"ros-{distribution}-{name.replace('_', '-')}"
        raise ConfigError(
            "nics install: ROS 2 was not installed from wheels here; install "
            f"{name} from your distribution, for example `sudo apt install {debian}`."
        )
    place = check_prefix(prefix or Path(sys.prefix))
    check_programs()
    with Generators(wheels, _tell) as generators:
        for source in sort_by_use(sources):
            interfaces = generators.find_interfaces(source)
            for file, missing in interfaces.left_out.items():
                _tell(
                    f"{source.name}: {file} is left out, because {missing} has no wheel"
                )
            _tell(f"building {source.name}")
            generators.build(interfaces, place)
            if prefix is None:
                check_import(source.name)
            line = f"{source.name} is installed in {place}"
            print_line(as_json, line, package=source.name, prefix=str(place))
    if prefix is not None:
        _tell(f"to use it: source {shlex.quote(str(write_setup(place)))}")


def find_source(name: str) -> "Source":
    """Returns a message package, shipped or in a folder. Raises ConfigError."""
    from nics_drl_bridge.commands.message_build import Source, read_source

    shipped = list_shipped_packages()
    if name in shipped:
        return Source(name, shipped[name])
    folder = Path(name)
    if folder.is_dir():
        return read_source(folder.resolve())
    fix = "or give the folder of a package with its msg, srv and action"
    raise ConfigError(
        f"unknown message package {name!r}; {suggest(name, shipped)} ({fix})."
    )


def check_prefix(prefix: Path) -> Path:
    """Creates a folder to install into and returns it. Raises ConfigError if that fails."""
    try:
        prefix.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(
            f"{prefix}: {error.strerror}; choose another place."
        ) from None
    if not os.access(prefix, os.W_OK):
        fix = "install this package into a virtual environment, or use --prefix"
        raise ConfigError(f"{prefix}: can't be written to; {fix}.")
    return prefix.resolve()


def is_installed(name: str) -> bool:
    """Returns True if a message package is installed and can be imported."""
    if find_spec(name) is None:
        return False
    try:
        check_import(name)
    except ConfigError as error:
        _tell(f"{error}; building it again")
        return False
    return True


def check_import(name: str) -> None:
    """Raises ConfigError unless a new process can use the messages of a package."""
    ask = f"import importlib as i; {name} = i.import_module('{name}.msg')\n"
    ask += "from rclpy.type_support import check_for_type_support as check\n"
    ask += f"[check(o) for o in vars({name}).values() if isinstance(o, type)]"
    done = subprocess.run([sys.executable, "-c", ask], capture_output=True, text=True)
    if done.returncode:
        reason = (done.stderr.strip().splitlines() or ["no output"])[-1]
        raise ConfigError(f"{name} is installed, but can't be imported: {reason}")


def _tell(line: str) -> None:
    typer.echo(line, err=True)
