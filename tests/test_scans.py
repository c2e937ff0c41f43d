"""Files of terrain: units, axes, faults that are mended, and those that are refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

import clamber
from clamber.errors import InputError
from clamber.model.boxes import grid_triangles
from clamber.model.terrain import load_scene

UPRIGHT = "meshes:\n  - {{name: rock, file: {file}, {more}friction: 0.7}}\n"


def box(size=(1.0, 1.2, 0.3), x=0.75) -> trimesh.Trimesh:
    mesh = trimesh.creation.box(size)
    mesh.apply_translation([x, 0.0, size[2] / 2])
    return mesh


def loaded(folder: Path, file: str, more: str = ""):
    text = UPRIGHT.format(file=file, more=more and f"{more}, ")
    (folder / "s.yaml").write_text(text)
    (mesh,) = load_scene(folder / "s.yaml").meshes
    return mesh


def is_the_box(mesh) -> None:
    (top,) = mesh.supports
    np.testing.assert_allclose(top.position, [0.75, 0.0, 0.3], atol=2e-4)
    assert sorted(np.ptp(top.polygon, axis=0)) == pytest.approx([1.0, 1.2], abs=2e-4)
    assert top.friction == 0.7


@pytest.mark.parametrize("suffix", ["obj", "stl", "ply", "glb"])
@pytest.mark.parametrize(
    ("unit", "scale"), [("m", 1.0), ("mm", 1000.0), ("in", 39.3701)]
)
def test_a_mesh_is_where_it_is_in_any_format_and_unit(tmp_path, suffix, unit, scale):
    mesh = box()
    mesh.apply_scale(scale)
    mesh.export(tmp_path / f"b.{suffix}")
    is_the_box(loaded(tmp_path, f"b.{suffix}", f"unit: {unit}"))


def test_y_up_scale_place_and_turn_are_those_of_the_scene_file(tmp_path):
    mesh = box(x=0.0)
    v = mesh.vertices
    mesh.vertices = np.column_stack([v[:, 0], v[:, 2], -v[:, 1]]) / 2.0
    mesh.export(tmp_path / "b.ply")
    more = "up: y, scale: 2.0, position: [0.75, 0.0], rpy: [0, 0, 3.14159265]"
    is_the_box(loaded(tmp_path, "b.ply", more))


def test_a_file_by_itself_is_a_scene_called_by_its_name(tmp_path):
    box().export(tmp_path / "my-rock.stl")
    (mesh,) = load_scene(tmp_path / "my-rock.stl").meshes
    assert mesh.name == "my_rock"


def test_faces_that_are_doubled_or_turned_are_mended_with_a_sentence(tmp_path):
    mesh = box()
    faces = np.array(mesh.faces)
    faces[::3] = faces[::3, ::-1]
    turned = trimesh.Trimesh(
        mesh.vertices, np.concatenate([faces, faces[:4]]), process=False
    )
    turned.export(tmp_path / "b.ply")
    found = loaded(tmp_path, "b.ply")
    is_the_box(found)
    assert any("doubled" in n for n in found.notes)
    assert any("wrong way" in n for n in found.notes)


def test_a_mesh_inside_out_is_turned_and_one_that_is_open_is_solid_behind(tmp_path):
    mesh = box()
    mesh.invert()
    mesh.export(tmp_path / "b.stl")
    is_the_box(loaded(tmp_path, "b.stl"))
    mesh = box()
    keep = mesh.face_normals[:, 2] > -0.5  # no bottom
    open_ = trimesh.Trimesh(mesh.vertices, mesh.faces[keep], process=False)
    open_.export(tmp_path / "b.ply")
    found = loaded(tmp_path, "b.ply")
    is_the_box(found)
    assert any("not closed" in n for n in found.notes)


def test_values_that_are_no_numbers_leave_a_hole_and_a_sentence(tmp_path):
    mesh = box().subdivide_to_size(0.2)
    v = np.array(mesh.vertices)
    v[np.argmin(np.linalg.norm(v - [0.75, 0.0, 0.3], axis=1))] = np.nan
    trimesh.Trimesh(v, mesh.faces, process=False).export(tmp_path / "b.ply")
    found = loaded(tmp_path, "b.ply")
    assert any("no numbers" in n for n in found.notes)
    middle = np.array([0.75, 0.0, 0.3])
    assert not any(s.inside(middle) for s in found.supports)


@pytest.mark.parametrize(
    ("scale", "word"), [(1000.0, "unit: mm"), (0.001, "where it is")]
)
def test_another_unit_is_asked_about(tmp_path, scale, word):
    mesh = box()
    mesh.apply_scale(scale)
    mesh.export(tmp_path / "b.stl")
    with pytest.raises(InputError, match=rf"b\.stl.*{word}"):
        load_scene(tmp_path / "b.stl")


@pytest.mark.parametrize(
    ("name", "content", "word"),
    [
        ("b.stl", b"solid x\nendsolid x\n", "triangles"),
        ("b.ply", b"ply\nformat ascii 1.0\nend_header\n", "mesh"),
        ("b.pcd", b"VERSION 0.7\n", "PCD"),
        ("b.npy", b"\x93NUMPY junk", "npy"),
        ("b.fbx", b"Kaydara FBX", "export it as OBJ"),
    ],
)
def test_what_is_no_terrain_is_refused_in_a_line(tmp_path, name, content, word):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=word) as e:
        load_scene(tmp_path / name)
    assert "\n" not in str(e.value)
    assert name in str(e.value)


HEIGHTS = "heightfields:\n  - {{name: hills, file: {file}, size: [1.0, 0.8], {more}}}\n"


def heights(folder: Path, file: str, more: str):
    (folder / "s.yaml").write_text(HEIGHTS.format(file=file, more=more))
    (mesh,) = load_scene(folder / "s.yaml").meshes
    return mesh


def test_heights_have_their_corners_at_the_borders_of_their_size(tmp_path):
    x = np.linspace(0.0, 0.2, 41)
    np.save(tmp_path / "h.npy", np.tile(0.1 + x, (31, 1)))
    found = heights(tmp_path, "h.npy", "position: [0.8, 0.1, 0.02]")
    (slope,) = found.supports
    np.testing.assert_allclose(slope.position, [0.8, 0.1, 0.22], atol=1e-6)
    assert slope.normal[0] / slope.normal[2] == pytest.approx(-0.2)
    corners = slope.vertices
    np.testing.assert_allclose(corners.min(axis=0), [0.3, -0.3, 0.12], atol=1e-6)


def test_a_hole_in_heights_is_no_support(tmp_path):
    h = np.full((41, 51), 0.2)
    h[15:25, 20:30] = np.nan
    np.save(tmp_path / "h.npy", h)
    found = heights(tmp_path, "h.npy", "position: [0.8, 0.0]")
    assert any("100 heights that are no numbers" in n for n in found.notes)
    assert not any(s.inside(np.array([0.79, 0.0, 0.2])) for s in found.supports)
    h[:] = np.nan
    np.save(tmp_path / "h.npy", h)
    with pytest.raises(InputError, match="numbers"):
        heights(tmp_path, "h.npy", "position: [0.8, 0.0]")


def test_a_picture_is_seen_from_above_and_asks_for_its_heights(tmp_path):
    grey = np.zeros((20, 30), dtype=np.uint8)
    grey[:10] = 255  # the upper half: far along y
    Image.fromarray(grey).save(tmp_path / "h.png")
    found = heights(tmp_path, "h.png", "position: [0.8, 0.0], range: [0.1, 0.3]")
    high = [s for s in found.supports if s.position[2] > 0.2]
    assert [round(float(s.position[2]), 3) for s in high] == [0.3]
    assert high[0].position[1] > 0.1
    with pytest.raises(InputError, match="range"):
        heights(tmp_path, "h.png", "position: [0.8, 0.0]")


@pytest.mark.parametrize("suffix", ["npy", "ply", "pcd"])
def test_a_cloud_of_points_is_the_surface_it_was_measured_on(tmp_path, suffix, rng):
    flat = rng.uniform([0.3, -0.5], [1.2, 0.5], size=(6000, 2))
    z = np.where(flat[:, 0] < 0.7, 0.1, 0.25) + rng.uniform(-0.004, 0.004, size=6000)
    points = np.column_stack([flat, z])
    points[7] = np.nan
    path = tmp_path / f"c.{suffix}"
    if suffix == "npy":
        np.save(path, points)
    elif suffix == "ply":
        trimesh.PointCloud(points).export(path)
    else:
        rows = "\n".join("{} {} {}".format(*p) for p in points)
        path.write_text(
            "# made by hand\nVERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\n"
            f"COUNT 1 1 1\nWIDTH 6000\nHEIGHT 1\nPOINTS 6000\nDATA ascii\n{rows}\n"
        )
    (mesh,) = load_scene(path).meshes
    levels = sorted(round(float(s.position[2]), 2) for s in mesh.supports[:2])
    assert levels == [0.1, 0.25]
    assert any("1 points that are no numbers" in n for n in mesh.notes)


def test_two_shapes_of_one_name_are_refused(tmp_path):
    box().export(tmp_path / "b.stl")
    entry = "  - {name: a, file: b.stl}\n"
    (tmp_path / "s.yaml").write_text("meshes:\n" + 2 * entry)
    with pytest.raises(InputError, match=r"meshes.*different names"):
        load_scene(tmp_path / "s.yaml")


def test_far_too_many_triangles_with_noise_are_put_together_to_one_surface(tmp_path):
    x, y = np.linspace(0.25, 1.05, 401), np.linspace(-0.4, 0.4, 401)
    z = np.random.default_rng(0).normal(0.25, 0.002, size=(401, 401))
    vertices, faces = grid_triangles(x, y, z)
    trimesh.Trimesh(vertices, faces, process=False).export(tmp_path / "fine.ply")
    mesh = loaded(tmp_path, "fine.ply")
    assert any("320000 triangles put together" in note for note in mesh.notes)
    assert not any("wrong way" in note for note in mesh.notes)
    (top,) = mesh.supports
    assert top.position[2] == pytest.approx(0.25, abs=2e-3)
    assert np.all(np.ptp(top.polygon, axis=0) > 0.75)


def test_a_mesh_without_a_support_says_why_it_has_none(tmp_path):
    steep = box((1.0, 1.2, 0.3), 0.0)
    turn = trimesh.transformations.rotation_matrix(-0.75, (0, 1, 0))
    steep.apply_transform(turn).apply_translation((0.9, 0.0, 0.4))
    steep.export(tmp_path / "steep.stl")
    loaded(tmp_path, "steep.stl")
    sequence = clamber.detect_contacts(clamber.load_demo("climb"))
    with pytest.raises(InputError, match=r"scene.meshes.rock .*too steep: 43 "):
        clamber.plan(sequence, "coman", tmp_path / "s.yaml")
