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


def box(name: str, x: float, size=(0.6, 0.8, 0.25), y=0.0, yaw=0.0, below=0.0) -> Box:
    return Box(
        name=name,
        size=np.array(size, float),
        position=np.array([x, y, below + size[2] / 2]),
        rotation=matrix_from_rpy([0.0, 0.0, yaw]),
    )


def scene(*boxes: Box, goal=(3.0, 0.0)) -> Scene:
    return Scene(boxes=boxes, start=np.zeros(3), goal=np.array(goal))


def test_a_box_is_entered_at_its_near_face_and_left_at_its_far_one():
    (platform,) = find_platforms(scene(box("a", 0.6)), np.array([3.0, 0.0]))
    np.testing.assert_allclose(platform.entry.point, [0.3, 0.0], atol=1e-12)
    np.testing.assert_allclose(platform.entry.inward, [1.0, 0.0], atol=1e-12)
    assert platform.exit is not None
    np.testing.assert_allclose(platform.exit.point, [0.9, 0.0], atol=1e-12)
    np.testing.assert_allclose(platform.exit.inward, [-1.0, 0.0], atol=1e-12)


def test_boxes_that_touch_are_one_platform_and_those_apart_are_several():
    near = scene(box("a", 0.6), box("b", 1.2))
    far = scene(box("b", 2.2), box("a", 0.6))  # in the order of the way, not the file
    goal = np.array([4.0, 0.0])
    assert [p.boxes for p in find_platforms(near, goal)] == [("a", "b")]
    assert [p.boxes for p in find_platforms(far, goal)] == [("a",), ("b",)]


def test_a_goal_on_top_has_no_way_down():
    (platform,) = find_platforms(scene(box("a", 0.6)), np.array([0.7, 0.0]))
    assert platform.exit is None
    assert platform.edges == (platform.entry,)


def test_walls_beside_the_way_are_no_platform():
    walls = [
        box("left", 0.6, (0.6, 0.05, 0.5), y=0.375, below=0.25),
        box("right", 0.6, (0.6, 0.05, 0.5), y=-0.375, below=0.25),
    ]
    found = find_platforms(scene(box("a", 0.6), *walls), np.array([3.0, 0.0]))
    assert [p.boxes for p in found] == [("a",)]


@pytest.mark.parametrize("yaw", [-0.5, -0.2, 0.3, 0.5])
def test_a_turned_box_is_entered_square_to_its_edge_away_from_corners(yaw):
    b = box("a", 0.8, yaw=yaw)
    (platform,) = find_platforms(scene(b), np.array([3.0, 0.0]))
    edge = platform.entry
    np.testing.assert_allclose(edge.inward, [np.cos(yaw), np.sin(yaw)], atol=1e-12)
    local = b.rotation[:2, :2].T @ (edge.point - b.position[:2])
    np.testing.assert_allclose(local[0], -0.3, atol=1e-12)
    assert abs(local[1]) <= 0.4 - BESIDE + 1e-12


def test_a_place_is_where_it_is_wanted_or_just_inside_the_border():
    s = scene(box("a", 0.6))
    there = find_place(s, ("a",), np.array([0.6, 0.1]), 0.06)
    assert there is not None
    np.testing.assert_allclose(there.position, [0.6, 0.1, 0.25], atol=1e-12)
    outside = find_place(s, ("a",), np.array([0.25, 0.1]), 0.06)
    assert outside is not None
    assert 0.3 + BORDER <= outside.position[0] <= 0.3 + BORDER + 0.02
    assert find_place(s, ("a",), np.array([-1.0, 0.0]), 0.06) is None


def test_a_place_keeps_off_the_riser_of_the_next_stair_or_takes_the_stair():
    low, high = box("a", 0.5, (0.4, 0.8, 0.1)), box("b", 0.9, (0.4, 0.8, 0.2))
    s = scene(low, high)
    before = find_place(s, ("a", "b"), np.array([0.66, 0.0]), 0.08)
    assert before is not None
    assert before.support == "a"
    assert before.position[0] <= 0.7 - 0.08
    beyond = find_place(s, ("a", "b"), np.array([0.70, 0.0]), 0.08)
    assert beyond is not None
    assert beyond.support == "b"
    assert beyond.position[2] == pytest.approx(0.2)


def test_a_goal_off_the_ground_is_refused_and_a_missing_one_is_the_first_top():
    with pytest.raises(InputError, match=r"scene\.goal .*a goal on the ground"):
        goal_of(scene(box("a", 0.6), goal=(30.0, 0.0)))
    np.testing.assert_allclose(
        goal_of(Scene(boxes=(box("a", 0.6),), start=np.zeros(3))), [0.6, 0.0]
    )
    with pytest.raises(InputError, match="a goal, or a box"):
        goal_of(Scene(start=np.zeros(3)))


def test_a_gap_of_exactly_what_is_crawled_across_is_crawled_across():
    """0.40 m, which no sum of lengths is to the last bit."""
    boxes = scene(box("a", 0.6), box("b", 1.6), goal=(4.0, 0.0))
    assert len(find_platforms(boxes, np.array([4.0, 0.0]))) == 1
    wider = scene(box("a", 0.6), box("b", 1.61), goal=(4.0, 0.0))
    assert len(find_platforms(wider, np.array([4.0, 0.0]))) == 2


def test_over_the_widest_gap_that_is_crossed_there_is_a_place_on_either_side():
    """What is wanted over its middle is no farther from a border than is looked."""
    s = scene(box("a", 0.6), box("b", 1.2 + GAP))
    middle = 0.9 + GAP / 2
    for x, side in ((middle - 0.005, "a"), (middle + 0.005, "b")):
        place = find_place(s, ("a", "b"), np.array([x, 0.1]), 0.06)
        assert place is not None
        assert place.support == side


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
    assert find_platforms(scene(box("a", 0.6)), goal)[0].gaps == ()


def test_the_room_on_a_box_is_that_to_the_nearest_other_box():
    left = box("left", 0.6, (0.4, 0.1, 0.5), y=0.40, below=0.25)
    right = box("right", 0.6, (0.4, 0.1, 0.5), y=-0.45, below=0.25)
    walled = scene(box("table", 0.6, (2.0, 1.2, 0.25)), left, right)
    assert room_on(walled, ("table",), np.array([0.6, 0.0])) == pytest.approx(0.35)
    corner = np.hypot(0.3, 0.35)
    assert room_on(walled, ("table",), np.array([1.1, 0.0])) == pytest.approx(corner)
    assert room_on(walled, ("table",), np.array([0.6, 0.42])) == 0.0
    alone = scene(box("table", 0.6))
    assert room_on(alone, ("table",), np.array([0.6, 0.0])) == np.inf
