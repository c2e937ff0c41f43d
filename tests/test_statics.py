"""Static stability against hand-computed cases, HiGHS, SciPy's hull and Klampt."""

import json
import math
import subprocess
import sys
import time
from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import linprog
from scipy.spatial import ConvexHull

from clamber.model.se3 import matrix_from_rpy
from clamber.step.statics import (
    BALANCE_TOL,
    GRAVITY,
    TorqueLimits,
    com_margin,
    com_margins,
    cone_generators,
    contact_angle,
    contact_forces,
    contact_frames,
    contact_phase,
    ellipse_excess,
    is_statically_stable,
    polygon_halfplanes,
    projected_distance,
    static_equilibrium,
    strength_needed,
    support_ellipse,
    support_polygon,
    theta_max,
)

UP = np.array([0.0, 0.0, 1.0])
MASS = 30.0
WEIGHT = MASS * GRAVITY
SQUARE = np.array([[-0.1, -0.1], [0.1, -0.1], [0.1, 0.1], [-0.1, 0.1]])


def flat(xy: np.ndarray, mu: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points, normals and friction of contacts on level ground."""
    n = len(xy)
    return np.c_[xy, np.zeros(n)], np.tile(UP, (n, 1)), np.full(n, mu)


def random_stance(rng: np.random.Generator, most: int = 8):
    """2 to `most` points, tilted normals, mu from 0.2 to 1, a centre of mass near."""
    nc = int(rng.integers(2, most + 1))
    points = rng.uniform(-0.4, 0.4, (nc, 3)) * [1.0, 1.0, 0.5]
    normals = np.c_[rng.normal(0.0, 0.35, (nc, 2)), np.ones(nc)]
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    com = np.append(points[:, :2].mean(axis=0) + rng.normal(0.0, 0.08, 2), 0.5)
    return points, normals, rng.uniform(0.2, 1.0, nc), com


def wrench_of(points: np.ndarray, forces: np.ndarray, com: np.ndarray) -> np.ndarray:
    return np.append(forces.sum(axis=0), np.cross(points - com, forces).sum(axis=0))


def lp_holds(points, normals, mu, com, edges: int) -> bool:
    """The defining LP, written out contact by contact, solved by HiGHS."""
    columns = []
    for p, edges_of in zip(points, cone_generators(normals, mu, edges), strict=True):
        columns += [np.append(e, np.cross(p - com, e)) for e in edges_of]
    A = np.array(columns).T
    b = [0.0, 0.0, 1.0, 0.0, 0.0, 0.0]
    return linprog(np.zeros(A.shape[1]), A_eq=A, b_eq=b, method="highs").status == 0


# The geometric measure.


def test_projected_distance_is_horizontal_on_level_ground():
    assert projected_distance([0.1, 0.2, 0.3], [0.4, 0.6, 0.9]) == pytest.approx(0.5)


def test_projected_distance_is_measured_across_the_given_normal():
    R = matrix_from_rpy([0.3, -0.2, 0.5])
    contact, mass = np.array([0.1, 0.2, 0.3]), np.array([0.4, 0.6, 0.9])
    d = projected_distance(R @ contact, R @ mass, R[:, 2])
    assert d == pytest.approx(0.5)


@pytest.mark.parametrize(
    ("mass", "angle"),
    [((0, 0, 1), 0.0), ((1, 0, 1), math.pi / 4), ((0, 0, -1), math.pi)],
)
def test_contact_angle_is_from_the_vertical(mass, angle):
    assert contact_angle([0, 0, 0], mass) == pytest.approx(angle)


def test_d_is_l_times_the_sine_of_the_contact_angle():
    rng = np.random.default_rng(0)
    for contact, mass in rng.normal(size=(20, 2, 3)):
        l = np.linalg.norm(mass - contact)
        d = l * math.sin(contact_angle(contact, mass))
        assert projected_distance(contact, mass) == pytest.approx(d)


def test_theta_max_is_the_friction_angle_up_to_25_degrees():
    assert theta_max(0.2) == pytest.approx(math.atan(0.2))
    assert theta_max(0.8) == pytest.approx(math.radians(25))


def test_a_contact_supports_up_to_the_bound_and_slides_beyond():
    bound = 0.5 * math.sin(theta_max(0.8))
    near, far = bound - 1e-9, bound + 1e-9
    assert contact_phase(near, 0.5, theta_max(0.8), loaded=True) == "supporting"
    wanted = "reach-to-supportable"
    assert contact_phase(near, 0.5, theta_max(0.8), loaded=False) == wanted
    for loaded in (True, False):
        assert contact_phase(far, 0.5, theta_max(0.8), loaded=loaded) == "sliding"


# The support polygon.


def test_the_hull_has_the_vertices_that_qhull_finds_counter_clockwise():
    rng = np.random.default_rng(1)
    for _ in range(200):
        points = rng.normal(size=(int(rng.integers(3, 20)), 2))
        polygon = support_polygon(points)
        expected = points[ConvexHull(points).vertices]
        start = int(np.argmin(np.linalg.norm(expected - polygon[0], axis=1)))
        np.testing.assert_allclose(
            polygon, np.roll(expected, -start, axis=0), atol=2e-9
        )


def test_the_hull_of_few_or_collinear_points_is_what_is_left_of_it():
    assert support_polygon(np.zeros((0, 2))).shape == (0, 2)
    assert support_polygon(np.ones((5, 2))).tolist() == [[1, 1]]
    assert support_polygon(np.array([[1, 0], [0, 0]])).tolist() == [[0, 0], [1, 0]]
    line = np.outer([0.5, 1.0, 0.0, 0.25], [2.0, 1.0])
    assert support_polygon(line).tolist() == [[0, 0], [2, 1]]


def test_collinear_points_on_an_edge_are_no_vertices():
    middles = (SQUARE + np.roll(SQUARE, -1, axis=0)) / 2
    assert len(support_polygon(np.r_[SQUARE, middles, SQUARE])) == 4


def test_the_hull_survives_noise_in_the_last_bits():
    """A vertical left edge whose points are sorted by noise keeps both its ends."""
    rng = np.random.default_rng(2)
    grid = np.stack(np.meshgrid([0.0, 1.0], np.linspace(0, 1, 7)), axis=-1)
    for _ in range(200):
        points = grid.reshape(-1, 2) + rng.normal(0, 1e-16, (14, 2))
        polygon = support_polygon(points)
        A, b = polygon_halfplanes(polygon)
        assert np.all(points @ A.T <= b + 2e-9)
        for corner in ([0, 0], [1, 0], [1, 1], [0, 1]):
            assert np.min(np.linalg.norm(polygon - corner, axis=1)) < 2e-9


def test_halfplanes_have_unit_outward_normals_and_touch_their_edges():
    polygon = support_polygon(np.random.default_rng(3).normal(size=(12, 2)))
    A, b = polygon_halfplanes(polygon)
    assert A.shape == polygon.shape
    np.testing.assert_allclose(np.linalg.norm(A, axis=1), 1.0)
    np.testing.assert_allclose(np.sum(A * polygon, axis=1), b)
    np.testing.assert_allclose(np.sum(A * np.roll(polygon, -1, axis=0), axis=1), b)
    assert np.all(A @ polygon.mean(axis=0) < b)


def test_halfplanes_of_a_segment_hold_on_the_segment_alone():
    A, b = polygon_halfplanes(np.array([[0.0, 0.0], [0.3, 0.4]]))
    assert A.shape == (4, 2)

    def inside(p):
        return bool(np.all(A @ p <= b + 1e-12))

    assert inside([0.15, 0.2])
    assert not inside([0.15, 0.21])
    assert not inside([0.15, 0.19])
    assert not inside([0.33, 0.44])
    assert not inside([-0.03, -0.04])


def test_halfplanes_of_a_point_meet_in_it():
    A, b = polygon_halfplanes(np.array([[0.3, -0.2]]))
    for offset in ([0.01, 0], [-0.01, 0], [0, 0.01], [0, -0.01]):
        assert np.max(A @ (np.array([0.3, -0.2]) + offset) - b) == pytest.approx(0.01)
    with pytest.raises(ValueError, match="no half-planes"):
        polygon_halfplanes(np.zeros((0, 2)))


def test_com_margin_is_the_distance_to_the_border_positive_inside():
    assert com_margin([0.0, 0.0], SQUARE) == pytest.approx(0.1)
    assert com_margin([0.07, 0.0, 5.0], SQUARE) == pytest.approx(0.03)
    assert com_margin([0.13, 0.0], SQUARE) == pytest.approx(-0.03)
    assert com_margin([0.13, 0.14], SQUARE) == pytest.approx(-0.05)  # to the corner


def test_com_margin_agrees_with_a_dense_sampling_of_the_border():
    rng = np.random.default_rng(4)
    for _ in range(20):
        polygon = support_polygon(rng.normal(size=(8, 2)))
        t = np.linspace(0, 1, 4001)[:, None, None]
        border = polygon * (1 - t) + np.roll(polygon, -1, axis=0) * t
        for p in rng.normal(size=(10, 2)):
            distance = np.min(np.linalg.norm(border - p, axis=-1))
            assert abs(com_margin(p, polygon)) == pytest.approx(distance, abs=1e-3)
            A, b = polygon_halfplanes(polygon)
            assert (com_margin(p, polygon) > 0) == bool(np.all(A @ p < b))


def test_com_margin_over_a_segment_a_point_or_nothing_is_never_positive():
    segment = np.array([[0.0, 0.0], [1.0, 0.0]])
    assert com_margin([0.5, 0.0], segment) == 0.0
    assert com_margin([0.5, 0.2], segment) == pytest.approx(-0.2)
    assert com_margin([1.3, 0.4], segment) == pytest.approx(-0.5)
    assert com_margin([3.0, 4.0], np.zeros((1, 2))) == pytest.approx(-5.0)
    assert com_margin([0.0, 0.0], np.zeros((0, 2))) == -math.inf


# The support ellipse.


def border_of(ellipse, n: int = 360) -> np.ndarray:
    """Points of the ellipse, from centre, axes and the direction of the foci."""
    along = ellipse.foci[1] - ellipse.foci[0]
    length = np.linalg.norm(along)
    u = along / length if length > 1e-12 else np.array([1.0, 0.0])
    a = np.linspace(0, 2 * math.pi, n, endpoint=False)
    x, y = ellipse.semi_axes[0] * np.cos(a), ellipse.semi_axes[1] * np.sin(a)
    return ellipse.centre + np.outer(x, u) + np.outer(y, [-u[1], u[0]])


def test_the_ellipse_lies_inside_and_touches_the_polygon():
    rng = np.random.default_rng(5)
    for _ in range(50):
        polygon = support_polygon(rng.normal(size=(9, 2)))
        A, b = polygon_halfplanes(polygon)
        ellipse = support_ellipse(polygon)
        gap = b - border_of(ellipse, 3600) @ A.T
        assert gap.min() > -1e-6
        assert gap.min() < 1e-4


def test_the_string_length_is_the_sum_of_distances_on_the_border():
    ellipse = support_ellipse(
        support_polygon(np.random.default_rng(6).normal(size=(9, 2)))
    )
    for p in border_of(ellipse):
        assert ellipse.excess(p)[0] == pytest.approx(0.0, abs=1e-9)
    assert ellipse.excess(ellipse.centre)[0] < 0
    outside = ellipse.centre + 1.01 * (border_of(ellipse) - ellipse.centre)
    assert all(ellipse.excess(p)[0] > 0 for p in outside)


def test_the_ellipse_of_a_rectangle_has_its_half_sides_as_axes():
    R = matrix_from_rpy([0, 0, 0.4])[:2, :2]
    ellipse = support_ellipse(SQUARE * [3.0, 1.0] @ R.T + [1.0, 2.0])
    np.testing.assert_allclose(ellipse.centre, [1.0, 2.0])
    np.testing.assert_allclose(ellipse.semi_axes, [0.3, 0.1])
    focus = R @ [math.sqrt(0.3**2 - 0.1**2), 0.0]
    expected = {tuple(np.round([1.0, 2.0] + s * focus, 9)) for s in (1, -1)}
    assert {tuple(np.round(f, 9)) for f in ellipse.foci} == expected
    assert ellipse.string_length == pytest.approx(0.6)


def test_the_ellipse_of_a_triangle_touches_the_middles_of_its_sides():
    """The Steiner inellipse: the largest one that fits into a triangle."""
    triangle = np.array([[0.0, 0.0], [1.0, 0.1], [0.3, 0.7]])
    ellipse = support_ellipse(triangle)
    for middle in (triangle + np.roll(triangle, -1, axis=0)) / 2:
        assert ellipse.excess(middle)[0] == pytest.approx(0.0, abs=1e-12)


def test_the_ellipse_has_the_axes_of_the_second_moments_of_area():
    rng = np.random.default_rng(19)
    polygon = support_polygon(rng.normal(size=(7, 2)) * [1.0, 0.4])
    A, b = polygon_halfplanes(polygon)
    low, high = polygon.min(axis=0), polygon.max(axis=0)
    samples = low + (high - low) * rng.random((400_000, 2))
    samples = samples[np.all(samples @ A.T < b, axis=1)]
    ellipse = support_ellipse(polygon)
    np.testing.assert_allclose(ellipse.centre, samples.mean(axis=0), atol=5e-3)
    values, vectors = np.linalg.eigh(np.cov(samples.T))
    ratio = math.sqrt(values[1] / values[0])
    assert ellipse.semi_axes[0] / ellipse.semi_axes[1] == pytest.approx(ratio, rel=5e-3)
    along = ellipse.foci[1] - ellipse.foci[0]
    assert abs(along @ vectors[:, 1]) == pytest.approx(np.linalg.norm(along), rel=1e-3)


def test_the_excess_needs_no_record():
    rng = np.random.default_rng(6)
    for n in (1, 2, 3, 4, 9):
        polygon, com = support_polygon(rng.normal(size=(n, 2))), rng.normal(size=3)
        excess, gradient = ellipse_excess(polygon, com)
        wanted = support_ellipse(polygon).excess(com)
        assert excess == wanted[0]
        assert np.array_equal(gradient, wanted[1])


def test_the_gradient_of_the_excess_matches_finite_differences():
    rng = np.random.default_rng(7)
    ellipse = support_ellipse(support_polygon(rng.normal(size=(9, 2))))
    for p in rng.normal(size=(20, 2)):
        _, gradient = ellipse.excess(p)
        for k, step in enumerate(np.eye(2) * 1e-6):
            slope = (ellipse.excess(p + step)[0] - ellipse.excess(p - step)[0]) / 2e-6
            assert gradient[k] == pytest.approx(slope, abs=1e-8)
    assert np.all(np.isfinite(ellipse.excess(ellipse.foci[0])[1]))


def test_ellipses_of_a_segment_and_a_point_have_no_inside():
    segment = support_ellipse(np.array([[0.0, 0.0], [0.0, 2.0]]))
    assert segment.string_length == pytest.approx(2.0)
    assert segment.excess([0.0, 0.7])[0] == pytest.approx(0.0)
    assert segment.excess([0.1, 0.7])[0] > 0
    point = support_ellipse(np.array([[1.0, 1.0]]))
    assert point.excess([4.0, 5.0])[0] == pytest.approx(10.0)
    with pytest.raises(ValueError, match="no ellipse"):
        support_ellipse(np.zeros((0, 2)))


# Friction cones.


def test_contact_frames_are_rotations_onto_the_normal():
    rng = np.random.default_rng(8)
    normals = rng.normal(size=(50, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    normals = np.r_[normals, np.eye(3), -np.eye(3)]
    R = contact_frames(normals)
    np.testing.assert_allclose(R[:, :, 2], normals, atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(R), 1.0)
    gram = R.transpose(0, 2, 1) @ R
    np.testing.assert_allclose(gram, np.tile(np.eye(3), (56, 1, 1)), atol=1e-9)


def test_pyramids_lie_inside_the_cone_with_their_edges_on_it():
    rng = np.random.default_rng(9)
    _, normals, mu, _ = random_stance(rng)
    for edges in (4, 8):
        E = cone_generators(normals, mu, edges)
        normal_part = np.einsum("nmj,nj->nm", E, normals)
        tangential = np.linalg.norm(E - normals[:, None], axis=2)
        np.testing.assert_allclose(normal_part, 1.0)
        np.testing.assert_allclose(tangential, np.tile(mu[:, None], edges))


# Balance of the whole body.


@pytest.mark.parametrize("slope", [0.05, 0.2, 0.4, 0.6])
def test_a_block_on_a_slope_holds_iff_the_slope_is_within_the_friction_angle(slope):
    """The slope runs along a pyramid's edge, where the pyramid reaches the cone."""
    R = matrix_from_rpy([0.0, slope, 0.0])
    corners = np.c_[SQUARE, np.zeros(4)] @ R.T
    com = R @ [0.0, 0.0, 0.05]
    normals = np.tile(R[:, 2], (4, 1))
    for factor, holds in ((1.001, True), (0.999, False)):
        mu = np.full(4, math.tan(slope) * factor)
        assert is_statically_stable(corners, normals, mu, com) == holds
        verdict = static_equilibrium(
            corners, normals, mu, com, MASS, names=["block"] * 4
        )
        assert verdict.feasible == holds
        assert verdict.limiting == "block"


def test_on_level_ground_forces_and_support_polygon_agree():
    rng = np.random.default_rng(10)
    stable = 0
    for _ in range(300):
        xy = rng.uniform(-0.3, 0.3, (int(rng.integers(3, 9)), 2))
        com = np.append(rng.uniform(-0.3, 0.3, 2), 0.6)
        margin = com_margin(com, support_polygon(xy))
        if abs(margin) < 1e-4:
            continue
        stable += margin > 0
        points, normals, mu = flat(xy, 0.3)
        assert is_statically_stable(points, normals, mu, com) == (margin > 0)
    assert 50 < stable < 250


@pytest.mark.parametrize("edges", [4, 8])
def test_the_quick_verdict_is_that_of_the_linear_program(edges):
    rng = np.random.default_rng(11)
    verdicts = []
    for _ in range(300):
        stance = random_stance(rng)
        verdicts.append(is_statically_stable(*stance, cone_edges=edges))
        assert verdicts[-1] == lp_holds(*stance, edges)
    assert 60 < sum(verdicts) < 240


def test_a_normal_of_the_wrong_sign_is_no_support():
    points, normals, mu = flat(SQUARE, 0.5)
    com = np.array([0.0, 0.0, 0.4])
    assert is_statically_stable(points, normals, mu, com)
    assert not is_statically_stable(points, -normals, mu, com)
    verdict = static_equilibrium(points, -normals, mu, com, MASS, names=["foot"] * 4)
    assert not verdict.feasible
    assert verdict.margin == -1.0
    assert verdict.limiting == "foot"


def test_nothing_holds_a_robot_without_contacts():
    points, normals, mu = flat(np.zeros((0, 2)), 0.5)
    assert not is_statically_stable(points, normals, mu, UP)
    verdict = static_equilibrium(points, normals, mu, UP, MASS, names=[])
    assert (verdict.feasible, verdict.margin, verdict.limiting) == (False, -1.0, None)
    assert contact_forces(points, normals, mu, UP, MASS).residual == 1.0


def test_the_margin_on_level_ground_is_the_push_that_tips_or_slides():
    """A push at height h tips at distance / h and slides at the pyramid's mu."""
    points, normals, mu = flat(SQUARE, 0.5)
    names = ["foot"] * 4

    def margin(x, h):
        com = np.array([x, 0.0, h])
        return static_equilibrium(points, normals, mu, com, MASS, names=names).margin

    assert margin(0.0, 0.8) == pytest.approx(0.1 / 0.8, abs=1e-5)
    assert margin(0.06, 0.8) == pytest.approx(0.04 / 0.8, abs=1e-5)
    assert margin(0.14, 0.8) == pytest.approx(-0.04 / 0.8, abs=1e-5)
    assert margin(0.0, 0.1) == pytest.approx(0.5 / math.sqrt(2), abs=1e-5)


def test_the_margin_on_level_ground_is_that_of_the_centre_of_mass_over_its_height():
    """Outside too, where the nearest push that helps may be towards a corner."""
    rng = np.random.default_rng(20)
    outside = 0
    for _ in range(40):
        xy = rng.uniform(-0.1, 0.1, (7, 2))
        com = np.append(rng.uniform(-0.12, 0.12, 2), 0.8)
        expected = com_margin(com, support_polygon(xy)) / 0.8
        outside += expected < 0
        verdict = static_equilibrium(*flat(xy, 0.9), com, MASS, names=["foot"] * 7)
        assert verdict.margin == pytest.approx(expected, abs=2e-6)
    assert 10 < outside < 35


def test_eight_edges_come_closer_to_the_cone_than_four():
    points, normals, mu = flat(SQUARE, 0.5)
    com = np.array([0.0, 0.0, 0.1])
    for edges in (4, 8, 16):
        margin = static_equilibrium(
            points, normals, mu, com, MASS, names=["foot"] * 4, cone_edges=edges
        ).margin
        assert margin == pytest.approx(0.5 * math.cos(math.pi / edges), abs=1e-5)


def test_the_margin_falls_as_the_centre_of_mass_moves_outwards():
    rng = np.random.default_rng(12)
    points, normals, mu = flat(rng.uniform(-0.3, 0.3, (6, 2)), 0.9)
    normals = np.stack([matrix_from_rpy([*rng.normal(0, 0.1, 2), 0])[:, 2] for _ in mu])
    centre = points.mean(axis=0) + 0.7 * UP
    margins = [
        static_equilibrium(
            points,
            normals,
            mu,
            centre + x * np.array([1.0, 0.3, 0.0]),
            MASS,
            names=["a"] * 6,
        ).margin
        for x in np.linspace(0.05, 0.5, 8)
    ]
    assert np.all(np.diff(margins) < 0)
    assert margins[0] > 0 > margins[-1]


def test_the_sign_of_the_margin_is_the_quick_verdict():
    rng = np.random.default_rng(13)
    for _ in range(60):
        stance = random_stance(rng)
        names = [str(i) for i in range(len(stance[0]))]
        verdict = static_equilibrium(*stance, MASS, names=names)
        assert verdict.feasible == (verdict.margin >= -1e-6)
        assert verdict.feasible == is_statically_stable(*stance)


def test_the_margin_is_the_least_push_over_all_directions():
    """Pushes just within the margin hold in every direction, one beyond it does not."""
    rng = np.random.default_rng(14)
    checked = 0
    while checked < 5:
        points, normals, mu, com = random_stance(rng)
        names = ["a"] * len(points)
        margin = static_equilibrium(points, normals, mu, com, MASS, names=names).margin
        if not 0.01 < margin < 0.9:
            continue
        checked += 1
        angles = np.linspace(0, 2 * math.pi, 180)

        def holds(push, stance=(points, normals, mu, com)):
            # tilting the world instead: gravity and push together point straight down
            p, n, m, c = stance
            E = cone_generators(n, m, 4).reshape(-1, 3)
            moments = np.cross(np.repeat(p - c, 4, axis=0), E)
            A = np.c_[E, moments].T
            b = np.r_[-push, 1.0, 0.0, 0.0, 0.0]
            return linprog(np.zeros(len(E)), A_eq=A, b_eq=b).status == 0

        ring = np.c_[np.cos(angles), np.sin(angles)]
        assert all(holds(0.999 * margin * u) for u in ring)
        assert not all(holds(1.02 * margin * u) for u in ring)


def test_another_contact_never_lowers_the_margin():
    rng = np.random.default_rng(15)
    for _ in range(15):
        points, normals, mu, com = random_stance(rng)
        n = len(points)

        def margin(k, stance=(points, normals, mu), com=com):
            few = [x[:k] for x in stance]
            return static_equilibrium(*few, com, MASS, names=["a"] * k).margin

        assert margin(n) >= margin(n - 1) - 1e-5


@pytest.mark.parametrize("mu_floor", [0.2, 0.3])
def test_a_ladder_holds_iff_its_foot_does_not_slide(mu_floor):
    """Against a slippery wall: W d / (2 h) at the wall, borne by the floor's mu W."""
    h = 1.0
    for factor, holds in ((0.98, True), (1.02, False)):
        d = 2 * h * mu_floor * factor
        rails = np.array([[0.0, 0.2, 0.0], [0.0, -0.2, 0.0]])
        points = np.r_[rails, rails + np.array([d, 0.0, h])]
        normals = np.repeat([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0]], 2, axis=0)
        mu = np.array([mu_floor, mu_floor, 1e-3, 1e-3])
        verdict = static_equilibrium(
            points,
            normals,
            mu,
            np.array([d / 2, 0.0, h / 2]),
            MASS,
            names=["foot", "foot", "top", "top"],
        )
        assert verdict.feasible == holds
        assert verdict.limiting == "foot"


