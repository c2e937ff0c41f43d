"""Boxes that are drawn: OBJ and MJCF, turned and tilted, as scenes."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from clamber import _core
from clamber.contact.contact import ContactSequence
from clamber.errors import InputError
from clamber.model.scene import Box, Scene
from clamber.model.se3 import matrix_from_rpy
from clamber.model.terrain import load_scene
from clamber.planning.diagnose import check_scene
from clamber.run.folder import save_sequence
from clamber.step.statics import contact_angle


def obj(size, position, rpy, rng) -> str:
    """Eight vertices in random order."""
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    v = signs * np.array(size) / 2 @ matrix_from_rpy(rpy).T + position
    return "\n".join("v {:.9f} {:.9f} {:.9f}".format(*p) for p in rng.permutation(v))


def corners(box) -> np.ndarray:
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    v = box.centre + signs * box.size / 2 @ box.rotation.T
    return v[np.lexsort(v.round(5).T)]


@pytest.mark.parametrize(
    "rpy", [(0, 0, 0.4), (0, -0.175, 0), (0.35, 0, 0), (0.2, 0.3, 0.7), (0, 0.35, -1.2)]
)
def test_a_tilted_box_is_found_from_its_vertices(tmp_path, rng, rpy):
    size, position = [1.0, 0.7, 0.4], [0.3, -0.2, 0.5]
    (tmp_path / "b.obj").write_text(obj(size, position, rpy, rng))
    (found,) = load_scene(tmp_path / "b.obj").boxes
    truth = Box(
        name="t",
        size=np.array(size),
        centre=np.array(position),
        rotation=matrix_from_rpy(rpy),
    )
    np.testing.assert_allclose(corners(found), corners(truth), atol=1e-5)
    np.testing.assert_allclose(found.top.normal, truth.top.normal, atol=1e-6)


MJCF = """<mujoco><compiler angle="radian"/><worldbody>
  <geom name="ground" type="plane" size="1 1 1" friction="0.6"/>
  <geom name="table" type="box" size="0.5 0.6 0.1" pos="0.8 0 0.1"
    euler="0 0 0.3" friction="0.7"/>
  <body pos="2 0 0.2"><geom type="box" size="0.2 0.2 0.2"/></body>
</worldbody></mujoco>"""


def test_boxes_and_ground_of_an_mjcf(tmp_path):
    (tmp_path / "w.xml").write_text(MJCF)
    scene = load_scene(tmp_path / "w.xml")
    assert [b.name for b in scene.boxes] == ["table", "box2"]
    assert scene.ground_friction == pytest.approx(0.6)
    assert scene.boxes[0].friction == pytest.approx(0.7)
    np.testing.assert_allclose(scene.boxes[0].size, [1.0, 1.2, 0.2])
    np.testing.assert_allclose(scene.boxes[1].centre, [2, 0, 0.2])
    turned = matrix_from_rpy([0, 0, 0.3])
    np.testing.assert_allclose(scene.boxes[0].rotation, turned, atol=1e-9)


UNNAMED = """<mujoco><worldbody>
  <geom type="box" size="0.5 0.6 0.1" pos="0.8 0 0.1"/>
  <geom type="sphere" size="0.2" pos="4 0 0.2"/>
  <body name="table" pos="2 0 0.1"><geom type="box" size="0.2 0.2 0.1"/>
    <geom type="box" size="0.1 0.1 0.1" pos="0 1 0" friction="{mu}"/></body>
</worldbody></mujoco>"""


def test_an_unnamed_geom_is_called_by_its_place(tmp_path):
    path = tmp_path / "w.xml"
    path.write_text(UNNAMED.format(mu=0.7))
    scene = load_scene(path)
    assert [b.name for b in scene.boxes] == ["box1", "table", "table2"]
    assert [m.name for m in scene.meshes] == ["box2"]
    path.write_text(UNNAMED.format(mu=1.5))
    with pytest.raises(InputError, match=r"'table2' at \(2, 1, 0\.1\).*friction"):
        load_scene(path)


SOLIDS = """boxes:
  - {name: box, size: [1, 1, 0.5], position: [0, 0, 0.25]}
meshes:
  - {name: mesh, file: m.obj, position: [2, 0, 0.25]}
heightfields:
  - {name: heights, file: h.npy, size: [1, 1], position: [4, 0, 0.25]}
