from __future__ import annotations

import numpy as np
import pytest
from shapely.geometry import LineString, Polygon

from nics_drl_bridge.env.task import contact_ranges
from nics_drl_bridge.lidar.spec import load_lidar
from nics_drl_bridge.robot.spec import load_robot

TRUCK = ((0.5, 0.2), (0.5, -0.2), (-0.3, -0.2), (-0.3, 0.2))
ARROW = ((0.6, 0.0), (-0.3, -0.3), (0.0, 0.0), (-0.3, 0.3))
MARGIN = 0.02


def robot(footprint):
    about = {**load_robot("differential").model_dump(), "footprint": footprint}
    about.pop("footprint_radius")
    return type(load_robot("differential")).model_validate(about)


def lidar(mount):
    spec = load_lidar("paper")
    return type(spec).model_validate({**spec.model_dump(), "mount": mount})


@pytest.mark.parametrize("footprint", [TRUCK, ARROW], ids=["truck", "arrow"])
@pytest.mark.parametrize("mount", [(0.2, 0.0, 0.0), (0.1, 0.02, 1.3)])
def test_a_return_within_the_corners_of_a_footprint_is_a_touch(footprint, mount):
    spec = lidar(mount)
    found = contact_ranges(robot(footprint), spec, MARGIN)
    outline = Polygon(footprint).boundary
    for angle, leaves in zip(spec.angles[::7] + mount[2], found[::7], strict=True):
        far = (mount[0] + 3.0 * np.cos(angle), mount[1] + 3.0 * np.sin(angle))
        crossed = LineString([mount[:2], far]).intersection(outline)
        points = [crossed] if crossed.geom_type == "Point" else list(crossed.geoms)
        last = max(np.hypot(p.x - mount[0], p.y - mount[1]) for p in points)
        assert leaves == pytest.approx(last + MARGIN, abs=1e-5)


def test_beams_that_do_not_cross_a_footprint_touch_nothing():
    spec = lidar((1.0, 0.0, 0.0))
    found = contact_ranges(robot(TRUCK), spec, MARGIN)
    ahead = np.abs(spec.angles) < 1.0
    assert (found[ahead] == -np.inf).all()
    assert (found[~ahead] > 0.0).any()


def test_a_round_footprint_is_left_at_its_radius_from_the_middle():
    spec = load_robot("differential")
    found = contact_ranges(spec, lidar((0.0, 0.0, 0.5)), MARGIN)
    assert found == pytest.approx(spec.footprint_radius + MARGIN, abs=1e-6)
