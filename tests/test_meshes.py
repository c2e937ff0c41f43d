"""Tessellated geoms against MuJoCo's own volumes, distances and inertias."""

from __future__ import annotations

import math

import mujoco
import numpy as np
import pytest

import clamber
from clamber.show.meshes import (
    MAX_TRIANGLES,
    PAD_COLOUR,
    body_meshes,
    geom_colour,
    geom_triangles,
    shaded,
    simplified,
)

SHAPES = """
<mujoco>
  <asset>
    <material name="red" rgba="0.9 0.1 0.1 1"/>
    <mesh name="tetra" vertex="0 0 0  0.2 0 0  0 0.3 0  0 0 0.4"/>
  </asset>
  <worldbody>
    <geom name="ground" type="plane" size="1 1 0.1"/>
    <geom name="step" type="box" size="0.2 0.3 0.1" pos="1 0 0.1"/>
    <body name="all" pos="0 0 1">
      <freejoint/>
      <geom name="box" type="box" size="0.1 0.2 0.3" pos="0.1 0 0" euler="10 20 30"/>
      <geom name="sphere" type="sphere" size="0.1" material="red"/>
      <geom name="capsule" type="capsule" size="0.05 0.2" euler="90 0 0"/>
      <geom name="cylinder" type="cylinder" size="0.1 0.2" pos="0 0.4 0"/>
      <geom name="ellipsoid" type="ellipsoid" size="0.1 0.2 0.15" euler="0 45 0"/>
      <geom name="mesh" type="mesh" mesh="tetra" pos="0 0 -0.2" euler="30 0 0"/>
      <geom name="hidden" type="sphere" size="0.3" group="3"/>
      <geom name="clear" type="sphere" size="0.3" rgba="1 1 1 0"/>
    </body>
  </worldbody>
</mujoco>
"""


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(SHAPES)


def volume(v: np.ndarray, f: np.ndarray) -> float:
    """Of a closed surface, by tetrahedra from the origin; outward faces count up."""
    a, b, c = (v[f[:, k]] for k in range(3))
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6)


VOLUMES = {
    "box": 8 * 0.1 * 0.2 * 0.3,
    "sphere": 4 / 3 * np.pi * 0.1**3,
    "capsule": 4 / 3 * np.pi * 0.05**3 + np.pi * 0.05**2 * 0.4,
    "cylinder": np.pi * 0.1**2 * 0.4,
    "ellipsoid": 4 / 3 * np.pi * 0.1 * 0.2 * 0.15,
    "mesh": 0.2 * 0.3 * 0.4 / 6,
}


@pytest.mark.parametrize("name", VOLUMES)
def test_a_shape_encloses_its_volume_with_normals_that_point_out(
    model: mujoco.MjModel, name: str
):
    shape = geom_triangles(model, model.geom(name).id)
    assert shape is not None
    v, n, f = shape
    assert abs(volume(v, f)) == pytest.approx(VOLUMES[name], rel=0.03)
    np.testing.assert_allclose(np.linalg.norm(n, axis=1), 1.0, atol=1e-5)
    a, b, c = (v[f[:, k]] for k in range(3))
    way = np.cross(b - a, c - a) * np.sign(volume(v, f))
    assert np.all(np.einsum("ij,ij->i", way, n[f].mean(axis=1)) > 0)


@pytest.mark.parametrize("name", [n for n in VOLUMES if n != "mesh"])
def test_vertices_lie_on_the_geom_where_mujoco_has_it(model: mujoco.MjModel, name: str):
    """A tiny probe at each vertex touches the geom, by MuJoCo's own distance."""
    shape = geom_triangles(model, model.geom(name).id)
    assert shape is not None
    spec = mujoco.MjSpec.from_string(SHAPES)
    probe = spec.worldbody.add_body(name="probe", mocap=True)
    probe.add_geom(name="probe", type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[1e-4, 0, 0])
    probed = spec.compile()
    data = mujoco.MjData(probed)
    body = probed.body("all").id
    for vertex in shape[0][::17]:
        mujoco.mj_kinematics(probed, data)
        world = data.xpos[body] + data.xmat[body].reshape(3, 3) @ vertex
        data.mocap_pos[0] = world
        mujoco.mj_kinematics(probed, data)
        ids = (probed.geom("probe").id, probed.geom(name).id)
        gap = mujoco.mj_geomDistance(probed, data, *ids, 1.0, np.zeros(6))
        assert abs(gap) < 1e-3


