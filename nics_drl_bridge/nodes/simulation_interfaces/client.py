"""The client: episodes and steps of any simulator that serves simulation_interfaces."""

import re
from importlib import import_module
from typing import Any

from geometry_msgs.msg import Point, Pose
from pydantic import Field, PositiveFloat
from rosgraph_msgs.msg import Clock

from nics_drl_bridge.config import Schema
from nics_drl_bridge.errors import BackendError, ConfigError
from nics_drl_bridge.generator import SimulatorModel
from nics_drl_bridge.interface import NS_PER_S, Array, Start
from nics_drl_bridge.lidar.exact_kernels import RADIUS
from nics_drl_bridge.nodes import conversions, qos
from nics_drl_bridge.nodes.link import POLL_S, Inbox, Link
from nics_drl_bridge.nodes.parameters import NEWEST
from nics_drl_bridge.sim.entities import OBSTACLE
from nics_drl_bridge.sim.scenes import sample_scene
from nics_drl_bridge.sim.world_set import AnyWorld

PACKAGE = "simulation_interfaces"
# Feature -> the service behind it, all of which a client needs.
NEEDED = {
    "SIMULATION_STATE_SETTING": "SetSimulationState",
    "SIMULATION_STATE_PAUSE": "",
    "SIMULATION_RESET": "ResetSimulation",
    "STEP_SIMULATION_SINGLE": "StepSimulation",
    "ENTITY_STATE_SETTING": "SetEntityState",
    "ENTITY_STATE_GETTING": "GetEntityState",
}
# of a control period, as a fraction of a step; and of stamps, of a period
TOLERANCE = 1e-3


class StandardOptions(Schema):
    """Options of a simulator behind the standard's services."""

    services: str = ""  # what their names begin with: `/gzserver` for Gazebo
    entity: str = ""  # name of the robot's entity; that of the model's robot by default
    # of a step of the simulator; None: measured on /clock
    step_s: PositiveFloat | None = None
    slack_s: float = Field(
        0.0, ge=0.0
    )  # by which data may be older than the end of a period
    # puts those of the episode's scene, where entities have their names
    obstacles: bool = True


def snake_case(name: str) -> str:
    """Return the name of a service as all simulators write it: `get_entities`."""
    return re.sub("(?<!^)(?=[A-Z])", "_", name).lower()


def module(kind: str) -> Any:
    """Return the module `srv` or `msg` of the messages. ConfigError if missing or too old."""
    if conversions.message_type(NEWEST) is None:
        fix = f"install {PACKAGE} 2.1 or newer with your ROS 2 distribution, and source it"
        raise ConfigError(
            f"simulator {PACKAGE!r} needs the messages of that name; {fix}."
        )
    return import_module(f"{PACKAGE}.{kind}")


