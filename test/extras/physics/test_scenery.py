import numpy as np
import pytest
from shapely.geometry import Polygon
from shapely.ops import unary_union

from nics_drl_bridge.extras.physics.scenery import merge_into_rectangles, split_convex

L_SHAPE = [
    [-0.3, -0.3],
    [0.3, -0.3],
    [0.3, -0.1],
    [-0.1, -0.1],
    [-0.1, 0.3],
    [-0.3, 0.3],
]
ANGLES = np.linspace(0.0, 2.0 * np.pi, 10, endpoint=False)
STAR = [
    (r * np.cos(a), r * np.sin(a)) for a, r in zip(ANGLES, [1.0, 0.3] * 5, strict=True)
]


@pytest.mark.parametrize("corners", [L_SHAPE, STAR])
def test_convex_parts_fill_a_concave_outline_without_overlap(corners):
    outline = np.array(corners, dtype=np.float64)
    parts = [Polygon(part) for part in split_convex(outline)]
    whole = Polygon(outline)
    assert unary_union(parts).symmetric_difference(whole).area < 1e-9
    assert sum(part.area for part in parts) == pytest.approx(whole.area)
    assert all(part.equals(part.convex_hull) for part in parts)


def test_a_convex_outline_is_its_own_part():
    square = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    (part,) = split_convex(square)
    assert np.array_equal(part, square)


def test_rectangles_cover_each_blocked_cell_once_and_no_other():
    blocked = np.random.default_rng(0).random((30, 40)) < 0.4
    covered = np.zeros(blocked.shape, int)
    for first_row, first, row, column in merge_into_rectangles(blocked):
        covered[first_row:row, first:column] += 1
    assert np.array_equal(covered, blocked.astype(int))
    assert merge_into_rectangles(np.zeros((3, 3), bool)).shape == (0, 4)
    assert merge_into_rectangles(np.ones((3, 5), bool)).tolist() == [[0, 0, 3, 5]]
