"""Conformance with simulation_interfaces: every announced feature is called, and does it.

One check for each feature; where the simulator does not announce it, its service, or the argument
that asks for it, has to be answered as unsupported.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from geometry_msgs.msg import PoseStamped
from simulation_interfaces import msg, srv

from nics_drl_bridge.extras.simulation_interfaces.server import snake_case
from nics_drl_bridge.nodes.listener import SpunNode

OK = msg.Result.RESULT_OK
UNSUPPORTED = msg.Result.RESULT_FEATURE_UNSUPPORTED
FAILED = msg.Result.RESULT_OPERATION_FAILED
NOT_FOUND = msg.Result.RESULT_NOT_FOUND
STATES = msg.SimulationState
SHAPE = "kind: circle\nradius: 0.15\n"
PATIENCE_S = 300.0
IDLE_S = 10.0


class Client(SpunNode):
    """Calls the services of a simulator, as anybody's client would.

    One that is `idle` takes all that it asks for as done, while nothing is.
    """

    idle = False

    def __init__(self, domain_id: int | None = None, prefix: str = "") -> None:
        super().__init__("conformance", domain_id)
        self._prefix = f"{prefix}/" if prefix else ""

    def __call__(self, name: str, /, **fields: Any) -> Any:
        """Returns the response of a service, by the name of its type. Raises TimeoutError."""
        kind = getattr(srv, name)
        if self.idle and not name.startswith("Get"):
            return kind.Response(result=msg.Result(result=OK))
        patience_s = IDLE_S if self.idle else PATIENCE_S
        service = f"{self._prefix}{snake_case(name)}"
        return self.call_service(kind, service, patience_s, kind.Request(**fields))

    def code(self, name: str, /, **fields: Any) -> int:
        """Returns the result of a service."""
        return int(self(name, **fields).result.result)

    def set_state(self, state: int) -> int:
        """Sets the simulation's state; returns the result."""
        return self.code("SetSimulationState", state=STATES(state=state))

    def time_ns(self) -> int:
        """Returns the stamp of a robot's state: the simulated time."""
        stamp = self("GetEntitiesStates").states[0].header.stamp
        return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)

    def names(self, **filters: Any) -> list[str]:
        """Returns the names of all entities that pass a filter."""
        return list(self("GetEntities", filters=msg.EntityFilters(**filters)).entities)

    def spawn(self, name: str, x: float = 0.0, /, **fields: Any) -> Any:
        """Spawns a disc at x [m], or what else the fields say; returns the response."""
        pose = PoseStamped()
        pose.pose.position.x = x
        disc = msg.Resource(resource_string=SHAPE)
        about = {"name": name, "entity_resource": disc, "initial_pose": pose}
        return self("SpawnEntity", **about | fields)

    def start(self) -> None:
        """Brings the simulator back to where it began, paused."""
        self("ResetSimulation", scope=0)
        self.set_state(STATES.STATE_PAUSED)


def _spawns_and_deletes(c: Client) -> bool:
    spawned = c.spawn("disc", 1.0)
    there = "disc" in c.names() and spawned.entity_name == "disc"
    return (
        there
        and c.code("DeleteEntity", entity="disc") == OK
        and "disc" not in c.names()
    )


def _names_collide(c: Client) -> bool:
    first = c.spawn("twin", 1.0)
    second = c.spawn("twin", 1.5)
    other = c.spawn("twin", 1.5, allow_renaming=True)
    codes = srv.SpawnEntity.Response
    refused = (
        second.result.result == codes.NAME_NOT_UNIQUE and second.result.error_message
    )
    renamed = other.result.result == OK and other.entity_name not in ("", "twin")
    return first.result.result == OK and bool(refused) and renamed


def _text_is_spawned(c: Client) -> bool:
    codes = srv.SpawnEntity.Response
    sdf = (
        "<sdf version='1.9'><model name='crate'><link name='l'><collision name='c'><geometry>"
        "<box><size>0.4 0.4 0.4</size></box></geometry></collision></link></model></sdf>"
    )
    named = c.spawn("", 1.0, entity_resource=msg.Resource(resource_string=sdf))
    wrong = c.spawn(
        "w", 1.0, entity_resource=msg.Resource(resource_string="kind: sphere")
    )
    empty = c.spawn("e", 1.0, entity_resource=msg.Resource())
    urdf = c.spawn(
        "u", 1.0, entity_resource=msg.Resource(resource_string="<robot name='r'/>")
    )
    told = [each.result.result for each in (named, wrong, empty, urdf)]
    wanted = [
        OK,
        codes.RESOURCE_PARSE_ERROR,
        codes.NO_RESOURCE,
        codes.UNSUPPORTED_FORMAT,
    ]
    return told == wanted and named.entity_name == "crate"


