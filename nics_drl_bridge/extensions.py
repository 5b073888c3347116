"""Extensions by name, in groups of entry points `nics_drl_bridge.GROUP`: `docs/extensions.md`.

Two ways lead to code. `load` takes a name, and finds it among installed entry points, and among
classes that this process was told to import: a name may come from a file of data. `import_class`
and `load_module` take `path/to/file.py:ClassName` and run that file: only for what a user typed on
the command line or passed to a Python function, never for what a file says.
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

from nics_drl_bridge.errors import MISSING_ROS, ConfigError, suggest

PACKAGE = "nics_drl_bridge"
ROS = ("rclpy", "_msgs", "std_srvs", "builtin_interfaces")
INSTALL = {  # libraries, and the extra of this package that brings each
    "filelock": "train",
    "imageio_ffmpeg": "video",
    "leapp": "leapp",
    "mcap": "bags",
    "mujoco": "mujoco",
    "onnx": "deploy",
    "onnxruntime": "deploy",
    "onnxscript": "train",
    "pettingzoo": "multi",
    "ray": "train,distributed",
    "rosbags": "bags",
    "stable_baselines3": "train",
    "tensorboard": "train",
    "torch": "train",
    "websockets": "view",
}
TRAINING = ("torch", "stable_baselines3", "tensorboard", "onnx", "onnxruntime")


@cache
def find_extensions(group: str) -> dict[str, EntryPoint]:
    """The extensions of a group by name, sorted; one of another package goes before one of ours."""
    found = entry_points(group=f"{PACKAGE}.{group}")
    ours_first = sorted(
        found, key=lambda each: (each.name, not each.value.startswith(PACKAGE))
    )
    return {each.name: each for each in ours_first}


_imported: dict[str, dict[str, type]] = {}  # group -> name -> class of a user's file


def load(group: str, name: str) -> Any:
    """An extension by group and name; ConfigError if it, or a library that it needs, is missing.

    The name is only looked up: nothing is imported that is not installed as an entry point, or was
    imported by `import_class` before.
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
    """Imports a class from `path/to/file.py:ClassName`; files may then name it `ClassName`.

    Only for a place that the user typed or passed, never for one that a file of data says.
    """
    what = group.rstrip("s")
    path, _, name = place.rpartition(":")
    found = getattr(load_module(path, what), name, None)
    if not (isinstance(found, type) and issubclass(found, base)):
        needed = f"{base.__module__.removeprefix(f'{PACKAGE}.')}.{base.__name__}"
        raise ConfigError(f"{what} kind {place!r}: is no subclass of {needed}.")
    if name in find_extensions(group):
        fix = "is installed under this name already; rename the class"
        raise ConfigError(f"{what} {place!r}: another {what} {fix}.")
    _imported.setdefault(group, {})[name] = found
    return found


@contextmanager
def require_modules(what: str) -> Iterator[None]:
    """Raises ConfigError, with the command to mend it, for a module that a block can't import."""
    try:
        yield
    except ModuleNotFoundError as error:
        raise ConfigError(f"{what} {explain_missing(error.name or '')}") from None


def explain_missing(module: str) -> str:
    """A clause about a library that is not installed, to follow the name of what needs it."""
    library = module.partition(".")[0]
    if library.endswith(ROS):
        return MISSING_ROS.format(module=module)
    if library in INSTALL:
        return (
            f"needs the module {module!r}; pip install '{PACKAGE}[{INSTALL[library]}]'."
        )
    return f"needs the module {module!r}; install it."


def find_lacking(modules: Iterable[str]) -> str | None:
    """The first of some modules that is not installed."""
    return next((module for module in modules if find_spec(module) is None), None)


def require(what: str, *modules: str) -> None:
    """Raises ConfigError, with the command to mend it, if a module that something needs is missing.

    To be asked before long work, and before an import that would fail.
    """
    if (module := find_lacking(modules)) is not None:
        raise ConfigError(f"{what} {explain_missing(module)}")