def test_where_the_robot_tips_over_the_contact_that_had_to_pull_limits():
    apart = np.array([0.0, 0.2])
    points, normals, mu = flat(np.r_[SQUARE + apart, SQUARE - apart], 0.9)
    names = ["left"] * 4 + ["right"] * 4
    com = np.array([0.0, -0.32, 0.8])
    verdict = static_equilibrium(points, normals, mu, com, MASS, names=names)
    assert not verdict.feasible
    assert verdict.limiting == "left"


def test_balancing_on_one_point_has_no_margin_and_names_the_pivot():
    points, normals, mu = flat(np.zeros((1, 2)), 0.5)
    above = static_equilibrium(points, normals, mu, 0.5 * UP, MASS, names=["hand"])
    assert above.feasible
    assert above.margin == pytest.approx(0.0, abs=1e-6)
    beside = np.array([0.05, 0.0, 0.5])
    verdict = static_equilibrium(points, normals, mu, beside, MASS, names=["hand"])
    assert verdict.margin == pytest.approx(-0.1, abs=1e-6)  # leans back by 0.05 / 0.5
    assert above.limiting == verdict.limiting == "hand"


def test_a_stance_that_holds_any_push_is_limited_by_nothing():
    """Six faces that grip: four walls around, floor and ceiling."""
    directions = np.r_[np.eye(3), -np.eye(3)]
    points = np.repeat(-0.3 * directions, 4, axis=0)
    for i, d in enumerate(directions):
        points[4 * i : 4 * i + 4] += (
            0.05
            * np.c_[SQUARE, np.zeros(4)]
            @ np.array([np.roll(np.abs(d), 1), np.roll(np.abs(d), 2), d])
        )
    verdict = static_equilibrium(
        points,
        np.repeat(directions, 4, axis=0),
        np.full(24, 0.5),
        np.zeros(3),
        MASS,
        names=["wall"] * 24,
    )
    assert verdict.margin == pytest.approx(1.0)
    assert verdict.limiting is None


