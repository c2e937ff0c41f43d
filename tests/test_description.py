"""Descriptions are read with care: meshes found or named, nothing expanded."""

from __future__ import annotations

import re
import struct
from pathlib import Path

import mujoco
import numpy as np
import pytest

import humanoids
from clamber.errors import InputError
from clamber.model.description import compile_description, read_description
from clamber.model.robot import load_robot

CUBE = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)]) * 0.1


def stl(points: np.ndarray) -> bytes:
    """A binary STL with enough triangles for a hull of the points."""
    triangles = [
        points[[i, j, k]]
        for i in range(len(points))
        for j in range(i + 1, len(points))
        for k in range(j + 1, len(points))
    ]
    out = b"\0" * 80 + struct.pack("<I", len(triangles))
    for t in triangles:
        out += struct.pack("<12fH", 0, 0, 0, *t.ravel(), 0)
    return out


def written(folder: Path, text: str, name: str = "robot.urdf") -> Path:
    path = folder / name
    path.write_text(text)
    return path


def test_a_package_mesh_is_found_above_the_file(tmp_path):
    (tmp_path / "pack" / "urdf").mkdir(parents=True)
    (tmp_path / "pack" / "meshes").mkdir()
    (tmp_path / "pack" / "meshes" / "t.stl").write_bytes(stl(CUBE))
    path = written(
        tmp_path / "pack" / "urdf", humanoids.urdf(mesh="package://pack/meshes/t.stl")
    )
    model = compile_description(read_description(path), path)
    assert model.nmesh == 1
    assert model.mesh_vertnum[0] == 8


def test_a_package_mesh_is_found_in_the_search_path(tmp_path, monkeypatch):
    (tmp_path / "elsewhere" / "pack").mkdir(parents=True)
    (tmp_path / "elsewhere" / "pack" / "t.stl").write_bytes(stl(CUBE))
    path = written(tmp_path, humanoids.urdf(mesh="package://pack/t.stl"))
    assert compile_description(read_description(path), path).nmesh == 0
    monkeypatch.setenv("ROS_PACKAGE_PATH", str(tmp_path / "elsewhere"))
    assert compile_description(read_description(path), path).nmesh == 1


def collision(text: str) -> str:
    """The drawn mesh as a collision shape."""
    return text.replace("<visual>", "<collision>").replace("</visual>", "</collision>")


LFS = b"version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 9\n"


@pytest.mark.parametrize(
    ("name", "content", "word"),
    [
        ("package://pack/gone.stl", None, "not there"),
        ("file:///nowhere/gone.stl", None, "not there"),
        ("gone.stl", LFS, "Git LFS pointer"),
        ("gone.stl", b"<!DOCTYPE html><html>", "web page"),
        ("gone.stl", b"PK\x03\x04....", "zip archive"),
        ("gone.stl", b"", "empty"),
    ],
)
def test_what_is_only_seen_may_be_missing_and_a_collision_mesh_may_not(
    tmp_path, name, content, word
):
    if content is not None:
        (tmp_path / name).write_bytes(content)
    path = written(tmp_path, humanoids.urdf(mesh=name))
    (note,) = read_description(path).notes
    assert re.search(rf"'k2'.*gone\.stl.*{word}", note)
    path = written(tmp_path, collision(humanoids.urdf(mesh=name)))
    with pytest.raises(InputError, match=r"'k2'.*gone\.stl"):
        read_description(path, lenient=True)