def _state_is_got(c: Client) -> bool:
    c.spawn("disc", 1.25)
    one = c("GetEntityState", entity="disc")
    none = c("GetEntityState", entity="nothing")
    every = c("GetEntitiesStates", filters=msg.EntityFilters(filter="^disc$"))
    x = [one.state.pose.position.x, every.states[0].pose.position.x]
    return (
        x == [1.25, 1.25]
        and none.result.result == NOT_FOUND
        and bool(none.result.error_message)
    )


def _state_is_set(c: Client) -> bool:
    robot = c.names()[0]
    state = msg.EntityState()
    state.pose.position.x, state.pose.position.y = 0.5, -0.5
    set_ = c.code("SetEntityState", entity=robot, state=state, set_pose=True)
    found = c("GetEntityState", entity=robot).state.pose.position
    c.spawn("disc", 1.5)
    state.twist.linear.x = 1.0
    pushed = c.code("SetEntityState", entity="disc", state=state, set_twist=True)
    state.pose.position.x = 1e6
    far = c.code("SetEntityState", entity=robot, state=state, set_pose=True)
    state.pose.orientation.w = 0.0
    turned = c.code("SetEntityState", entity=robot, state=state, set_pose=True)
    invalid = srv.SetEntityState.Response.INVALID_POSE
    right = [set_, pushed, far, turned] == [OK, FAILED, invalid, invalid]
    return right and abs(found.x - 0.5) + abs(found.y + 0.5) < 1e-6


def _resets(scope: int) -> Callable[[Client], bool]:
    def check(c: Client) -> bool:
        robot = c.names()[0]
        began = c("GetEntityState", entity=robot).state.pose.position.x
        first = c.time_ns()
        c.spawn("disc", 1.0), c("StepSimulation", steps=5)
        state = msg.EntityState()
        state.pose.position.x = 0.3
        c("SetEntityState", entity=robot, state=state, set_pose=True)
        done = c.code("ResetSimulation", scope=scope) == OK
        x = c("GetEntityState", entity=robot).state.pose.position.x
        scopes = srv.ResetSimulation.Request
        found = c.time_ns() <= first, abs(x - began) < 1e-6, "disc" not in c.names()
        wanted = [
            bool(scope & each)
            for each in (scopes.SCOPE_TIME, scopes.SCOPE_STATE, scopes.SCOPE_SPAWNED)
        ]
        return done and list(found) == wanted

    return check


def _state_of_simulation(c: Client) -> bool:
    return int(c("GetSimulationState").state.state) == STATES.STATE_PAUSED


def _sets_state(c: Client) -> bool:
    codes = srv.SetSimulationState.Response
    asked = (
        STATES.STATE_PLAYING,
        STATES.STATE_PLAYING,
        STATES.STATE_STOPPED,
        STATES.STATE_NO_WORLD,
    )
    wanted = [OK, codes.ALREADY_IN_TARGET_STATE, OK, codes.INCORRECT_TRANSITION]
    found = [c.set_state(each) for each in asked]
    return (
        found == wanted
        and int(c("GetSimulationState").state.state) == STATES.STATE_STOPPED
    )


def _pauses(c: Client) -> bool:
    c.set_state(STATES.STATE_PLAYING)
    return c.set_state(STATES.STATE_PAUSED) == OK and _state_of_simulation(c)


def _steps(steps: int) -> Callable[[Client], bool]:
    def check(c: Client) -> bool:
        before = c.time_ns()
        done = c.code("StepSimulation", steps=1) == OK
        one = c.time_ns() - before
        done = done and c.code("StepSimulation", steps=steps) == OK
        moved = c.time_ns() - before == one * (1 + steps) and one > 0
        c.set_state(STATES.STATE_PLAYING)
        return done and moved and c.code("StepSimulation", steps=steps) == FAILED

    return check


def _loads(c: Client) -> bool:
    codes = srv.LoadWorld.Response
    loaded = c("LoadWorld", world_resource=msg.Resource(uri="empty"))
    right = loaded.result.result == OK and loaded.world.name == "empty"
    right = right and int(c("GetSimulationState").state.state) == STATES.STATE_STOPPED
    empty = c.code("LoadWorld", world_resource=msg.Resource())
    other = c.code("LoadWorld", world_resource=msg.Resource(uri="hall.usd"))
    return right and [empty, other] == [codes.NO_RESOURCE, codes.UNSUPPORTED_FORMAT]


