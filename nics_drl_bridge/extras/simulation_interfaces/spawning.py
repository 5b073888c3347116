"""Spawning: shapes of YAML and SDF, and robots of the simulator's kind."""

import re
from typing import Any

import numpy as np
from simulation_interfaces.msg import (
    Resource,
    Result,
    Spawnable,
    SpawnResult,
)

from nics_drl_bridge import geometry
from nics_drl_bridge.config import find_config, list_shipped, read_text
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.extras.simulation_interfaces import plane, resources
from nics_drl_bridge.extras.simulation_interfaces.entities import EntityServices
from nics_drl_bridge.extras.simulation_interfaces.host import (
    Host,
    RefusalError,
)
from nics_drl_bridge.extras.simulation_interfaces.state import Simulation
from nics_drl_bridge.nodes import device_parameters
from nics_drl_bridge.sim.entities import NAME, OutsideError, hull_of
from nics_drl_bridge.sim.models import Model, model_of_sdf, model_of_yaml

# With room for the names of topics, which may have 255 characters in all.
NAMESPACE = re.compile(
    r"(?=.{1,120}\Z)/?[A-Za-z_][A-Za-z0-9_]*(/[A-Za-z_][A-Za-z0-9_]*)*"
)
FORMATS = ["sdf", "yaml"]
FOLDER = "entities"  # of the shipped ones, in config/


class Spawning:
    """Answers SpawnEntity and GetSpawnables."""

    def __init__(
        self, host: Host, simulation: Simulation, entities: EntityServices
    ) -> None:
        self._host = host
        self._simulation = simulation
        self._entities = entities

    def spawn(self, request: Any, response: Any) -> None:
        """Answer SpawnEntity. Raises RefusalError, BridgeError."""
        model = self._model(request)
        wanted = request.name or ("" if model is None else model.name)
        name = self._name(wanted, request.allow_renaming)
        space = self._namespace(request.entity_namespace, name, model is None)
        entities = self._simulation.entities
        code = SpawnResult.INVALID_POSE
        posed = request.initial_pose
        base = plane.frame_pose(
            posed.header.frame_id, entities, self._host.frames, code
        )
        pose = plane.pose_from_ros(posed.pose, base, code)
        try:
            if model is None:
                robot = entities.spawn_robot(name, pose)
                try:
                    self._host.add_robot(space)
                except BaseException:
                    entities.delete(robot)
                    raise
            else:
                entities.spawn(name, model.parts, pose)
        except OutsideError as error:
            raise RefusalError(code, str(error)) from None
        response.entity_name = name

    def _model(self, request: Any) -> Model | None:
        """The entity of a request; None for a robot. Raises RefusalError."""
        resource = resources.find(request.entity_resource, SpawnResult)
        if not resource.form:
            if resource.source == self._host.model.robot.name:
                return None
            try:
                path = find_config(resource.source, FOLDER)
                resource = resources.Content(
                    resources.YAML, read_text(path), path.stem, path
                )
            except ConfigError as error:
                held = f"robots here are {self._host.model.robot.name!r}"
                raise RefusalError(
                    Result.RESULT_NOT_FOUND, f"{error} {held}."
                ) from None
        with resources.refused(SpawnResult):
            if resource.form == resources.SDF:
                z = request.initial_pose.pose.position.z
                return model_of_sdf(
                    resource.text, z if np.isfinite(z) else 0.0, resource.source
                )
            model = model_of_yaml(resource.text, resource.source)
            if resource.path is None or model.name:
                return model
            return model._replace(name=resource.path.stem)

    def _name(self, wanted: str, may_rename: bool) -> str:
        entities = self._simulation.entities
        if not wanted:
            if may_rename:
                return entities.free_name("entity")
            fault = "the name is empty; give one, or set allow_renaming."
            raise RefusalError(SpawnResult.NAME_INVALID, fault)
        if not NAME.fullmatch(wanted):
            fault = f"the name {wanted!r} is not valid; use up to 120 letters, digits, and _ . / -"
            raise RefusalError(SpawnResult.NAME_INVALID, f"{fault} between them.")
        free = entities.free_name(wanted)
        if free != wanted and not may_rename:
            fix = "give another, or set allow_renaming"
            raise RefusalError(
                SpawnResult.NAME_NOT_UNIQUE, f"the name {wanted!r} is taken; {fix}."
            )
        return free

    def _namespace(self, wanted: str, name: str, robot: bool) -> str:
        """The wanted one, or a robot's by its name, which no other may have. RefusalError."""
        host: Any = self._host
        space = wanted or re.sub(r"\W", "_", name)
        code = SpawnResult.NAMESPACE_INVALID
        if (robot or wanted) and not NAMESPACE.fullmatch(space):
            if wanted:
                fault = f"entity_namespace {wanted!r} is"
            else:
                fault = f"the name {name!r} makes"
            code = code if wanted else SpawnResult.NAME_INVALID
            raise RefusalError(
                code, f"{fault} no namespace of ROS; write it as in 'robot_1'."
            )
        scan = robot and host.resolve_topic_name(f"{space}/scan")
        taken = scan in [publisher.topic_name for publisher in host.publishers]
        if robot and (
            taken or device_parameters.frames(host, space.strip("/")) in host.frames
        ):
            fault = f"the namespace {space!r} is that of another robot"
            raise RefusalError(code, f"{fault}; give one as entity_namespace.")
        return space

    def list_spawnables(self, request: Any, response: Any) -> None:
        """Answer GetSpawnables."""
        robot = self._host.model.robot
        hull = hull_of(self._simulation.entities.simulator.footprint)
        response.spawnables.append(
            _spawnable(robot.name, f"another robot {robot.name}", [hull])
        )
        for name in list_shipped(FOLDER):
            model = model_of_yaml(read_text(find_config(name, FOLDER)), name)
            hulls = [
                geometry.rotate(hull_of(shape), at[2]) + at[:2]
                for shape, at in model.parts
            ]
            response.spawnables.append(_spawnable(name, model.description, hulls))
        if request.sources:
            response.result.result = Result.RESULT_OK
            sources = ", ".join(map(repr, request.sources))
            response.result.error_message = (
                f"not searched: {sources}; spawn a file by its path."
            )


def _spawnable(uri: str, about: str, hulls: list[Any]) -> Spawnable:
    bounds = plane.box_to_ros(hulls)
    return Spawnable(
        entity_resource=Resource(uri=uri), description=about, spawn_bounds=bounds
    )
