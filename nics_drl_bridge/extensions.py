"""Extensions by name, in groups of entry points `nics_drl_bridge.GROUP`: `docs/extensions.md`.

Extensions are loaded in two ways. `load` looks a name up among installed entry points and classes
that were imported explicitly, so the name may come from a data file. `import_class` and
`load_module` take `path/to/file.py:ClassName` and run that file. They are only for
names that a user typed on the command line or passed to a Python function, never for
names from a file.
"""

import hashlib
import re
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from functools import cache
from importlib import import_module
from importlib.metadata import (
    EntryPoint,
    PackageNotFoundError,
    entry_points,
    requires,
    version,
)
from importlib.util import find_spec, module_from_spec, spec_from_file_location
from pathlib import Path
from traceback import extract_tb, walk_tb
from typing import Any

from nics_drl_bridge.errors import ConfigError, suggest

PACKAGE = "nics_drl_bridge"
ROS = ("rclpy", "_msgs", "std_srvs", "builtin_interfaces", "rcl_interfaces")
INSTALL_ROS = f"source your ROS 2 installation, or pip install '{PACKAGE}[ros]'"
# library -> the extra of this package that installs it
INSTALL = {
    "dartpy": "dart",
    "filelock": "train",
    "imageio_ffmpeg": "video",
    "leapp": "leapp",
    "mcap": "bags",
    "mujoco": "mujoco",
    "onnx": "deploy",
    "onnxruntime": "deploy",
    "onnxscript": "sb3",
    "pettingzoo": "multi",
    "ray": "sb3,train,distributed",
    "rosbags": "bags",
    "safetensors": "deploy",
    "stable_baselines3": "sb3",
    "tensorboard": "train",
    "torch": "sb3",
    "websockets": "view",
}
TRAINING = ("filelock", "tensorboard", "onnx", "onnxruntime")
SB3 = ("torch", "stable_baselines3")


@cache
def find_extensions(group: str) -> dict[str, EntryPoint]:
    """Returns the extensions of a group by name, sorted; other packages override ours."""
    points = _read_entry_points().select(group=f"{PACKAGE}.{group}")
    ours_first = sorted(
        points, key=lambda point: (point.name, not point.value.startswith(PACKAGE))
    )
    return {point.name: point for point in ours_first}


@cache
def _read_entry_points() -> Any:
    """Returns the entry points of all installed packages; reading them takes 0.1 s."""
    return entry_points()


_imported: dict[str, dict[str, type]] = {}  # group -> name -> class of a user's file


def load(group: str, name: str) -> Any:
    """Loads an extension. Raises ConfigError if it or a library that it needs is missing.

    The name is only looked up: the extension must be installed as an entry point, or have been
    imported by `import_class`.
    """
    imported = _imported.get(group, {})
    if name in imported:
        return imported[name]
    extensions = find_extensions(group)
    if name not in extensions:
        names = (*extensions, *imported)
        raise ConfigError(
            f"unknown {group.rstrip('s')} {name!r}; {suggest(name, names)}"
        )
    with require_modules(f"{group.rstrip('s')} {name!r}"):
        return extensions[name].load()


def import_class(group: str, place: str, base: type) -> type:
    """Imports a class from `path/to/file.py:ClassName`; data files may then name `ClassName`.

    The place must come from the user, never from a data file.
    """
    kind = group.rstrip("s")
    path, _, name = place.rpartition(":")
    if not path:
        raise ConfigError(f"{kind} {place!r}: give path/to/file.py:ClassName.")
    loaded = getattr(load_module(path, kind), name, None)
    if not (isinstance(loaded, type) and issubclass(loaded, base)):
        needed = f"{base.__module__.removeprefix(f'{PACKAGE}.')}.{base.__name__}"
        raise ConfigError(f"{kind} kind {place!r}: is not a subclass of {needed}.")
    if name in find_extensions(group):
        fix = "is already installed under this name; rename the class"
        raise ConfigError(f"{kind} {place!r}: another {kind} {fix}.")
    _imported.setdefault(group, {})[name] = loaded
    return loaded


@contextmanager
def require_modules(user: str) -> Iterator[None]:
    """Converts the import error of a missing module to a ConfigError with the install command."""
    try:
        yield
    except ModuleNotFoundError as error:
        if (error.name or "").partition(".")[0] == PACKAGE:
            raise
        raise ConfigError(f"{user} {explain_missing(error.name or '')}") from None


def explain_missing(module: str) -> str:
    """Returns a clause about a missing library, to be appended to the name of its user."""
    library = module.partition(".")[0]
    if library.endswith(ROS):
        fix = INSTALL_ROS
    elif library in INSTALL:
        fix = f"pip install '{PACKAGE}[{INSTALL[library]}]'"
    else:
        fix = "install it"
    return f"needs the module {module!r}; {fix}."


