"""Entities: their names and states, and how they are spawned, moved and deleted."""

import re
from typing import Any

import numpy as np
from simulation_interfaces.msg import EntityFilters, EntityState, Result, SpawnResult
from simulation_interfaces.srv import SetEntityState

from nics_drl_bridge import geometry
from nics_drl_bridge.config import find_config, read_text
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.extras.simulation_interfaces.models import (
    TEXT,
    Model,
    model_of_sdf,
    model_of_yaml,
)
from nics_drl_bridge.extras.simulation_interfaces.roster import (
    NAME,
    Entity,
)
from nics_drl_bridge.extras.simulation_interfaces.state import (
    Host,
    RefusalError,
    Simulation,
    find_local_path,
    refused,
)
from nics_drl_bridge.interface import Array
from nics_drl_bridge.nodes import conversions, device_parameters
from nics_drl_bridge.recording.messages import read_whole_pose
from nics_drl_bridge.sim.world import OutsideError

FAILED = Result.RESULT_OPERATION_FAILED
INVALID_POSE = SetEntityState.Response.INVALID_POSE
FORMATS = ["sdf", "yaml"]
SUFFIXES = (".sdf", ".yaml", ".yml")
SHIPPED = "entities"  # folder of the shipped ones, in config/
MOST_BYTES = 2**24  # of a file
# With room for the names of topics, which may have 255 characters in all.
NAMESPACE = re.compile(
    r"(?=.{1,120}\Z)/?[A-Za-z_][A-Za-z0-9_]*(/[A-Za-z_][A-Za-z0-9_]*)*"
)


