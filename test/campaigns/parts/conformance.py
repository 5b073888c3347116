"""Conformance with simulation_interfaces: every announced feature is called, and does it.

One check for each feature; where the simulator does not announce it, its service, or the argument
that asks for it, has to be answered as unsupported.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from action_msgs.msg import GoalStatus
from rclpy.action import ActionClient
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rosgraph_msgs.msg import Clock
from simulation_interfaces import msg, srv
from simulation_interfaces.action import SimulateSteps

from nics_drl_bridge.extras.simulation_interfaces.server import snake_case
from nics_drl_bridge.nodes.listener import open_context

OK = msg.Result.RESULT_OK
UNSUPPORTED = msg.Result.RESULT_FEATURE_UNSUPPORTED
FAILED = msg.Result.RESULT_OPERATION_FAILED
NOT_FOUND = msg.Result.RESULT_NOT_FOUND
STATES = msg.SimulationState
SHAPE = "kind: circle\nradius: 0.15\n"
WORLD = "name: text\nsize: [5.0, 4.0]\ngoal_distance: [1.0, 3.0]\n"
PATIENCE_S = 300.0
IDLE_S = 10.0


class Client:
    """Calls the services of a simulator, as anybody's client would.

    One that is `idle` takes all that it asks for as done, while nothing is.
    """

    idle = False

    def __init__(self, domain_id: int | None = None, prefix: str = "") -> None:
        self.context = open_context(domain_id=domain_id)
        self.node = Node(
            "conformance", context=self.context, start_parameter_services=False
        )
        self._executor = SingleThreadedExecutor(context=self.context)
        self._executor.add_node(self.node)
        self._clients: dict[str, Any] = {}
        self._prefix = f"{prefix}/" if prefix else ""
        self._action = ActionClient(
            self.node, SimulateSteps, f"{self._prefix}simulate_steps"
        )
        self.clock: list[Any] = []
        self.node.create_subscription(Clock, "/clock", self.clock.append, 10)

    def until(self, holds: Callable[[], Any], what: str) -> None:
        """Spins until a condition holds. Raises TimeoutError."""
        patience_s = IDLE_S if self.idle else PATIENCE_S
        deadline = time.monotonic() + patience_s
        while not holds():
            if time.monotonic() > deadline:
                raise TimeoutError(f"not within {patience_s:g} s: {what}")
            self._executor.spin_once(timeout_sec=0.05)

    def wait(self, future: Any, what: str) -> Any:
        """Returns the result of a future. Raises TimeoutError."""
        self.until(future.done, what)
        return future.result()

    def __call__(self, name: str, /, **fields: Any) -> Any:
        """Returns the response of a service, by the name of its type."""
        kind = getattr(srv, name)
        if self.idle and not name.startswith("Get"):
            return kind.Response(result=msg.Result(result=OK))
        if name not in self._clients:
            topic = f"{self._prefix}{snake_case(name)}"
            self._clients[name] = self.node.create_client(kind, topic)
        client = self._clients[name]
        self.until(client.service_is_ready, f"the service of {name}")
        return self.wait(
            client.call_async(kind.Request(**fields)), f"an answer of {name}"
        )

    def code(self, name: str, /, **fields: Any) -> int:
        """Returns the result of a service."""
        return int(self(name, **fields).result.result)

    def set_state(self, state: int) -> int:
        """Sets the simulation's state; returns the result."""
        return self.code("SetSimulationState", state=STATES(state=state))

    def simulate(self, steps: int, cancel_at: int = 0) -> tuple[int, int, list[int]]:
        """Runs the action; returns goal status, result, and the completed steps of the feedback."""
        self.until(self._action.server_is_ready, "the action server")
        seen: list[int] = []
        feedback = lambda one: seen.append(one.feedback.completed_steps)  # noqa: E731
        sent = self._action.send_goal_async(SimulateSteps.Goal(steps=steps), feedback)
        goal = self.wait(sent, "the goal is accepted")
        if cancel_at:
            self.until(lambda: len(seen) >= cancel_at, "feedback")
            self.wait(goal.cancel_goal_async(), "the goal is cancelled")
        end = self.wait(goal.get_result_async(), "the action ends")
        return end.status, end.result.result.result, seen

    def time_ns(self) -> int:
        """Returns the stamp of a robot's state: the simulated time."""
        robots = msg.EntityFilters(categories=[category("ROBOT")])
        stamp = self("GetEntitiesStates", filters=robots).states[0].header.stamp
        return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)

    def names(self, **filters: Any) -> list[str]:
        """Returns the names of all entities that pass a filter."""
        return list(self("GetEntities", filters=msg.EntityFilters(**filters)).entities)

    def spawn(self, name: str, x: float = 0.0, /, **fields: Any) -> Any:
        """Spawns a disc; returns the response."""
        request = spawn_request(name, x, **fields)
        given = {
            field: getattr(request, field)
            for field in request.get_fields_and_field_types()
        }
        return self("SpawnEntity", **given)

    def start(self) -> None:
        """Brings the simulator back to where it began, paused."""
        self("ResetSimulation", scope=0)
        self.set_state(STATES.STATE_PAUSED)

    def close(self) -> None:
        """Ends the client."""
        self._executor.shutdown(timeout_sec=1.0)
        self.node.destroy_node()
        self.context.try_shutdown()


