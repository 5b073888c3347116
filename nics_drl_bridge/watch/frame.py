"""What the page shows: one stage, and frames over time, as plain data for JSON."""

import base64
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from nics_drl_bridge.env.snapshot import Snapshot
from nics_drl_bridge.generator import SimulatorModel
from nics_drl_bridge.geometry import Array
from nics_drl_bridge.lidar.exact_kernels import HEADING, RADIUS, SHAPE, X, Y
from nics_drl_bridge.lidar.maps import GridMap
from nics_drl_bridge.lidar.shapes import Shape
from nics_drl_bridge.sim.world import World
from nics_drl_bridge.sim.world_set import AnyWorld
from nics_drl_bridge.watch.motion import MotionMeter, Velocities

MM = 1000.0  # lengths and angles are sent as integer thousandths
NO_RETURN = -1


@dataclass(frozen=True)
class Stage:
    """Everything that stays the same from frame to frame."""

    title: str
    model: SimulatorModel
    # The members of these worlds, one after another, are the places of frames.
    worlds: tuple[AnyWorld, ...]
    # requests that the source accepts, see `server.Request`
    can: frozenset[str] = frozenset()
    # names of policies and worlds to choose from
    choices: Mapping[str, Sequence[str]] = field(default_factory=dict)
    chosen: Mapping[str, str] = field(default_factory=dict)
    span_s: tuple[float, float] | None = None  # first and last time of a bag [s]
    # name of the model on the page; if empty, the robot's name
    model_name: str = ""

    def plain(self) -> dict[str, Any]:
        """Returns the stage as plain data."""
        robot = self.model.robot
        lidar = self.model.lidar
        commands = [
            variable.model_dump(include={"name", "unit", "min", "max"})
            for variable in robot.command
        ]
        places = [
            _describe_place(member, world.shapes)
            for world in self.worlds
            for member in world.members
        ]
        return {
            "kind": "stage",
            "title": self.title,
            "can": sorted(self.can),
            "commands": commands,
            "sideways": robot.moves_sideways,
            "footprint": robot.footprint,
            "radius": robot.footprint_radius,
            "model": {
                "name": self.model_name or robot.name,
                "robot": robot.name,
                "lidar": f"{lidar.beams} beams, {lidar.range_max:g} m",
            },
            "lidar": {
                "mount": lidar.mount,
                "first": lidar.angle_min,
                "step": lidar.angle_increment,
                "far": lidar.range_max,
            },
            "places": places,
            "span": self.span_s,
            "chosen": dict(self.chosen),
            "choices": {name: list(names) for name, names in self.choices.items()},
        }


def _describe_place(world: World, shapes: Sequence[Shape]) -> dict[str, Any]:
    outlines = [np.round(shape.outline / shape.radius, 4).tolist() for shape in shapes]
    return {
        "name": world.name,
        "extent": world.extent,
        "walls": world.all_walls().tolist(),
        "map": world.grid and _describe_map(world.grid),
        "shapes": outlines,
    }


def _describe_map(grid: GridMap) -> dict[str, Any]:
    """Returns a map with one byte per cell: 0 free, 1 unknown, 2 blocked."""
    cells = np.where(grid.free, 0, np.where(grid.blocked, 2, 1)).astype(np.uint8)
    return {
        "rows": cells.shape[0],
        "columns": cells.shape[1],
        "resolution": grid.resolution,
        "origin": grid.origin,
        "cells": base64.b64encode(cells.tobytes()).decode(),
    }


