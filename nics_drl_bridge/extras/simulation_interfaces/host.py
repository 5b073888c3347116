"""How the services are answered by the node that offers them, and how they refuse."""

import errno
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, TypeAlias

from simulation_interfaces.msg import Result

from nics_drl_bridge.errors import BridgeError
from nics_drl_bridge.sim.entities import UnknownEntityError

if TYPE_CHECKING:
    from nics_drl_bridge.nodes.simulator_node import DeviceNode

# the device node that offers the services
Host: TypeAlias = "DeviceNode"


class RefusalError(BridgeError):
    """A request that is answered by a code of the standard and one sentence."""

    def __init__(self, code: int, sentence: str) -> None:
        super().__init__(sentence)
        self.code = code


Handler = Callable[[Any, Any], None]
ABSENT = (
    errno.ENOENT,
    errno.ENOTDIR,
    errno.EISDIR,
    errno.EACCES,
    errno.ENAMETOOLONG,
    errno.ELOOP,
)


def outcome(act: Callable[[], object], host: Host) -> tuple[int, str]:
    """Do something; return the standard's code of how it went, and a sentence if it failed."""
    try:
        act()
    except RefusalError as error:
        return error.code, str(error)
    except UnknownEntityError as error:
        return Result.RESULT_NOT_FOUND, str(error)
    except BridgeError as error:
        return Result.RESULT_OPERATION_FAILED, str(error)
    except Exception as error:  # noqa: BLE001  (the other robots and clients go on)
        if isinstance(error, OSError) and error.errno in ABSENT:
            return Result.RESULT_NOT_FOUND, str(
                BridgeError(f"{error}; check the path.")
            )
        fault = f"the simulator failed: {type(error).__name__}: {error}"
        host.get_logger().error(fault)
        return Result.RESULT_OPERATION_FAILED, " ".join(fault.split())
    return Result.RESULT_OK, ""


def served(handler: Handler, host: Host) -> Callable[[Any, Any], Any]:
    """Return a service's callback, which answers by a handler's result or refusal."""

    def reply(request: Any, response: Any) -> Any:
        code, sentence = outcome(lambda: handler(request, response), host)
        # A handler that succeeds in part has set the result itself.
        if code != Result.RESULT_OK or not response.result.result:
            response.result.result = code
        if sentence:
            response.result.error_message = sentence
        return response

    return reply
