"""Where limbs go on stairs: from the build and the stance, tread after tread."""

from __future__ import annotations

import itertools
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from clamber.contact.contact import Contact
from clamber.model.robot import load_robot
from clamber.model.scene import GROUND, Scene
from clamber.model.se3 import matrix_from_rpy
from clamber.model.world import build_world
from clamber.planning import gait as traverse
from clamber.planning.records import PlanOptions
from clamber.planning.route import BORDER, Place, find_platforms
from clamber.planning.stairs import CLEAR, WORTH, Gait, is_flight, next_contacts
from clamber.step.change import standing
from clamber.step.ik import IK
from clamber.step.path import interpolate, overlap, watched_pairs
from conftest import stairs
from test_traverse import POLICY

SOLE = 0.1  # [m] half of COMAN's
FACE = 0.23
GAIT = Gait(
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


class Flight:
    """A flight and a stance that only geometry moves."""

    def __init__(self, scene: Scene) -> None:
        self.robot = load_robot("coman")
        self.world = build_world(self.robot, scene)
        assert scene.goal is not None
        self.goal = scene.goal[:2]
        (self.platform,) = find_platforms(scene, self.goal)
        self.stance: dict[str, Contact] = {}
        for side, y in (("left", 0.07), ("right", -0.07)):
            turn = matrix_from_rpy(np.array([0.0, 0.0, scene.start[2]]))
            p = np.array([*scene.start[:2], 0.0]) + turn @ [0.03, y, 0.0]
            self.set(f"{side[0].upper()}Foot", Place(support=GROUND, position=p))

    def set(self, surface: str, place: Place, edge: int | None = None) -> None:
        self.stance[self.robot.limb_of(surface).name] = Contact(
            surface=surface,
            support=place.support,
            position=place.position,
            quaternion=np.array([1.0, 0, 0, 0]),
            edge=edge,
        )

    def put(self, surface: str, support: str, x: float, edge: int | None = None):
        """Where a flight along x has it, `x` in the world."""
        y = GAIT.sides[surface]
        z = self.world.supports[support].position[2]
        self.set(surface, Place(support=support, position=np.array([x, y, z])), edge)

    def next(self) -> dict[str, tuple[Place, ...]]:
        stance = tuple(self.stance.values())
        return dict(next_contacts(self.world, self.platform, stance, self.goal, GAIT))

    def x(self, p: np.ndarray) -> float:
        return self.platform.entry.distance(p)


@pytest.fixture
def narrow() -> Flight:
    return Flight(stairs(3, 0.15, 0.25))


def test_a_flight_goes_up_and_has_room_for_hands_and_feet(narrow):
    assert is_flight(narrow.world, narrow.platform, narrow.goal, GAIT)

    def flight(scene: Scene) -> bool:
        f = Flight(scene)
        return is_flight(f.world, f.platform, f.goal, GAIT)

    assert not flight(stairs(1, 0.15, 0.4))
    assert not flight(stairs(3, 0.15, 0.22))  # a foot of 0.2 m and its borders
    assert not flight(stairs(2, 0.005, 0.4))
    up = stairs(3, 0.1, 0.4)
    sizes = [0.1, 0.2, 0.1]
    down = tuple(
        replace(
            b,
            size=np.array([0.4, 0.8, h]),
            position=np.array([b.position[0], 0.0, h / 2]),
        )
        for b, h in zip(up.boxes, sizes, strict=True)
    )
    assert not flight(replace(up, boxes=down))
    wide = tuple(replace(b, size=b.size * [1.0, 0.3, 1.0]) for b in up.boxes)
    assert not flight(replace(up, boxes=wide))  # hands are 0.34 m apart


@pytest.mark.parametrize(
    ("tread", "support"), [(0.25, "s2"), (0.30, "s2"), (0.35, "s1"), (0.4, "s1")]
)
def test_hands_go_first_as_far_ahead_as_on_a_box(tread, support):
    flight = Flight(stairs(3, 0.15, tread))
    wanted = flight.next()
    assert set(wanted) == {"LHand", "RHand"}
    for surface, (place,) in wanted.items():
        assert place.support == support
        assert place.position[0] == pytest.approx(0.03 + GAIT.lead, abs=0.05)
        assert place.position[1] == pytest.approx(GAIT.sides[surface])
        assert place.position[2] == pytest.approx(0.3 if support == "s2" else 0.15)


def test_soles_lie_wholly_on_a_tread_and_behind_the_hands(narrow):
    for hand in ("LHand", "RHand"):
        narrow.put(hand, "s2", 0.53)
    wanted = narrow.next()
    assert set(wanted) == {"LFoot", "RFoot"}
    for places in wanted.values():
        for place in places:
            assert place.support == "s1"
            x = place.position[0]
            assert x - SOLE >= FACE + BORDER - 1e-9
            assert x + SOLE <= FACE + 0.25 - CLEAR + 1e-9
            assert x <= 0.53 - GAIT.gap
    # The nearer hand counts, and one that leaves no room holds the feet back.
    narrow.put("LHand", "s1", 0.40)
    assert set(narrow.next()) == {"LHand"}


def test_the_farthest_place_comes_first_and_the_near_end_of_the_tread_next():
    flight = Flight(stairs(3, 0.1, 0.4))
    for hand in ("LHand", "RHand"):
        flight.put(hand, "s2", 0.99)
    for foot in ("LFoot", "RFoot"):
        flight.put(foot, "s1", 0.51)
    first, second = flight.next()["LFoot"]
    assert first.position[0] == pytest.approx(0.99 - GAIT.gap)
    assert second.position[0] == pytest.approx(0.63 + BORDER + SOLE)


def test_no_foot_goes_on_the_last_tread_but_knees_do_around_the_goal():
    flight = Flight(stairs(2, 0.15, 0.4))
    for hand in ("LHand", "RHand"):
        flight.put(hand, "s2", 0.83 + 0.5 * GAIT.span)
    for foot in ("LFoot", "RFoot"):
        flight.put(foot, "s1", 0.51)
    wanted = flight.next()
    assert set(wanted) == {"LKnee", "RKnee"}
    for (place,) in wanted.values():
        assert place.support == "s2"
        assert place.position[0] == pytest.approx(0.83 - 0.5 * GAIT.span)
    flight.put("LKnee", "s2", 0.715)
    assert set(flight.next()) == {"RKnee"}
    flight.put("RKnee", "s2", 0.715)
    assert not flight.next()


def test_where_the_goal_is_far_knees_come_near_the_edge():
    far = Flight(replace(stairs(2, 0.15, 0.4), goal=np.array([1.4, 0.0])))
    for hand in ("LHand", "RHand"):
        far.put(hand, "s2", 0.96)
    for foot in ("LFoot", "RFoot"):
        far.put(foot, "s1", 0.51)
    ((knee,), _) = far.next().values()
    assert knee.position[0] == pytest.approx(0.63 + GAIT.knee + GAIT.gap)


def test_a_limb_without_a_contact_is_set_down_first(narrow):
    for hand in ("LHand", "RHand"):
        narrow.put(hand, "s2", 0.53)
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
    aside = Flight(replace(stairs(3, 0.15, 0.25), start=np.array([0.0, 0.1, 0.0])))
    entry = aside.platform.entry.point
    assert entry[1] > 0.05
    for surface, (place,) in aside.next().items():
        share = aside.x(place.position) / aside.x(aside.goal)
        side = GAIT.sides[surface]
        assert place.position[1] - side == pytest.approx((1.0 - share) * entry[1])


def test_an_elbow_gives_way_to_the_hand(narrow):
    narrow.put("RHand", "s2", 0.53)
    narrow.set("LElbow", Place(support="s2", position=np.array([0.53, 0.17, 0.3])))
    assert set(narrow.next()) == {"LHand"}


def test_a_foot_on_tiptoe_is_half_a_sole_behind_its_toes():
    flight = Flight(stairs(3, 0.15, 0.4))
    for foot in ("LFoot", "RFoot"):
        flight.put(foot, "s1", 0.40)
    flat = flight.next()["LHand"][0].position[0]
    for foot in ("LFoot", "RFoot"):
        flight.put(foot, "s1", 0.40 + SOLE, edge=0)
    assert flight.next()["LHand"][0].position[0] == pytest.approx(flat)
    assert flat == pytest.approx(0.40 + GAIT.lead)


@pytest.mark.parametrize(
    ("steps", "tread", "yaw"),
    [
        *itertools.product((2, 3, 6), (0.25, 0.3, 0.35, 0.4), (0.0,)),
        (3, 0.25, 0.6),
        (6, 0.4, -1.2),
        (2, 0.9, 0.0),
    ],
)
def test_the_way_up_ends_with_all_on_the_last_tread(steps, tread, yaw):
    """Only forwards, soles on treads, hands ahead of the feet, wherever it faces."""
    turn = matrix_from_rpy(np.array([0.0, 0.0, yaw]))
    flat = stairs(steps, 0.15, tread)
    assert flat.goal is not None
    boxes = tuple(
        replace(b, position=turn @ b.position, rotation=turn) for b in flat.boxes
    )
    goal = turn[:2, :2] @ flat.goal
    flight = Flight(Scene(boxes=boxes, start=np.array([0.0, 0, yaw]), goal=goal))
    assert is_flight(flight.world, flight.platform, flight.goal, GAIT)
    for _ in range(20 * steps):
        wanted = flight.next()
        if not wanted:
            break
        for surface, (place, *_) in wanted.items():
            limb = flight.robot.limb_of(surface)
            support = flight.world.supports[place.support]
            half = SOLE if surface.endswith("Foot") else 0.0
            ends = place.position + np.outer([-half, half], turn[:, 0])
            assert support.inside(ends, 0.015).all()
            now = flight.stance.get(limb.name)
            if now is not None:
                ahead = flight.x(place.position) - flight.x(now.position)
                # Knees bend from where the soles were.
                assert ahead >= WORTH or surface != now.surface
            flight.set(surface, place)
            arms = [c for c in flight.stance.values() if c.surface.endswith("Hand")]
            if surface.endswith("Foot"):
                least = min(flight.x(c.position) for c in arms)
                assert flight.x(place.position) <= least - GAIT.gap + 1e-9
                assert place.support != f"s{steps}"
    on = list(flight.stance.values())
    assert {c.support for c in on} == {f"s{steps}"}
    assert {c.surface for c in on} == {"LHand", "RHand", "LKnee", "RKnee"}
    middle = np.mean([flight.x(c.position) for c in on])
    if tread <= 0.4:
        assert middle == pytest.approx(flight.x(goal), abs=0.05)


# With the robot.


@pytest.fixture(scope="module")
def climbing():
    """The first contacts of a flight of 0.25 m treads."""
    ik = IK(build_world(load_robot("coman"), stairs(3, 0.15, 0.25)))
    task = traverse._task(ik, POLICY, PlanOptions())
    (platform,) = task.platforms
    keys, paths = [standing(ik, task.options.keyframe)], []
    for _ in range(4):
        made, why = traverse._up_stairs(task, keys[-1], platform)
        assert not why
        keys += [change.keyframe for change, _ in made]
        paths += [change for change, _ in made]
    return task, platform, keys, paths


def test_hands_then_feet_get_to_their_places(climbing):
    _, _, keys, _ = climbing
    assert len(keys) == 9
    hands, feet = keys[2].stance, keys[4].stance
    assert {c.support for c in hands} == {GROUND, "s2"}
    assert {f"{c.surface}@{c.support}" for c in feet} == {
        *("LHand@s2", "RHand@s2", "LFoot@s1", "RFoot@s1")
    }


def test_the_weight_is_between_hands_and_feet(climbing):
    """Not over the hands, where legs that come after them would push it."""
    task, _, keys, _ = climbing
    stance = keys[4].stance
    middle = traverse._middle(task, stance)
    x = {c.surface: c.position[0] for c in stance}
    assert middle[0] == pytest.approx(np.mean(list(x.values())))
    assert abs(keys[4].com[0] - middle[0]) < 0.03
    assert keys[4].com_margin > 0.08


def test_a_limb_that_goes_up_does_not_graze_the_riser_of_its_tread(climbing):
    """Between postures too, where it is not about to leave or to touch."""
    task, _, _, paths = climbing
    assert len(paths) == 8
    for path in paths:
        swing = path.phases[1]
        watched = watched_pairs(task.ik.world, swing.contacts)
        start, end = swing.arc[0], swing.arc[-1]
        for a, b in itertools.pairwise(swing.q):
            q = interpolate(task.ik.kin, a, b, 0.5)
            task.ik.kin.update(q)
            p = task.ik.kin.contact_point(
                path.step.makes.surface, np.array([0.0, 0.0, 1.0])
            )
            away = min(np.linalg.norm(p - start), np.linalg.norm(p - end))
            if away > 0.25 * np.linalg.norm(end - start):
                depth, _ = overlap(task.ik, q, watched)
                assert depth < 0.0015


def test_the_upright_posture_closes_its_contacts(climbing):
    task, _, keys, _ = climbing
    key = keys[4]
    here = next(c for c in key.stance if c.surface == "LHand")
    place = Place(support="s2", position=here.position + np.array([0.04, 0, 0]))
    q = traverse._upright(task, key, "LHand", place)
    kin = task.ik.kin
    kin.update(q)
    up = np.array([0.0, 0.0, 1.0])
    np.testing.assert_allclose(
        kin.contact_point("LHand", up), place.position, atol=2e-3
    )
    for c in key.stance:
        if c.surface != "LHand" and c.edge is None:
            p = kin.contact_point(c.surface, up)
            assert abs(p[2] - c.position[2]) < 2e-3


def test_a_pair_that_does_not_fit_goes_to_its_next_places(climbing, monkeypatch):
    task, platform, keys, _ = climbing
    near, far = (
        Place(support="s1", position=np.array([x, 0.0, 0.15])) for x in (0.35, 0.45)
    )
    asked = []

    def wanted(*_):
        return [("LFoot", (far, near)), ("RFoot", (far, near))]

    def attempt(task, key, surface, place, *_, **__):
        asked.append((surface, float(place.position[0])))
        if surface == "RFoot" and place is far:
            return "too far"
        return SimpleNamespace(keyframe=key)

    monkeypatch.setattr(traverse, "next_contacts", wanted)
    monkeypatch.setattr(traverse, "_attempt", attempt)
    monkeypatch.setattr(traverse, "_upright", lambda *_: None)
    made, why = traverse._up_stairs(task, keys[-1], platform)
    assert not why
    assert len(made) == 2
    assert asked[-2:] == [("LFoot", 0.35), ("RFoot", 0.35)]
    # Where no place does, what was reached is kept.
    monkeypatch.setattr(
        traverse, "next_contacts", lambda *_: [("LFoot", (far,)), ("RFoot", (far,))]
    )
    made, why = traverse._up_stairs(task, keys[-1], platform)
    assert len(made) == 1
    assert not why
    monkeypatch.setattr(traverse, "next_contacts", lambda *_: [("RFoot", (far,))])
    assert traverse._up_stairs(task, keys[-1], platform) == ([], "too far")