def explain_unmet(error: ImportError) -> str | None:
    """A clause about the libraries for whose lack or age an import failed; None if not for these.

    A system's own packages are often older than what this one needs, and pip was not asked.
    """
    if (error.name or "").partition(".")[0] == PACKAGE and isinstance(
        error, ModuleNotFoundError
    ):
        return None
    if wrong := dict(_find_wrong()):
        told = ", ".join(
            f"{needed} ({found or 'missing'})" for needed, found in wrong.items()
        )
        return f"needs {told}; pip install {' '.join(map(repr, wrong))}."
    return (
        explain_missing(error.name or "")
        if isinstance(error, ModuleNotFoundError)
        else None
    )


def _find_wrong() -> Iterator[tuple[str, str]]:
    """Yields each required library that is not there in a fitting version, and the version."""
    try:
        required = requires(PACKAGE) or []
    except PackageNotFoundError:  # a source tree that was never installed
        return
    for needed in (one.replace(" ", "") for one in required if ";" not in one):
        name, bounds = re.match(r"([\w.-]*)(.*)", needed).groups()  # type: ignore[union-attr]
        try:
            found = version(name)
        except PackageNotFoundError:
            found = ""
        numbers = _parse_version(found)
        for sign, bound in re.findall(r"(>=|<)([\d.]+)", bounds):
            if sign == ">=":
                fits = numbers >= _parse_version(bound)
            else:
                fits = numbers < _parse_version(bound)
            if not (found and fits):
                yield needed, found
                break


def _parse_version(release: str) -> tuple[int, ...]:
    return tuple(
        int(part) for part in re.findall(r"\d+", release.partition("+")[0])[:3]
    )


def explain_own_fault(error: BaseException) -> str | None:
    """A clause about an error that a user's own task raised, with its place; else None."""
    for frame, line in reversed(list(walk_tb(error.__traceback__))):
        task = type(frame.f_locals.get("self"))
        module = str(frame.f_globals.get("__name__"))
        if hasattr(task, "step_into") and not module.startswith(f"{PACKAGE}."):
            place = f"{frame.f_code.co_filename}:{line}, in {frame.f_code.co_name}"
            return str(
                ConfigError(f"task {task.__name__}: {place}: {error!r}; mend it.")
            )
    return None


def load_module(place: str, what: str) -> Any:
    """A module by name, or file, anew if it has changed; ConfigError if it is missing or fails."""
    if place.endswith(".py"):
        return _load(Path(place), what)
    try:
        return import_module(place)
    except (ImportError, TypeError, ValueError) as error:
        reason = f"can't be imported ({error}); give path/to/file.py:ClassName."
        raise ConfigError(f"{what} {place!r}: {reason}") from None


def _load(path: Path, what: str) -> Any:
    if not path.is_file():
        raise ConfigError(
            f"{what} {str(path)!r}: no such file; give path/to/file.py:ClassName."
        )
    digest = hashlib.sha256(
        str(path.resolve()).encode() + path.read_bytes()
    ).hexdigest()[:16]
    name = f"{PACKAGE}_{what}_{digest}"
    if name in sys.modules:
        return sys.modules[name]
    spec = spec_from_file_location(name, path)
    if spec is None or spec.loader is None:
        raise ConfigError(
            f"{what} {str(path)!r}: can't be imported; it must be a Python file."
        )
    module = sys.modules[name] = module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except BaseException as error:
        del sys.modules[name]
        if not isinstance(error, Exception):
            raise
        raise ConfigError(_explain_unfit(path, what, error)) from error
    return module


def _explain_unfit(path: Path, what: str, error: Exception) -> str:
    frames = extract_tb(error.__traceback__)
    lines = [
        frame.lineno for frame in frames if Path(frame.filename) == path.absolute()
    ]
    line = error.lineno if isinstance(error, SyntaxError) else (lines or [None])[-1]
    place = f"{path}, line {line}" if line else str(path)
    reason = " ".join(str(error).split())
    return f"{what} {place}: can't be imported ({type(error).__name__}: {reason}); mend the file."