def test_what_the_viewer_hides_is_left_out_and_bodies_are_merged(model: mujoco.MjModel):
    meshes = {m.body: m for m in body_meshes(model)}
    assert set(meshes) == {0, model.body("all").id}
    step = meshes[0]  # the plane is not among the world's triangles
    np.testing.assert_allclose(step.vertices.min(axis=0), [0.8, -0.3, 0.0], atol=1e-9)
    np.testing.assert_allclose(step.vertices.max(axis=0), [1.2, 0.3, 0.2], atol=1e-9)
    parts = [geom_triangles(model, model.geom(n).id) for n in VOLUMES]
    assert len(meshes[1].triangles) == sum(len(p[2]) for p in parts if p)
    assert meshes[1].triangles.max() == len(meshes[1].vertices) - 1
    assert geom_triangles(model, model.geom("ground").id) is None


def test_a_material_colours_what_has_no_colour_of_its_own(model: mujoco.MjModel):
    red = geom_colour(model, model.geom("sphere").id)
    np.testing.assert_allclose(red, [0.9, 0.1, 0.1, 1], atol=1e-6)
    plain = geom_colour(model, model.geom("box").id)
    np.testing.assert_allclose(plain, [0.5, 0.5, 0.5, 1])
    colours = {m.body: m.colours for m in body_meshes(model)}[1]
    assert np.any(np.all(np.isclose(colours, red[:3]), axis=1))
    pads = [model.geom("sphere").id]
    colours = {m.body: m.colours for m in body_meshes(model, pads=pads)}[1]
    assert not np.any(np.all(np.isclose(colours, red[:3]), axis=1))
    assert np.any(np.all(np.isclose(colours, PAD_COLOUR[:3]), axis=1))


def fine_sphere() -> tuple[np.ndarray, np.ndarray]:
    a = np.linspace(0, 2 * np.pi, 200, endpoint=False)
    z = np.linspace(-1, 1, 100)
    r = np.sqrt(1 - z**2)[:, None]
    v = np.stack([r * np.cos(a), r * np.sin(a), z[:, None] + 0 * a], axis=-1)
    i, j = np.meshgrid(np.arange(99), np.arange(200), indexing="ij")
    p, q = (i * 200 + j).ravel(), (i * 200 + (j + 1) % 200).ravel()
    f = np.concatenate(
        [np.stack([p, q, q + 200], axis=1), np.stack([p, q + 200, p + 200], axis=1)]
    )
    return v.reshape(-1, 3), f


def test_a_simplified_mesh_is_small_and_still_the_same_shape():
    v, f = fine_sphere()
    w, g = simplified(v, f, 4000)
    assert 1000 < len(g) <= 4000
    assert g.max() < len(w)
    assert volume(w, g) == pytest.approx(volume(v, f), rel=0.03)
    assert len(simplified(v, f, 0)[1]) == 0  # ends, whatever is asked


def test_flat_faces_stay_flat_and_edges_sharp_when_a_mesh_is_simplified():
    """A cube of many triangles, off the grid: corners and volume are kept."""
    n = 40
    i, j = np.meshgrid(np.arange(n), np.arange(n), indexing="ij")
    quads = np.stack([i, i + 1, i + 1, i], axis=-1), np.stack([j, j, j + 1, j + 1], -1)
    u, w = (x.reshape(-1, 4) / n for x in quads)
    patches = []
    for axis in range(3):
        for side in (0.0, 1.0):
            p = np.zeros((len(u), 4, 3))
            p[..., axis] = side
            p[..., (axis + 1) % 3], p[..., (axis + 2) % 3] = u, w
            patches.append(p if side else p[:, ::-1])
    corners = np.concatenate(patches).reshape(-1, 3)
    v, index = np.unique(corners.round(9), axis=0, return_inverse=True)
    quad = index.reshape(-1, 4)
    f = np.concatenate([quad[:, [0, 1, 2]], quad[:, [0, 2, 3]]])
    turn, _ = np.linalg.qr(np.random.default_rng(2).normal(size=(3, 3)))
    turn *= np.linalg.det(turn)
    assert volume(v @ turn.T, f) == pytest.approx(1.0)
    w, g = simplified(v @ turn.T, f, 400)
    assert 60 < len(g) <= 400
    assert volume(w, g) == pytest.approx(1.0, rel=0.01)  # 0.9 with means of cells
    back = w[np.unique(g)] @ turn
    assert np.abs(np.clip(back, 0, 1) - back).max() < 0.01
    face = np.minimum(np.abs(back), np.abs(1 - back)).min(axis=1)
    assert face.max() < 0.01


