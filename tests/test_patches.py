"""Supports and pieces of meshes: what is flat is found, and nothing else is filled."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import shapely
import trimesh
from scipy.spatial import ConvexHull

from clamber.model.patches import mesh_of
from clamber.model.regions import neighbours

FRICTION = 0.8


def block(x, y, z) -> trimesh.Trimesh:
    """A block between two values of each coordinate."""
    size, middle = np.ptp([x, y, z], axis=1), np.mean([x, y, z], axis=1)
    mesh = trimesh.creation.box(size)
    mesh.apply_translation(middle)
    return mesh


def joined(*meshes: trimesh.Trimesh) -> trimesh.Trimesh:
    mesh = trimesh.util.concatenate(meshes)
    mesh.merge_vertices()
    return mesh


def terrain(mesh: trimesh.Trimesh, **more):
    vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    return mesh_of("m", vertices, faces, friction=FRICTION, **more)


def staircase(spacing: float = 0.02, noise: float = 0.0, seed: int = 0):
    """Three treads of 0.3 m, 0.1 m apart, as a sheet seen from above."""
    x, y = np.arange(0.0, 0.9, spacing), np.arange(-0.4, 0.4, spacing)
    X, Y = np.meshgrid(x, y)
    z = 0.1 * (np.floor(X / 0.3 + 1e-9) + 1.0)
    vertices = np.stack([X, Y, z], axis=-1).reshape(-1, 3)
    i = np.arange(X.size).reshape(X.shape)
    a, b, c, d = i[:-1, :-1], i[:-1, 1:], i[1:, :-1], i[1:, 1:]
    faces = np.concatenate(
        [np.stack(f, axis=-1).reshape(-1, 3) for f in ((a, b, d), (a, d, c))]
    )
    noise = np.random.default_rng(seed).normal(scale=noise, size=vertices.shape)
    return trimesh.Trimesh(vertices + noise, faces, process=False)


def extruded(profile: list[tuple[float, float]], depth: float) -> trimesh.Trimesh:
    """A polygon in x and z, counter-clockwise, made solid along y."""
    cut = shapely.constrained_delaunay_triangles(shapely.Polygon(profile))
    out = []
    for t in shapely.get_parts(cut):
        x, z = np.array(t.exterior.coords)[:3].T
        near = np.column_stack([x, np.zeros(3), z])
        near = near if np.cross(*(near[1:] - near[0]))[1] < 0 else near[::-1]
        out += [near, near[::-1] + np.array([0, depth, 0])]
    for (x, z), (u, w) in itertools.pairwise([*profile, profile[0]]):
        a, b = np.array([x, 0, z]), np.array([u, 0, w])
        c, d = (x + np.array([0, depth, 0]) for x in (b, a))
        out += [np.array([a, c, b]), np.array([a, d, c])]
    corners = np.concatenate(out)
    mesh = trimesh.Trimesh(corners, np.arange(len(corners)).reshape(-1, 3))
    mesh.merge_vertices()
    assert mesh.is_watertight
    if mesh.volume < 0:
        mesh.invert()
    return mesh


def is_in(piece: np.ndarray, points: np.ndarray, slack: float) -> np.ndarray:
    planes = ConvexHull(piece).equations
    return (points @ planes[:, :3].T + planes[:, 3] <= slack).all(axis=1)


def test_a_block_is_one_piece_and_its_top_one_support():
    mesh = terrain(block((0.2, 1.2), (-0.6, 0.6), (0.0, 0.3)))
    (piece,), (top,) = mesh.pieces, mesh.supports
    assert top.name == "m"
    np.testing.assert_allclose(top.position, [0.7, 0.0, 0.3], atol=1e-6)
    np.testing.assert_allclose(top.normal, [0, 0, 1], atol=1e-9)
    assert np.ptp(top.polygon, axis=0) == pytest.approx([1.0, 1.2], abs=1e-6)
    assert ConvexHull(piece).volume == pytest.approx(0.36)


@pytest.mark.parametrize("noise", [0.0, 0.002, 0.005])
def test_treads_are_found_under_the_noise_of_a_scan(noise):
    mesh = terrain(staircase(noise=noise))
    assert len(mesh.supports) == 3
    levels = sorted(s.position[2] for s in mesh.supports)
    np.testing.assert_allclose(levels, [0.1, 0.2, 0.3], atol=0.003)
    for s in mesh.supports:
        assert s.normal[2] > np.cos(np.radians(1.0))
        assert np.ptp(s.polygon, axis=0) == pytest.approx([0.27, 0.77], abs=0.05)


def test_the_same_triangles_give_the_same_bits():
    one, other = (terrain(staircase(noise=0.005)) for _ in range(2))
    for a, b in zip(one.pieces, other.pieces, strict=True):
        assert a.tobytes() == b.tobytes()
    for a, b in zip(one.supports, other.supports, strict=True):
        assert a.polygon.tobytes() == b.polygon.tobytes()


def test_room_under_a_table_stays_free_and_its_top_is_solid(rng):
    """A frame in one part: a slab with two walls under its ends, and a channel."""
    profile = [(0, 0), (0.1, 0), (0.1, 0.25), (0.9, 0.25), (0.9, 0), (1, 0), (1, 0.3)]
    mesh = extruded([*profile, (0, 0.3)], 0.8)
    found = terrain(mesh)
    points = rng.uniform([0.0, 0.0, 0.0], [1.0, 0.8, 0.3], size=(4000, 3))
    x, z = points[:, 0], points[:, 2]
    under = (x > 0.11) & (x < 0.89) & (z < 0.24)
    just_in = ~((x > 0.1) & (x < 0.9) & (z < 0.25)) & (z > 0.292)
    inside = np.any([is_in(p, points, 1e-6) for p in found.pieces], axis=0)
    assert not inside[under].any()
    assert inside[just_in].all()
    assert [round(float(s.position[2]), 6) for s in found.supports] == [0.3]


def test_solids_that_share_an_edge_are_pieces_of_their_own():
    mesh = joined(
        block((0.0, 0.5), (0.0, 0.5), (0.0, 0.2)),
        block((0.5, 1.0), (0.0, 0.5), (0.0, 0.3)),
        block((0.5, 1.0), (0.5, 1.0), (0.0, 0.2)),
    )
    found = terrain(mesh)
    volumes = sorted(ConvexHull(p).volume for p in found.pieces)
    np.testing.assert_allclose(volumes, [0.05, 0.05, 0.075], rtol=1e-6)
    assert len(found.supports) == 3


def test_faces_about_a_common_edge_are_paired_around_their_solids():
    mesh = joined(
        block((0, 1), (0, 1), (0, 1)),
        block((1, 2), (1, 2), (0, 1)),
    )
    faces = np.asarray(mesh.faces)
    pairs, _ = neighbours(faces, np.asarray(mesh.vertices))
    middle = np.asarray(mesh.triangles_center)[:, :2].sum(axis=1) > 2.0
    assert len(pairs) == 36
    assert np.array_equal(middle[pairs[:, 0]], middle[pairs[:, 1]])


def test_what_is_covered_narrow_steep_or_buried_is_no_support():
    covered = joined(
        block((0.0, 1.0), (0.0, 1.0), (0.0, 0.2)),
        block((0.5, 1.0), (0.0, 1.0), (0.25, 0.3)),
    )
    found = terrain(covered)
    low = [s for s in found.supports if s.position[2] < 0.25]
    assert [round(float(np.ptp(s.polygon[:, 0])), 2) for s in low] == [0.5]
    assert "covered" in {r.why for r in found.rejected}

    rail = terrain(block((0.0, 1.0), (0.0, 0.03), (0.0, 0.5)))
    assert not rail.supports
    assert "too narrow" in {r.why for r in rail.rejected}

    corners = np.array([[0, 0, 0], [0.4, 0, 0], [0.4, 0, 0.4]], dtype=float)
    wedge = trimesh.convex.convex_hull(
        np.concatenate([corners, corners + np.array([0, 1, 0])])
    )
    steep = terrain(wedge)
    assert not steep.supports
    assert any(r.why.startswith("too steep: 45 degrees") for r in steep.rejected)

    assert not terrain(block((0, 1), (0, 1), (-0.5, -0.1))).supports


def test_a_log_is_one_piece_with_facets_that_turn_over_it():
    mesh = trimesh.creation.cylinder(radius=0.12, height=1.0, sections=48)
    turn = trimesh.transformations.rotation_matrix(np.pi / 2, [1, 0, 0])
    mesh.apply_transform(turn)
    mesh.apply_translation([0.0, 0.0, 0.12])
    found = terrain(mesh)
    assert len(found.pieces) == 1
    assert len(found.supports) >= 2
    for s in found.supports:
        radius = np.hypot(s.position[0], s.position[2] - 0.12)
        assert radius == pytest.approx(0.12, abs=0.009)


def test_each_support_lies_on_its_piece_and_what_it_may_touch_is_beside_it():
    found = terrain(staircase(noise=0.004))
    for support, i in zip(found.supports, found.under, strict=True):
        top = np.sort(np.abs(support.height(found.pieces[i])))[:3]
        assert top.max() < 0.01