def category(name: str) -> Any:
    """Returns a category by its name."""
    return msg.EntityCategory(category=getattr(msg.EntityCategory, f"CATEGORY_{name}"))


def spawn_request(name: str, x: float = 0.0, /, **fields: Any) -> Any:
    """Returns the request of a disc at x [m], or of what else the fields say."""
    request = msg.SpawnEntity(name=name)
    request.entity_resource.resource_string = SHAPE
    request.initial_pose.pose.position.x = x
    for field, value in fields.items():
        setattr(request, field, value)
    return request


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
    robot = c.names(categories=[category("ROBOT")])[0]
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


def _info_is_got(c: Client) -> bool:
    robot = c.names(categories=[category("ROBOT")])[0]
    info = c("GetEntityInfo", entity=robot)
    return info.info.category == category("ROBOT") and info.result.result == OK


def _categories(c: Client) -> bool:
    c.spawn("disc", 1.0)
    robots = c.names(categories=[category("ROBOT")])
    still = c.names(categories=[category("STATIC_OBJECT")])
    return bool(robots) and "disc" in still and not set(robots) & set(still)


def _bounds(c: Client) -> bool:
    c.spawn("disc", 1.0)
    bounds = c("GetEntityBounds", entity="disc").bounds
    (high, low), near = bounds.points, 0.01
    right = bounds.type == msg.Bounds.TYPE_BOX and abs(high.x - 0.15) < near > abs(
        low.x + 0.15
    )
    where = msg.Bounds(type=msg.Bounds.TYPE_SPHERE)
    filters = msg.EntityFilters(bounds=where)
    return right and c.code("GetEntities", filters=filters) == UNSUPPORTED


def _spawnables(c: Client) -> bool:
    listed = c("GetSpawnables", sources=["/nowhere"])
    told = listed.result.result == OK and "/nowhere" in listed.result.error_message
    first = next(one for one in listed.spawnables if "robot" not in one.description)
    spawned = c.spawn("listed", 1.0, entity_resource=first.entity_resource)
    return told and spawned.result.result == OK


def _resets(scope: int) -> Callable[[Client], bool]:
    def check(c: Client) -> bool:
        robot = c.names(categories=[category("ROBOT")])[0]
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


def _acts(c: Client) -> bool:
    status, result, seen = c.simulate(20)
    right = status == GoalStatus.STATUS_SUCCEEDED and result == OK and seen[-1:] == [20]
    status, _, seen = c.simulate(1_000_000, cancel_at=3)
    right = right and status == GoalStatus.STATUS_CANCELED and seen == sorted(seen)
    right = right and _state_of_simulation(c)
    c.set_state(STATES.STATE_PLAYING)
    status, result, _ = c.simulate(3)
    return right and result == FAILED and status == GoalStatus.STATUS_ABORTED