# Contact forces.


def test_contact_forces_balance_gravity_within_the_cones():
    rng = np.random.default_rng(16)
    checked = 0
    for _ in range(100):
        points, normals, mu, com = random_stance(rng)
        if not is_statically_stable(points, normals, mu, com):
            continue
        checked += 1
        held = contact_forces(points, normals, mu, com, MASS)
        wrench = wrench_of(points, held.forces, com)
        np.testing.assert_allclose(
            wrench, [0, 0, WEIGHT, 0, 0, 0], atol=2 * BALANCE_TOL * WEIGHT
        )
        assert held.residual <= BALANCE_TOL
        fn = np.sum(held.forces * normals, axis=1)
        ft = np.linalg.norm(held.forces - fn[:, None] * normals, axis=1)
        assert np.all(ft <= mu * fn + 1e-5 * WEIGHT)
    assert checked > 30


def test_contact_forces_are_the_least_of_those_that_balance():
    """Against the weighted pseudo-inverse, where no cone binds."""
    points, normals, mu = flat(np.r_[SQUARE, [[0.3, 0.0]]], 0.8)
    points = points + np.outer([0, 0, 0, 0, 1], [0.0, 0.0, 0.3])  # a hand on a table
    com = np.array([0.06, 0.02, 0.5])
    G = np.concatenate(
        [
            np.tile(np.eye(3), (1, 5)),
            np.concatenate([np.cross(p - com, np.eye(3)).T for p in points], axis=1),
        ]
    )
    S = np.tile([0.5, 0.5, 1.0], 5)  # tangential forces weigh four times as much
    expected = S * (np.linalg.pinv(G * S) @ [0, 0, WEIGHT, 0, 0, 0])
    held = contact_forces(points, normals, mu, com, MASS)
    np.testing.assert_allclose(held.forces.ravel(), expected, atol=1e-3)


