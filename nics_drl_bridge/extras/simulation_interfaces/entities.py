"""Entities: their names by filters, their states, what they are, and their bounds."""

import re
from typing import Any

from geometry_msgs.msg import Accel, Twist
from simulation_interfaces.msg import (
    EntityCategory,
    EntityInfo,
    EntityState,
    Result,
    TagsFilter,
)
from simulation_interfaces.srv import SetEntityState

from nics_drl_bridge import geometry as planar
from nics_drl_bridge.extras.simulation_interfaces import plane
from nics_drl_bridge.extras.simulation_interfaces.host import Host, RefusalError
from nics_drl_bridge.extras.simulation_interfaces.state import Simulation
from nics_drl_bridge.nodes import conversions
from nics_drl_bridge.sim.entities import Entity, OutsideError
from nics_drl_bridge.sim.obstacles import Pedestrian

FAILED = Result.RESULT_OPERATION_FAILED
INVALID_POSE = SetEntityState.Response.INVALID_POSE
CATEGORIES = {
    getattr(EntityCategory, f"CATEGORY_{name}")
    for name in ("OBJECT", "ROBOT", "HUMAN", "DYNAMIC_OBJECT", "STATIC_OBJECT")
}
# Classes of POSIX's bracket expressions, which Python writes otherwise.
CLASSES = {
    "alpha": "A-Za-z",
    "digit": "0-9",
    "alnum": "A-Za-z0-9",
    "upper": "A-Z",
    "lower": "a-z",
    "space": r"\s",
    "blank": r" \t",
    "punct": r"!-/:-@\[-`{-~",
    "xdigit": "0-9A-Fa-f",
    "word": r"\w",
    "print": " -~",
    "graph": "!-~",
    "cntrl": r"\x00-\x1f",
}
# What is escaped, a bracket expression (its `^`, and what it holds), or one that can't be had.
BRACKET = re.compile(
    rf"\\.|\[(\^?)(\]?(?:\[:(?:{'|'.join(CLASSES)}):\]|\[(?![:.=])|[^][])*)\]|(\[)",
    re.DOTALL,
)
HELD = re.compile(r"\[:(\w+):\]|[][\\&|~]")
# of a filter: it is matched while the simulator waits
MOST_CHARACTERS = 1000
MOST_REPEATS = 3
TOO_LONG = "it repeats what repeats or branches, or more than 3 times, or has over 1000 characters"


def pattern_of(expression: str) -> re.Pattern[str]:
    """Compile a POSIX extended regular expression. Raises RefusalError for none."""
    try:
        if len(expression) > MOST_CHARACTERS or _runs_away(
            BRACKET.sub(".", expression)
        ):
            raise re.error(TOO_LONG)
        return re.compile(BRACKET.sub(_bracket, expression))
    except (re.error, OverflowError, RecursionError) as error:
        fault = f"the filter {expression!r} is no regular expression for names ({error}); mend it."
        raise RefusalError(FAILED, fault) from None


def _bracket(match: re.Match[str]) -> str:
    if match[3]:
        raise re.error("a '[' has no end, or holds [. or [= or an unknown class")
    held = HELD.sub(
        lambda one: CLASSES[one[1]] if one[1] else f"\\{one[0]}", match[2] or ""
    )
    return match[0] if match[2] is None else f"[{match[1]}{held}]"


def _runs_away(plain: str) -> bool:
    """True for many repeats, or groups that repeat with repeats or like branches in them."""
    while True:
        group = re.search(r"\(([^()]*)\)([*+{]?)", plain)
        if group is None:
            break
        heads = [branch[:1] for branch in group[1].split("|")]
        alike = len(heads) > 1 and len({"", ".", *heads}) < len(heads) + 2
        if group[2] and (alike or re.search(r"[*+?{]", group[1])):
            return True
        inner = group[1].replace("|", "." if group[2] else ".|.")
        plain = plain.replace(group[0], inner + group[2], 1)
    return (
        max(sum(map(branch.count, "*+?{")) for branch in plain.split("|"))
        > MOST_REPEATS
    )


def tags_match(wanted: Any, tags: Any) -> bool:
    """True if tags pass a TagsFilter; one without tags lets all pass. Raises RefusalError."""
    if wanted.filter_mode not in (
        TagsFilter.FILTER_MODE_ANY,
        TagsFilter.FILTER_MODE_ALL,
    ):
        fault = f"filter_mode {wanted.filter_mode} of the tags is none; give 0 (any) or 1 (all)."
        raise RefusalError(FAILED, fault)
    if not wanted.tags:
        return True
    match = any if wanted.filter_mode == TagsFilter.FILTER_MODE_ANY else all
    return match(tag in tags for tag in wanted.tags)


class EntityServices:
    """Answers what the standard asks about entities."""

    def __init__(self, host: Host, simulation: Simulation) -> None:
        self._host = host
        self._simulation = simulation

    def info(self, entity: Entity) -> EntityInfo:
        """Return what an entity is."""
        if entity.name in self._simulation.infos:
            return self._simulation.infos[entity.name]
        kinds = EntityCategory
        if entity.robot >= 0:
            spec = self._host.model.robot
            return _info(kinds.CATEGORY_ROBOT, f"the robot {spec.name}", ("robot",))
        kind = kinds.CATEGORY_STATIC_OBJECT
        if entity.motion is not None:
            walks = isinstance(entity.motion, Pedestrian)
            kind = kinds.CATEGORY_HUMAN if walks else kinds.CATEGORY_DYNAMIC_OBJECT
        shapes = tuple(dict.fromkeys(shape.kind for shape, _ in entity.parts))
        return _info(kind, f"an obstacle: {', '.join(shapes)}", shapes)

    def _matching(self, filters: Any) -> list[Entity]:
        self._simulation.require_world()
        pattern = pattern_of(filters.filter)
        categories = {category.category for category in filters.categories}
        unknown = categories - CATEGORIES
        if unknown:
            fault = f"category {min(unknown)} is none of the standard"
            raise RefusalError(FAILED, f"{fault}; give 0 to 5 but 3.")
        tags_match(filters.tags, ())
        region = plane.Region(filters.bounds)
        entities = self._simulation.entities
        matching = []
        for entity in entities:
            info = self.info(entity)
            pose = entities.pose(entity)
            outlines = (
                planar.rotate(outline, pose[2]) + pose[:2]
                for outline in entities.outlines(entity)
            )
            if (
                pattern.search(entity.name)
                and (not categories or info.category.category in categories)
                and tags_match(filters.tags, info.tags)
                and (region.empty or any(map(region.touches, outlines)))
            ):
                matching.append(entity)
        return matching

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
        self._simulation.require_world()
        return self._simulation.entities.find(name)

    def get_info(self, request: Any, response: Any) -> None:
        """Answer GetEntityInfo."""
        response.info = self.info(self.find(request.entity))

    def set_info(self, request: Any, _: Any) -> None:
        """Answer SetEntityInfo."""
        name = self.find(request.entity).name
        kind = request.info.category.category
        if kind not in CATEGORIES:
            fault = f"category {kind} is none of the standard; give 0 to 5 but 3."
            raise RefusalError(FAILED, fault)
        self._simulation.infos[name] = request.info

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


def _info(kind: int, description: str, tags: tuple[str, ...]) -> EntityInfo:
    category = EntityCategory(category=kind)
    return EntityInfo(category=category, description=description, tags=list(tags))