@pytest.mark.parametrize("solid", [False, True])
def test_the_same_holds_for_meshes_and_textures_of_an_mjcf(tmp_path, solid):
    shape = '<geom type="mesh" mesh="shell" material="skin" group="2"'
    shape += "/>" if solid else ' contype="0" conaffinity="0"/>'
    assets = (
        '<asset><texture name="grain" type="2d" file="gone.png"/>'
        '<material name="skin" texture="grain" rgba="1 0 0 1"/>'
        '<mesh name="shell" file="gone.stl"/></asset>'
    )
    text = humanoids.mjcf().replace("<worldbody>", assets + "<worldbody>")
    text = text.replace('<body name="h"', shape + '<body name="h"')
    path = written(tmp_path, text, "robot.xml")
    if solid:
        with pytest.raises(InputError, match=r"'b1'.*gone\.stl.*not there"):
            read_description(path, lenient=True)
    else:
        (note,) = (found := read_description(path, lenient=True)).notes
        assert re.search(r"'b1'.*gone\.stl is not there", note)
        assert compile_description(found, path).nmesh == 0


def test_commas_between_numbers_of_an_mjcf_are_blanks(tmp_path):
    (tmp_path / "meshes").mkdir()
    (tmp_path / "meshes" / "m.stl").write_bytes(stl(CUBE))
    path = tmp_path / "r.xml"
    path.write_text(
        """<mujoco><compiler meshdir="meshes"/><asset><mesh file="m.stl"/></asset>
        <worldbody><body name="a,1" pos="1, 2,3" quat="0.5,0.5,0.5,0.5">
        <geom type="mesh" mesh="m"/></body></worldbody></mujoco>"""
    )
    found = read_description(path)
    assert found.notes == ("commas between numbers are taken for blanks",)
    body = compile_description(found, path).body("a,1")
    np.testing.assert_allclose(body.pos, [1, 2, 3])
    np.testing.assert_allclose(body.quat, 0.5)


def test_what_an_mjcf_includes_is_found_beside_it(tmp_path, monkeypatch):
    text = humanoids.mjcf()
    start = text.index('<body name="t1"')
    end = text.index('<body name="u1"')
    (tmp_path / "parts").mkdir()
    leg = f"<mujocoinclude>{text[start:end]}</mujocoinclude>"
    written(tmp_path, leg, "parts/leg.xml")
    text = text[:start] + '<include file="parts/leg.xml"/>' + text[end:]
    path = written(tmp_path, text, "robot.xml")
    monkeypatch.chdir(tmp_path.parent)
    for place in (path, path.relative_to(tmp_path.parent)):
        model = compile_description(read_description(place), place)
        assert model.njnt == 25
    (tmp_path / "parts" / "leg.xml").unlink()
    with pytest.raises(InputError, match=r"robot\.xml.*parts/leg\.xml"):
        read_description(path)


@pytest.mark.parametrize("kind", ["mjcf", "urdf"])
def test_a_value_that_is_no_number_is_refused_by_its_field(tmp_path, capfd, kind):
    text = humanoids.mjcf() if kind == "mjcf" else humanoids.urdf()
    at = text.index('axis="') if kind == "mjcf" else text.index('xyz="')
    first = text.index('"', at) + 1
    path = tmp_path / ("r.xml" if kind == "mjcf" else "r.urdf")
    path.write_text(f"{text[:first]}NaN {text[text.index(' ', first) + 1 :]}")
    with pytest.raises(InputError, match=rf"{path.name}: \w+ (axis|xyz).*NaN.*numbers"):
        read_description(path)
    assert capfd.readouterr().err == ""


def test_what_comes_again_does_not_matter(tmp_path, capfd):
    (tmp_path / "t.stl").write_bytes(stl(CUBE))
    text = humanoids.urdf(mesh="t.stl")
    skins = '<material name="a"/><material name="b"/></visual>'
    text = text.replace("</visual>", skins).replace(
        "<collision>", '<collision name="c">'
    )
    path = written(tmp_path, text)
    model = compile_description(read_description(path), path)
    plain = written(tmp_path, humanoids.urdf(mesh="t.stl"), "plain.urdf")
    assert model.ngeom == compile_description(read_description(plain), plain).ngeom
    assert capfd.readouterr().err == ""