class StandardEpisodes:
    """Episodes and steps by the standard's services alone, as `EpisodeServices` are by our own.

    A seed is nothing to the standard: an episode is a reset, after which robot and obstacles are
    put where they start. Raises BackendError for a feature that the simulator lacks.
    """

    def __init__(
        self,
        link: Link,
        model: SimulatorModel,
        world: AnyWorld,
        options: StandardOptions,
        inbox: Inbox,
    ) -> None:
        self._link = link
        self._model = model
        self._world = world
        self._options = options
        self._inbox = inbox
        self._types = module("srv")
        self._messages = module("msg")
        self._entity = options.entity or model.robot.name
        self._features = self._client("GetSimulatorFeatures")
        names = [name for name in NEEDED.values() if name]
        self._services = {name: self._client(name) for name in names}
        self._entities = self._client("GetEntities")
        self.clients = [self._features]  # the one that all simulators have
        self._known: frozenset[int] = frozenset()
        self._stood: dict[
            str, Pose
        ] = {}  # of entities after a reset: heights and tilts are kept
        self._steps = 0
        self._period_ns = round(model.control_period * NS_PER_S)
        self._pending: list[Any] = []
        self._clock: list[Any] = []
        if options.step_s is None:  # before the executor runs
            self._listening = link.node.create_subscription(
                Clock, "/clock", self._clock.append, qos.SENSOR
            )

    def _client(self, name: str) -> Any:
        if self._options.services:
            prefix = f"{self._options.services.rstrip('/')}/"
        else:
            prefix = ""
        kind = getattr(self._types, name)
        return self._link.node.create_client(kind, f"{prefix}{snake_case(name)}")

    def _call(self, name: str, timeout_s: float, *fine: int, **fields: Any) -> Any:
        """Call a service. Raises BackendError for a result that is neither OK nor `fine`."""
        kind = getattr(self._types, name)
        response = self._link.call(
            self._services[name], kind.Request(**fields), timeout_s
        )
        if response.result.result not in (self._messages.Result.RESULT_OK, *fine):
            reason = response.result.error_message or f"result {response.result.result}"
            raise BackendError(f"the simulator refused {name}: {reason}")
        return response

    def open(self, timeout_s: float) -> None:
        """Check the features, and measure a step. Raises BackendError naming what is missing."""
        request = self._types.GetSimulatorFeatures.Request()
        kinds = self._messages
        answer = self._link.call(self._features, request, timeout_s).features
        self._known = frozenset(answer.features)
        for feature, service in NEEDED.items():
            self._require(feature, f", which {service} serves" if service else "")
        self.clients += self._services.values()
        self._paused = {
            "state": kinds.SimulationState(state=kinds.SimulationState.STATE_PAUSED)
        }
        self._pause(timeout_s)
        if self._options.step_s is None:
            step_ns = self._measured(timeout_s)
        else:
            step_ns = round(self._options.step_s * NS_PER_S)
        self._steps = max(1, round(self._period_ns / step_ns))
        if abs(self._steps * step_ns - self._period_ns) > TOLERANCE * step_ns:
            parts = f"a control period of {self._period_ns / NS_PER_S:g} s is no whole number of"
            fix = "give the simulator a step that divides it"
            raise BackendError(
                f"{parts} the simulator's steps of {step_ns / NS_PER_S:g} s; {fix}."
            )
        if self._steps > 1:
            self._require(
                "STEP_SIMULATION_MULTIPLE", ", as a control period is several steps"
            )

    def _require(self, feature: str, clause: str) -> None:
        if getattr(self._messages.SimulatorFeatures, feature) not in self._known:
            lacks = f"the simulator does not have the feature {feature}{clause}"
            raise BackendError(f"{lacks}; choose one that has, or another backend.")

    def _pause(self, timeout_s: float) -> None:
        already = self._types.SetSimulationState.Response.ALREADY_IN_TARGET_STATE
        self._call("SetSimulationState", timeout_s, already, **self._paused)

    def _measured(self, timeout_s: float) -> int:
        stamps = list[int]()
        for _ in range(2):
            self._clock.clear()
            self._call("StepSimulation", timeout_s, steps=1)
            if not self._link.wait_until(lambda: self._clock, timeout_s):
                fault = f"no message on /clock within {timeout_s:g} s, so the length of a step"
                raise BackendError(f"{fault} is unknown; give it as the option step_s.")
            self._link.wait_until(lambda: False, POLL_S)  # of several, the last counts
            stamps.append(conversions.stamp_from_ros(self._clock[-1].clock))
        self._link.node.destroy_subscription(self._listening)
        if stamps[1] <= stamps[0]:
            raise BackendError(
                "time does not pass in a step; give its seconds as option step_s."
            )
        return stamps[1] - stamps[0]

    def begin(self, start: Start, timeout_s: float) -> int:
        """Begin an episode; return the stamp of its first data [ns]. Raises BackendError."""
        if not self._steps:
            self.open(timeout_s)
        self._link.wait_until(
            lambda: all(future.done() for future in self._pending), timeout_s
        )
        self._pending.clear()
        self._pause(timeout_s)
        scopes = self._types.ResetSimulation.Request
        known = self._messages.SimulatorFeatures
        of_state = known.SIMULATION_RESET_STATE in self._known
        scope = scopes.SCOPE_STATE if of_state else scopes.SCOPE_ALL
        self._call("ResetSimulation", timeout_s, scope=scope)
        self._pause(timeout_s)  # some play on after a reset
        self._put_obstacles(start, timeout_s)
        self._put(self._entity, start.pose.reshape(3), timeout_s)
        answer = self._call("GetEntityState", timeout_s, entity=self._entity)
        time_ns = conversions.stamp_from_ros(answer.state.header.stamp)
        self._link.halt()
        self._inbox.clear()  # of what is from before a reset that put time back
        self.advance()
        if time_ns:
            return time_ns + self._period_ns
        # An answer without a stamp: by the first data, of several steps the last.
        self._link.wait_until(
            lambda: self._pending[-1].done() and self._inbox.find_newest_ns() >= 0,
            timeout_s,
        )
        self._link.wait_until(lambda: False, POLL_S)
        return max(0, self._inbox.find_newest_ns())

    def _put_obstacles(self, start: Start, timeout_s: float) -> None:
        if not self._options.obstacles or not self._entities.service_is_ready():
            return
        request = self._types.GetEntities.Request()
        there = set(self._link.call(self._entities, request, timeout_s).entities)
        scene = sample_scene(
            self._world, self._model.robot.footprint_radius, int(start.seed)
        )
        for k, body in enumerate(scene.bodies):
            if body[RADIUS] > 0.0 and f"{OBSTACLE}{k}" in there:
                self._put(f"{OBSTACLE}{k}", body[:3], timeout_s)

    def _put(self, entity: str, pose: Array, timeout_s: float) -> None:
        if entity not in self._stood:
            self._stood[entity] = self._call(
                "GetEntityState", timeout_s, entity=entity
            ).state.pose
        state = self._messages.EntityState()
        stood = self._stood[entity]
        x, y, heading = map(float, pose)
        state.pose.position = Point(x=x, y=y, z=stood.position.z)
        state.pose.orientation = conversions.turned_to(stood.orientation, heading)
        flags = {"set_pose": True, "set_twist": not entity.startswith(OBSTACLE)}
        self._call("SetEntityState", timeout_s, entity=entity, state=state, **flags)

    def advance(self) -> None:
        """Request the steps of one control period without waiting for them."""
        self._look()
        request = self._types.StepSimulation.Request(steps=self._steps)
        self._pending.append(self._services["StepSimulation"].call_async(request))

    def repeat(self) -> None:
        """Raise BackendError if the steps were refused; the standard can't repeat data."""
        self._look()

    def _look(self) -> None:
        for future in tuple(self._pending):
            if not future.done():
                continue
            self._pending.remove(future)
            result = future.result().result
            if result.result != self._messages.Result.RESULT_OK:
                self._pending.clear()
                reason = result.error_message or f"result {result.result}"
                raise BackendError(f"the simulator refused StepSimulation: {reason}")
