"""Felt contacts -> boxes and meshes, against the posterior written out another way."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation
from scipy.stats import multivariate_normal

from clamber.execution.terrain import (
    CAUTION,
    CONTACT_SIGMA,
    HEIGHT_SIGMA,
    ROUGHNESS,
    SLOPE_SIGMA,
    believed_scene,
    fitted_box,
    fitted_mesh,
)
from clamber.model.patches import mesh_of
from clamber.model.scene import Box, Mesh, Scene
from clamber.model.se3 import matrix_from_rpy

PRIOR = np.array([HEIGHT_SIGMA, SLOPE_SIGMA, SLOPE_SIGMA])
RPYS = [(0.0, 0.0, 0.0), (0.0, 0.0, 0.7), (0.1, -0.15, -2.0), (np.pi / 2, 0.0, 0.3)]


def box_at(rpy=(0.0, 0.0, 0.0), **changes) -> Box:
    fields = {
        "name": "box",
        "size": np.array([1.0, 1.2, 0.3]),
        "centre": np.array([0.8, 0.1, 0.15]),
        "rotation": matrix_from_rpy(rpy),
    }
    return Box(**(fields | changes))


def on_top(box: Box, xyz: np.ndarray) -> np.ndarray:
    """(n, 3) world points from coordinates in the frame of the top."""
    return box.top.position + np.asarray(xyz) @ box.top.rotation.T


def plane(box: Box, abc, xy: np.ndarray) -> np.ndarray:
    """(n, 3) world points over `xy` (n, 2) of the top, on z = a + b x + c y."""
    a, b, c = abc
    xy = np.asarray(xy)
    return on_top(box, np.column_stack([xy, a + xy @ [b, c]]))


def fitted_plane(before: Box, after: Box) -> np.ndarray:
    """(3,) a, b, c of the new top in the frame of the old one."""
    n = before.top.rotation.T @ after.top.normal
    p = before.top.rotation.T @ (after.top.position - before.top.position)
    return np.array([p @ n, -n[0], -n[1]]) / n[2]


def posterior(xy: np.ndarray, z: np.ndarray, rough: float) -> np.ndarray:
    """(3,) by the normal equations of a ridge regression."""
    X = np.column_stack([np.ones(len(xy)), xy])
    s2 = CONTACT_SIGMA**2 + rough**2
    A = np.vstack([X / np.sqrt(s2), np.diag(1.0 / PRIOR)])
    y = np.concatenate([z / np.sqrt(s2), np.zeros(3)])
    return np.linalg.lstsq(A, y, rcond=None)[0]


def most_probable(xy: np.ndarray, z: np.ndarray) -> float:
    """The roughness under which the heights are likeliest."""
    X = np.column_stack([np.ones(len(xy)), xy]) * PRIOR
    noise = [(CONTACT_SIGMA**2 + s * s) * np.eye(len(z)) for s in ROUGHNESS]
    p = [multivariate_normal.logpdf(z, cov=X @ X.T + N) for N in noise]
    return ROUGHNESS[int(np.argmax(p))]


@pytest.fixture
def spread(rng) -> np.ndarray:
    """(12, 2) places over the top."""
    return rng.uniform(-0.45, 0.45, (12, 2))


# A plane.


@pytest.mark.parametrize("rpy", RPYS, ids=str)
@pytest.mark.parametrize("abc", [(0.03, 0.0, 0.0), (-0.02, 0.06, -0.04)])
def test_points_on_a_plane_give_its_height_and_slopes(spread, rpy, abc):
    box = box_at(rpy)
    after = fitted_box(box, plane(box, abc, spread))
    assert np.allclose(fitted_plane(box, after), abc, atol=1.5e-3)
    assert after.roughness == CAUTION


@pytest.mark.parametrize("rpy", RPYS, ids=str)
def test_the_fit_is_the_maximum_of_the_posterior(rng, spread, rpy):
    """Noise as of a smooth top: the plane by the normal equations, no lowering."""
    box = box_at(rpy)
    z = 0.02 + spread @ [0.05, -0.03] + rng.normal(0.0, 0.003, len(spread))
    assert most_probable(spread, z) == 0.0
    after = fitted_box(box, on_top(box, np.column_stack([spread, z])))
    assert np.allclose(fitted_plane(box, after), posterior(spread, z, 0.0), atol=1e-9)


def test_one_point_at_the_near_edge_is_height_more_than_slope():
    box, xy, z = box_at(), np.array([[-0.4, 0.0]]), np.array([0.04])
    after = fitted_box(box, on_top(box, [[-0.4, 0.0, 0.04]]))
    a, b, c = fitted_plane(box, after)
    assert np.allclose([a, b, c], posterior(xy, z, 0.0), atol=1e-12)
    assert a > 0.4 * 0.04
    assert b < 0.0  # ... the far end may be as it was
    assert c == pytest.approx(0.0, abs=1e-12)
    assert abs(a - 0.4 * b - 0.04) < 1.5e-3  # the top goes through the point


def test_what_was_not_felt_of_a_box_stays_as_it_was(spread):
    box = box_at((0.1, 0.0, 0.4), friction=0.33, name="crate")
    after = fitted_box(box, plane(box, (0.03, 0.05, -0.05), spread))
    assert (after.name, after.friction) == ("crate", 0.33)
    assert np.array_equal(after.size, box.size)
    assert np.allclose(after.rotation.T @ after.rotation, np.eye(3), atol=1e-12)
    assert np.linalg.det(after.rotation) == pytest.approx(1.0)
    assert np.allclose(after.top.polygon, box.top.polygon)
    # It is turned no more than the normal is: the shortest way.
    turn = Rotation.from_matrix(after.rotation @ box.rotation.T).magnitude()
    between = np.arccos(after.top.normal @ box.top.normal)
    assert turn == pytest.approx(between, abs=1e-9)


@pytest.mark.parametrize("rpy", [(0.0, 0.0, 1.1), (0.2, -0.1, 2.5)], ids=str)
@pytest.mark.parametrize("spread_of_z", [0.003, 0.025])
def test_the_fit_does_not_depend_on_the_frame_of_the_world(
    rng, spread, rpy, spread_of_z
):
    box = box_at()
    z = 0.01 + spread @ [0.05, 0.02] + rng.normal(0.0, spread_of_z, len(spread))
    R, t = matrix_from_rpy(rpy), np.array([0.7, -1.3, 0.2])
    moved = replace(box, rotation=R @ box.rotation, centre=R @ box.centre + t)
    points = on_top(box, np.column_stack([spread, z]))
    here, there = fitted_box(box, points), fitted_box(moved, points @ R.T + t)
    assert np.allclose(there.centre, R @ here.centre + t, atol=1e-12)
    assert np.allclose(there.rotation, R @ here.rotation, atol=1e-12)
    assert there.roughness == pytest.approx(here.roughness)


def test_a_box_on_its_side_has_the_same_top(spread):
    """Which of its axes is upright is a matter of how the box was written down."""
    a = box_at()
    b = box_at(
        rotation=matrix_from_rpy((np.pi / 2, 0.0, 0.0)), size=np.array([1.0, 0.3, 1.2])
    )
    points = plane(a, (0.02, 0.06, -0.05), spread)
    one, other = fitted_box(a, points), fitted_box(b, points)
    assert np.allclose(one.top.normal, other.top.normal, atol=1e-12)
    assert np.allclose(one.top.position, other.top.position, atol=1e-12)


# Roughness.


def test_near_contacts_that_contradict_make_a_rough_top_not_a_steep_one():
    box = box_at()
    points = on_top(box, [[-0.35, -0.05, 0.015], [-0.35, 0.05, -0.015]])
    after = fitted_box(box, points)
    assert after.roughness > CAUTION
    steep = posterior(points[:, :2] - box.centre[:2], [0.015, -0.015], 0.0)
    slope = fitted_plane(box, after)[2]
    assert abs(slope) < 0.5 * abs(steep[2])
    assert abs(steep[2]) > 0.1


@pytest.mark.parametrize("seed", range(30))
@pytest.mark.parametrize("n", [2, 4, 9])
def test_of_a_rough_top_no_contact_lies_below_nor_higher_than_it_is_rough(seed, n):
    rng = np.random.default_rng([seed, n])
    box = box_at(RPYS[seed % 3])
    xy, z = rng.uniform(-0.4, 0.4, (n, 2)), rng.normal(0.0, 0.03, n)
    points = on_top(box, np.column_stack([xy, z]))
    after = fitted_box(box, points)
    rough = most_probable(xy, z)
    plain = posterior(xy, z, rough)
    if rough == 0.0:
        assert after.roughness == CAUTION
        assert np.allclose(fitted_plane(box, after), plain, atol=1e-9)
        return
    height = after.top.height(points)
    assert height.min() >= -1e-12
    # Lowered as far as must be, along the normal, and what sticks out is counted.
    normal = box.top.rotation @ np.array([-plain[1], -plain[2], 1.0])
    normal /= np.linalg.norm(normal)
    middle = on_top(box, [0.0, 0.0, plain[0]])
    lowest = min(((points - middle) @ normal).min(), 0.0)
    assert np.allclose(after.top.normal, normal, atol=1e-9)
    assert np.allclose(after.top.position, middle + lowest * normal, atol=1e-9)
    assert after.roughness == pytest.approx(max(rough - lowest, CAUTION))
    assert height.min() == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("rough", ROUGHNESS)
def test_the_roughness_that_contacts_were_drawn_with_is_found(rough):
    """From the model itself, many contacts: the right one, nearly always."""
    right = 0
    for seed in range(40):
        rng = np.random.default_rng([seed, 7])
        box, xy = box_at(), rng.uniform(-0.45, 0.45, (60, 2))
        a, b, c = rng.normal(0.0, PRIOR)
        z = a + xy @ [b, c] + rng.normal(0.0, np.hypot(CONTACT_SIGMA, rough), len(xy))
        after = fitted_box(box, on_top(box, np.column_stack([xy, z])))
        points = on_top(box, np.column_stack([xy, z]))
        plain = posterior(xy, z, rough)
        normal = np.array([-plain[1], -plain[2], 1.0])
        off = (z - plain[0] - xy @ plain[1:]) / np.linalg.norm(normal)
        expected = CAUTION if rough == 0.0 else rough - min(off.min(), 0.0)
        right += abs(after.roughness - max(expected, CAUTION)) < 1e-9
        assert rough == 0.0 or after.top.height(points).min() > -1e-9
    assert right >= 34


@pytest.mark.parametrize("believed", [0.0, 0.01, 0.05])
def test_a_felt_top_is_no_smoother_than_it_was_believed(spread, believed):
    box = box_at(roughness=believed)
    after = fitted_box(box, plane(box, (0.01, 0.0, 0.0), spread))
    assert after.roughness == max(CAUTION, believed)


# The scene.


@pytest.fixture
def scene() -> Scene:
    second = box_at((0.0, 0.0, 0.5), name="step", centre=np.array([2.0, 1.0, 0.15]))
    return Scene(
        boxes=(box_at(), second),
        ground_friction=0.6,
        start=np.array([0.1, 0.2, 0.3]),
        goal=np.array([1.0, 2.0]),
    )


def test_nothing_felt_leaves_a_scene_as_it_is(scene):
    same = believed_scene(scene, [])
    assert all(a is b for a, b in zip(same.boxes, scene.boxes, strict=True))
    assert np.array_equal(same.start, scene.start)
    assert np.array_equal(same.goal, scene.goal)
    assert same.ground_friction == scene.ground_friction


def test_each_box_is_fitted_to_its_own_contacts(scene, spread):
    box, step = scene.boxes
    here = plane(box, (0.03, 0.02, 0.0), spread)
    there = plane(step, (-0.02, 0.0, 0.04), spread)
    felt = [
        x for p, q in zip(here, there, strict=True) for x in (("box", p), ("step", q))
    ]
    new = believed_scene(scene, iter(felt))
    for b, points, after in zip(scene.boxes, (here, there), new.boxes, strict=True):
        expected = fitted_box(b, points)
        assert np.array_equal(after.centre, expected.centre)
        assert np.array_equal(after.rotation, expected.rotation)
        assert after.roughness == expected.roughness
    assert np.array_equal(new.goal, scene.goal)


def test_a_box_that_was_not_touched_is_believed_as_before(scene, spread):
    felt = [("step", p) for p in plane(scene.boxes[1], (0.02, 0.0, 0.0), spread)]
    new = believed_scene(scene, felt)
    assert new.boxes[0] is scene.boxes[0]
    assert new.boxes[1].top.position[2] > scene.boxes[1].top.position[2] + 0.01


# Meshes.


@pytest.fixture
def steps() -> Mesh:
    """Two blocks of one mesh, the second higher, with a support each."""
    solids = []
    for x, height in ((0.5, 0.2), (1.1, 0.3)):
        block = trimesh.creation.box((0.6, 1.0, height))
        solids.append(block.apply_translation((x, 0.0, height / 2)))
    both = trimesh.util.concatenate(solids)
    return mesh_of("m", np.asarray(both.vertices), np.asarray(both.faces), friction=0.8)


def over(support, xy: np.ndarray, off) -> np.ndarray:
    """(n, 3) points over places (n, 2) of a support, at heights `off`."""
    local = np.column_stack([xy, np.broadcast_to(off, len(xy))])
    return support.position + local @ support.rotation.T


def test_a_support_of_a_mesh_becomes_the_plane_that_was_felt_and_its_piece_too(
    steps, spread
):
    s = steps.supports[0]
    xy = spread * [0.25, 0.4] / np.abs(spread).max(axis=0)
    felt = over(s, xy, 0.02 + xy @ [0.02, -0.01])
    after = fitted_mesh(steps, {s.name: felt})
    assert np.abs(after.supports[0].height(felt)).max() < 0.004
    new, piece = after.supports[0], after.pieces[after.under[0]]
    before = steps.pieces[steps.under[0]]
    was_top = np.abs(s.height(before)) < 1e-6
    assert was_top.sum() == 4
    assert np.abs(new.height(piece[was_top])).max() < 1e-3
    assert ConvexHull(piece).volume > ConvexHull(before).volume


def test_where_one_support_is_higher_the_others_are_believed_higher_as_well(
    steps, spread
):
    s, other = steps.supports
    felt = over(s, 0.1 * spread / np.abs(spread).max(), 0.03)
    after = fitted_mesh(steps, {s.name: felt})
    rise = after.supports[1].position - other.position
    assert rise[:2] == pytest.approx(0.0)
    assert 0.02 < rise[2] < 0.03
    assert after.pieces[after.under[1]] == pytest.approx(
        steps.pieces[steps.under[1]] + rise
    )
    assert np.array_equal(after.supports[1].rotation, other.rotation)


def test_two_supports_that_were_felt_at_different_heights_are_both_there(steps, spread):
    xy = 0.1 * spread / np.abs(spread).max()
    felt = {
        s.name: over(s, xy, off)
        for s, off in zip(steps.supports, (0.01, -0.012), strict=True)
    }
    after = fitted_mesh(steps, felt)
    for s in after.supports:
        assert np.abs(s.height(felt[s.name])).max() < 0.004


def test_a_mesh_is_fitted_in_its_scene_and_stays_where_nothing_was_felt(steps, spread):
    scene = Scene(meshes=(steps,), start=np.zeros(3))
    assert believed_scene(scene, []).meshes[0] is steps
    s = steps.supports[0]
    felt = over(s, 0.1 * spread / np.abs(spread).max(), 0.02)
    new = believed_scene(scene, [(s.name, p) for p in felt]).meshes[0]
    assert new.supports[0].position[2] > s.position[2] + 0.015
    assert new.roughness == CAUTION