@dataclass(frozen=True)
class WorldFrame:
    """What is shown of one world at one time."""

    shot: Snapshot
    name: str = ""
    place: int = 0  # index among the members of `Stage.worlds`
    trails: tuple[Array, ...] = ()  # (T, 2) path of each robot in this episode [m]
    state: str = ""  # state of the episode, in a word or two
    time_s: float | None = None  # since the start of its episode [s]; None: the frame's

    def plain(self, velocities: Velocities) -> dict[str, Any]:
        """Returns the world as plain data."""
        shot = self.shot
        exists = shot.bodies[:, RADIUS] > 0.0
        bodies = shot.bodies[exists]
        ranges = np.where(np.isfinite(shot.ranges), shot.ranges, NO_RETURN / MM)
        plain: dict[str, Any] = {
            "name": self.name,
            "place": self.place,
            "state": self.state,
            "gate": shot.gate,
            "poses": round_to_thousandths(shot.poses),
            "ranges": round_to_thousandths(ranges),
            "bodies": round_to_thousandths(bodies[:, [X, Y, HEADING, RADIUS]]),
            "kinds": bodies[:, SHAPE].astype(int).tolist(),
            "goals": round_to_thousandths(shot.goals),
            "velocities": round_to_thousandths(velocities.robots),
            "body_velocities": round_to_thousandths(velocities.bodies[exists]),
            "trails": [round_to_thousandths(trail) for trail in self.trails],
            "estimates": None,
            "ellipses": None,
            "commands": None,
        }
        if shot.estimates is not None:
            plain["estimates"] = round_to_thousandths(shot.estimates)
        if shot.covariance is not None:
            plain["ellipses"] = [_compute_ellipse(c) for c in shot.covariance]
        if shot.commands is not None:
            plain["commands"] = np.round(shot.commands, 3).tolist()
        return plain


def _compute_ellipse(covariance: Array) -> list[float]:
    """Returns semi-axes [m] and rotation [rad] of the 95 % confidence ellipse."""
    values, vectors = np.linalg.eigh(covariance[:2, :2])
    scale = -2.0 * math.log(0.05)  # quantile of chi squared with two degrees of freedom
    small, large = np.sqrt(np.maximum(values, 0.0) * scale).tolist()
    return [
        round(large, 4),
        round(small, 4),
        round(math.atan2(vectors[1, 1], vectors[0, 1]), 4),
    ]


def round_to_thousandths(values: ArrayLike) -> Any:
    """Returns numbers as lists of integer thousandths, with 0 for non-finite ones."""
    scaled = np.nan_to_num(np.asarray(values, np.float64) * MM, posinf=0.0, neginf=0.0)
    return np.rint(scaled).astype(np.int64).tolist()


@dataclass(frozen=True)
class Frame:
    """What is shown of all worlds at one time."""

    time_s: float
    worlds: tuple[WorldFrame, ...]
    note: str = ""  # a line about all worlds, such as training progress

    def plain(self, meter: MotionMeter | None = None) -> dict[str, Any]:
        """Returns the frame as plain data, with velocities if a meter measures them."""
        pairs = zip(self.worlds, self.measured_by(meter or MotionMeter()), strict=True)
        return {
            "kind": "frame",
            "time": self.time_s,
            "note": self.note,
            "worlds": [world.plain(velocities) for world, velocities in pairs],
        }

    def measured_by(self, meter: MotionMeter) -> list[Velocities]:
        """Returns the velocities in each world since the meter's previous frame."""
        times_s = [
            self.time_s if world.time_s is None else world.time_s
            for world in self.worlds
        ]
        return meter.measure(times_s, [world.shot for world in self.worlds])


class Track:
    """Paths of M robots in an episode, with at most `MOST` points each."""

    MOST = 600

    def __init__(self) -> None:
        self._points: list[Array] = []

    def add(self, poses: Array, step: int) -> None:
        """Adds the robots' poses (M, 3) after a step of the episode; step 0 restarts the paths."""
        if step == 0:
            self._points = []
        self._points.append(poses[:, :2].copy())
        if len(self._points) > self.MOST:
            # Drop every other point, so that the whole path stays visible.
            del self._points[::2]

    @property
    def paths(self) -> tuple[Array, ...]:
        """Paths (T, 2) of the robots."""
        return tuple(np.array(self._points).transpose(1, 0, 2)) if self._points else ()