def test_normals_are_smooth_on_a_ball_and_sharp_on_a_cube():
    w, n, _ = shaded(*fine_sphere())
    at = np.abs(w[:, 2]) < 0.9  # not the poles, whose faces are slivers
    assert np.min(np.abs(np.einsum("ij,ij->i", w[at], n[at]))) > 0.999
    assert len(w) < 1.2 * len(fine_sphere()[0])
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1.0)])
    faces = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4)]
    quads = np.array([*faces, (1, 5, 7, 3)])
    f = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    w, n, _ = shaded(corners, f)
    assert len(w) == 24
    np.testing.assert_allclose(np.sort(np.abs(n), axis=1), [[0, 0, 1]] * 24, atol=1e-9)


def test_a_large_mesh_is_cut_down_and_a_small_one_is_not(model: mujoco.MjModel):
    v, f = fine_sphere()
    spec = mujoco.MjSpec()
    mesh = spec.add_mesh(name="ball")
    mesh.uservert, mesh.userface = v.ravel().tolist(), f.ravel().tolist()
    spec.worldbody.add_body(name="b").add_geom(
        type=mujoco.mjtGeom.mjGEOM_MESH, meshname="ball"
    )
    large = spec.compile()
    assert len(body_meshes(large)[0].triangles) > 30_000
    assert len(body_meshes(large, max_triangles=5000)[0].triangles) <= 5000


@pytest.mark.parametrize("deviation", [0.01, 0.005, 0.001])
def test_faces_are_no_farther_off_than_was_asked_and_no_more_than_that(
    model: mujoco.MjModel, deviation: float
):
    """Of the ball of 0.1 m, around its equator; large shapes have more faces."""
    spec = mujoco.MjSpec.from_string(SHAPES)
    for geom in spec.geoms:
        if geom.name != "sphere":
            geom.rgba = [1, 1, 1, 0]
    ball = body_meshes(spec.compile(), deviation=deviation)[-1]
    middle = ball.vertices[np.abs(ball.vertices[:, 2]) < 1e-9]
    middle = np.unique(middle.round(9), axis=0)
    corners = len(middle)
    inside = 0.1 * (1 - math.cos(math.pi / corners))
    assert inside <= deviation
    assert 0.1 * (1 - math.cos(math.pi / (corners - 1))) > deviation
    sizes = {
        r: len(body_meshes(balls(r), deviation=deviation)[0].triangles)
        for r in (0.02, 0.1)
    }
    assert sizes[0.02] < sizes[0.1]


def balls(radius: float) -> mujoco.MjModel:
    spec = mujoco.MjSpec()
    spec.worldbody.add_body(name="b").add_geom(
        type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[radius, 0, 0]
    )
    return spec.compile()


def test_the_built_in_robot_has_a_mesh_for_each_body_that_shows():
    world = clamber.build_world(
        clamber.load_robot("coman"), clamber.Scene.from_height(0.3)
    )
    meshes = body_meshes(world.model)
    shown = set(world.model.geom_bodyid[world.model.geom_group <= 2].tolist())
    assert {m.body for m in meshes} == shown
    assert sum(len(m.triangles) for m in meshes) < MAX_TRIANGLES


def test_a_height_field_is_drawn_where_rays_meet_it(rng):
    heights = rng.uniform(size=(5, 7))
    heights = (heights - heights.min()) / np.ptp(heights)
    spec = mujoco.MjSpec()
    spec.add_hfield(
        name="h", nrow=5, ncol=7, size=[0.3, 0.2, 0.1, 0.1], userdata=heights.ravel()
    )
    kind = mujoco.mjtGeom.mjGEOM_HFIELD
    turned = [np.cos(0.2), 0.0, 0.0, np.sin(0.2)]
    spec.worldbody.add_geom(type=kind, hfieldname="h", pos=[1, 0, 0.5], quat=turned)
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    shape = geom_triangles(model, 0)
    assert shape is not None
    v, n, f = shape
    assert np.all(n[:, 2] > 0.0)
    for face in f:
        p = v[face].mean(axis=0)
        down = np.array([0.0, 0.0, -1.0])
        hit = mujoco.mj_ray(
            model, data, p - down, down, None, 1, -1, np.zeros(1, np.int32)
        )
        assert hit == pytest.approx(1.0, abs=1e-6)
