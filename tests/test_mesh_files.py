"""Meshes that MuJoCo does not load: what is drawn is what is read, and nothing else."""

from __future__ import annotations

import itertools
import subprocess
import sys
import time
from pathlib import Path

import mujoco
import numpy as np
import pytest
import trimesh
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.spatial import ConvexHull

import humanoids
from clamber.errors import InputError
from clamber.model.description import (
    compile_description,
    read_description,
    read_mesh,
)
from clamber.model.propose import propose_robot
from test_description import stl

SOLID = trimesh.creation.box(bounds=[[0.0, 0.0, 0.0], [0.1, 0.1, 0.1]])
CUBE = np.array(SOLID.vertices)
TRIANGLES = SOLID.faces.tolist()
SHOW = '<instance_geometry url="#g"/>'
NAMESPACE = "http://www.collada.org/2005/11/COLLADASchema"
CORNER = '<input semantic="VERTEX" source="#v" offset="0"/>'


def numbers(x) -> str:
    return " ".join(str(v) for v in np.asarray(x).ravel())


def triangles(faces=TRIANGLES) -> str:
    """Each corner with a normal, as exporters write them."""
    index = [i for face in faces for corner in face for i in (corner, 0)]
    return (
        f'<triangles count="{len(faces)}">{CORNER}'
        '<input semantic="NORMAL" source="#n" offset="1"/>'
        f"<p>{numbers(index)}</p></triangles>"
    )


def polylist(faces=TRIANGLES) -> str:
    return (
        f'<polylist count="{len(faces)}">{CORNER}'
        f"<vcount>{numbers([len(f) for f in faces])}</vcount>"
        f"<p>{numbers([i for f in faces for i in f])}</p></polylist>"
    )


LINES = f'<lines count="1">{CORNER}<p>0 7</p></lines>'


def dae(
    shapes: str = "",
    *,
    points=CUBE,
    scene: str = f"<node>{SHOW}</node>",
    nodes: str = "",
    asset: str = "<up_axis>Z_UP</up_axis>",
    more: str = "",
) -> str:
    """A COLLADA file with one geometry."""

    def source(name: str, values) -> str:
        return (
            f'<source id="{name}"><float_array id="{name}a"'
            f' count="{np.size(values)}">{numbers(values)}</float_array>'
            f'<technique_common><accessor source="#{name}a" stride="3"'
            f' count="{np.size(values) // 3}"><param name="X" type="float"/>'
            '<param name="Y" type="float"/><param name="Z" type="float"/>'
            "</accessor></technique_common></source>"
        )

    return (
        f'<?xml version="1.0"?><COLLADA xmlns="{NAMESPACE}" version="1.4.1">'
        "<asset><created>2020-01-01T00:00:00</created>"
        f"<modified>2020-01-01T00:00:00</modified>{asset}</asset>{more}"
        f'<library_geometries><geometry id="g"><mesh>{source("p", points)}'
        f'{source("n", [0, 0, 1])}<vertices id="v"><input semantic="POSITION"'
        f' source="#p"/></vertices>{shapes or triangles()}</mesh></geometry>'
        f"</library_geometries><library_nodes>{nodes}</library_nodes>"
        f'<library_visual_scenes><visual_scene id="s">{scene}</visual_scene>'
        '</library_visual_scenes><scene><instance_visual_scene url="#s"/></scene>'
        "</COLLADA>"
    )


def text_stl(points=CUBE) -> str:
    return trimesh.Trimesh(points, TRIANGLES, process=False).export(
        file_type="stl_ascii"
    )


def read(folder: Path, text: str | bytes, name: str = "m.dae"):
    path = folder / name
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return read_mesh(path)


def volume(mesh) -> float:
    """That which the triangles enclose, by the divergence theorem."""
    a, b, c = np.swapaxes(mesh.vertices[mesh.triangles], 0, 1)
    return float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6)


@pytest.mark.parametrize("faces", [triangles(), polylist()])
def test_faces_are_the_closed_surface_that_they_were_written_as(tmp_path, faces):
    mesh = read(tmp_path, dae(faces + LINES))
    assert len(mesh.vertices) == 8
    assert len(mesh.triangles) == 12
    np.testing.assert_allclose(
        sorted(mesh.vertices.tolist()), sorted(CUBE.tolist()), atol=1e-7
    )
    assert volume(mesh) == pytest.approx(1e-3)


