"""Environments of their own for other projects: they conflict with each other and with ours."""

import os
import shutil
import subprocess
import sys
import time
import venv
from pathlib import Path

CACHE = (
    Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "nics_drl_bridge"
)
INSTALL_S = 600.0
NEWCOMER_S = 1800.0
OF_OUR_OWN = (
    "LD_LIBRARY_PATH",
    "_ROS_WHEELS_BOOTSTRAP_COMPLETE",
    "PYTHONPATH",
    "PYTHONHOME",
)
"""Variables that would load our libraries into the other environment."""


class NotInstalledError(Exception):
    """A project can't be installed here; the text says why."""


def clean() -> dict[str, str]:
    """The environment variables for a program of another environment."""
    kept = {name: value for name, value in os.environ.items() if name not in OF_OUR_OWN}
    return {
        **kept,
        "MPLBACKEND": "Agg",
        "OMP_NUM_THREADS": "1",
        "OPENBLAS_NUM_THREADS": "1",
    }


def inherit_for_newcomer(folder: Path) -> dict[str, str]:
    """Returns the environment variables of a user who has installed nothing of ours yet.

    Temporary files go into the folder. The ROS 2 wheels set variables that would lead child
    processes to wrong libraries.
    """
    left_out = {*OF_OUR_OWN, "VIRTUAL_ENV", "MAKEFLAGS"}
    if "ROS_DISTRO" in os.environ:
        left_out -= {"LD_LIBRARY_PATH", "PYTHONPATH"}
    kept = {name: value for name, value in os.environ.items() if name not in left_out}
    return kept | {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST", "TMPDIR": str(folder)}


def wait_for(
    command: list[str], folder: Path, environment: dict[str, str]
) -> tuple[float, str]:
    """Runs a command that must not fail; returns how long it took [s] and what it printed."""
    begin = time.monotonic()
    done = subprocess.run(
        command,
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        timeout=NEWCOMER_S,
    )
    if done.returncode:
        end = done.stderr[-2000:]
        raise RuntimeError(f"{' '.join(command)} ended with {done.returncode}:\n{end}")
    return time.monotonic() - begin, done.stdout


def python_with(name: str, requirements: tuple[str, ...]) -> Path:
    """The interpreter of a cached environment that holds the requirements.

    It is made at first use and whenever the requirements change.

    Raises:
        NotInstalledError: pip could not install them.
    """
    folder = CACHE / f"{name}-py{sys.version_info[0]}.{sys.version_info[1]}"
    python = folder / "bin" / "python"
    ready = folder / ".ready"
    wanted = "\n".join(requirements)
    if ready.is_file() and ready.read_text() == wanted:
        return python
    sys.stderr.write(f"Installing {', '.join(requirements)} into {folder}.\n")
    shutil.rmtree(folder, ignore_errors=True)
    command = [str(python), "-m", "pip", "install", "-q", "--disable-pip-version-check"]
    try:
        venv.create(folder, with_pip=True)
        subprocess.run(
            [*command, *requirements],
            env=clean(),
            check=True,
            capture_output=True,
            text=True,
            timeout=INSTALL_S,
        )
    except (OSError, subprocess.SubprocessError) as error:
        shutil.rmtree(folder, ignore_errors=True)
        said = getattr(error, "stderr", None) or str(error)
        last = str(said).strip().splitlines()[-1:] or ["no message"]
        raise NotInstalledError(f"{name} can't be installed: {last[0]}") from None
    ready.write_text(wanted)
    return python
