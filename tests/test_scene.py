"""Boxes and their supports against geometry by hand; mistakes in files are named."""

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import qpsolvers
import yaml

from clamber.errors import InputError
from clamber.model.scene import GROUND, Box, Scene, Support
from clamber.model.se3 import matrix_from_rpy
from clamber.model.terrain import load_scene
from clamber.run.forms import CODEC

SQUARE = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])


def box_at(rpy=(0.0, 0.0, 0.0), size=(0.8, 0.5, 0.3), position=(0.4, -0.2, 0.6)) -> Box:
    return Box(
        name="box",
        size=np.array(size),
        centre=np.array(position),
        rotation=matrix_from_rpy(rpy),
    )


def corners_of(box: Box) -> np.ndarray:
    """(8, 3) corners in the world, written out."""
    signs = np.array([[i, j, k] for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)])
    return box.centre + (signs * box.size / 2) @ box.rotation.T


def support_of(polygon: np.ndarray, rpy=(0.0, 0.0, 0.0)) -> Support:
    return Support(
        name="s",
        position=np.array([0.3, 0.2, 0.1]),
        rotation=matrix_from_rpy(rpy),
        polygon=polygon,
        friction=0.8,
    )


def written(path: Path, text: str) -> Path:
    file = path / "scene.yaml"
    file.write_text(text)
    return file


def one_box(**changes: str) -> str:
    """A valid file with one box, some of its fields changed."""
    fields = {"name": "table", "size": "[1.0, 0.6, 0.275]", "position": "[0.73, 0.0]"}
    fields |= changes
    return "boxes:\n  - {" + ", ".join(f"{k}: {v}" for k, v in fields.items()) + "}\n"


# The scene of a height.


def test_a_height_makes_one_box_with_its_near_face_before_the_ankles():
    scene = Scene.from_height(0.275)
    (box,) = scene.boxes
    np.testing.assert_array_equal(scene.start, 0.0)
    np.testing.assert_array_equal(box.size, [1.0, 1.2, 0.275])
    corners = corners_of(box)
    np.testing.assert_allclose(corners.min(axis=0), [0.23, -0.6, 0.0], atol=1e-15)
    np.testing.assert_allclose(corners.max(axis=0), [1.23, 0.6, 0.275], atol=1e-15)
    assert scene.goal is None


def test_friction_of_a_height_holds_for_box_and_ground():
    scene = Scene.from_height(0.3, friction=0.35)
    assert [s.friction for s in scene.supports] == [0.35, 0.35]


@pytest.mark.parametrize("height", [0.0, -0.2, math.nan, math.inf, 275.0])
def test_no_height_but_a_positive_one_in_metres_is_taken(height):
    with pytest.raises(InputError, match="height"):
        Scene.from_height(height)


# Supports.


@pytest.mark.parametrize(
    "rpy",
    [
        (0.0, 0.0, 0.0),
        (0.0, 0.0, 0.7),
        (0.3, 0.0, 0.0),
        (-0.2, 0.35, 1.9),
        (np.pi, 0.1, 0.0),  # upside down: the other face is the top
        (np.pi / 2, 0.0, 0.4),  # on its side
        (0.0, -np.pi / 2, 0.2),
    ],
)
def test_the_top_is_the_highest_face_and_points_out(rpy):
    box = box_at(rpy)
    top = box.top
    R = top.rotation
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(R) == pytest.approx(1.0)
    corners = corners_of(box)
    # Its four vertices are corners of the box, and the box lies behind their plane.
    vertices = top.position + top.polygon @ R[:, :2].T
    gaps = np.linalg.norm(vertices[:, None] - corners, axis=2)
    assert sorted(set(gaps.argmin(axis=1))) == sorted(gaps.argmin(axis=1))
    np.testing.assert_allclose(gaps.min(axis=1), 0.0, atol=1e-12)
    heights = top.height(corners)
    assert heights.max() < 1e-12
    assert np.sum(heights > -1e-12) == 4
    assert top.normal @ (top.position - box.centre) > 0
    # No other face has a normal as upright.
    assert top.normal[2] == pytest.approx(np.abs(box.rotation[2]).max())
    np.testing.assert_allclose(vertices.mean(axis=0), top.position, atol=1e-12)