def test_nodes_place_what_they_hold_from_the_outside_in(tmp_path):
    nodes = '<node id="n"><scale>2 1 1</scale><instance_geometry url="#g"/></node>'
    scene = (
        "<node><translate>1 2 3</translate><rotate>0 0 1 90</rotate>"
        "<node><matrix>1 0 0 0.5  0 1 0 0  0 0 1 0  0 0 0 1</matrix>"
        '<instance_node url="#n"/></node></node>'
        f"<node>{SHOW}</node>"
    )
    mesh = read(tmp_path, dae(scene=scene, nodes=nodes))
    # x to y and y to -x, after the step of 0.5 along x; twice as long along x.
    R = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]])
    moved = (CUBE * [2, 1, 1] + [0.5, 0, 0]) @ R.T + [1, 2, 3]
    expected = np.concatenate([CUBE, moved])
    np.testing.assert_allclose(
        sorted(mesh.vertices.round(5).tolist()),
        sorted(expected.round(5).tolist()),
        atol=1e-5,
    )
    assert volume(mesh) == pytest.approx(3e-3, rel=1e-4)


@pytest.mark.parametrize(
    ("asset", "metres", "up"),
    [
        ("", 1.0, [0, 1, 0]),  # the format's own defaults
        ('<unit name="centimeter" meter="0.01"/><up_axis>Z_UP</up_axis>', 0.01, "z"),
        ('<unit meter="0.0254"/><up_axis>X_UP</up_axis>', 0.0254, [1, 0, 0]),
        ("<up_axis>Y_UP</up_axis>", 1.0, [0, 1, 0]),
    ],
)
def test_the_unit_counts_and_the_up_axis_is_told(tmp_path, asset, metres, up):
    mesh = read(tmp_path, dae(asset=asset))
    assert np.ptp(mesh.vertices, axis=0) == pytest.approx(3 * [0.1 * metres])
    up = [0, 0, 1] if up == "z" else up
    np.testing.assert_array_equal(mesh.upright @ up, [0, 0, 1])
    np.testing.assert_array_equal(mesh.upright @ mesh.upright.T, np.eye(3))
    assert np.linalg.det(mesh.upright) == pytest.approx(1)


def test_stl_in_text_and_binary_and_obj_are_the_same_surface(tmp_path):
    binary = stl(CUBE)
    faces = [f"f {' '.join(str(i + 1) for i in t)}" for t in TRIANGLES]
    obj = "\n".join([*(f"v {numbers(p)}" for p in CUBE), *faces])
    for name, content in (
        ("a.stl", binary),
        ("b.stl", b"solid" + binary[5:]),
        ("c.STL", text_stl()),
        ("d.obj", obj),
    ):
        mesh = read(tmp_path, content, name)
        assert len(mesh.vertices) == 8
        assert ConvexHull(mesh.vertices).volume == pytest.approx(1e-3)
        if not isinstance(content, bytes):
            assert volume(mesh) == pytest.approx(1e-3)


def test_materials_and_pictures_need_not_be_there(tmp_path):
    shown = (
        '<node><instance_geometry url="#g"><bind_material><technique_common>'
        '<instance_material symbol="a" target="#gone"/></technique_common>'
        '</bind_material></instance_geometry><instance_light url="#gone"/></node>'
    )
    more = (
        '<library_images><image id="i"><init_from>/etc/hostname</init_from></image>'
        '</library_images><library_effects><effect id="e"/></library_effects>'
    )
    before = sorted(tmp_path.iterdir())
    assert volume(read(tmp_path, dae(scene=shown, more=more))) == pytest.approx(1e-3)
    assert sorted(tmp_path.iterdir()) == [*before, tmp_path / "m.dae"]


LOOP = '<node id="a"><instance_node url="#a"/></node>'
GOOD = dae()