def test_a_shape_without_a_size_is_a_mark_and_no_shape(tmp_path):
    mark = '<collision><geometry><sphere radius="0"/></geometry></collision>'
    text = humanoids.urdf().replace("</link>", mark + "</link>", 1)
    path = written(tmp_path, text)
    found = read_description(path, lenient=True)
    assert any("'k0'" in n and "size 0" in n for n in found.notes)
    solid = compile_description(found, path)
    plain = written(tmp_path, humanoids.urdf(), "plain.urdf")
    assert solid.ngeom == compile_description(read_description(plain), plain).ngeom


def test_a_mesh_of_more_faces_than_mujoco_loads_becomes_coarser(tmp_path):
    n = 330  # on each side: 217 800 faces of a warped sheet
    x, y = np.meshgrid(np.linspace(0, 0.4, n + 1), np.linspace(0, 0.4, n + 1))
    p = np.stack([x, y, 0.1 * np.sin(9 * x) * y], axis=-1)
    a, b, c, d = p[:-1, :-1], p[1:, :-1], p[1:, 1:], p[:-1, 1:]
    corners = np.stack([[a, b, c], [a, c, d]]).transpose(0, 2, 3, 1, 4)
    face = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("rest", "<u2")])
    faces = np.zeros(2 * n * n, dtype=face)
    faces["corners"] = corners.reshape(-1, 3, 3)
    head = bytes(80) + np.uint32(len(faces)).tobytes()
    (tmp_path / "t.stl").write_bytes(head + faces.tobytes())
    path = written(tmp_path, humanoids.urdf(mesh="t.stl"))
    found = read_description(path)
    (note,) = found.notes
    assert re.search(r"t\.stl of k2.*217800 faces", note)
    model = compile_description(found, path)
    assert 1000 < model.mesh_facenum[0] <= 200_000
    away = np.linalg.norm(model.mesh_vert - model.mesh_vert.mean(axis=0), axis=1).max()
    assert away == pytest.approx(0.2 * np.sqrt(2), abs=0.02)


def test_a_mesh_of_another_format_is_refused_or_left_out_with_a_note(tmp_path):
    (tmp_path / "t.3ds").write_bytes(b"MM")
    path = written(tmp_path, humanoids.urdf(mesh="t.3ds"))
    with pytest.raises(InputError, match=r"t\.3ds.*\.dae"):
        read_description(path)
    (note,) = read_description(path, lenient=True).notes
    assert "t.3ds" in note


@pytest.mark.parametrize(
    "head",
    [
        '<!DOCTYPE x [<!ENTITY a "b"><!ENTITY c "&a;&a;&a;">]>',
        '<!DOCTYPE x [<!ENTITY a SYSTEM "file:///etc/hostname">]>',
    ],
)
@pytest.mark.parametrize("body", [humanoids.mjcf(), humanoids.urdf()])
def test_entities_are_not_expanded(tmp_path, head, body):
    path = written(tmp_path, head + body, "robot.xml")
    with pytest.raises(InputError, match="entities are not expanded"):
        read_description(path)


@pytest.mark.parametrize(
    ("content", "word"),
    [
        ("<mujoco><worldbody>", "XML"),
        ("<svg/>", "svg"),
        ("<mujoco><nonsense/></mujoco>", "MuJoCo loads"),
        ("", "XML"),
    ],
)
def test_what_is_no_description_is_refused_in_one_sentence(tmp_path, content, word):
    path = written(tmp_path, content, "robot.xml")
    with pytest.raises(InputError, match=word) as e:
        read_description(path)
    assert str(path) in str(e.value)
    assert "\n" not in str(e.value)


def test_a_file_that_stands_in_anothers_place_is_told(tmp_path):
    for content, word in (
        (LFS, "Git LFS"),
        (b"<!DOCTYPE html>", "web page"),
        (b"PK\3\4", "zip"),
    ):
        (tmp_path / "robot.urdf").write_bytes(content)
        with pytest.raises(InputError, match=word):
            read_description(tmp_path / "robot.urdf")
    (tmp_path / "robot.yaml").write_bytes(LFS)
    with pytest.raises(InputError, match="Git LFS"):
        load_robot(tmp_path / "robot.yaml")