@pytest.mark.parametrize("rpy", [(0.0, 0.0, 0.0), (0.0, 0.0, 1.1), (0.3, -0.2, 2.5)])
def test_half_planes_say_what_the_box_frame_says(rpy, rng):
    box = box_at(rpy)
    top = box.top
    local = rng.uniform(-0.6, 0.6, (400, 3))
    points = box.centre + local @ box.rotation.T
    truth = np.all(np.abs(local[:, :2]) <= box.size[:2] / 2, axis=1)
    np.testing.assert_array_equal(top.inside(points), truth)
    assert 0.1 < truth.mean() < 0.9
    margin = 0.05
    shrunk = np.all(np.abs(local[:, :2]) <= box.size[:2] / 2 - margin, axis=1)
    np.testing.assert_array_equal(top.inside(points, margin), shrunk)
    height = local[:, 2] - box.size[2] / 2
    np.testing.assert_allclose(top.height(points), height, atol=1e-12)


@pytest.mark.parametrize("rpy", [(0.0, 0.0, 0.4), (0.3, -0.2, 2.5)])
def test_half_planes_have_unit_normals_in_the_support(rpy):
    top = box_at(rpy).top
    A, b = top.edges()
    np.testing.assert_allclose(np.linalg.norm(A, axis=1), 1.0, atol=1e-12)
    np.testing.assert_allclose(A @ top.normal, 0.0, atol=1e-12)
    # Each passes through two neighbouring vertices, the others lie before it.
    vertices = top.position + top.polygon @ top.rotation[:, :2].T
    room = b - vertices @ A.T
    assert room.min() > -1e-12
    np.testing.assert_array_equal((room < 1e-12).sum(axis=0), 2)
    # From the middle, the distance to a side is half the length across.
    np.testing.assert_allclose(sorted(b - A @ top.position), [0.25, 0.25, 0.4, 0.4])


def test_a_triangle_is_a_support_as_well():
    s = support_of(np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]))
    inside = s.position + np.array([0.3, 0.3, 0.0])
    assert s.inside(inside)
    assert not s.inside(s.position + np.array([0.6, 0.6, 0.0]))
    # Incircle of the right triangle: 1 - sqrt(1/2).
    radius = 1.0 - math.sqrt(0.5)
    centre = s.position + np.array([radius, radius, 0.0])
    assert s.inside(centre, radius - 1e-9)
    assert not s.inside(centre, radius + 1e-9)


@pytest.mark.parametrize(
    "polygon",
    [
        SQUARE[::-1],  # clockwise
        np.array([[0, 0], [2, 0], [2, 2], [1, 0.5]]),  # a dent
        np.array([[0, 0], [1, 0], [2, 0], [1, 1]]),  # three in a line
        np.array([[0, 0], [1, 0], [1, 0], [0, 1]]),  # twice the same
        np.array([[np.cos(a), np.sin(a)] for a in 0.8 * np.pi * np.arange(5)]),  # star
        np.array([[0, 0], [1, 0]]),
        np.zeros((0, 2)),
    ],
)
def test_a_polygon_that_is_not_convex_and_ccw_is_refused(polygon):
    with pytest.raises(ValueError, match="convex"):
        support_of(np.asarray(polygon, dtype=float))


def test_arrays_are_copies_and_read_only():
    size = np.array([1.0, 1.0, 1.0])
    box = Box(name="b", size=size, centre=np.zeros(3), rotation=np.eye(3))
    size[0] = 9.0
    assert box.size[0] == 1.0
    for a in (box.size, box.centre, box.rotation, box.top.polygon, box.top.position):
        with pytest.raises(ValueError, match="read-only"):
            a[0] = 2.0
    with pytest.raises(ValueError, match="expected"):
        Box(name="b", size=np.ones(2), centre=np.zeros(3), rotation=np.eye(3))


def test_supports_come_ground_first_and_are_found_by_name():
    scene = Scene.from_height(0.4)
    assert [s.name for s in scene.supports] == [GROUND, "box"]
    np.testing.assert_array_equal(scene.support(GROUND).normal, [0, 0, 1])
    assert scene.support("box").position[2] == pytest.approx(0.4)
    with pytest.raises(KeyError, match=r"crate.*ground.*box"):
        scene.support("crate")