def test_contact_forces_are_continuous_also_where_the_stance_stops_to_hold():
    points, normals, mu = flat(np.r_[SQUARE, [[0.3, 0.0]]], 0.4)
    xs = np.linspace(-0.3, 0.5, 1601)
    track = [
        contact_forces(points, normals, mu, np.array([x, 0.03, 0.5]), MASS) for x in xs
    ]
    jumps = np.abs(np.diff([h.forces for h in track], axis=0)).max(axis=(1, 2))
    assert jumps.max() < 0.02 * WEIGHT
    inside = np.array(
        [com_margin([x, 0.03], support_polygon(points[:, :2])) for x in xs]
    )
    residual = np.array([h.residual for h in track])
    assert np.all(residual[inside > 0] <= BALANCE_TOL)
    assert np.all(residual[inside < -1e-3] > 1e-4)


def test_the_best_effort_leaves_no_more_unbalanced_than_it_must():
    """Beyond the border the ground pushes at the edge: the lever arm is left over."""
    points, normals, mu = flat(SQUARE, 0.8)
    held = contact_forces(points, normals, mu, np.array([0.2, 0.0, 0.5]), MASS)
    assert 0.05 < held.residual < 0.1
    assert np.all(held.forces[:, 2] >= -1e-6 * WEIGHT)