"""


def test_the_third_number_of_position_is_the_lower_face_in_files_and_python(tmp_path):
    corner = np.array([[k & 1, k >> 1 & 1, k >> 2] for k in range(8)]) - [0.5, 0.5, 0]
    faces = [[int(i) + 1 for i in f] for f in TRIANGLES.split()]
    obj = ["v {} {} {}".format(*v) for v in corner * [1, 1, 0.5]]
    obj += ["f {} {} {}".format(*f) for f in faces]
    (tmp_path / "m.obj").write_text("\n".join(obj))
    np.save(tmp_path / "h.npy", np.array([[0.0, 0.5], [0.5, 0.5]]))
    (tmp_path / "s.yaml").write_text(SOLIDS)
    scene = load_scene(tmp_path / "s.yaml")
    (box,) = scene.boxes
    assert [corners(box)[:, 2].min(), box.top.position[2]] == [0.25, 0.75]
    mesh, heights = scene.meshes
    z = np.concatenate(mesh.pieces)[:, 2]
    assert [z.min(), z.max()] == pytest.approx([0.25, 0.75], abs=1e-6)
    assert max(s.vertices[:, 2].max() for s in heights.supports) == pytest.approx(0.75)
    assert min(s.vertices[:, 2].min() for s in heights.supports) == pytest.approx(0.25)
    # Python's record has no position that could mean another face.
    assert not hasattr(box, "position")
    assert box.centre[2] == 0.5
    # What is written of it is a scene file again.
    only_box = Scene(boxes=(box,), start=np.zeros(3))
    sequence = ContactSequence(
        source="none", subject=None, scene=only_box, stances=(), t=np.zeros(1)
    )
    save_sequence(sequence, tmp_path / "sequence.json")
    written = json.loads((tmp_path / "sequence.json").read_text())["scene"]["boxes"]
    assert written[0]["position"] == [0.0, 0.0, 0.25]
    (tmp_path / "t.yaml").write_text(json.dumps({"boxes": written}))
    again = load_scene(tmp_path / "t.yaml").boxes[0]
    np.testing.assert_array_equal(again.centre, box.centre)


def test_a_scene_names_a_drawing(tmp_path, rng):
    (tmp_path / "b.obj").write_text(obj([1, 1, 0.3], [0.8, 0, 0.15], [0, 0, 0], rng))
    (tmp_path / "s.yaml").write_text(
        "boxes: b.obj\nfriction: 0.5\nground: {friction: 0.9}\nstart: [0.1, 0, 0]\n"
    )
    scene = load_scene(tmp_path / "s.yaml")
    assert scene.boxes[0].friction == 0.5
    assert scene.ground_friction == 0.9
    assert scene.start[0] == 0.1


@pytest.mark.parametrize(
    ("name", "text", "word"),
    [
        (
            "w.xml",
            MJCF.replace('friction="0.7"', 'friction="1.5"'),
            "'table'.*friction",
        ),
        ("w.xml", "<mujoco/>", "fixed to the world"),
        ("w.xml", "<!DOCTYPE a>" + MJCF, "entities"),
        ("b.obj", "v 1 2 3\n", "8 vertices"),
    ],
)
def test_what_cannot_be_a_scene_is_named(tmp_path, name, text, word):
    path: Path = tmp_path / name
    path.write_text(text)
    with pytest.raises(InputError, match=word) as e:
        load_scene(path)
    assert str(path) in str(e.value)


def only(path: Path) -> Box:
    (box,) = load_scene(path).boxes
    return box


URDF = """<robot name="r"><link name="world"/><link name="top">
  <collision><origin xyz="0 0 0.1" rpy="0 0 0.3"/>{shape}</collision></link>
  <joint name="j" type="fixed"><parent link="world"/><child link="top"/>
    <origin xyz="0.8 0.1 0.2"/></joint></robot>"""
SDF = """<sdf version="1.7"><world name="w"><model name="floor"><static>true</static>
  <link name="l"><collision name="c"><geometry><plane><normal>0 0 1</normal></plane>
  </geometry></collision></link></model>
  <model name="top"><static>1</static><pose>0.8 0.1 0.2 0 0 0</pose><link name="l">
  <pose>0 0 0 0 0 0.3</pose><collision name="c"><pose>0 0 0.1 0 0 0</pose>{shape}
  <surface><friction><ode><mu>0.6</mu></ode></friction></surface></collision></link>
  </model></world></sdf>"""
BOX = {
    "urdf": '<geometry><box size="1.0 1.2 0.2"/></geometry>',
    "sdf": "<geometry><box><size>1.0 1.2 0.2</size></box></geometry>",
}
MESH = {
    "urdf": '<geometry><mesh filename="m.obj"/></geometry>',
    "sdf": "<geometry><mesh><uri>m.obj</uri></mesh></geometry>",
}
TRIANGLES = "013 032 457 476 015 054 237 276 026 064 137 175"  # of signs in binary


def triangulated(size, split: bool) -> str:
    """A closed box of triangles, each with corners of its own if split."""
    corner = np.array([[k & 1, k >> 1 & 1, k >> 2] for k in range(8)]) - 0.5
    faces = [[int(c) for c in f] for f in TRIANGLES.split()]
    if split:
        corner = corner[[i for f in faces for i in f]]
        faces = np.arange(36).reshape(12, 3).tolist()
    v = "".join("v {} {} {}\n".format(*p) for p in corner * size)
    return v + "".join("f {} {} {}\n".format(*(i + 1 for i in f)) for f in faces)


@pytest.mark.parametrize("shapes", [BOX, MESH], ids=["box", "mesh"])
@pytest.mark.parametrize("kind", ["urdf", "sdf"])
@pytest.mark.parametrize("split", [False, True])
def test_a_box_of_a_urdf_or_sdf_is_where_its_poses_put_it(
    tmp_path, kind, shapes, split
):
    (tmp_path / "m.obj").write_text(triangulated([1.0, 1.2, 0.2], split))
    text = {"urdf": URDF, "sdf": SDF}[kind].format(shape=shapes[kind])
    (tmp_path / f"s.{kind}").write_text(text)
    found = only(tmp_path / f"s.{kind}")
    assert found.name == "top"
    assert found.friction == {"urdf": 0.8, "sdf": 0.6}[kind]
    truth = Box(
        name="t",
        size=np.array([1.0, 1.2, 0.2]),
        centre=np.array([0.8, 0.1, 0.3]),
        rotation=matrix_from_rpy([0.0, 0.0, 0.3]),
    )
    np.testing.assert_allclose(corners(found), corners(truth), atol=1e-6)


@pytest.mark.parametrize("kind", ["urdf", "sdf", "xml"])
def test_a_drawn_mesh_that_is_no_box_is_a_mesh(tmp_path, kind):
    text = triangulated([1.0, 1.2, 0.2], False).replace(
        "v 0.5 0.6 0.1", "v 0.1 0.2 0.1"
    )
    (tmp_path / "m.obj").write_text(text)
    scene = {"urdf": URDF, "sdf": SDF}.get(kind, "").format(shape=MESH.get(kind))
    if kind == "xml":
        scene = """<mujoco><asset><mesh name="rock" file="m.obj"/></asset><worldbody>
          <geom type="mesh" mesh="rock"/></worldbody></mujoco>"""
    (tmp_path / f"s.{kind}").write_text(scene)
    scene = load_scene(tmp_path / f"s.{kind}")
    (mesh,) = scene.meshes
    assert mesh.name == {"xml": "box1", "sdf": "top", "urdf": "top"}[kind]
    assert not scene.boxes
    assert mesh.friction == {"xml": 1.0, "sdf": 0.6, "urdf": 0.8}[kind]


@pytest.mark.parametrize(
    ("geom", "top"),
    [
        ('type="cylinder" size="0.3 0.1" pos="0.6 0 0.1"', 0.2),
        ('type="sphere" size="0.2" pos="0.6 0 0.2"', 0.4),
        ('type="capsule" size="0.1 0.4" pos="0.6 0 0.1" euler="90 0 0"', 0.2),
        ('type="ellipsoid" size="0.4 0.3 0.1" pos="0.6 0 0.1"', 0.2),
        ('type="hfield" hfield="h" pos="0.6 0 0"', 0.3),
    ],
)
def test_geoms_of_every_kind_are_terrain_as_high_as_they_are(tmp_path, geom, top):
    (tmp_path / "s.xml").write_text(
        f"""<mujoco><asset><hfield name="h" nrow="2" ncol="3" size="0.3 0.4 0.3 0.1"
        elevation="0 1 0 0 1 0"/></asset><worldbody><geom {geom} friction="0.6"/>
        </worldbody></mujoco>"""
    )
    (mesh,) = load_scene(tmp_path / "s.xml").meshes
    highest = max(p[:, 2].max() for p in mesh.pieces)
    assert highest == pytest.approx(top, abs=0.003)
    assert mesh.friction == 0.6


def test_a_mesh_of_an_mjcf_with_the_corners_of_a_box_is_one(tmp_path):
    (tmp_path / "m.obj").write_text(triangulated([1.0, 1.2, 0.2], True))
    (tmp_path / "s.xml").write_text(
        """<mujoco><asset><mesh name="m" file="m.obj"/></asset><worldbody>
        <body name="desk" pos="0.8 0 0.1"><geom type="mesh" mesh="m"/></body>
        </worldbody></mujoco>"""
    )
    found = only(tmp_path / "s.xml")
    assert found.name == "desk"
    assert found.top.position[2] == pytest.approx(0.2, abs=1e-6)
    np.testing.assert_allclose(sorted(found.size), [0.2, 1.0, 1.2], atol=1e-6)


def test_an_sdf_that_includes_others_or_places_things_by_name_says_so(tmp_path):
    path = tmp_path / "s.sdf"
    path.write_text("<sdf><world><include><uri>model://t</uri></include>"
                    "<model name='m'/></world></sdf>")  # fmt: skip
    with pytest.raises(InputError, match="<include> is 'model://t'"):
        load_scene(path)
    path.write_text(SDF.format(shape=BOX["sdf"]).replace("<pose>0 0 0.1",
                    "<pose relative_to='x'>0 0 0.1"))  # fmt: skip
    with pytest.raises(InputError, match="relative_to"):
        load_scene(path)


# OBJ as exporters write them.


def test_an_obj_of_edges_alone_is_refused_in_a_sentence(tmp_path):
    corners = "\n".join(f"v {k & 1} {k >> 1 & 1} {k >> 2}" for k in range(9))
    (tmp_path / "b.obj").write_text(f"o rock\n{corners}\nf 1 2\n")
    with pytest.raises(InputError, match=r"b\.obj.*expected"):
        load_scene(tmp_path / "b.obj")


@pytest.mark.parametrize("split", [False, True])
@pytest.mark.parametrize("faces", [False, True])
def test_a_box_whose_faces_have_corners_of_their_own_is_one_box(tmp_path, split, faces):
    text = triangulated([1.0, 1.2, 0.2], split)
    if not faces:
        text = "\n".join(x for x in text.splitlines() if x[0] == "v")
    moved = text.replace("v ", "v ").splitlines()
    moved = [
        f"v {float(a) + 0.8} {b} {float(c) + 0.1}"
        if kind == "v" else f"{kind} {a} {b} {c}"
        for kind, a, b, c in (line.split() for line in moved)
    ]  # fmt: skip
    (tmp_path / "b.obj").write_text("o table\n" + "\n".join(moved))
    found = only(tmp_path / "b.obj")
    assert found.name == "table"
    np.testing.assert_allclose(found.centre, [0.8, 0.0, 0.1], atol=1e-6)
    np.testing.assert_allclose(sorted(found.size), [0.2, 1.0, 1.2], atol=1e-6)


def test_boxes_that_share_corners_stay_apart_where_faces_tell(tmp_path):
    """Two steps that touch: eight vertices each, four places in common."""
    low = triangulated([0.3, 1.0, 0.2], False).splitlines()
    text, first = "", 0
    for name, x in (("a", 0.5), ("b", 0.8)):
        text += f"g {name}\n"
        for line in low:
            kind, *rest = line.split()
            if kind == "v":
                text += f"v {float(rest[0]) + x} {rest[1]} {float(rest[2]) + 0.1}\n"
            else:
                text += "f " + " ".join(f"{int(i) + first}/1" for i in rest) + "\n"
        first += 8
    (tmp_path / "b.obj").write_text(text)
    boxes = load_scene(tmp_path / "b.obj").boxes
    assert [b.name for b in boxes] == ["a", "b"]
    np.testing.assert_allclose([b.centre[0] for b in boxes], [0.5, 0.8], atol=1e-6)


def test_an_obj_with_y_up_is_asked_about_and_never_half_buried(tmp_path, rng):
    text = obj([1.0, 0.3, 1.2], [0.8, 0.15, 0.0], [0, 0, 0], rng)
    (tmp_path / "b.obj").write_text(text)
    with pytest.raises(InputError, match=r"0\.60 m under the ground.*`up: y`"):
        load_scene(tmp_path / "b.obj")
    (tmp_path / "s.yaml").write_text("boxes: b.obj\nup: y\n")
    found = only(tmp_path / "s.yaml")
    np.testing.assert_allclose(found.centre, [0.8, 0.0, 0.15], atol=1e-6)
    (tmp_path / "s.yaml").write_text("boxes: b.obj\nup: z\n")
    assert only(tmp_path / "s.yaml").centre[2] == pytest.approx(0.0, abs=1e-6)


def test_an_obj_of_another_shape_is_named(tmp_path):
    text = triangulated([1.0, 1.2, 0.2], False) + "v 0 0 0.4\nf 5 6 9\n"
    (tmp_path / "b.obj").write_text("o rock\n" + text)
    (tmp_path / "s.yaml").write_text("boxes: b.obj\n")
    with pytest.raises(InputError, match=r"rock is '9 corners'.*put boxes in its"):
        load_scene(tmp_path / "s.yaml")
    (mesh,) = load_scene(tmp_path / "b.obj").meshes  # by itself it is a mesh
    assert mesh.name == "b"


def test_a_missing_drawing_is_named(tmp_path):
    (tmp_path / "s.yaml").write_text("boxes: gone.obj\n")
    with pytest.raises(InputError, match=r"s\.yaml, \S*gone\.obj: expected a readable"):
        load_scene(tmp_path / "s.yaml")
    with pytest.raises(InputError, match=r"gone\.xml"):
        load_scene(tmp_path / "gone.xml")


def slope(pitch: float, friction: float = 0.8, x: float = 1.0) -> Box:
    return Box(
        name="slope",
        size=np.array([1.0, 1.0, 0.4]),
        centre=np.array([x, 0.0, 0.2]),
        rotation=matrix_from_rpy([0.0, pitch, 0.0]),
        friction=friction,
    )


@pytest.mark.parametrize(
    ("box", "word"),
    [
        (slope(0.3, friction=0.3), "steeper"),
        (slope(0.3, x=0.2), "starts in it"),
        (slope(0.3), None),
    ],
)
def test_check_names_what_is_wrong_with_a_support(box, word):
    faults = check_scene(Scene(boxes=(box,), start=np.zeros(3)))
    assert ("slope" in faults) == (word is not None)
    assert word is None or word in faults["slope"]


def highest(support, p1, p2) -> float:
    return _core.highest(support.position, support.normal, *support.edges(), p1, p2)


def test_arcs_rise_over_the_highest_point_on_their_way():
    top = slope(0.35).top  # the near edge is the high one
    edge = top.position - top.rotation[:, 0] * 0.5
    p1 = np.array([edge[0] - 0.3, 0.0, 0.0])
    deep = top.position + top.rotation[:, 0] * 0.3
    assert highest(top, p1, deep) == pytest.approx(edge[2], abs=0.01)
    flat = slope(0.0).top
    assert highest(flat, p1, flat.position) == flat.position[2]


def test_the_angle_to_a_normal_is_that_to_the_vertical_turned(rng):
    for _ in range(10):
        R = matrix_from_rpy(rng.uniform(-1, 1, 3))
        p, m = rng.normal(size=3), rng.normal(size=3)
        assert contact_angle(R @ p, R @ m, R[:, 2]) == pytest.approx(
            contact_angle(p, m)
        )


@pytest.mark.slow
@pytest.mark.parametrize(
    "rpy", [(0, -0.1745, 0), (0, 0.1745, 0), (0.1745, 0, 0), (0, 0.3491, 0)]
)
def test_a_slope_is_climbed_in_physics(coman, demo_sequence, rpy):
    from clamber.execution.simulation import simulate
    from clamber.execution.verdict import judge
    from clamber.planning.planner import plan

    R, size = matrix_from_rpy(rpy), np.array([1.0, 1.2, 0.5])
    edge = R @ (size * [-0.5, 0.0, 0.5])
    box = Box(
        name="slope",
        size=size,
        centre=np.array([0.25, 0.0, 0.25]) - edge,
        rotation=R,
    )
    made = plan(demo_sequence, coman, Scene(boxes=(box,), start=np.zeros(3)))
    assert made.complete
    assert judge(made, simulate(made)).reached