def test_two_boxes_of_one_name_make_no_scene():
    with pytest.raises(ValueError, match="unique"):
        Scene(boxes=(box_at(), box_at()), start=np.zeros(3))


# Places on supports.


def polygon_of(rng, corners: int) -> np.ndarray:
    """(K, 2) convex, counter-clockwise, about its middle: points of an ellipse."""
    angles = np.sort(rng.uniform(0, 2 * np.pi, corners))
    while np.diff(np.append(angles, angles[0] + 2 * np.pi)).max() > 2.8:
        angles = np.sort(rng.uniform(0, 2 * np.pi, corners))
    return np.stack([0.9 * np.cos(angles), 0.5 * np.sin(angles)], axis=1)


@pytest.mark.parametrize("corners", [3, 4, 5, 9])
@pytest.mark.parametrize("inset", [0.0, 0.05])
def test_the_nearest_point_is_what_a_qp_finds(rng, corners, inset):
    for _ in range(8):
        s = support_of(polygon_of(rng, corners), rng.uniform(-0.5, 0.5, 3))
        A, b = s.edges()
        for p in s.position + rng.uniform(-1.2, 1.2, (8, 3)):
            plane, at = s.normal[None], np.array([s.normal @ s.position])
            truth = qpsolvers.solve_qp(
                np.eye(3), -p, A, b - inset, plane, at, solver="daqp"
            )
            if truth is not None:
                np.testing.assert_allclose(s.nearest(p, inset), truth, atol=1e-6)


@pytest.mark.parametrize("inset", [0.0, 0.015, 0.2])
def test_of_a_rectangle_the_nearest_point_is_clipped_to_the_bit(rng, inset):
    top = box_at((0.2, -0.1, 0.7)).top
    half = top.polygon.max(axis=0) - inset
    for p in rng.uniform(-1.0, 1.0, (20, 3)):
        local = top.rotation.T @ (p - top.position)
        clipped = [*np.clip(local[:2], -half, half), 0]
        truth = top.position + top.rotation @ np.array(clipped)
        np.testing.assert_array_equal(top.nearest(p, inset), truth)


def test_where_a_support_is_too_narrow_the_nearest_point_is_on_its_middle():
    box = box_at(size=(0.8, 0.1, 0.3), position=(0.0, 0.0, 0.15)).top
    np.testing.assert_allclose(
        box.nearest(np.array([0.2, 9.0, 0.3]), 0.06), [0.2, 0.0, 0.3]
    )
    triangle = support_of(np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]))
    radius = 1.0 - math.sqrt(0.5)  # of the incircle: there is one deepest point
    middle = triangle.position + np.array([radius, radius, 0.0])
    found = triangle.nearest(np.array([5.0, 0.0, 0.0]), inset=0.4)
    np.testing.assert_allclose(found, middle, atol=1e-6)


@pytest.mark.parametrize("rpy", [(0.0, 0.0, 0.7), (0.2, -0.3, 2.0)])
def test_the_edge_towards_a_place_is_the_nearest_of_all_points_of_the_border(rng, rpy):
    s = support_of(polygon_of(rng, 6), rpy)
    ends = np.roll(s.vertices, -1, axis=0)
    share = np.linspace(0, 1, 400)[:, None, None]
    border = (s.vertices + share * (ends - s.vertices)).reshape(-1, 3)
    for p in s.position[:2] + rng.uniform(-2, 2, (20, 2)):
        edge = s.edge_towards(p)
        gaps = np.linalg.norm(border[:, :2] - p, axis=1)
        assert np.linalg.norm(edge.point[:2] - p) <= gaps.min() + 1e-12
        np.testing.assert_allclose(edge.point, border[gaps.argmin()], atol=0.01)
        # The whole support lies behind the edge, which is level ground's x axis.
        behind = [edge.distance(v) for v in s.vertices]
        np.testing.assert_allclose(sorted(behind)[:2], 0.0, atol=1e-12)
        np.testing.assert_allclose(edge.rotation[:2, 0], edge.inward)
        np.testing.assert_allclose(
            edge.rotation, matrix_from_rpy([0.0, 0.0, edge.yaw]), atol=1e-12
        )


