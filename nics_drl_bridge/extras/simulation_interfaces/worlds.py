"""Worlds: the one that is loaded, those that may be, and loading."""

import math
from pathlib import Path
from typing import Any

import numpy as np
from scipy import ndimage
from simulation_interfaces.msg import Resource, Result, WorldResource
from simulation_interfaces.srv import LoadWorld

from nics_drl_bridge import defaults
from nics_drl_bridge.config import list_shipped, parse_yaml, validate
from nics_drl_bridge.errors import UnknownNameError
from nics_drl_bridge.extras.simulation_interfaces import resources
from nics_drl_bridge.extras.simulation_interfaces.host import RefusalError
from nics_drl_bridge.extras.simulation_interfaces.state import (
    STOPPED,
    Simulation,
)
from nics_drl_bridge.lidar.maps import FREE
from nics_drl_bridge.nodes.runner import get_text
from nics_drl_bridge.sim.models import HEIGHT, file_of
from nics_drl_bridge.sim.occupancy import occupancy
from nics_drl_bridge.sim.sdf import read_sdf
from nics_drl_bridge.sim.sections import Standing
from nics_drl_bridge.sim.world import Region, World, check_places
from nics_drl_bridge.sim.world_set import BARN, AnyWorld, load_worlds

CODES = LoadWorld.Response
EMPTY = (
    (-4.0, -4.0),
    (4.0, 4.0),
)  # places in the field of a world without walls around it [m]
CELL = 0.05  # [m]
MOST_OPEN = 0.5  # fraction of what is free in a field that may be open to all around


class Worlds:
    """Answers LoadWorld, GetCurrentWorld and GetAvailableWorlds."""

    def __init__(self, host: Any, simulation: Simulation) -> None:
        self._host = host
        self._simulation = simulation
        self._resource = Resource(uri=get_text(host, "world"))

    def current(self, _: Any, response: Any) -> None:
        """Answer GetCurrentWorld."""
        response.world = describe_world(self._host.world, self._resource)

    def load(self, request: Any, response: Any) -> None:
        """Answer LoadWorld; the present world stays if the other can't be read."""
        resource = resources.find(request.world_resource, CODES)
        world = self._read(resource, request)
        host = self._host
        simulation = self._simulation
        simulation.restore()
        host.use_world(world)
        simulation.renew()
        host.begin(rewind=True)
        simulation.halt(STOPPED)
        self._resource = request.world_resource
        response.world = describe_world(world, self._resource)

    def _read(self, resource: resources.Content, request: Any) -> AnyWorld:
        with resources.refused(CODES):
            if resource.form == resources.SDF:
                if resource.path is not None:
                    return self._standing(resource.path, resource.path.stem, request)
                with file_of(resource.text) as file:
                    return self._standing(file, "resource_string", request)
            if resource.path is not None:
                return _load(resource.path, named=not resource.form)
            content = parse_yaml(resource.text, resource.source)
            world = validate(content, World, resource.source)
            check_places(world)
            _ = world.grid
            return world

    def _standing(self, file: Path, name: str, request: Any) -> World:
        if request.fail_on_unsupported_element:
            fault = "fail_on_unsupported_element is not supported here; leave it out."
            raise RefusalError(Result.RESULT_FEATURE_UNSUPPORTED, fault)
        skip = bool(request.ignore_missing_or_unsupported_assets)
        standing = read_sdf(file, HEIGHT, skip_unknown=True, may_be_empty=True)
        if standing.left_out and not skip:
            if standing.missing:
                code = CODES.MISSING_ASSETS
            else:
                code = CODES.UNSUPPORTED_ASSETS
            fault = f"{name}: {standing.left_out[0]}, which a world can't hold"
            raise RefusalError(
                code, f"{fault}; put a box in its place, or ignore such assets."
            )
        return world_of(standing, name)

    def available(self, request: Any, response: Any) -> None:
        """Answer GetAvailableWorlds."""
        if request.filter.tags:
            fault = "worlds have no tags here; leave the filter out."
            raise RefusalError(Result.RESULT_FEATURE_UNSUPPORTED, fault)
        for name in list_shipped("worlds"):
            shipped = describe_world(load_worlds(name), Resource(uri=name))
            response.worlds.append(shipped)
        # The many worlds of a set would take long to read.
        for name in (BARN, *list_shipped("world_sets")):
            about = f"the worlds of {name}; every episode draws one of them"
            resource = Resource(uri=name)
            response.worlds.append(
                WorldResource(name=name, description=about, world_resource=resource)
            )
        if request.additional_sources:
            sources = ", ".join(map(repr, request.additional_sources))
            fault = f"not searched: {sources}; load a file by its path."
            if not request.continue_on_error:
                raise RefusalError(Result.RESULT_NOT_FOUND, fault)
            response.result.result = Result.RESULT_OK
            response.result.error_message = fault


def _load(path: Path, named: bool) -> AnyWorld:
    """Load worlds from a path, or by a name. Raises ConfigError, RefusalError for no such name."""
    try:
        return load_worlds(str(path))
    except UnknownNameError as error:
        if named and error.kind == "worlds":
            raise RefusalError(Result.RESULT_NOT_FOUND, str(error)) from None
        raise


def describe_world(world: AnyWorld, resource: Resource) -> WorldResource:
    """Return the description of a world."""
    x1, y1, x2, y2 = world.extent
    size = f"{x2 - x1:.3g} m x {y2 - y1:.3g} m"
    description = f"a field of {size}"
    if len(world.members) > 1:
        description = f"{len(world.members)} worlds in {size}"
    return WorldResource(
        name=world.name, world_resource=resource, description=description
    )


def world_of(standing: Standing, name: str) -> World:
    """Return the world of what stands in an SDF file. Raises ConfigError.

    What encloses most of its field bounds it; else 2 m around it do, and 5 m around the origin.
    """
    if not standing.placed:
        return _in_field(standing, name, standing.bounds(*EMPTY))
    tight = standing.bounds()
    wide = standing.bounds(*EMPTY, *np.add(np.reshape(tight, (2, 2)), [[-1.0], [1.0]]))
    return _in_field(
        standing, name, tight if _encloses(standing, tight, wide) else wide
    )


def _in_field(standing: Standing, name: str, bounds: Region) -> World:
    x1, y1, x2, y2 = bounds
    far = round(math.hypot(x2 - x1, y2 - y1), 3)
    content = {
        "name": name,
        "bounds": bounds,
        "obstacles": standing.obstacles,
        "clearance": defaults.IMPORT_CLEARANCE_M,
        "goal_distance": (
            min(defaults.IMPORT_GOAL_DISTANCE_M, round(far / 4.0, 3)),
            far,
        ),
    }
    return validate(content, World, name)


def _encloses(standing: Standing, tight: Region, wide: Region) -> bool:
    """True if most of what is free within a field can't be reached from around it."""
    made = occupancy(_in_field(standing, "field", wide), standing.placed, CELL)
    room = ndimage.distance_transform_edt(made.cells == FREE) * made.resolution
    area, _ = ndimage.label(room > defaults.IMPORT_CLEARANCE_M)
    first, last = made.world_to_cell(np.reshape(tight, (2, 2)))
    within = area[first[0] : last[0], first[1] : last[1]]
    free = within[within > 0]
    return bool(free.size and np.mean(free == area[2, 2]) < MOST_OPEN)
