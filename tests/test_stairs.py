"""Where limbs go on stairs: from proportions and stance, tread after tread."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest

from clamber.contact.contact import Contact
from clamber.model.robot import load_robot
from clamber.model.scene import GROUND, Scene
from clamber.model.se3 import matrix_from_rpy
from clamber.model.world import build_world
from clamber.planning.proportions import StairSteps
from clamber.planning.route import BORDER, find_platforms
from clamber.planning.stairs import CLEAR, WORTH, Flight
from conftest import stairs

SOLE = 0.1  # [m] half of COMAN's
FACE = 0.23
STEPS = StairSteps(
    lead=0.49,
    gap=0.13,
    knee=0.05,
    span=0.23,
    sides={
        f"{side}{kind}": sign * y
        for side, sign in (("L", 1.0), ("R", -1.0))
        for kind, y in (("Hand", 0.17), ("Foot", 0.07), ("Knee", 0.1))
    },
)
ROBOT = load_robot("coman")


class Climber:
    """A flight and a stance that only geometry moves; it begins on both feet."""

    def __init__(self, scene: Scene) -> None:
        assert scene.goal is not None
        self.world, self.goal = build_world(ROBOT, scene), scene.goal[:2]
        (self.platform,) = find_platforms(scene, self.goal)
        self.flight = Flight(self.world, self.platform, self.goal, STEPS)
        self.stance: dict[str, Contact] = {}
        turn = matrix_from_rpy(np.array([0.0, 0.0, scene.start[2]]))
        for foot, y in (("LFoot", 0.07), ("RFoot", -0.07)):
            p = np.array([*scene.start[:2], 0.0]) + turn @ [0.03, y, 0.0]
            self.set(foot, GROUND, p)

    def set(self, surface: str, support: str, p, edge: int | None = None) -> None:
        self.stance[ROBOT.limb_of(surface).name] = Contact(
            surface=surface,
            support=support,
            position=p,
            quaternion=np.array([1.0, 0, 0, 0]),
            edge=edge,
        )

    def put(self, kind: str, support: str, x: float, edge: int | None = None) -> None:
        """One surface, or one of each side, where a flight along x has it."""
        z = self.world.supports[support].position[2]
        for s in [kind] if kind in STEPS.sides else ["L" + kind, "R" + kind]:
            self.set(s, support, np.array([x, STEPS.sides[s], z]), edge)

    def next(self) -> dict[str, tuple[Contact, ...]]:
        found = self.flight.next_contacts(tuple(self.stance.values()))
        return {places[0].surface: places for places in found}

    def x(self, p: np.ndarray) -> float:
        return self.platform.entry.distance(p)


@pytest.fixture
def narrow() -> Climber:
    return Climber(stairs(3, 0.15, 0.25))


def heights(scene: Scene, *z: float) -> Scene:
    """The same boxes, that high."""
    boxes = (
        replace(b, size=[*b.size[:2], h], centre=[*b.centre[:2], h / 2])
        for b, h in zip(scene.boxes, z, strict=True)
    )
    return replace(scene, boxes=tuple(boxes))


def test_a_flight_goes_up_and_has_room_for_hands_and_feet():
    def climbable(scene: Scene) -> bool:
        return Climber(scene).flight.is_climbable()

    up = stairs(3, 0.1, 0.4)
    assert climbable(up)
    assert climbable(stairs(3, 0.15, 0.25))
    assert not climbable(stairs(1, 0.15, 0.4))
    assert not climbable(stairs(3, 0.15, 0.22))  # a foot of 0.2 m and its borders
    assert not climbable(stairs(2, 0.005, 0.4))
    assert not climbable(heights(up, 0.1, 0.2, 0.1))
    slim = tuple(replace(b, size=b.size * [1.0, 0.3, 1.0]) for b in up.boxes)
    assert not climbable(replace(up, boxes=slim))  # hands are 0.34 m apart


@pytest.mark.parametrize(
    ("tread", "support"), [(0.25, "s2"), (0.30, "s2"), (0.35, "s1"), (0.4, "s1")]
)
def test_hands_go_first_as_far_ahead_as_on_a_box(tread, support):
    wanted = Climber(stairs(3, 0.15, tread)).next()
    assert set(wanted) == {"LHand", "RHand"}
    for surface, (place,) in wanted.items():
        assert (place.surface, place.support) == (surface, support)
        there = [0.03 + STEPS.lead, STEPS.sides[surface], 0.15 * int(support[1])]
        np.testing.assert_allclose(place.position, there, atol=0.05)
        assert place.position[1] == pytest.approx(STEPS.sides[surface])


def test_soles_lie_wholly_on_a_tread_and_behind_the_hands(narrow):
    narrow.put("Hand", "s2", 0.53)
    wanted = narrow.next()
    assert set(wanted) == {"LFoot", "RFoot"}
    for place in (p for places in wanted.values() for p in places):
        assert place.support == "s1"
        x = place.position[0]
        assert FACE + BORDER - 1e-9 <= x - SOLE
        assert x + SOLE <= FACE + 0.25 - CLEAR + 1e-9
        assert x <= 0.53 - STEPS.gap
    # The nearer hand counts, and one that leaves no room holds the feet back.
    narrow.put("LHand", "s1", 0.40)
    assert set(narrow.next()) == {"LHand"}


def test_the_farthest_place_comes_first_and_the_near_end_of_the_tread_next():
    flight = Climber(stairs(3, 0.1, 0.4))
    flight.put("Hand", "s2", 0.99)
    flight.put("Foot", "s1", 0.51)
    first, second = flight.next()["LFoot"]
    assert first.position[0] == pytest.approx(0.99 - STEPS.gap)
    assert second.position[0] == pytest.approx(0.63 + BORDER + SOLE)


@pytest.mark.parametrize(
    ("goal", "knees"),
    [(0.83, 0.83 - 0.5 * STEPS.span), (1.4, 0.63 + STEPS.knee + STEPS.gap)],
)
def test_knees_go_on_the_last_tread_around_the_goal_or_near_the_edge(goal, knees):
    flight = Climber(replace(stairs(2, 0.15, 0.4), goal=np.array([goal, 0.0])))
    flight.put("Hand", "s2", max(knees + STEPS.span, 0.96))
    flight.put("Foot", "s1", 0.51)
    wanted = flight.next()
    assert set(wanted) == {"LKnee", "RKnee"}
    for (place,) in wanted.values():
        assert place.support == "s2"
        assert place.position[0] == pytest.approx(knees)
    flight.put("LKnee", "s2", knees)
    assert set(flight.next()) == {"RKnee"}
    flight.put("RKnee", "s2", knees)
    assert not flight.next()


def test_a_limb_without_a_contact_is_set_down_first(narrow):
    narrow.put("Hand", "s2", 0.53)
    del narrow.stance["left_arm"]
    assert set(narrow.next()) == {"LHand"}
    narrow.put("RFoot", "s1", 0.355)
    del narrow.stance["left_leg"]
    ((surface, (place,)),) = narrow.next().items()
    assert (surface, place.support) == ("LFoot", "s1")
    np.testing.assert_allclose(place.position, [0.355, 0.07, 0.15], atol=1e-9)
    # With one knee up, a lost hand comes back before the other knee goes up.
    narrow.put("LKnee", "s3", 0.78)
    narrow.put("RFoot", "s2", 0.605)
    narrow.put("LHand", "s3", 0.95)
    del narrow.stance["right_arm"]
    assert set(narrow.next()) == {"RHand"}


def test_who_starts_beside_the_goal_comes_nearer_to_it_with_every_tread():
    aside = Climber(replace(stairs(3, 0.15, 0.25), start=np.array([0.0, 0.1, 0.0])))
    entry = aside.platform.entry.point
    assert entry[1] > 0.05
    for surface, (place,) in aside.next().items():
        share = aside.x(place.position) / aside.x(aside.goal)
        side = STEPS.sides[surface]
        assert place.position[1] - side == pytest.approx((1.0 - share) * entry[1])


def test_an_elbow_gives_way_to_the_hand(narrow):
    narrow.put("RHand", "s2", 0.53)
    narrow.set("LElbow", "s2", np.array([0.53, 0.17, 0.3]))
    assert set(narrow.next()) == {"LHand"}


def test_a_foot_on_tiptoe_is_half_a_sole_behind_its_toes():
    flight = Climber(stairs(3, 0.15, 0.4))
    flight.put("Foot", "s1", 0.40)
    flat = flight.next()["LHand"][0].position[0]
    flight.put("Foot", "s1", 0.40 + SOLE, edge=0)
    assert flight.next()["LHand"][0].position[0] == pytest.approx(flat)
    assert flat == pytest.approx(0.40 + STEPS.lead)


@pytest.mark.parametrize(
    ("steps", "tread", "yaw"),
    [
        *itertools.product((2, 6), (0.25, 0.3, 0.35, 0.4), (0.0,)),
        (3, 0.25, 0.6),
        (6, 0.4, -1.2),
        (2, 0.9, 0.0),
    ],
)
def test_the_way_up_ends_with_all_on_the_last_tread(steps, tread, yaw):
    """Only forwards, soles on treads, hands ahead of the feet, wherever it faces."""
    turn = matrix_from_rpy(np.array([0.0, 0.0, yaw]))
    flat = stairs(steps, 0.15, tread)
    turned = (replace(b, centre=turn @ b.centre, rotation=turn) for b in flat.boxes)
    goal = turn[:2, :2] @ flat.goal
    start = np.array([0.0, 0, yaw])
    flight = Climber(Scene(boxes=tuple(turned), start=start, goal=goal))
    for _ in range(20 * steps):
        wanted = flight.next()
        if not wanted:
            break
        for surface, (place, *_) in wanted.items():
            support = flight.world.supports[place.support]
            half = SOLE if surface.endswith("Foot") else 0.0
            ends = place.position + np.outer([-half, half], turn[:, 0])
            assert support.inside(ends, 0.015).all()
            now = flight.stance.get(ROBOT.limb_of(surface).name)
            if now is not None and surface == now.surface:
                # Knees bend from where the soles were.
                assert flight.x(place.position) - flight.x(now.position) >= WORTH
            flight.set(surface, place.support, place.position)
            arms = [c for c in flight.stance.values() if c.surface.endswith("Hand")]
            if surface.endswith("Foot"):
                least = min(flight.x(c.position) for c in arms)
                assert flight.x(place.position) <= least - STEPS.gap + 1e-9
                assert place.support != f"s{steps}"
    on = list(flight.stance.values())
    assert {c.support for c in on} == {f"s{steps}"}
    assert {c.surface for c in on} == {"LHand", "RHand", "LKnee", "RKnee"}
    middle = np.mean([flight.x(c.position) for c in on])
    if tread <= 0.4:
        assert middle == pytest.approx(flight.x(goal), abs=0.05)