def find_lacking(modules: Iterable[str]) -> str | None:
    """Returns the first module that is not installed, or None."""
    return next((module for module in modules if find_spec(module) is None), None)


def require(user: str, *modules: str) -> None:
    """Raises ConfigError, with the command to install it, if `user` lacks a module.

    Call it before long work, and before an import that would fail.
    """
    module = find_lacking(modules)
    if module is not None:
        raise ConfigError(f"{user} {explain_missing(module)}")


def explain_unmet(error: ImportError) -> str | None:
    """Returns a clause about missing or outdated libraries if they made an import fail, else None.

    System packages are often older than this package needs.
    """
    if (error.name or "").partition(".")[0] == PACKAGE and isinstance(
        error, ModuleNotFoundError
    ):
        return None
    unmet = dict(_find_wrong())
    if unmet:
        requirements = ", ".join(
            f"{needed} ({installed or 'missing'})"
            for needed, installed in unmet.items()
        )
        return f"needs {requirements}; pip install {' '.join(map(repr, unmet))}."
    return (
        explain_missing(error.name or "")
        if isinstance(error, ModuleNotFoundError)
        else None
    )


def _find_wrong() -> Iterator[tuple[str, str]]:
    """Yields each requirement that is not met, with the installed version, if any."""
    try:
        required = requires(PACKAGE) or []
    except PackageNotFoundError:  # a source tree that was never installed
        return
    for line in required:
        requirement = line.replace(" ", "")
        if ";" in requirement:  # belongs to an extra
            continue
        name, bounds = re.match(r"([\w.-]*)(.*)", requirement).groups()  # type: ignore[union-attr]
        try:
            installed = version(name)
        except PackageNotFoundError:
            installed = ""
        numbers = _parse_version(installed)
        for sign, bound in re.findall(r"(>=|<)([\d.]+)", bounds):
            if sign == ">=":
                fits = numbers >= _parse_version(bound)
            else:
                fits = numbers < _parse_version(bound)
            if not (installed and fits):
                yield requirement, installed
                break


def _parse_version(release: str) -> tuple[int, ...]:
    return tuple(
        int(part) for part in re.findall(r"\d+", release.partition("+")[0])[:3]
    )


def explain_own_fault(error: BaseException) -> str | None:
    """Returns a sentence about an error raised in a user's own task, with its place; else None."""
    for frame, line in reversed(list(walk_tb(error.__traceback__))):
        task = type(frame.f_locals.get("self"))
        module = str(frame.f_globals.get("__name__"))
        if hasattr(task, "step_into") and not module.startswith(f"{PACKAGE}."):
            place = f"{frame.f_code.co_filename}:{line}, in {frame.f_code.co_name}"
            return str(
                ConfigError(
                    f"task {task.__name__}: {place}: {error!r}; correct the task."
                )
            )
    return None


def load_module(place: str, kind: str) -> Any:
    """Imports a module by name or file; reimports a changed file. Raises ConfigError."""
    if place.endswith(".py"):
        return _load(Path(place), kind)
    try:
        return import_module(place)
    except (ImportError, TypeError, ValueError) as error:
        reason = f"can't be imported ({error}); give path/to/file.py:ClassName."
        raise ConfigError(f"{kind} {place!r}: {reason}") from None


def _load(path: Path, kind: str) -> Any:
    if not path.is_file():
        raise ConfigError(
            f"{kind} {str(path)!r}: no such file; give path/to/file.py:ClassName."
        )
    digest = hashlib.sha256(
        str(path.resolve()).encode() + path.read_bytes()
    ).hexdigest()[:16]
    name = f"{PACKAGE}_{kind}_{digest}"
    if name in sys.modules:
        return sys.modules[name]
    spec = spec_from_file_location(name, path)
    if spec is None or spec.loader is None:
        raise ConfigError(
            f"{kind} {str(path)!r}: can't be imported; it must be a Python file."
        )
    module = sys.modules[name] = module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except BaseException as error:
        del sys.modules[name]
        if not isinstance(error, Exception):
            raise
        raise ConfigError(_explain_unfit(path, kind, error)) from error
    return module


def _explain_unfit(path: Path, kind: str, error: Exception) -> str:
    frames = extract_tb(error.__traceback__)
    lines = [
        frame.lineno for frame in frames if Path(frame.filename) == path.absolute()
    ]
    line = error.lineno if isinstance(error, SyntaxError) else (lines or [None])[-1]
    place = f"{path}, line {line}" if line else str(path)
    reason = " ".join(str(error).split())
    return f"{kind} {place}: can't be imported ({type(error).__name__}: {reason}); correct it."