XACRO = 'xmlns:xacro="http://www.ros.org/wiki/xacro"'


@pytest.mark.parametrize(
    "inside",
    [
        "<xacro:leg/>",
        '<link name="a"/><xacro:include filename="leg.xacro"/>',
        '<link name="a"/><xacro:leg x="1"/><xacro:macro name="leg" params="x"/>',
        '<link name="${side}_leg"/>',
    ],
)
def test_macros_of_xacro_are_asked_to_be_expanded(tmp_path, inside):
    text = f"<robot {XACRO}>{inside}</robot>"
    with pytest.raises(InputError, match="expand the macros"):
        read_description(written(tmp_path, text))


def test_what_xacro_left_of_macros_that_nothing_defines_does_not_matter(tmp_path):
    whole = humanoids.urdf()
    left = whole.replace("<robot ", f"<robot {XACRO} ", 1)
    left = left.replace("</robot>", '<xacro:imu port="none"/></robot>')
    path = written(tmp_path, left)
    found = read_description(path)
    assert found.notes == ("macros that the file does not define are left out: imu",)
    model = compile_description(found, path)
    plain = written(tmp_path, whole)
    assert model.nbody == compile_description(read_description(plain), plain).nbody


def test_a_document_in_another_encoding_hides_nothing(tmp_path):
    text = '<?xml version="1.0" encoding="utf-16"?><!DOCTYPE x><robot name="a"/>'
    (tmp_path / "r.urdf").write_bytes(text.encode("utf-16"))
    with pytest.raises(InputError, match="UTF-8"):
        read_description(tmp_path / "r.urdf")


def test_the_root_of_a_urdf_keeps_its_mass(tmp_path):
    path = written(tmp_path, humanoids.urdf())
    model = compile_description(read_description(path), path)
    assert model.body("k0").mass[0] == pytest.approx(5.0)


def test_an_inertia_that_is_not_positive_is_named_or_replaced(tmp_path):
    text = humanoids.urdf()
    first = text.index("ixx=")
    text = text[:first] + text[first:].replace('ixx="', 'ixx="-', 1)
    path = written(tmp_path, text)
    with pytest.raises(InputError, match="'k0': inertia"):
        read_description(path)
    mended = read_description(path, lenient=True)
    assert "'k0': inertia" in mended.notes[0]
    model = compile_description(mended, path)
    # A ball of water of 5 kg: radius 0.106 m, 2/5 m r^2.
    radius = (3 * 5.0 / (4 * np.pi * 1000)) ** (1 / 3)
    expected = pytest.approx(0.4 * 5.0 * radius**2, rel=1e-4)
    assert model.body("k0").inertia[0] == expected


def test_coupled_joints_are_told(tmp_path):
    path = written(tmp_path, humanoids.urdf(mimic_knee=True))
    assert read_description(path).mimics == {"q3j": "p3j", "pg2": "pg1", "qg2": "qg1"}
    xml = humanoids.mjcf().replace(
        "</mujoco>",
        '<equality><joint joint1="ud" joint2="td"/></equality></mujoco>',
    )
    assert read_description(written(tmp_path, xml, "r.xml")).mimics == {"ud": "td"}


def test_an_mjcf_is_what_mujoco_reads(tmp_path):
    path = written(tmp_path, humanoids.mjcf(), "r.xml")
    ours = read_description(path).spec.compile()
    theirs = mujoco.MjModel.from_xml_path(str(path))
    np.testing.assert_array_equal(ours.body_inertia, theirs.body_inertia)
    np.testing.assert_array_equal(ours.geom_pos, theirs.geom_pos)
