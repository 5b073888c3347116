"""Worlds of Gazebo as DART's own parser and ray casting see them, against this package's."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import dartpy
import numpy as np

from nics_drl_bridge.extras.dart.scenery import cast_scan, make_group
from nics_drl_bridge.generator import builtin_model
from nics_drl_bridge.lidar.scanner import make_scanner
from nics_drl_bridge.sim.sdf import read_sdf

HEIGHT = 0.2  # of the lidar [m]
SAME_M = 0.01
CLEARANCE_M = 0.3  # of the lidar from the middle of every obstacle
TRIES = 1000


@dataclass(frozen=True)
class Comparison:
    """Two readings of one world: numbers of solids and of beams."""

    solids: int  # that this package reads
    by_dart: int  # that DART reads
    beams: int
    same: int  # beams that differ by less than `SAME_M`
    hits: int  # beams that meet something


def read_by_dart(path: Path) -> tuple[Any, list[Any]]:
    """Returns a world, and the nodes of everything that stands on its ground."""
    world = dartpy.utils.SdfParser.readWorld(dartpy.common.Uri(path.as_uri()))
    skeletons = map(world.getSkeleton, range(world.getNumSkeletons()))
    return world, [
        node
        for skeleton in skeletons
        if skeleton.getName() != "ground_plane"
        for node in skeleton.getBodyNode(0).getShapeNodes()
        if node.hasCollisionAspect()
    ]


def compare_readings(
    path: Path, seed: int, poses: int, moved: Sequence[float] = (0.0, 0.0, 0.0)
) -> Comparison:
    """Scans a world from so many free poses as both read it; this package's is moved (3,) first."""
    lidar = builtin_model("jackal").lidar.model_copy(update={"noise_std": 0.0})
    shapes, places = zip(*read_sdf(path, HEIGHT).placed, strict=True)
    scanner = make_scanner(lidar, list(dict.fromkeys(shapes)), "exact")
    bodies = scanner.place(shapes, np.array(places) + moved)
    _world, nodes = read_by_dart(path)  # without the world, its nodes end
    group = make_group(nodes)
    rng = np.random.default_rng(seed)
    middles = np.array(places)[:, :2]
    points = rng.uniform(middles.min(axis=0), middles.max(axis=0), (TRIES, 2))
    free = [
        point for point in points if np.hypot(*(middles - point).T).min() > CLEARANCE_M
    ]
    same = hits = 0
    for point in free[:poses]:
        pose = np.array([*point, rng.uniform(-np.pi, np.pi)])
        theirs = cast_scan(group, lidar, pose, HEIGHT)
        ours = scanner.scan(pose, bodies)[0]
        same += int(np.isclose(theirs, ours, rtol=0.0, atol=SAME_M).sum())
        hits += int(np.isfinite(theirs).sum())
    beams = lidar.beams * len(free[:poses])
    return Comparison(len(shapes), len(nodes), beams, same, hits)
