"""Entities: their names, their states, what they are, and their bounds."""

from typing import Any

from geometry_msgs.msg import Accel, Twist
from simulation_interfaces.msg import (
    Bounds,
    EntityCategory,
    EntityInfo,
    EntityState,
    Result,
)
from simulation_interfaces.srv import SetEntityState

from nics_drl_bridge.extras.simulation_interfaces import plane
from nics_drl_bridge.extras.simulation_interfaces.filters import compile_filter
from nics_drl_bridge.extras.simulation_interfaces.host import Host, RefusalError
from nics_drl_bridge.extras.simulation_interfaces.state import Simulation
from nics_drl_bridge.nodes import conversions
from nics_drl_bridge.sim.entities import Entity, OutsideError
from nics_drl_bridge.sim.obstacles import Pedestrian

FAILED = Result.RESULT_OPERATION_FAILED
INVALID_POSE = SetEntityState.Response.INVALID_POSE


class EntityServices:
    """Answers what the standard asks about entities."""

    def __init__(self, host: Host, simulation: Simulation) -> None:
        self._host = host
        self._simulation = simulation

    def info(self, entity: Entity) -> EntityInfo:
        """Return what an entity is."""
        kinds = EntityCategory
        if entity.robot >= 0:
            spec = self._host.model.robot
            return _info(kinds.CATEGORY_ROBOT, f"the robot {spec.name}")
        kind = kinds.CATEGORY_STATIC_OBJECT
        if entity.motion is not None:
            walks = isinstance(entity.motion, Pedestrian)
            kind = kinds.CATEGORY_HUMAN if walks else kinds.CATEGORY_DYNAMIC_OBJECT
        shapes = dict.fromkeys(shape.kind for shape, _ in entity.parts)
        return _info(kind, f"an obstacle: {', '.join(shapes)}")

    def _matching(self, filters: Any) -> list[Entity]:
        if filters.tags.tags or filters.bounds.type != Bounds.TYPE_EMPTY:
            fault = (
                "entities are filtered by name and category; leave out tags and bounds."
            )
            raise RefusalError(Result.RESULT_FEATURE_UNSUPPORTED, fault)
        try:
            pattern = compile_filter(filters.filter)
        except ValueError as error:
            raise RefusalError(FAILED, str(error)) from None
        categories = {category.category for category in filters.categories}
        return [
            entity
            for entity in self._simulation.entities
            if pattern.search(entity.name)
            and (not categories or self.info(entity).category.category in categories)
        ]

    def state(self, entity: Entity) -> EntityState:
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

    def list_names(self, request: Any, response: Any) -> None:
        """Answer GetEntities."""
        response.entities = [entity.name for entity in self._matching(request.filters)]

    def list_states(self, request: Any, response: Any) -> None:
        """Answer GetEntitiesStates."""
        entities = self._matching(request.filters)
        response.entities = [entity.name for entity in entities]
        response.states = [self.state(entity) for entity in entities]

    def find(self, name: str) -> Entity:
        """Return the entity of a name. Raises RefusalError, UnknownEntityError."""
        return self._simulation.entities.find(name)

    def get_info(self, request: Any, response: Any) -> None:
        """Answer GetEntityInfo."""
        response.info = self.info(self.find(request.entity))

    def get_state(self, request: Any, response: Any) -> None:
        """Answer GetEntityState."""
        response.state = self.state(self.find(request.entity))

    def get_bounds(self, request: Any, response: Any) -> None:
        """Answer GetEntityBounds."""
        entity = self.find(request.entity)
        response.bounds = plane.box_to_ros(self._simulation.entities.outlines(entity))

    def set_state(self, request: Any, _: Any) -> None:
        """Answer SetEntityState."""
        entity = self.find(request.entity)
        asked = request.state
        entities = self._simulation.entities
        frames = self._host.frames
        base = plane.frame_pose(asked.header.frame_id, entities, frames, INVALID_POSE)
        pose = twist = None
        if request.set_pose:
            pose = plane.pose_from_ros(asked.pose, base, INVALID_POSE)
        if request.set_twist:
            twist = plane.twist_from_ros(asked.twist, base[2], FAILED)
        still = entity.robot < 0 and entity.motion is None
        pushed = request.set_acceleration and asked.acceleration != Accel()
        if still and (pushed or (request.set_twist and asked.twist != Twist())):
            what = "acceleration" if pushed else "twist"
            fault = f"{entity.name!r} stands still and takes no {what}; leave it out."
            raise RefusalError(FAILED, fault)
        try:
            entities.move(entity, pose, twist)
        except OutsideError as error:
            raise RefusalError(INVALID_POSE, str(error)) from None

    def delete(self, request: Any, _: Any) -> None:
        """Answer DeleteEntity."""
        self._simulation.remove(self.find(request.entity).name)


def _info(kind: int, description: str) -> EntityInfo:
    category = EntityCategory(category=kind)
    return EntityInfo(category=category, description=description)