def test_of_two_edges_at_a_corner_that_is_taken_which_faces_the_place():
    square = support_of(SQUARE)
    for corner in square.vertices[:, :2]:
        out = np.sign(corner - square.position[:2])
        for away in (np.array([0.3, 0.1]), np.array([0.1, 0.3])):
            edge = square.edge_towards(corner + out * away)
            np.testing.assert_allclose(edge.point[:2], corner)
            facing = out * (away == away.max())
            np.testing.assert_allclose(edge.inward, -facing, atol=1e-12)


def test_the_support_below_is_the_highest_that_is_there(rng):
    low = box_at((0.1, 0.0, 0.3), size=(1.0, 1.0, 0.3), position=(0.0, 0.0, 0.15))
    shelf = replace(low, name="shelf", centre=np.array([0.4, 0.0, 0.8]))
    scene = Scene(boxes=(low, shelf), start=np.zeros(3))
    for p in rng.uniform([-1, -1, 0], [1, 1, 1.2], (200, 3)):
        best = GROUND, 0.0
        for s in scene.supports[1:]:  # where a plumb line meets each plane
            drop = float(s.height(p) / s.normal[2])
            if drop >= 0 and s.inside(p - [0, 0, drop]) and p[2] - drop > best[1]:
                best = s.name, p[2] - drop
        found = scene.below(p)
        assert found is not None
        assert found.name == best[0]
        assert found.level(p) == pytest.approx(best[1])
    assert scene.below(np.array([0.0, 0.0, -0.1])) is None
    beside = shelf.top.position + 0.52 * shelf.top.rotation[:, 1] - [0, 0, 0.01]
    assert [scene.below(beside, x).name for x in (0.0, 0.1)] == ["box", "shelf"]


# Files.


def test_a_file_says_all_there_is_to_say(tmp_path):
    scene = load_scene(
        written(
            tmp_path,
            """
ground: {friction: 0.5}
boxes:
  - name: table
    size: [0.95, 0.60, 0.275]
    position: [0.705, 0.1]
    rpy: [0.0, 0.0, 0.3]
    friction: 0.6
  - {name: shelf, size: [0.2, 0.3, 0.1], position: [2.0, 0.0, 0.5]}
start: [0.1, 0.2, 0.3]
goal: [1.6, 0.4, 0.5]
""",
        )
    )
    table, shelf = scene.boxes
    assert (scene.ground.friction, table.friction, shelf.friction) == (0.5, 0.6, 0.8)
    np.testing.assert_allclose(table.centre, [0.705, 0.1, 0.1375])  # on the ground
    np.testing.assert_allclose(shelf.centre, [2.0, 0.0, 0.55])  # bottom face at 0.5
    np.testing.assert_allclose(table.rotation, matrix_from_rpy([0.0, 0.0, 0.3]))
    np.testing.assert_array_equal(scene.start, [0.1, 0.2, 0.3])
    np.testing.assert_array_equal(scene.goal, [1.6, 0.4, 0.5])


def test_what_a_file_leaves_out_has_a_default(tmp_path):
    scene = load_scene(written(tmp_path, one_box()))
    np.testing.assert_array_equal(scene.start, 0.0)
    assert scene.goal is None
    assert scene.ground.friction == 0.8
    np.testing.assert_array_equal(scene.boxes[0].rotation, np.eye(3))
    assert load_scene(written(tmp_path, "start: [1, 2, 0]\n")).boxes == ()


def test_a_box_is_smooth_unless_its_file_says_how_rough_it_is(tmp_path):
    for text, roughness in ((one_box(), 0.0), (one_box(roughness="0.1"), 0.1)):
        (box,) = load_scene(written(tmp_path, text)).boxes
        assert box.roughness == roughness
        assert box.top.position[2] == pytest.approx(0.275)  # no offset


def test_roughness_survives_the_fields_of_a_written_scene(tmp_path):
    box = box_at((0.0, 0.0, 0.3))
    scene = Scene(boxes=(replace(box, roughness=0.017),), start=np.zeros(3))
    fields = CODEC.encode(scene)
    assert [b["roughness"] for b in fields["boxes"]] == [0.017]
    plain = yaml.safe_dump(json.loads(json.dumps(fields, default=np.ndarray.tolist)))
    again = load_scene(written(tmp_path, plain))
    assert again.boxes[0].roughness == 0.017
    np.testing.assert_allclose(again.boxes[0].centre, box.centre)
    np.testing.assert_allclose(again.boxes[0].rotation, box.rotation, atol=1e-12)


