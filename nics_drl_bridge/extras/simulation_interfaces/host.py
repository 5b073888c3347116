"""How the services are answered by the node that offers them, and how they refuse."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias
from urllib.parse import unquote, urlsplit

from simulation_interfaces.msg import Result, SpawnResult
from simulation_interfaces.srv import LoadWorld

from nics_drl_bridge.errors import (
    BridgeError,
    ConfigError,
    MissingFileError,
    UnknownNameError,
)
from nics_drl_bridge.extras.simulation_interfaces.roster import UnknownEntityError
from nics_drl_bridge.sim.sdf import AssetsError

if TYPE_CHECKING:
    from nics_drl_bridge.nodes.simulator_node import DeviceNode

# the device node that offers the services
Host: TypeAlias = "DeviceNode"
Handler = Callable[[Any, Any], None]
# A service's message whose constants are its codes for resources that it can't use.
Codes = type[SpawnResult] | type[LoadWorld.Response]


class RefusalError(BridgeError):
    """A request that is answered by a code of the standard and one sentence."""

    def __init__(self, code: int, sentence: str) -> None:
        super().__init__(sentence)
        self.code = code


def served(handler: Handler, host: Host) -> Callable[[Any, Any], Any]:
    """Return a service's callback, which answers whether a handler succeeds or why it does not."""

    def reply(request: Any, response: Any) -> Any:
        code = Result.RESULT_OPERATION_FAILED
        sentence = ""
        try:
            handler(request, response)
            code = Result.RESULT_OK
        except RefusalError as error:
            code = error.code
            sentence = str(error)
        except UnknownEntityError as error:
            code = Result.RESULT_NOT_FOUND
            sentence = str(error)
        except OSError as error:
            code = Result.RESULT_NOT_FOUND
            sentence = str(BridgeError(f"{error}; check the path."))
        except BridgeError as error:
            sentence = str(error)
        except Exception as error:  # noqa: BLE001  (the other robots and clients go on)
            fault = f"the simulator failed: {type(error).__name__}: {error}"
            host.get_logger().error(fault)
            sentence = " ".join(fault.split())
        response.result.result = code
        response.result.error_message = sentence
        return response

    return reply


def find_local_path(uri: str, codes: Codes, formats: tuple[str, ...]) -> Path:
    """Return the path that a URI or a plain path means, or a name. Raises RefusalError."""
    fault = "is not on this machine; give file:// or a path"
    place = uri
    try:
        parts = urlsplit(uri)
    except ValueError:  # of a host that is none
        parts = None
    if parts and parts.scheme == "file" and parts.netloc in ("", "localhost"):
        place = unquote(parts.path)
    path = Path(place)
    if parts and "://" not in place:
        if path.suffix in ("", *formats) or path.is_dir():
            return path
        fault = f"is none of {', '.join(formats)}; convert it"
    raise RefusalError(codes.UNSUPPORTED_FORMAT, f"uri {uri!r}: {fault}.")


@contextmanager
def refused(codes: Codes) -> Iterator[None]:
    """Within this context, a resource that can't be used raises RefusalError with its code."""
    try:
        yield
    except AssetsError as error:
        code = codes.MISSING_ASSETS if error.missing else codes.UNSUPPORTED_ASSETS
        raise RefusalError(code, str(error)) from None
    except (MissingFileError, UnknownNameError) as error:
        raise RefusalError(Result.RESULT_NOT_FOUND, str(error)) from None
    except ConfigError as error:
        raise RefusalError(codes.RESOURCE_PARSE_ERROR, str(error)) from None