BROKEN = [
    "",
    GOOD[: len(GOOD) // 2],
    "<robot/>",
    '<!DOCTYPE x [<!ENTITY a "b">]>' + GOOD,
    dae(asset='<unit meter="0"/>'),
    dae(asset='<unit meter="-1"/>'),
    dae(asset='<unit meter="wide"/>'),
    dae(asset="<up_axis>W_UP</up_axis>"),
    dae(triangles([(0, 1, 8)])),
    dae(triangles([(0, 1, -1)])),
    dae(points=np.full((8, 3), np.nan)),
    dae(points=np.full((8, 3), np.inf)),
    dae(points=[*CUBE.tolist()[:-1], ["x", 0, 0]]),
    dae(LINES),
    dae(triangles([(0, 0, 1)])),
    dae(scene=""),
    dae(scene='<node><instance_geometry url="#gone"/></node>'),
    dae(scene='<node><instance_geometry url="/etc/x#g"/></node>'),
    dae(scene=LOOP),
    dae(nodes=LOOP),
    dae(scene="<node>" * 5000 + SHOW + "</node>" * 5000),
    dae().split("<scene>")[0] + "</COLLADA>",
]


@pytest.mark.parametrize("text", BROKEN)
def test_a_broken_collada_file_is_named_in_one_sentence(tmp_path, text):
    with pytest.raises(InputError) as e:
        read(tmp_path, text)
    assert e.value.source == tmp_path / "m.dae"
    assert "\n" not in str(e.value)


@pytest.mark.parametrize("leaf", [SHOW, ""])
def test_nodes_that_multiply_end_early(tmp_path, leaf):
    nodes = [f'<node id="n0">{leaf}</node>']
    for i in range(1, 40):
        again = f'<instance_node url="#n{i - 1}"/>'
        nodes.append(f'<node id="n{i}">{again * 2}</node>')
    text = dae(nodes="".join(nodes), scene='<node><instance_node url="#n39"/></node>')
    start = time.monotonic()
    with pytest.raises(InputError, match="at most"):
        read(tmp_path, text)
    assert time.monotonic() - start < 5


@pytest.mark.parametrize(
    "text",
    [
        "solid",
        "solid a\nvertex 0 0 0\nvertex 1 0 0\nendsolid",
        text_stl().replace("vertex 0.0", "vertex x", 1),
        text_stl().replace("vertex 0.0", "vertex inf", 1),
    ],
)
def test_a_broken_text_stl_is_named(tmp_path, text):
    with pytest.raises(InputError) as e:
        read(tmp_path, text, "m.stl")
    assert e.value.source == tmp_path / "m.stl"


@pytest.mark.parametrize("name", ["m.dae", "m.stl"])
def test_a_file_that_cannot_be_read_is_named(tmp_path, name):
    (tmp_path / name).mkdir()
    with pytest.raises(InputError) as e:
        read_mesh(tmp_path / name)
    assert e.value.source == tmp_path / name


def test_a_file_that_is_too_large_is_not_read(tmp_path, monkeypatch):
    monkeypatch.setattr("clamber.model.description.MAX_BYTES", len(GOOD) - 1)
    with pytest.raises(InputError, match="at most"):
        read(tmp_path, GOOD)


@pytest.mark.parametrize("name", ["m.dae", "m.stl"])
@given(data=st.data())
@settings(
    max_examples=150,
    deadline=5000,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@pytest.mark.whole
def test_whatever_a_file_holds_it_is_a_mesh_or_our_own_error(tmp_path, name, data):
    good = (GOOD if name == "m.dae" else text_stl()).encode()
    at = sorted(data.draw(st.lists(st.integers(0, len(good)), min_size=2, max_size=6)))
    parts = [good[a:b] for a, b in itertools.pairwise([0, *at, len(good)])]
    which = data.draw(st.integers(0, len(parts) - 1))
    parts[which] = data.draw(
        st.one_of(
            st.just(b""),
            st.just(2 * parts[which]),
            st.binary(max_size=20),
            st.sampled_from(
                [b"-1", b"1e999", b"99999999999", b"<node>", b"#a", b"nan"]
            ),
        )
    )
    try:
        mesh = read(tmp_path, b"".join(parts), name)
    except InputError:
        return
    assert np.isfinite(mesh.vertices).all()
    assert 0 <= mesh.triangles.min() <= mesh.triangles.max() < len(mesh.vertices)


# In a robot.

FORMS = {"t.stl": stl(CUBE), "u.stl": text_stl().encode(), "v.dae": GOOD.encode()}


def drawn(folder: Path, name: str, content: bytes) -> mujoco.MjModel:
    (folder / name).write_bytes(content)
    path = folder / "robot.urdf"
    path.write_text(humanoids.urdf(mesh=f'{name}" scale="1 -2 0.5'))
    return compile_description(read_description(path), path)


def test_a_robot_is_the_same_whatever_its_meshes_are_written_in(tmp_path):
    corners = []
    for name, content in FORMS.items():
        model = drawn(tmp_path, name, content)
        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
        (geom,) = np.flatnonzero(model.geom_type == mujoco.mjtGeom.mjGEOM_MESH)
        R, p = data.geom_xmat[geom].reshape(3, 3), data.geom_xpos[geom]
        corners.append(sorted((model.mesh_vert @ R.T + p).round(5).tolist()))
    np.testing.assert_allclose(corners[1], corners[0], atol=1e-5)
    np.testing.assert_allclose(corners[2], corners[0], atol=1e-5)
    assert np.ptp(corners[0], axis=0) == pytest.approx([0.1, 0.2, 0.05], abs=1e-5)


def test_a_mesh_read_here_goes_into_the_scene_and_not_beside_the_robot(tmp_path):
    folder = tmp_path / "robot"
    folder.mkdir()
    drawn(folder, "v.dae", FORMS["v.dae"])
    spec = read_description(folder / "robot.urdf").spec
    spec.compile()
    model = mujoco.MjModel.from_xml_string(spec.to_xml())
    assert model.nmesh == 1
    assert sorted(p.name for p in folder.iterdir()) == ["robot.urdf", "v.dae"]


def test_a_broken_mesh_of_a_robot_is_named(tmp_path):
    for name in ("v.dae", "u.stl"):
        with pytest.raises(InputError, match=name):
            drawn(tmp_path, name, FORMS[name][:400].rstrip(b"-0123456789. \n"))


def long_along(axis: int) -> np.ndarray:
    """Corners of a bar of 0.3 m that begins at the origin."""
    size = np.full(3, 0.04)
    size[axis] = 0.3
    corners = 10 * CUBE - np.where(np.arange(3) == axis, 0, 0.5)
    return corners * size


@pytest.mark.parametrize(
    ("tag", "axis", "heeded"),
    [
        ("Y_UP", 2, False),  # written for tools that ignore the tag
        ("Y_UP", 1, True),  # ... and for those that turn y to z
        ("X_UP", 0, True),
        ("Z_UP", 2, False),
        ("Y_UP", 0, False),  # does not fit either way: as it is
    ],
)
def test_joints_tell_whether_the_up_axis_counts(tmp_path, tag, axis, heeded):
    points = long_along(axis)
    text = dae(points=points, asset=f"<up_axis>{tag}</up_axis>")
    (tmp_path / "bar.dae").write_text(text)
    inertial = (
        '<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0"'
        ' ixz="0" iyz="0"/></inertial>'
    )
    path = tmp_path / "arm.urdf"
    path.write_text(
        f'<robot name="arm"><link name="a">{inertial}<collision><geometry>'
        '<mesh filename="bar.dae"/></geometry></collision></link>'
        f'<link name="b">{inertial}</link><joint name="j" type="revolute">'
        '<origin xyz="0 0 0.3"/><parent link="a"/><child link="b"/>'
        '<axis xyz="0 1 0"/><limit lower="-1" upper="1" effort="1" velocity="1"/>'
        "</joint></robot>"
    )
    description = read_description(path)
    (mesh,) = description.spec.meshes
    vertices = np.reshape(mesh.uservert, (-1, 3))
    if heeded:
        assert [0, 0.3] == pytest.approx([vertices[:, 2].min(), vertices[:, 2].max()])
    else:
        np.testing.assert_allclose(
            sorted(vertices.tolist()), sorted(points.tolist()), atol=1e-6
        )
    assert any("up axis" in n for n in description.notes) is heeded


def test_feet_and_hands_are_found_in_meshes_of_any_form(tmp_path):
    """A robot whose feet are meshes is proposed as one whose feet are boxes."""
    box = '<box size="0.17 0.08 0.02"/>'
    corners = (10 * CUBE - 0.5) * [0.17, 0.08, 0.02]
    soles = []
    for name, content in (
        ("", b""),
        ("foot.dae", dae(points=corners).encode()),
        ("foot.stl", text_stl(corners).encode()),
    ):
        text = humanoids.urdf()
        if name:
            (tmp_path / name).write_bytes(content)
            text = text.replace(box, f'<mesh filename="{name}"/>')
        path = tmp_path / "small.urdf"
        path.write_text(text)
        proposal = propose_robot(path)
        model = mujoco.MjModel.from_xml_string(proposal.mjcf, dict(proposal.files))
        soles.append([model.geom(f).size.tolist() for f in ("LFoot", "RFoot")])
    np.testing.assert_allclose(soles[1], soles[0], atol=1e-5)
    np.testing.assert_allclose(soles[2], soles[0], atol=1e-5)


@pytest.mark.whole
def test_the_library_is_imported_only_where_there_is_such_a_mesh():
    code = "import sys, clamber.model.propose; sys.exit('trimesh' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
