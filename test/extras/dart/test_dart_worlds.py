"""Worlds of Gazebo as DART's own parser reads them, against this package's reading."""

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("dartpy", reason="needs DART: the extra `dart`")

import dartpy

from nics_drl_bridge.extras.dart.scenery import cast_scan, make_group
from nics_drl_bridge.generator import builtin_model
from nics_drl_bridge.lidar.scanner import make_scanner
from nics_drl_bridge.sim.sdf import read_sdf

BARN = Path(__file__).resolve().parents[4] / "shared" / "barn" / "gazebo"
HEIGHT = 0.2  # of the lidar [m]
POSES = 12  # per world
pytestmark = pytest.mark.slow


def read_by_dart(path: Path) -> list:
    """The nodes of everything that stands on the ground."""
    world = dartpy.utils.SdfParser.readWorld(dartpy.common.Uri(path.as_uri()))
    skeletons = map(world.getSkeleton, range(world.getNumSkeletons()))
    read_by_dart.world = world  # its shapes end with it
    return [
        node
        for skeleton in skeletons
        if skeleton.getName() != "ground_plane"
        for node in skeleton.getBodyNode(0).getShapeNodes()
        if node.hasCollisionAspect()
    ]


@pytest.mark.parametrize("number", [1, 2, 50, 151, 200, 299])
def test_a_published_world_looks_the_same_to_dart_and_to_this_package(number):
    path = BARN / f"world_{number}.world"
    if not path.is_file():
        pytest.skip("the benchmark's worlds are not on this machine")
    lidar = builtin_model("jackal").lidar.model_copy(update={"noise_std": 0.0})
    shapes, places = zip(*read_sdf(path, HEIGHT).placed, strict=True)
    scanner = make_scanner(lidar, list(dict.fromkeys(shapes)), "exact")
    bodies = scanner.place(shapes, places)
    nodes = read_by_dart(path)
    assert len(nodes) == len(shapes)
    group = make_group(dartpy, nodes)
    rng = np.random.default_rng(number)
    middles = np.array(places)[:, :2]
    same = beams = 0
    for _ in range(POSES):
        point = rng.uniform(middles.min(axis=0), middles.max(axis=0))
        if np.hypot(*(middles - point).T).min() < 0.3:
            continue
        pose = np.array([*point, rng.uniform(-np.pi, np.pi)])
        theirs = cast_scan(dartpy, group, lidar, pose, HEIGHT)
        ours = scanner.scan(pose, bodies)[0]
        assert np.isfinite(ours).sum() > 50
        same += int(np.isclose(theirs, ours, rtol=0.0, atol=0.01).sum())
        beams += lidar.beams
    assert beams > 0
    assert same >= 0.999 * beams
