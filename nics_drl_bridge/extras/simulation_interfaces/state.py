"""The simulation: playing, paused, stopped; its steps, resets, and worlds.

Its services are answered by the node that offers them, with a code of the standard.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias
from urllib.parse import unquote, urlsplit

from simulation_interfaces.msg import (
    Resource,
    Result,
    SimulationState,
    SpawnResult,
    WorldResource,
)
from simulation_interfaces.srv import LoadWorld, ResetSimulation, SetSimulationState

from nics_drl_bridge.errors import (
    BridgeError,
    ConfigError,
    MissingFileError,
    UnknownNameError,
)
from nics_drl_bridge.extras.simulation_interfaces.roster import Entities
from nics_drl_bridge.nodes import runner
from nics_drl_bridge.sim.sdf import AssetsError
from nics_drl_bridge.sim.world_set import SPECIAL, load_worlds

if TYPE_CHECKING:
    from nics_drl_bridge.nodes.simulator_node import DeviceNode

STOPPED = SimulationState.STATE_STOPPED
PLAYING = SimulationState.STATE_PLAYING
PAUSED = SimulationState.STATE_PAUSED
QUITTING = SimulationState.STATE_QUITTING
NAMES = {STOPPED: "stopped", PLAYING: "playing", PAUSED: "paused", QUITTING: "quitting"}
MOST_STEPS = 100_000  # of one call of a service, which answers nothing else meanwhile
GOODBYE_S = 0.2  # until the answer to who ended the simulation has left
SCOPES = ResetSimulation.Request
EVERY_SCOPE = SCOPES.SCOPE_TIME | SCOPES.SCOPE_STATE | SCOPES.SCOPE_SPAWNED
CODES = LoadWorld.Response

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
        code = Result.RESULT_OK
        sentence = ""
        try:
            handler(request, response)
        except BridgeError as error:
            code = getattr(error, "code", Result.RESULT_OPERATION_FAILED)
            sentence = str(error)
        except OSError as error:
            code = Result.RESULT_NOT_FOUND
            sentence = str(BridgeError(f"{error}; check the path."))
        except Exception as error:  # noqa: BLE001  (the other robots and clients go on)
            code = Result.RESULT_OPERATION_FAILED
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


class Simulation:
    """The state of a device node's simulation, and the services around it."""

    def __init__(self, host: Host) -> None:
        self._host = host
        self._halted = STOPPED  # or paused, or quitting, while the host is paused
        self._resource = Resource(uri=runner.get_text(host, "world"))
        self._list_entities()

    def _list_entities(self) -> None:
        """List the entities of a world that the host begins to simulate."""
        host = self._host
        self.entities = Entities(
            host.device, host.world, host.robot_names, host.make_simulator
        )

    @property
    def state(self) -> int:
        """Constant of SimulationState; who pauses the node by its own service pauses it too."""
        if not self._host.paused:
            self._halted = PAUSED
            return int(PLAYING)
        return int(self._halted)

    def _halt(self, state: int) -> None:
        """Hold the simulation in a state other than playing."""
        self._host.pause(True)
        self._halted = state

    def get_state(self, _: Any, response: Any) -> None:
        """Answer GetSimulationState."""
        response.state.state = self.state

    def set_state(self, request: Any, _: Any) -> None:
        """Answer SetSimulationState."""
        codes = SetSimulationState.Response
        wanted = request.state.state
        state = self.state
        if wanted == state:
            already = f"the simulation is {NAMES[state]} already."
            raise RefusalError(codes.ALREADY_IN_TARGET_STATE, already)
        if wanted not in NAMES:
            states = ", ".join(f"{value} ({name})" for value, name in NAMES.items())
            fault = f"state {wanted} can't be set; choose one of {states}."
            raise RefusalError(codes.INCORRECT_TRANSITION, fault)
        if wanted == QUITTING:
            runner.call_periodically(
                self._host, GOODBYE_S, self._host.context.try_shutdown
            )
        if wanted == STOPPED:
            try:
                self._reset_all()
            except BridgeError as error:
                self._halt(PAUSED)
                fault = f"it did not stop: {error}"
                raise RefusalError(codes.STATE_TRANSITION_ERROR, fault) from None
        if wanted == PLAYING:
            self._host.pause(False)
        else:
            self._halt(wanted)

    def step(self, request: Any, _: Any) -> None:
        """Answer StepSimulation."""
        problem = ""
        if self.state != PAUSED:
            problem = "the simulation is not paused; set its state to paused first."
        elif not 1 <= request.steps <= MOST_STEPS:
            problem = f"steps is {request.steps}; ask for 1 to {MOST_STEPS}."
        if problem:
            raise RefusalError(Result.RESULT_OPERATION_FAILED, problem)
        for _ in range(request.steps):
            self._host.step()

    def reset(self, request: Any, _: Any) -> None:
        """Answer ResetSimulation."""
        scope = request.scope or SCOPES.SCOPE_ALL
        if not scope & EVERY_SCOPE or (
            scope & ~EVERY_SCOPE and scope != SCOPES.SCOPE_ALL
        ):
            fault = (
                f"scope {scope} has bits that mean nothing; add up 1 (time), 2 (state) and 4 "
                "(spawned), or give 0 for all."
            )
            raise RefusalError(Result.RESULT_FEATURE_UNSUPPORTED, fault)
        if scope & EVERY_SCOPE == EVERY_SCOPE:
            self._reset_all()
            return
        if scope & SCOPES.SCOPE_SPAWNED:
            if set(self.entities.robot_names) <= self.entities.spawned.keys():
                fault = "a simulator needs a robot, and all were spawned; reset all, by scope 0."
                raise RefusalError(Result.RESULT_OPERATION_FAILED, fault)
            for name in tuple(self.entities.spawned):
                self.remove(name)
        if scope & SCOPES.SCOPE_STATE:
            self._host.begin(rewind=bool(scope & SCOPES.SCOPE_TIME))
        elif scope & SCOPES.SCOPE_TIME:
            self._host.rewind()

    def _reset_all(self) -> None:
        self._restore()
        self._host.begin(rewind=True)

    def _restore(self) -> None:
        """Remove what was spawned, and bring back what was deleted."""
        # A robot that was spawned may have the name of one that was deleted.
        changed = any(entity.robot >= 0 for entity in self.entities.spawned.values())
        changed |= self.entities.robot_names != list(self._host.robot_names)
        self.entities.restore()
        if changed:
            self._host.reopen_robots()

    def remove(self, name: str) -> None:
        """Remove an entity, and the topics of a robot. Raises UnknownEntityError."""
        entity = self.entities.find(name)
        self.entities.delete(entity)
        if entity.robot >= 0:
            self._host.remove_robots([entity.robot])

    def load_world(self, request: Any, response: Any) -> None:
        """Answer LoadWorld; the present world stays if the other can't be read."""
        resource = request.world_resource
        if resource.resource_string and not resource.uri:
            fault = "a world is loaded by its name or file; give a uri."
            raise RefusalError(Result.RESULT_FEATURE_UNSUPPORTED, fault)
        if not resource.uri:
            raise RefusalError(CODES.NO_RESOURCE, "the uri is empty; give one.")
        with refused(CODES):
            name = resource.uri
            if not any(sign in name for sign in SPECIAL):
                name = str(find_local_path(name, CODES, (".yaml", ".yml")))
            world = load_worlds(name)
        self._restore()
        self._host.use_world(world)
        self._list_entities()
        self._host.begin(rewind=True)
        self._halt(STOPPED)
        self._resource = resource
        self.get_world(request, response)

    def get_world(self, _: Any, response: Any) -> None:
        """Answer GetCurrentWorld."""
        world = self._host.world
        x1, y1, x2, y2 = world.extent
        count = len(world.members)
        what = "a field of" if count == 1 else f"{count} worlds in"
        response.world = WorldResource(
            name=world.name,
            world_resource=self._resource,
            description=f"{what} {x2 - x1:.3g} m x {y2 - y1:.3g} m",
        )
