"""Requirements of the services on the node that offers them, and how they refuse."""

import errno
from collections.abc import Callable, Sequence
from typing import Any, Protocol

from simulation_interfaces.msg import Result

from nics_drl_bridge.errors import BridgeError
from nics_drl_bridge.generator import SimulatorModel
from nics_drl_bridge.sim.device import DeviceWorld
from nics_drl_bridge.sim.entities import UnknownEntityError
from nics_drl_bridge.sim.simulator import FastSimulator
from nics_drl_bridge.sim.world_set import AnyWorld

NO_WORLD = "no world is loaded; load one by load_world first."


class Host(Protocol):
    """A device node, as `simulator_node.DeviceNode` is one."""

    device: DeviceWorld
    world: AnyWorld
    model: SimulatorModel
    paused: bool
    now_ns: int
    robot_names: tuple[str, ...]
    map_frame: str
    frames: list[Any]  # of each robot, see `device_parameters.Frames`
    context: Any

    def make_simulator(self, world: AnyWorld, robots: int) -> FastSimulator:
        """Make a simulator of a world for M robots."""

    def use_world(self, world: AnyWorld) -> None:
        """Simulate a world, with the robots that the node was started with."""

    def add_robot(self, namespace: str) -> None:
        """Open the topics of a further robot."""

    def remove_robots(self, gone: Sequence[int]) -> None:
        """Close the topics of robots."""

    def reopen_robots(self) -> None:
        """Open the topics of the robots that the node was started with, and of no other."""

    def begin(self, rewind: bool = False) -> None:
        """Begin an episode."""

    def rewind(self) -> None:
        """Put the time back to its start."""

    def step(self) -> None:
        """Move the world by one step."""

    def pause(self, paused: bool) -> None:
        """Hold time, or let it go on."""

    def get_logger(self) -> Any:
        """Return the node's logger."""


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