# Joint torques: a body on two straight legs whose feet are at (+-a, 0, -h) from the
# hips; both hips turn about y. A foot's force (fx, fz) costs its hip a torque.

A_LEG, H_LEG = 0.2, 0.5


def a_frame(limit: float, *, leg_mass: float = 0.0) -> tuple[np.ndarray, TorqueLimits]:
    """Feet and torque limits; dofs: base x y z, base rotation, left, right hip.

    The mass of each leg sits in its foot, so that feet cost the hips less torque.
    """
    feet = np.array([[A_LEG, 0.0, -H_LEG], [-A_LEG, 0.0, -H_LEG]])
    J = np.zeros((6, 8))
    for i, p in enumerate(feet):
        rows = slice(3 * i, 3 * i + 3)
        J[rows, :3] = np.eye(3)
        J[rows, 3:6] = np.cross(np.eye(3), p).T  # v = omega x p
        J[rows, 6 + i] = np.cross([0.0, 1.0, 0.0], p)
    leg = np.array([0.0, 0.0, leg_mass * GRAVITY])
    gravity = np.array([0.0, 0.0, WEIGHT, 0.0, 0.0, 0.0, 0.0, 0.0])
    gravity[6:] = J[:3, 6] @ leg, J[3:, 7] @ leg
    return feet, TorqueLimits(
        jacobian=J,
        gravity=gravity,
        dofs=np.array([6, 7]),
        limits=np.full(2, limit),
        names=("left_hip", "right_hip"),
    )


