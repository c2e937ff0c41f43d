"""What lies on the way, where it is entered and left, and where contacts can be."""

from __future__ import annotations

import numpy as np
import pytest

from clamber.errors import InputError
from clamber.model.scene import Box, Scene
from clamber.model.se3 import matrix_from_rpy
from clamber.planning.route import (
    BESIDE,
    BORDER,
    GAP,
    find_place,
    find_platforms,
    goal_of,
    room_on,
)

FAR = np.array([4.0, 0.0])


def box(name: str, x: float, size=(0.6, 0.8, 0.25), y=0.0, yaw=0.0, below=0.0) -> Box:
    return Box(
        name=name,
        size=np.array(size, float),
        centre=np.array([x, y, below + size[2] / 2]),
        rotation=matrix_from_rpy([0.0, 0.0, yaw]),
    )


def scene(*boxes: Box, goal=FAR) -> Scene:
    return Scene(boxes=boxes, start=np.zeros(3), goal=np.array(goal))


def groups(*boxes: Box) -> list[tuple[str, ...]]:
    return [p.boxes for p in find_platforms(scene(*boxes), FAR)]


def test_a_box_is_entered_at_its_near_face_and_left_at_its_far_one():
    (platform,) = find_platforms(scene(box("a", 0.6)), FAR)
    up, down = platform.edges
    np.testing.assert_allclose(up.point[:2], [0.3, 0.0], atol=1e-12)
    np.testing.assert_allclose(up.inward, [1.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(down.point[:2], [0.9, 0.0], atol=1e-12)
    np.testing.assert_allclose(down.inward, [-1.0, 0.0], atol=1e-12)
    assert platform.is_passed(np.array([1.0, 0.0]))
    assert not platform.is_passed(np.array([0.6, 0.0]))
    (top,) = find_platforms(scene(box("a", 0.6)), np.array([0.7, 0.0]))
    assert top.exit is None
    assert len(top.edges) == 1


def test_boxes_near_one_another_are_one_platform_and_those_beside_the_way_walls():
    assert groups(box("a", 0.6), box("b", 1.2)) == [("a", "b")]
    # In the order of the way, not of the file.
    assert groups(box("b", 2.2), box("a", 0.6)) == [("a",), ("b",)]
    # 0.40 m, which no sum of lengths is to the last bit.
    assert groups(box("a", 0.6), box("b", 1.6)) == [("a", "b")]
    assert groups(box("a", 0.6), box("b", 1.61)) == [("a",), ("b",)]
    walls = [box(n, 0.6, (0.6, 0.05, 0.5), y, below=0.25) for n, y in WALLS]
    assert groups(box("a", 0.6), *walls) == [("a",)]


WALLS = (("left", 0.375), ("right", -0.375))


@pytest.mark.parametrize("yaw", [-0.5, -0.2, 0.3, 0.5])
def test_a_turned_box_is_entered_square_to_its_edge_away_from_corners(yaw):
    b = box("a", 0.8, yaw=yaw)
    edge = find_platforms(scene(b), FAR)[0].entry
    np.testing.assert_allclose(edge.inward, [np.cos(yaw), np.sin(yaw)], atol=1e-12)
    local = b.rotation[:2, :2].T @ (edge.point[:2] - b.centre[:2])
    np.testing.assert_allclose(local[0], -0.3, atol=1e-12)
    assert abs(local[1]) <= 0.4 - BESIDE + 1e-12


def test_a_place_is_where_it_is_wanted_or_just_inside_the_border():
    def place(x: float, y: float):
        return find_place(scene(box("a", 0.6)), ("a",), np.array([x, y]), 0.06)

    name, there = place(0.6, 0.1)
    assert name == "a"
    np.testing.assert_allclose(there, [0.6, 0.1, 0.25], atol=1e-12)
    assert 0.3 + BORDER <= place(0.25, 0.1)[1][0] <= 0.3 + BORDER + 0.02
    assert place(-1.0, 0.0) is None


def test_a_place_keeps_off_the_riser_of_the_next_stair_or_takes_the_stair():
    s = scene(box("a", 0.5, (0.4, 0.8, 0.1)), box("b", 0.9, (0.4, 0.8, 0.2)))
    name, before = find_place(s, ("a", "b"), np.array([0.66, 0.0]), 0.08)
    assert name == "a"
    assert before[0] <= 0.7 - 0.08
    name, beyond = find_place(s, ("a", "b"), np.array([0.70, 0.0]), 0.08)
    assert name == "b"
    assert beyond[2] == pytest.approx(0.2)


def test_over_the_widest_gap_that_is_crossed_there_is_a_place_on_either_side():
    """What is wanted over its middle is no farther from a border than is looked."""
    s = scene(box("a", 0.6), box("b", 1.2 + GAP))
    middle = 0.9 + GAP / 2
    for x, side in ((middle - 0.005, "a"), (middle + 0.005, "b")):
        assert find_place(s, ("a", "b"), np.array([x, 0.1]), 0.06)[0] == side


def test_a_goal_off_the_ground_is_refused_and_a_missing_one_is_the_first_top():
    bare = Scene(boxes=(box("a", 0.6),), start=np.zeros(3))
    np.testing.assert_allclose(goal_of(bare), [0.6, 0.0])
    for wrong in (scene(goal=(30.0, 0.0)), Scene(start=np.zeros(3))):
        with pytest.raises(InputError) as e:
            goal_of(wrong)
        assert e.value.field == "scene.goal"


def test_a_platform_knows_the_gaps_on_its_way_in_order():
    boxes = (
        box("c", 2.5, y=-0.05),
        box("a", 0.6),
        box("b", 1.55, y=0.1),
        box("d", 3.11, y=0.0),  # so near to the one before that there is no gap
    )
    goal = np.array([5.0, 0.0])
    (platform,) = find_platforms(scene(*boxes, goal=goal), goal)
    assert platform.boxes == ("a", "b", "c", "d")
    first, second = platform.gaps
    np.testing.assert_allclose(first, [[0.9, 0.0], [1.25, 0.0]], atol=1e-12)
    np.testing.assert_allclose(second, [[1.85, 0.0], [2.2, 0.0]], atol=1e-12)


def test_the_room_on_a_box_is_that_to_the_nearest_other_box():
    left = box("left", 0.6, (0.4, 0.1, 0.5), y=0.40, below=0.25)
    right = box("right", 0.6, (0.4, 0.1, 0.5), y=-0.45, below=0.25)
    walled = scene(box("table", 0.6, (2.0, 1.2, 0.25)), left, right)
    for x, y, room in ((0.6, 0, 0.35), (1.1, 0, np.hypot(0.3, 0.35)), (0.6, 0.42, 0)):
        assert room_on(walled, ("table",), np.array([x, y])) == pytest.approx(room)
    assert room_on(scene(box("a", 0.6)), ("a",), np.array([0.6, 0.0])) == np.inf
