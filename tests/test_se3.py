"""Rotations against SciPy's, the group's axioms and formulas written out by hand."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from clamber.model.se3 import (
    frame_from_normal,
    matrix_from_quat,
    matrix_from_rpy,
    quat_conjugate,
    quat_from_matrix,
    quat_from_yaw,
    quat_multiply,
    rotation_vector,
    rpy_from_matrix,
    wrap,
    yaw_of,
)

N = 50
UP = np.array([0.0, 0.0, 1.0])


@pytest.fixture
def quats(rng) -> np.ndarray:
    """(N, 4) random unit quaternions, wxyz, of both signs of w."""
    return Rotation.random(N, random_state=rng).as_quat(scalar_first=True) * rng.choice(
        [-1.0, 1.0], (N, 1)
    )


def cross_matrix(w: np.ndarray) -> np.ndarray:
    return np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])


def test_matrices_of_quaternions_are_scipys(quats):
    theirs = Rotation.from_quat(quats, scalar_first=True).as_matrix()
    np.testing.assert_allclose(matrix_from_quat(quats), theirs, atol=1e-14)
    one_by_one = np.stack([matrix_from_quat(q) for q in quats])
    np.testing.assert_allclose(matrix_from_quat(quats), one_by_one, atol=1e-14)


def test_a_matrix_of_a_quaternion_is_a_rotation(quats):
    R = matrix_from_quat(quats)
    np.testing.assert_allclose(R @ R.mT, np.tile(np.eye(3), (N, 1, 1)), atol=1e-14)
    np.testing.assert_allclose(np.linalg.det(R), 1.0, atol=1e-14)


def test_a_quaternion_comes_back_from_its_matrix_with_positive_w(quats):
    for q in quats:
        back = quat_from_matrix(matrix_from_quat(q))
        assert back[0] >= 0
        np.testing.assert_allclose(back, q * np.sign(q[0]), atol=1e-12)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_half_turns_come_back_too(axis):
    R = -np.eye(3)
    R[axis, axis] = 1.0
    np.testing.assert_allclose(matrix_from_quat(quat_from_matrix(R)), R, atol=1e-12)


def test_the_product_of_quaternions_is_that_of_their_matrices(quats):
    a, b = quats, np.roll(quats, 1, axis=0)
    product = matrix_from_quat(quat_multiply(a, b))
    np.testing.assert_allclose(
        product, matrix_from_quat(a) @ matrix_from_quat(b), atol=1e-14
    )


def test_unit_quaternions_are_a_group(quats):
    a, b, c = quats, np.roll(quats, 1, axis=0), np.roll(quats, 2, axis=0)
    one = np.array([1.0, 0.0, 0.0, 0.0])
    left = quat_multiply(quat_multiply(a, b), c)
    right = quat_multiply(a, quat_multiply(b, c))
    np.testing.assert_allclose(left, right, atol=1e-14)
    np.testing.assert_allclose(np.linalg.norm(left, axis=1), 1.0, atol=1e-14)
    np.testing.assert_array_equal(quat_multiply(a, np.tile(one, (N, 1))), a)
    np.testing.assert_array_equal(quat_multiply(np.tile(one, (N, 1)), a), a)
    for inverse in (
        quat_multiply(a, quat_conjugate(a)),
        quat_multiply(quat_conjugate(a), a),
    ):
        np.testing.assert_allclose(inverse, np.tile(one, (N, 1)), atol=1e-14)
    np.testing.assert_allclose(
        quat_conjugate(quat_multiply(a, b)),
        quat_multiply(quat_conjugate(b), quat_conjugate(a)),
        atol=1e-14,
    )


def test_hamiltons_equations_hold():
    one, i, j, k = np.eye(4)
    for a, b, c in ((i, j, k), (j, k, i), (k, i, j)):
        np.testing.assert_array_equal(quat_multiply(a, b), c)
        np.testing.assert_array_equal(quat_multiply(b, a), -c)
        np.testing.assert_array_equal(quat_multiply(a, a), -one)


def test_roll_pitch_yaw_turn_about_fixed_axes_in_that_order(rng):
    for rpy in rng.uniform(-np.pi, np.pi, (N, 3)):
        theirs = Rotation.from_euler("xyz", rpy).as_matrix()  # lower case: fixed axes
        np.testing.assert_allclose(matrix_from_rpy(rpy), theirs, atol=1e-14)


@pytest.mark.parametrize(
    ("rpy", "before", "after"),
    [
        ([np.pi / 2, 0, 0], [0, 1, 0], [0, 0, 1]),  # roll lifts the left side
        ([0, np.pi / 2, 0], [1, 0, 0], [0, 0, -1]),  # pitch lowers the nose
        ([0, 0, np.pi / 2], [1, 0, 0], [0, 1, 0]),  # yaw turns to the left
        ([np.pi / 2, 0, np.pi / 2], [0, 1, 0], [0, 0, 1]),  # roll first, then yaw
    ],
)
def test_each_angle_turns_the_way_its_name_says(rpy, before, after):
    np.testing.assert_allclose(matrix_from_rpy(rpy) @ before, after, atol=1e-15)


def test_roll_pitch_yaw_come_back_from_their_matrix(rng):
    for rpy in rng.uniform(-1, 1, (N, 3)) * [np.pi, np.pi / 2, np.pi]:
        np.testing.assert_allclose(rpy_from_matrix(matrix_from_rpy(rpy)), rpy)
    for pitch in (np.pi / 2, -np.pi / 2):  # roll and yaw about one axis
        R = matrix_from_rpy([0.3, pitch, 0.4])
        again = rpy_from_matrix(R)
        assert again[2] == 0.0
        np.testing.assert_allclose(matrix_from_rpy(again), R, atol=1e-12)


def test_the_yaw_is_that_of_roll_pitch_yaw(quats, rng):
    for q in quats:
        yaw = rpy_from_matrix(matrix_from_quat(q))[2]
        assert yaw_of(q) == pytest.approx(yaw)
    for yaw in rng.uniform(-np.pi, np.pi, N):
        assert yaw_of(quat_from_yaw(yaw)) == pytest.approx(yaw)


def test_wrapped_angles_are_the_same_turns_within_half_a_turn(rng):
    angles = np.concatenate([rng.uniform(-50, 50, N), [np.pi, -np.pi, 0.0]])
    wrapped = wrap(angles)
    assert np.all((wrapped >= -np.pi) & (wrapped < np.pi))
    turns = (angles - wrapped) / (2 * np.pi)
    np.testing.assert_allclose(turns, turns.round(), atol=1e-12)


def test_the_rotation_vector_is_the_logarithm(rng):
    for _ in range(N):
        axis = rng.normal(size=3)
        axis /= np.linalg.norm(axis)
        w = axis * rng.uniform(1e-7, np.pi - 1e-6)
        R = Rotation.from_rotvec(w).as_matrix()
        np.testing.assert_allclose(rotation_vector(R), w, atol=2e-9)


def test_the_rotation_vector_of_a_small_turn_is_its_skew_part(rng):
    for _ in range(N):
        w = rng.normal(scale=1e-5, size=3)
        R = np.eye(3) + cross_matrix(w) + 0.5 * cross_matrix(w) @ cross_matrix(w)
        np.testing.assert_allclose(rotation_vector(R), w, atol=1e-12)
    np.testing.assert_array_equal(rotation_vector(np.eye(3)), 0.0)


def test_the_rotation_vector_is_seen_from_the_world(quats):
    """log(A R A^-1) = A log(R): a turn seen from a turned frame is a turned vector."""
    for a, r in zip(quats, np.roll(quats, 1, axis=0), strict=True):
        A, R = matrix_from_quat(a), matrix_from_quat(r)
        w = rotation_vector(R)
        if np.linalg.norm(w) > np.pi - 1e-3:
            continue
        np.testing.assert_allclose(rotation_vector(A @ R @ A.T), A @ w, atol=1e-9)
        np.testing.assert_allclose(rotation_vector(R.T), -w, atol=1e-9)


def test_a_turn_by_pi_has_a_vector_of_that_length():
    for axis in np.eye(3):
        R = Rotation.from_rotvec(np.pi * axis).as_matrix()
        w = rotation_vector(R)
        assert np.linalg.norm(w) == pytest.approx(np.pi, abs=1e-9)
        np.testing.assert_allclose(np.abs(w), np.pi * axis, atol=1e-9)


def test_a_frame_from_a_normal_is_a_rotation_with_z_along_it(rng):
    for _ in range(N):
        z, heading = rng.normal(size=(2, 3))
        z /= np.linalg.norm(z)
        R = frame_from_normal(z, heading)
        np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(R) == pytest.approx(1.0)
        np.testing.assert_allclose(R[:, 2], z, atol=1e-15)
        # No direction in the plane is nearer to the heading than x.
        flat = heading - z * (heading @ z)
        assert R[:, 0] @ heading == pytest.approx(np.linalg.norm(flat))
        assert R[:, 1] @ heading == pytest.approx(0.0, abs=1e-12)


def test_on_level_ground_x_is_the_level_heading():
    R = frame_from_normal(UP, [3.0, 4.0, 9.0])
    np.testing.assert_allclose(R[:, 0], [0.6, 0.8, 0.0], atol=1e-15)
    np.testing.assert_allclose(R[:, 1], [-0.8, 0.6, 0.0], atol=1e-15)


@pytest.mark.parametrize("normal", [*np.eye(3), *-np.eye(3)])
def test_a_heading_along_the_normal_still_gives_a_rotation(normal):
    for heading in (normal, -2.0 * normal, np.zeros(3)):
        R = frame_from_normal(normal, heading)
        np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-15)
        assert np.linalg.det(R) == pytest.approx(1.0)
        np.testing.assert_array_equal(R[:, 2], normal)
