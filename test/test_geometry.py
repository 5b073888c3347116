import numpy as np
import pytest
from scipy.linalg import expm

from nics_drl_bridge import geometry

EDGES = [
    0.0,
    np.pi,
    -np.pi,
    np.nextafter(np.pi, 4.0),
    np.nextafter(-np.pi, -4.0),
    np.nextafter(np.pi, 0.0),
    -1e-17,
    3.0 * np.pi,
    -3.0 * np.pi,
    1e9,
    -1e9,
]


def random_poses(count, seed=0):
    """Poses of all sizes, with headings on and around the seam among them."""
    rng = np.random.default_rng(seed)
    poses = rng.normal(size=(count, 3)) * 10.0 ** rng.uniform(-3.0, 2.0, (count, 1))
    poses[:, 2] = rng.uniform(-np.pi, np.pi, count)
    seam = [
        edge for edge in EDGES if abs(edge) < 10.0
    ]  # beyond, rounding hides the direction
    poses[: len(seam), 2] = seam
    return poses


def matrix(pose):
    x, y, heading = pose
    c = np.cos(heading)
    s = np.sin(heading)
    return np.array([[c, -s, x], [s, c, y], [0.0, 0.0, 1.0]])


def generator_matrix(twist):
    x, y, w = twist
    return np.array([[0.0, -w, x], [w, 0.0, y], [0.0, 0.0, 0.0]])


def turn_between(a, b):
    """The angle from one heading to another, without using the code under test."""
    return np.angle(np.exp(1j * (np.asarray(b) - np.asarray(a))))


def test_composition_multiplies_homogeneous_matrices():
    for a, b in zip(random_poses(200, 2), random_poses(200, 3), strict=True):
        assert np.allclose(
            matrix(geometry.compose(a, b)), matrix(a) @ matrix(b), rtol=1e-12, atol=1e-9
        )


def test_the_pose_between_two_leads_from_one_to_the_other():
    a = random_poses(500, 4)
    b = random_poses(500, 5)
    reached = geometry.compose(a, geometry.between(a, b))
    assert np.allclose(reached[:, :2], b[:, :2], rtol=1e-12, atol=1e-9)
    assert np.abs(turn_between(reached[:, 2], b[:, 2])).max() < 1e-9
    assert ((reached[:, 2] >= -np.pi) & (reached[:, 2] < np.pi)).all()


@pytest.mark.parametrize("turn", [0.0, 1e-12, 9.9e-5, 1.01e-4, 1e-3, 0.7, -3.0, 5.0])
def test_exp_is_the_matrix_exponential(turn):
    rng = np.random.default_rng(6)
    for x, y in rng.normal(size=(20, 2)):
        twist = np.array([x, y, turn])
        assert np.allclose(
            matrix(geometry.exp(twist)),
            expm(generator_matrix(twist)),
            rtol=0.0,
            atol=1e-11,
        )


def test_a_batch_gives_what_its_rows_give_one_by_one():
    a = random_poses(60, 9).reshape(3, 20, 3)
    b = random_poses(20, 10)
    for function in (geometry.compose, geometry.between):
        batch = function(a, b)
        assert batch.shape == (3, 20, 3)
        assert np.array_equal(batch[1, 5], function(a[1, 5], b[5]))
    for function in (geometry.exp, geometry.log):
        assert np.array_equal(function(a)[2, 7], function(a[2, 7]))


def test_a_degree_of_latitude_and_of_longitude_has_its_known_length():
    thousandth = np.radians(0.001)
    east, _ = geometry.east_and_north(
        np.array([0.0, thousandth]), np.radians([45.0, 45.0])
    )
    _, north = geometry.east_and_north(np.zeros(2), np.radians([45.0, 45.001]))
    assert east[1] == pytest.approx(78.847, abs=0.001)
    assert north[1] == pytest.approx(111.132, abs=0.001)


def test_wrapping_keeps_the_direction_within_a_half_open_interval():
    angles = np.random.default_rng(1).uniform(-40.0, 40.0, 10_000)
    assert np.abs(turn_between(angles, geometry.wrap_angle(angles))).max() < 1e-13
    wrapped = geometry.wrap_angle([*angles, *EDGES])
    assert ((wrapped >= -np.pi) & (wrapped < np.pi)).all()
    assert np.abs(geometry.wrap_angle(wrapped) - wrapped).max() < 1e-15


def test_exp_and_log_undo_each_other_at_the_seam_too():
    rng = np.random.default_rng(7)
    poses = random_poses(300, 8)
    back = geometry.exp(geometry.log(poses))
    assert np.allclose(back[:, :2], poses[:, :2], rtol=1e-9, atol=1e-9)
    assert np.abs(turn_between(back[:, 2], poses[:, 2])).max() < 1e-6
    twist = rng.normal(size=(3000, 3))
    for largest in (3.14, 2e-4, 0.0):
        twist[:, 2] = rng.uniform(-largest, largest, len(twist))
        assert np.abs(geometry.log(geometry.exp(twist)) - twist).max() < 1e-8


def test_path_lengths_ignore_the_heading_and_begin_with_0():
    poses = np.array(
        [[0.0, 0.0, 0.0], [3.0, 4.0, 1.0], [3.0, 4.0, 2.0], [3.0, 2.0, 2.0]]
    )
    assert geometry.measure_path(poses) == pytest.approx([0.0, 5.0, 5.0, 7.0])
    assert geometry.accumulate([]).tolist() == [0.0]
