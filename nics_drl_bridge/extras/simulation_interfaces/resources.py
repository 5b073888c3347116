"""Resources of the standard: what a URI or a text is, and where it is read."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import unquote, urlsplit

from simulation_interfaces.msg import Result, SpawnResult
from simulation_interfaces.srv import LoadWorld

from nics_drl_bridge.config import read_text
from nics_drl_bridge.errors import ConfigError, MissingFileError
from nics_drl_bridge.extras.simulation_interfaces.host import RefusalError
from nics_drl_bridge.sim.sdf import AssetsError
from nics_drl_bridge.sim.world_set import SPECIAL

SDF = "sdf"
YAML = "yaml"
SUFFIXES = {".sdf": SDF, ".world": SDF, ".yaml": YAML, ".yml": YAML}
MOST_BYTES = 2**24


# A service's message whose constants are its codes for resources that it can't use.
Codes = type[SpawnResult] | type[LoadWorld.Response]


@contextmanager
def refused(codes: Codes) -> Iterator[None]:
    """Within this context, a resource that can't be used raises RefusalError with its code."""
    try:
        yield
    except AssetsError as error:
        code = codes.MISSING_ASSETS if error.missing else codes.UNSUPPORTED_ASSETS
        raise RefusalError(code, str(error)) from None
    except MissingFileError as error:
        raise RefusalError(codes.MISSING_ASSETS, str(error)) from None
    except ConfigError as error:
        raise RefusalError(codes.RESOURCE_PARSE_ERROR, str(error)) from None


class Content(NamedTuple):
    """A resource that is there."""

    form: str  # SDF or YAML; empty for a name
    text: str  # empty for a name
    source: str  # a path, a name, or `resource_string`
    path: Path | None = None


def local(uri: str) -> Path | None:
    """Return the path that a URI or a plain path means; None if it is elsewhere."""
    try:
        parts = urlsplit(uri)
    except ValueError:  # of a host that is none
        return None
    if parts.scheme == "file" and parts.netloc in ("", "localhost"):
        uri = unquote(parts.path)
    return Path(uri) if uri and "://" not in uri else None


def find(resource: Any, codes: Codes) -> Content:
    """Return a resource, whose URI goes before its text. Raises RefusalError."""
    if resource.uri:
        return _of_uri(resource.uri, codes)
    text = resource.resource_string
    if not text.strip():
        fault = "both uri and resource_string are empty; give one of them."
        raise RefusalError(codes.NO_RESOURCE, fault)
    if text.lstrip("\ufeff \t\r\n").startswith(("<", "#usda")):
        if "<sdf" not in text:
            fault = "the resource_string is XML or USD, but no SDF; give SDF or YAML."
            raise RefusalError(codes.UNSUPPORTED_FORMAT, fault)
        return Content(SDF, text, "resource_string")
    return Content(YAML, text, "resource_string")


def _of_uri(uri: str, codes: Codes) -> Content:
    path = local(uri)
    if path is None:
        fault = f"uri {uri!r}: is not on this machine; give file:// or a path."
        raise RefusalError(codes.UNSUPPORTED_FORMAT, fault)
    suffix = path.suffix.lower()
    named = path.is_dir() or (
        any(sign in uri for sign in SPECIAL) and not path.is_file()
    )
    if named or not suffix:
        return Content("", "", str(path), path)
    if suffix not in SUFFIXES:
        fault = f"uri {uri!r}: is none of {', '.join(SUFFIXES)}; convert it."
        raise RefusalError(codes.UNSUPPORTED_FORMAT, fault)
    if not path.is_file():
        fault = f"uri {uri!r}: no such file; check the path on the simulator's machine."
        raise RefusalError(Result.RESULT_NOT_FOUND, fault)
    try:
        return Content(SUFFIXES[suffix], read_text(path, MOST_BYTES), str(path), path)
    except ConfigError as error:
        raise RefusalError(codes.RESOURCE_PARSE_ERROR, str(error)) from None