def _tells_world(c: Client) -> bool:
    found = c("GetCurrentWorld")
    return found.result.result == OK and bool(found.world.name)


SCOPES = srv.ResetSimulation.Request
CHECKS: dict[str, Callable[[Client], bool]] = {
    "SPAWNING": _names_collide,
    "DELETING": _spawns_and_deletes,
    "SPAWNING_RESOURCE_STRING": _text_is_spawned,
    "ENTITY_STATE_GETTING": _state_is_got,
    "ENTITY_STATE_SETTING": _state_is_set,
    "SIMULATION_RESET": _resets(SCOPES.SCOPE_ALL),
    "SIMULATION_RESET_TIME": _resets(SCOPES.SCOPE_TIME),
    "SIMULATION_RESET_STATE": _resets(SCOPES.SCOPE_STATE),
    "SIMULATION_RESET_SPAWNED": _resets(SCOPES.SCOPE_SPAWNED),
    "SIMULATION_STATE_GETTING": _state_of_simulation,
    "SIMULATION_STATE_SETTING": _sets_state,
    "SIMULATION_STATE_PAUSE": _pauses,
    "STEP_SIMULATION_SINGLE": _steps(1),
    "STEP_SIMULATION_MULTIPLE": _steps(7),
    "WORLD_LOADING": _loads,
    "WORLD_INFO_GETTING": _tells_world,
}
# Features of which the service itself is answered as unsupported where they are not announced.
SERVICES = {
    "SPAWNING": "SpawnEntity",
    "DELETING": "DeleteEntity",
    "NAMED_POSES": "GetNamedPoses",
    "POSE_BOUNDS": "GetNamedPoseBounds",
    "ENTITY_BOUNDS": "GetEntityBounds",
    "ENTITY_STATE_GETTING": "GetEntityState",
    "ENTITY_STATE_SETTING": "SetEntityState",
    "ENTITY_INFO_GETTING": "GetEntityInfo",
    "ENTITY_INFO_SETTING": "SetEntityInfo",
    "SPAWNABLES": "GetSpawnables",
    "SIMULATION_RESET": "ResetSimulation",
    "SIMULATION_STATE_GETTING": "GetSimulationState",
    "SIMULATION_STATE_SETTING": "SetSimulationState",
    "STEP_SIMULATION_SINGLE": "StepSimulation",
    "WORLD_LOADING": "LoadWorld",
    "WORLD_UNLOADING": "UnloadWorld",
    "WORLD_INFO_GETTING": "GetCurrentWorld",
    "AVAILABLE_WORLDS": "GetAvailableWorlds",
    "SPAWNING_ENTITIES": "SpawnEntities",
}


def list_features() -> dict[str, int]:
    """Returns all features of the standard by their names."""
    kinds = msg.SimulatorFeatures
    found = {name: getattr(kinds, name) for name in dir(type(kinds)) if name.isupper()}
    return {name: number for name, number in found.items() if isinstance(number, int)}


def announced(client: Client) -> set[str]:
    """Returns the names of the features that a simulator announces."""
    told = set(client("GetSimulatorFeatures").features.features)
    return {name for name, number in list_features().items() if number in told}


def failures(client: Client, world: str, told: set[str] | None = None) -> list[str]:
    """Checks every feature of the standard; returns a sentence for each that fails.

    Args:
        client: of the simulator.
        world: that is loaded before each check.
        told: features to hold the simulator to; by default those that it announces.
    """
    told = announced(client) if told is None else told
    failed = []
    for name in list_features():
        if name in told and name in CHECKS:
            client("LoadWorld", world_resource=msg.Resource(uri=world))
            client.start()
            try:
                right = CHECKS[name](client)
            except (
                AttributeError,
                LookupError,
                StopIteration,
                TimeoutError,
                ValueError,
            ):
                right = False  # an answer without what was asked for
            if not right:
                failed.append(
                    f"{name} is announced, but does not do what the standard says"
                )
        elif name in told:
            failed.append(f"{name} is announced, but nothing checks it")
        elif name in SERVICES and client.code(SERVICES[name]) != UNSUPPORTED:
            failed.append(
                f"{name} is not announced, but {SERVICES[name]} does not say so"
            )
    return failed