def test_hip_torques_of_an_a_frame_are_those_computed_by_hand():
    """Vertical forces of half the weight: |tau| = a m g / 2, of opposite signs."""
    _, torque = a_frame(1e3)
    forces = np.array([[0.0, 0.0, WEIGHT / 2], [0.0, 0.0, WEIGHT / 2]])
    expected = A_LEG * WEIGHT / 2
    np.testing.assert_allclose(torque.torques(forces), [expected, -expected])


@pytest.mark.parametrize("mu", [0.1, 0.2, 0.3])
@pytest.mark.parametrize("leg_mass", [0.0, 2.0])
def test_an_a_frame_holds_iff_its_hips_bear_what_friction_leaves(mu, leg_mass):
    """Feet held together by mu m g / 2 relieve the hips to (a - mu h) m g / 2.

    Of a leg's own weight, which rests on the ground, the hip feels nothing.
    """
    needed = (A_LEG - mu * H_LEG) * WEIGHT / 2 - A_LEG * leg_mass * GRAVITY
    for factor, holds in ((1.001, True), (0.999, False)):
        feet, torque = a_frame(needed * factor, leg_mass=leg_mass)
        normals, friction = np.tile(UP, (2, 1)), np.full(2, mu)
        com = np.zeros(3)
        assert is_statically_stable(feet, normals, friction, com)
        held = contact_forces(feet, normals, friction, com, MASS, torque=torque)
        assert (held.residual <= BALANCE_TOL) == holds
        verdict = static_equilibrium(
            feet,
            normals,
            friction,
            com,
            MASS,
            names=["left_foot", "right_foot"],
            torque=torque,
        )
        assert verdict.feasible == holds
        assert verdict.torques is not None
        if holds:
            assert np.all(np.abs(verdict.torques) <= torque.limits * (1 + 1e-5))