def test_a_goal_may_leave_the_yaw_open(tmp_path):
    scene = load_scene(written(tmp_path, "goal: [1.6, 0.0]\n"))
    assert scene.goal is not None
    assert scene.goal.shape == (2,)


FAULTS = [
    (one_box(size="[1.0, -0.6, 0.275]"), "boxes.0.size.1"),
    (one_box(size="[1.0, 0.0, 0.275]"), "boxes.0.size.1"),
    (one_box(size="[1.0, 0.6, .nan]"), "boxes.0.size.2"),
    (one_box(size="[.inf, 0.6, 0.3]"), "boxes.0.size.0"),
    (one_box(size="[950, 600, 275]"), "boxes.0.size.0"),
    (one_box(size="[1.0, 0.6]"), "boxes.0.size.2"),
    (one_box(size="high"), "boxes.0.size"),
    (one_box(size="[1.0, wide, 1.0]"), "boxes.0.size.1"),
    (one_box(position="[730, 0]"), "boxes.0.position.0"),
    (one_box(rpy="[90, 0, 0]"), "boxes.0.rpy.0"),
    (one_box(friction="-0.1"), "boxes.0.friction"),
    (one_box(friction="1.5"), "boxes.0.friction"),
    (one_box(roughness="-0.01"), "boxes.0.roughness"),
    (one_box(roughness="0.11"), "boxes.0.roughness"),
    (one_box(roughness=".nan"), "boxes.0.roughness"),
    (one_box(roughness="coarse"), "boxes.0.roughness"),
    (one_box(colour="red"), "boxes.0.colour"),
    (one_box(name="ground"), "boxes"),
    (one_box(name="a/b"), "boxes.0.name"),
    (one_box() + one_box()[6:].lstrip("\n"), "boxes"),  # twice the same name
    ("boxes:\n  - {size: [1, 1, 1], position: [1, 0]}\n", "boxes.0.name"),
    ("boxes: 3\n", "boxes"),
    ("ground: {friction: .nan}\n", "ground.friction"),
    ("start: [0.0, 0.0]\n", "start.2"),
    ("start: [0.0, .nan, 0.0]\n", "start.1"),
    ("goal: [1600, 0]\n", "goal.0"),
    ("obstacles: []\n", "obstacles"),
    ("- 1\n- 2\n", None),
    ("", None),
    ("boxes: [\n", None),
]


@pytest.mark.parametrize(("text", "field"), FAULTS)
def test_a_mistake_is_named_with_file_and_field(tmp_path, text, field):
    file = written(tmp_path, text)
    with pytest.raises(InputError) as caught:
        load_scene(file)
    assert (caught.value.source, caught.value.field) == (file, field)
    assert "\n" not in str(caught.value)


def test_a_mistake_is_one_sentence_with_file_field_value_and_what_was_expected(
    tmp_path,
):
    file = written(tmp_path, one_box(size="[950, 600, 275]"))
    expected = "metres or radians, at most 50: is it in millimetres?"
    with pytest.raises(InputError) as caught:
        load_scene(file)
    said = f"{file}: boxes.0.size.0 is 950; expected {expected}"
    assert str(caught.value) == said


def test_a_file_that_is_not_there_is_named(tmp_path):
    missing = tmp_path / "none.yaml"
    with pytest.raises(InputError, match=r"none\.yaml.*No such file"):
        load_scene(missing)
    with pytest.raises(InputError, match="directory"):
        load_scene(tmp_path)
    (tmp_path / "image.yaml").write_bytes(b"\x89PNG\xff\xfe\x00")
    with pytest.raises(InputError, match="YAML"):
        load_scene(tmp_path / "image.yaml")


def test_points_are_projected_along_the_normal(rng):
    top = box_at((0.3, -0.2, 0.5)).top
    points = rng.normal(size=(5, 3))
    on = top.project(points)
    np.testing.assert_allclose(top.height(on), 0.0, atol=1e-12)
    np.testing.assert_allclose(np.cross(points - on, top.normal), 0.0, atol=1e-12)
    np.testing.assert_allclose(top.project(points[0]), on[0])
