"""Boxes that are drawn: OBJ and MJCF, turned and tilted, as scenes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from clamber import _core
from clamber.errors import InputError
from clamber.model.scene import Box, Scene
from clamber.model.se3 import matrix_from_rpy
from clamber.model.terrain import load_scene
from clamber.planning.diagnose import check_scene
from clamber.step.statics import contact_angle


def obj(size, position, rpy, rng) -> str:
    """Eight vertices in random order."""
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    v = signs * np.array(size) / 2 @ matrix_from_rpy(rpy).T + position
    return "\n".join("v {:.9f} {:.9f} {:.9f}".format(*p) for p in rng.permutation(v))


def corners(box) -> np.ndarray:
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    v = box.position + signs * box.size / 2 @ box.rotation.T
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
        position=np.array(position),
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
    np.testing.assert_allclose(scene.boxes[1].position, [2, 0, 0.2])
    turned = matrix_from_rpy([0, 0, 0.3])
    np.testing.assert_allclose(scene.boxes[0].rotation, turned, atol=1e-9)


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
        ("w.xml", MJCF.replace('type="box"', 'type="sphere"', 1), "boxes and a plane"),
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


def test_a_missing_drawing_is_named(tmp_path):
    (tmp_path / "s.yaml").write_text("boxes: gone.obj\n")
    with pytest.raises(InputError, match=r"gone\.obj"):
        load_scene(tmp_path / "s.yaml")
    with pytest.raises(InputError, match=r"gone\.xml"):
        load_scene(tmp_path / "gone.xml")


def slope(pitch: float, friction: float = 0.8, x: float = 1.0) -> Box:
    return Box(
        name="slope",
        size=np.array([1.0, 1.0, 0.4]),
        position=np.array([x, 0.0, 0.2]),
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
        position=np.array([0.25, 0.0, 0.25]) - edge,
        rotation=R,
    )
    made = plan(demo_sequence, coman, Scene(boxes=(box,), start=np.zeros(3)))
    assert made.complete
    assert judge(made, simulate(made)).reached