class EntityServices:
    """Answers what the standard asks about entities."""

    def __init__(self, host: Host, simulation: Simulation) -> None:
        self._host = host
        self._simulation = simulation

    def list_names(self, request: Any, response: Any) -> None:
        """Answer GetEntities."""
        response.entities = [entity.name for entity in self._filter(request.filters)]

    def list_states(self, request: Any, response: Any) -> None:
        """Answer GetEntitiesStates."""
        self.list_names(request, response)
        response.states = [
            self._state_to_ros(entity) for entity in self._filter(request.filters)
        ]

    def _filter(self, filters: Any) -> list[Entity]:
        text = filters.filter
        if filters != EntityFilters(filter=text):
            fault = "entities are filtered by name alone; leave out all else."
            raise RefusalError(Result.RESULT_FEATURE_UNSUPPORTED, fault)
        try:
            pattern = re.compile(text)
        except re.error as error:
            fault = f"the filter {text!r} is no regular expression ({error}); mend it."
            raise RefusalError(FAILED, fault) from None
        entities = self._simulation.entities
        return [entity for entity in entities if pattern.search(entity.name)]

    def get_state(self, request: Any, response: Any) -> None:
        """Answer GetEntityState."""
        response.state = self._state_to_ros(
            self._simulation.entities.find(request.entity)
        )

    def _state_to_ros(self, entity: Entity) -> EntityState:
        """Return where an entity is and how it moves, in the frame of the map."""
        entities = self._simulation.entities
        state = EntityState()
        x, y, heading = entities.pose(entity).tolist()
        state.header.frame_id = self._host.map_frame
        state.header.stamp = conversions.stamp_to_ros(self._host.now_ns)
        state.pose.position.x, state.pose.position.y = x, y
        state.pose.orientation = conversions.heading_to_ros(heading)
        state.twist = conversions.twist_to_ros(entities.twist(entity))
        return state

    def set_state(self, request: Any, _: Any) -> None:
        """Answer SetEntityState."""
        entities = self._simulation.entities
        entity = entities.find(request.entity)
        asked = request.state
        base = self._find_frame(asked.header.frame_id, INVALID_POSE)
        pose = twist = None
        if request.set_pose:
            pose = pose_from_ros(asked, base, INVALID_POSE)
        if request.set_twist:
            linear = asked.twist.linear
            twist = np.array([linear.x, linear.y, asked.twist.angular.z])
            if not np.isfinite(twist).all():
                fault = "the twist holds NaN or inf; give finite numbers."
                raise RefusalError(FAILED, fault)
            twist[:2] = geometry.rotate(twist[:2], base[2])
        try:
            entities.move(entity, pose, twist)
        except OutsideError as error:
            raise RefusalError(INVALID_POSE, str(error)) from None

    def _find_frame(self, frame: str, code: int) -> Array:
        """Return the pose (3,) of a frame in `map`: itself, or an entity's; RefusalError."""
        entities = self._simulation.entities
        frames = self._host.frames
        if frame in {"", "world", *(robot.map for robot in frames)}:
            return np.zeros(3)
        bases = [robot.base for robot in frames]
        names = dict(zip(bases, entities.robot_names, strict=False))
        name = names.get(frame, frame)
        entity = next((entity for entity in entities if entity.name == name), None)
        if entity is None:
            raise RefusalError(
                code,
                f"the frame {frame!r} is not known here; leave it empty for the world, or name "
                "an entity.",
            )
        return entities.pose(entity)

    def delete(self, request: Any, _: Any) -> None:
        """Answer DeleteEntity."""
        self._simulation.remove(request.entity)

    def spawn(self, request: Any, response: Any) -> None:
        """Answer SpawnEntity. Raises RefusalError, BridgeError."""
        model = self._read_model(request)
        entities = self._simulation.entities
        name = self._choose_name(request, "" if model is None else model.name)
        space = request.entity_namespace
        if space and not NAMESPACE.fullmatch(space):
            raise RefusalError(
                SpawnResult.NAMESPACE_INVALID,
                f"entity_namespace {space!r} is no namespace of ROS; write it as in 'robot_1'.",
            )
        code = SpawnResult.INVALID_POSE
        base = self._find_frame(request.initial_pose.header.frame_id, code)
        pose = pose_from_ros(request.initial_pose, base, code)
        try:
            if model is None:
                self._spawn_robot(name, space or re.sub(r"\W", "_", name), pose)
            else:
                entities.spawn(name, model.parts, pose)
        except OutsideError as error:
            raise RefusalError(code, str(error)) from None
        response.entity_name = name

    def _spawn_robot(self, name: str, space: str, pose: Array) -> None:
        host = self._host
        if not NAMESPACE.fullmatch(space):
            fault = f"the name {name!r} makes no namespace of ROS"
            raise RefusalError(
                SpawnResult.NAME_INVALID, f"{fault}; write it as in 'robot_1'."
            )
        scan = host.resolve_topic_name(f"{space}/scan")
        taken = scan in [publisher.topic_name for publisher in host.publishers]
        if taken or device_parameters.get_frames(host, space.strip("/")) in host.frames:
            fault = f"the namespace {space!r} is that of another robot"
            raise RefusalError(
                SpawnResult.NAMESPACE_INVALID,
                f"{fault}; give one as entity_namespace.",
            )
        robot = self._simulation.entities.spawn_robot(name, pose)
        try:
            host.add_robot(space)
        except BaseException:
            self._simulation.entities.delete(robot)
            raise

    def _read_model(self, request: Any) -> Model | None:
        """Return what a resource describes; None for another robot. Raises RefusalError."""
        codes = SpawnResult
        uri = request.entity_resource.uri
        text = request.entity_resource.resource_string
        source = TEXT
        name = ""
        robot = self._host.model.robot.name
        if uri == robot:
            return None
        if uri:
            path = find_local_path(uri, codes, SUFFIXES)
            try:
                if not path.suffix:
                    path = find_config(str(path), SHIPPED)
                text = read_text(path, MOST_BYTES)
            except ConfigError as error:
                fault = f"{error} Robots here are {robot!r}."
                raise RefusalError(Result.RESULT_NOT_FOUND, fault) from None
            source = str(path)
            name = path.stem
        is_sdf = "<sdf" in text
        if not text.strip():
            fault = "both uri and resource_string are empty; give one of them."
            raise RefusalError(codes.NO_RESOURCE, fault)
        if not is_sdf and text.lstrip("\ufeff \t\r\n").startswith(("<", "#usda")):
            fault = "the resource is XML or USD, but no SDF; give SDF or YAML."
            raise RefusalError(codes.UNSUPPORTED_FORMAT, fault)
        with refused(codes):
            if is_sdf:
                z = request.initial_pose.pose.position.z
                return model_of_sdf(text, z if np.isfinite(z) else 0.0, source)
            model = model_of_yaml(text, source)
        return model if model.name else model._replace(name=name)

    def _choose_name(self, request: Any, default: str) -> str:
        """Return the name of a new entity. Raises RefusalError."""
        wanted = request.name or default
        if not wanted and request.allow_renaming:
            wanted = "entity"
        if not NAME.fullmatch(wanted):
            raise RefusalError(
                SpawnResult.NAME_INVALID,
                f"the name {wanted!r} is not valid; use up to 120 letters, digits, and _ . / - "
                "between them.",
            )
        free = self._simulation.entities.find_free_name(wanted)
        if free != wanted and not request.allow_renaming:
            raise RefusalError(
                SpawnResult.NAME_NOT_UNIQUE,
                f"the name {wanted!r} is taken; give another, or set allow_renaming.",
            )
        return free


def pose_from_ros(message: Any, base: Array, code: int) -> Array:
    """Return x, y, heading (3,) in `map` of a pose in a frame that has a pose (3,) there.

    Raises RefusalError with a code for an invalid pose; only x, y and heading are looked at.
    """
    local = np.array(read_whole_pose(message))
    if not np.isfinite(local).all():
        fault = "the pose needs finite numbers and a quaternion of unit length."
        raise RefusalError(code, fault)
    pose_in_map: Array = geometry.compose(base, local)
    return pose_in_map