def _loads(c: Client) -> bool:
    codes = srv.LoadWorld.Response
    loaded = c("LoadWorld", world_resource=msg.Resource(uri="empty"))
    right = loaded.result.result == OK and loaded.world.name == "empty"
    right = right and int(c("GetSimulationState").state.state) == STATES.STATE_STOPPED
    empty = c.code("LoadWorld", world_resource=msg.Resource())
    other = c.code("LoadWorld", world_resource=msg.Resource(uri="hall.usd"))
    return right and [empty, other] == [codes.NO_RESOURCE, codes.UNSUPPORTED_FORMAT]


def _loads_text(c: Client) -> bool:
    loaded = c("LoadWorld", world_resource=msg.Resource(resource_string=WORLD))
    wrong = c.code(
        "LoadWorld", world_resource=msg.Resource(resource_string="name: [\n")
    )
    right = loaded.result.result == OK and loaded.world.name == "text"
    return right and wrong == srv.LoadWorld.Response.RESOURCE_PARSE_ERROR


def _tells_world(c: Client) -> bool:
    found = c("GetCurrentWorld")
    return found.result.result == OK and bool(found.world.name)


def _lists_worlds(c: Client) -> bool:
    listed = c("GetAvailableWorlds")
    right = listed.result.result == OK and len(listed.worlds) > 1
    failed = c("GetAvailableWorlds", additional_sources=["/nowhere"])
    on = c(
        "GetAvailableWorlds", additional_sources=["/nowhere"], continue_on_error=True
    )
    return right and failed.result.result != OK and on.result.result == OK


SCOPES = srv.ResetSimulation.Request
CHECKS: dict[str, Callable[[Client], bool]] = {
    "SPAWNING": _names_collide,
    "DELETING": _spawns_and_deletes,
    "ENTITY_BOUNDS": _bounds,
    "ENTITY_CATEGORIES": _categories,
    "SPAWNING_RESOURCE_STRING": _text_is_spawned,
    "ENTITY_STATE_GETTING": _state_is_got,
    "ENTITY_STATE_SETTING": _state_is_set,
    "ENTITY_INFO_GETTING": _info_is_got,
    "SPAWNABLES": _spawnables,
    "SIMULATION_RESET": _resets(SCOPES.SCOPE_ALL),
    "SIMULATION_RESET_TIME": _resets(SCOPES.SCOPE_TIME),
    "SIMULATION_RESET_STATE": _resets(SCOPES.SCOPE_STATE),
    "SIMULATION_RESET_SPAWNED": _resets(SCOPES.SCOPE_SPAWNED),
    "SIMULATION_STATE_GETTING": _state_of_simulation,
    "SIMULATION_STATE_SETTING": _sets_state,
    "SIMULATION_STATE_PAUSE": _pauses,
    "STEP_SIMULATION_SINGLE": _steps(1),
    "STEP_SIMULATION_MULTIPLE": _steps(7),
    "STEP_SIMULATION_ACTION": _acts,
    "WORLD_LOADING": _loads,
    "WORLD_RESOURCE_STRING": _loads_text,
    "WORLD_INFO_GETTING": _tells_world,
    "AVAILABLE_WORLDS": _lists_worlds,
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


def features() -> dict[str, int]:
    """Returns all features of the standard by their names."""
    kinds = msg.SimulatorFeatures
    found = {name: getattr(kinds, name) for name in dir(type(kinds)) if name.isupper()}
    return {name: number for name, number in found.items() if isinstance(number, int)}


def announced(client: Client) -> set[str]:
    """Returns the names of the features that a simulator announces."""
    told = set(client("GetSimulatorFeatures").features.features)
    return {name for name, number in features().items() if number in told}


def failures(client: Client, world: str, told: set[str] | None = None) -> list[str]:
    """Checks every feature of the standard; returns a sentence for each that fails.

    Args:
        client: of the simulator.
        world: that is loaded before each check.
        told: features to hold the simulator to; by default those that it announces.
    """
    told = announced(client) if told is None else told
    failed = []
    for name in features():
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