def test_torque_limits_lower_the_margin_and_name_the_weak_joint():
    feet, strong = a_frame(1e3)
    apart = np.array([0.0, 0.1, 0.0])
    feet = np.r_[feet + apart, feet - apart]
    J = np.tile(strong.jacobian, (2, 1))
    normals, mu = np.tile(UP, (4, 1)), np.full(4, 0.3)
    names = ["left_foot", "right_foot"] * 2

    def verdict(limits):
        torque = TorqueLimits(
            jacobian=J,
            gravity=strong.gravity,
            dofs=strong.dofs,
            limits=np.array(limits),
            names=strong.names,
        )
        return static_equilibrium(
            feet, normals, mu, np.zeros(3), MASS, names=names, torque=torque
        )

    free = static_equilibrium(feet, normals, mu, np.zeros(3), MASS, names=names)
    assert verdict([1e3, 1e3]).margin == pytest.approx(free.margin, abs=1e-6)
    assert free.margin > 0.1
    for k, weak in enumerate(strong.names):
        limits = [1e3, 1e3]
        limits[k] = 0.0
        weakened = verdict(limits)
        assert not weakened.feasible
        assert weakened.margin < free.margin
        limits[k] = 9.0  # a little more than (a - mu h) m g / 2 = 7.4 N m
        assert 0 < verdict(limits).margin < free.margin
        assert verdict(limits).limiting == weak


def test_the_strength_that_is_needed_is_that_computed_by_hand():
    """Upright forces on ice, and none that friction would turn inwards: a m g / 2."""
    needed = A_LEG * WEIGHT / 2
    for limit in (0.1 * needed, needed, 3.0 * needed):
        feet, torque = a_frame(limit)
        torque = replace(torque, limits=np.array([limit, 10.0 * limit]))
        found = strength_needed(
            feet,
            np.tile(UP, (2, 1)),
            np.full(2, 1e-9),
            np.zeros(3),
            MASS,
            torque=torque,
        )
        assert found is not None
        share, joint = found
        assert share == pytest.approx(needed / limit, rel=1e-5)
        assert torque.names[joint] == "left_hip"
    feet, torque = a_frame(needed)
    normals, mu = np.tile(UP, (2, 1)), np.full(2, 0.5)
    beside = np.array([2.0 * A_LEG, 0.0, 0.0])  # no strength stands beside its feet
    assert strength_needed(feet, normals, mu, beside, MASS, torque=torque) is None
    none = feet[:0], normals[:0], mu[:0]
    assert strength_needed(*none, np.zeros(3), MASS, torque=torque) is None


