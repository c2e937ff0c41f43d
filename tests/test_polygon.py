"""The support polygon and its ellipse against Qhull, samples and cases by hand."""

import math

import numpy as np
import pytest
from scipy.spatial import ConvexHull

from clamber.model.se3 import matrix_from_rpy
from clamber.step.polygon import (
    com_margin,
    com_margins,
    polygon_halfplanes,
    support_ellipse,
    support_polygon,
)

SQUARE = np.array([[-0.1, -0.1], [0.1, -0.1], [0.1, 0.1], [-0.1, 0.1]])


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


def test_a_hull_of_many_points_is_that_of_its_vertices():
    rng = np.random.default_rng(8)
    points = rng.normal(size=(5000, 2))
    vertices = points[ConvexHull(points).vertices]
    np.testing.assert_array_equal(support_polygon(points), support_polygon(vertices))


@pytest.mark.parametrize("x", [math.nan, math.inf, 1e300])
def test_points_without_a_place_have_no_hull(x):
    with pytest.raises(ValueError, match="finite points"):
        support_polygon(np.array([[0.0, 0.0], [0.0, x], [1.0, 0.0]]))


def test_a_hull_has_at_most_64_vertices():
    angles = np.linspace(0, 2 * math.pi, 65, endpoint=False)
    circle = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    assert len(support_polygon(circle[:64])) == 64
    with pytest.raises(ValueError, match="at most 64"):
        support_polygon(circle)


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
    assert com_margin([3.0, 4.0], np.zeros((3, 2))) == pytest.approx(-5.0)
    assert com_margin([0.0, 0.0], np.zeros((0, 2))) == -math.inf
    assert math.isnan(com_margin([math.nan, 0.0], SQUARE))


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


def test_points_that_rounding_takes_off_their_line_have_an_ellipse_without_width():
    rng = np.random.default_rng(2)
    for _ in range(200):
        x = rng.uniform(-1, 1, size=8)
        polygon = support_polygon(np.column_stack([x, 0.3 * x]))
        assert len(polygon) > 1
        longer, shorter = support_ellipse(polygon).semi_axes
        assert longer == pytest.approx(0.5 * math.hypot(1.0, 0.3) * np.ptp(x), rel=1e-6)
        assert 0.0 <= shorter < 1e-3


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


@pytest.mark.parametrize("polygon", [SQUARE, SQUARE[:3], SQUARE[:2], SQUARE[:1]])
def test_margins_of_many_are_those_of_each(polygon):
    com = np.random.default_rng(3).uniform(-0.3, 0.3, (200, 2))
    each = [com_margin(c, polygon) for c in com]
    np.testing.assert_allclose(com_margins(com, polygon), each, atol=1e-12)