def test_the_strength_that_is_needed_is_where_postures_begin_to_hold():
    feet, torque = a_frame(1.0)
    apart = np.array([0.0, 0.1, 0.0])
    feet = np.r_[feet + apart, feet - apart]
    torque = replace(torque, jacobian=np.tile(torque.jacobian, (2, 1)))
    stance = feet, np.tile(UP, (4, 1)), np.full(4, 0.1), np.zeros(3), MASS
    share, _ = strength_needed(*stance, torque=torque)
    for more, holds in ((0.99, False), (1.01, True)):
        limits = share * more * torque.limits
        assert (
            static_equilibrium(
                *stance,
                names=["left_foot", "right_foot"] * 2,
                torque=replace(torque, limits=limits),
            ).feasible
            is holds
        )


def test_the_rows_of_the_base_are_the_balance_of_the_whole_body():
    """What the record promises about J and g, hence why the base rows are left out."""
    feet, torque = a_frame(1e3)
    held = contact_forces(feet, np.tile(UP, (2, 1)), np.full(2, 0.5), np.zeros(3), MASS)
    base = torque.gravity[:6] - torque.jacobian[:, :6].T @ held.forces.ravel()
    np.testing.assert_allclose(base, 0.0, atol=1e-3)


def test_torque_limits_of_the_wrong_shape_are_refused():
    _, good = a_frame(1.0)
    with pytest.raises(ValueError, match="2 dofs"):
        TorqueLimits(
            jacobian=good.jacobian,
            gravity=good.gravity,
            dofs=good.dofs,
            limits=np.ones(3),
            names=good.names,
        )
    with pytest.raises(ValueError, match="jacobian"):
        TorqueLimits(
            jacobian=good.jacobian[:, :7],
            gravity=good.gravity,
            dofs=good.dofs,
            limits=good.limits,
            names=good.names,
        )


# Against another library.


KLAMPT = """
import json, sys
from klampt import robotsim
edges, stances = json.load(sys.stdin)
robotsim.set_friction_cone_approximation_edges(edges)
found = [robotsim.com_equilibrium(c, (0, 0, -1), p) is not None for c, p in stances]
print(json.dumps(found))
"""


@pytest.mark.compare
@pytest.mark.parametrize("edges", [4, 8])
def test_verdicts_agree_with_klampt_on_a_thousand_stances(edges):
    """In a process of its own: without a terminal, Klampt's solver may abort."""
    pytest.importorskip("klampt.robotsim")
    rng = np.random.default_rng(17)
    stances = [random_stance(rng) for _ in range(1000)]
    asked = [
        (np.c_[points, normals, mu].tolist(), com.tolist())
        for points, normals, mu, com in stances
    ]
    child = subprocess.run(
        [sys.executable, "-c", KLAMPT],
        input=json.dumps([edges, asked]),
        capture_output=True,
        text=True,
    )
    if child.returncode < 0:
        pytest.skip(f"Klampt ended by signal {-child.returncode}")
    theirs = json.loads(child.stdout.splitlines()[-1])
    stable = 0
    for (points, normals, mu, com), holds in zip(stances, theirs, strict=True):
        ours = is_statically_stable(points, normals, mu, com, cone_edges=edges)
        stable += ours
        if ours != holds:  # only within rounding of the border
            margin = static_equilibrium(
                points,
                normals,
                mu,
                com,
                MASS,
                names=["a"] * len(points),
                cone_edges=edges,
            ).margin
            assert abs(margin) < 1e-5
    assert 200 < stable < 900


def test_the_quick_test_fits_a_planners_inner_loop():
    """150 us is the aim; a loaded machine gets four times that."""
    rng = np.random.default_rng(18)
    stances = [random_stance(rng) for _ in range(200)]
    took = []
    for stance in stances:
        start = time.perf_counter()
        is_statically_stable(*stance)
        took.append(time.perf_counter() - start)
    assert np.median(took) < 600e-6


@pytest.mark.parametrize("polygon", [SQUARE, SQUARE[:3], SQUARE[:2], SQUARE[:1]])
def test_margins_of_many_are_those_of_each(polygon):
    com = np.random.default_rng(3).uniform(-0.3, 0.3, (200, 2))
    each = [com_margin(c, polygon) for c in com]
    np.testing.assert_allclose(com_margins(com, polygon), each, atol=1e-12)


def test_a_limit_is_named_though_its_lp_has_a_weight():
    """Four feet of a table: the two that its weight leaves first."""
    points = np.array([[x, y, 0.0] for x in (0.1, -0.1) for y in (0.2, -0.2)])
    verdict = static_equilibrium(
        points,
        np.tile([0.0, 0.0, 1.0], (4, 1)),
        np.full(4, 0.8),
        np.array([0.0, 0.0, 0.5]),
        10.0,
        names=["a", "b", "c", "d"],
    )
    # It tips over two feet when the push at 0.5 m is 0.1 / 0.5 of the weight.
    assert verdict.margin == pytest.approx(0.2, abs=1e-6)
    assert verdict.limiting in {"a", "b", "c", "d"}
