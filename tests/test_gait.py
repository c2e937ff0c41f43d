"""What a gait proposes from a stance, and in which order; no posture is solved."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from clamber.contact.contact import Contact
from clamber.contact.policy import GeneralPolicy, Option, PelvisDistribution
from clamber.contact.steps import MOVED
from clamber.errors import InputError, Status
from clamber.model.robot import load_robot
from clamber.model.scene import GROUND, Box, Scene
from clamber.model.world import build_world
from clamber.planning.gait import (
    BEFORE_RISER,
    RISER_SHARES,
    SHARES,
    STRIDE,
    TURN,
    Gait,
)
from clamber.planning.gaps import due_near_gap, gaps_ahead
from clamber.planning.proposals import FREELY, Climb, Outcome, Proposal, pursue
from clamber.planning.route import Frame
from clamber.step.change import Failure
from conftest import stairs


def option(name: str, region, surfaces, until) -> Option:
    return Option(
        name=name,
        region=region,
        surfaces=surfaces,
        repeats=2,
        initiation=("M",),
        held=(),
        termination=until,
    )


HANDS, ELBOWS = ("LHand", "RHand"), ("LElbow", "RElbow")
KNEES, FEET = ("LKnee", "RKnee"), ("LFoot", "RFoot")
POLICY = GeneralPolicy(
    options=(
        option("ac1", "M", HANDS, "M"),
        option("ac2", "M", ELBOWS, "O"),
        option("ac3", "O", (*ELBOWS, *KNEES), "M"),
        option("ac2", "M", ELBOWS, "M"),
        option("ac1", "M", HANDS, "goal"),
        option("ac4", "goal", FEET, "goal"),
    ),
    over_top=PelvisDistribution(
        mean=np.array([0.0, 1.4, 1.2]), sigma=np.array([0.1, 0.2, 1.3]), samples=9
    ),
    near_edge=PelvisDistribution(
        mean=np.array([0.0, 1.0, 0.0]), sigma=np.array([0.1, 0.4, 0.2]), samples=9
    ),
    goal=FEET,
)
ROBOT = load_robot("coman")


def box(name: str, x: float, length: float, width=0.8, height=0.25) -> Box:
    """A box whose near face is at x."""
    return Box(
        name=name,
        size=np.array([length, width, height]),
        centre=np.array([x + length / 2, 0.0, height / 2]),
        rotation=np.eye(3),
    )


def table(length=0.6, height=0.25, face=0.23, goal=None) -> Scene:
    """One box on the way."""
    goal = [face + length + 0.25, 0.0] if goal is None else goal
    boxes = (box("table", face, length, height=height),)
    return Scene(boxes=boxes, start=np.zeros(3), goal=np.array(goal))


def row(gap: float, *lengths: float) -> Scene:
    """Boxes one behind the other."""
    boxes, x = [], 0.23
    for i, length in enumerate(lengths):
        boxes.append(box(f"b{i + 1}", x, length))
        x += length + gap
    goal = np.array([x - gap + 0.5, 0.0])
    return Scene(boxes=tuple(boxes), start=np.zeros(3), goal=goal)


def gait_in(scene: Scene, policy: GeneralPolicy = POLICY) -> Gait:
    return Gait(build_world(ROBOT, scene), policy)


def contact(surface: str, x: float, y: float, support="table", yaw=0.0) -> Contact:
    return Contact(
        surface=surface,
        support=support,
        position=np.array([x, y, 0.0 if support == GROUND else 0.25]),
        quaternion=np.array([math.cos(yaw / 2), 0, 0, math.sin(yaw / 2)]),
    )


def on_feet(x=0.03, y=0.0, yaw=0.0) -> tuple[Contact, ...]:
    frame = Frame(np.array([x, y]), yaw)
    sides = ((FEET[0], 0.07), (FEET[1], -0.07))
    return tuple(contact(s, *frame.at(np.array([0, d])), GROUND, yaw) for s, d in sides)


def on_fours(gait: Gait, x: float, yaw=0.0, support="table") -> tuple[Contact, ...]:
    frame = Frame(np.array([x, 0.0]), yaw)
    limb_of = gait.world.robot.limb_of
    return tuple(
        contact(s, *frame.at(gait.proportions.offsets[limb_of(s).name]), support, yaw)
        for s in (*ELBOWS, *KNEES)
    )


class Obstinate:
    """Makes what is wanted where it is wanted, but for what it refuses."""

    def __init__(self, gait: Gait, stance, refused=lambda c: True) -> None:
        self.gait, self.refused, self.asked = gait, refused, []
        self.here = Outcome(key=SimpleNamespace(stance=stance, q=gait.world.home))

    def pursue(self):
        """What comes next, and why nothing; all that was asked is kept."""
        return pursue(self.gait.propose(self.here), self.attempt)

    def attempt(self, proposal: Proposal | Climb) -> Outcome:
        self.asked.append(proposal)
        stance, changes = proposal.after.stance, [*proposal.after.changes]
        left = []
        if isinstance(proposal, Climb):
            if proposal.start is not None:
                *xy, yaw = proposal.start
                feet = Frame(np.array(xy), yaw).at(self.gait.proportions.ahead)
                stance = on_feet(*feet, yaw)
            rows = [(s.limb, s.breaks, (s.makes,), o) for s, o in proposal.steps]
        else:
            rows = [
                (x.name, x.surfaces, g.contacts, g.option)
                for g in proposal.goals
                for x in [ROBOT.limb_of(g.contacts[0].surface)]
            ]
        for limb, breaks, contacts, o in rows:
            able = [c for c in contacts if c is None or not self.refused(c)]
            if not able:
                left.append(contacts[0].surface)
                continue
            leaving = tuple(c for c in stance if c.surface in breaks)
            stance = tuple(c for c in (*stance, *able[:1]) if c and c not in leaving)
            step = SimpleNamespace(limb=limb, makes=able[0])
            way = {"leaving": leaving, "shifted": None, "touching": None}
            changes.append((SimpleNamespace(step=step, stance=stance, **way), o))
        if isinstance(proposal, Climb) and (left or not rows):
            changes, left = [], left or ["-"]
        return Outcome(
            key=SimpleNamespace(stance=stance, q=self.here.key.q),
            changes=tuple(changes),
            left=tuple(left),
            failure=Failure(status=Status.STUCK) if left else None,
        )


def proposed(gait: Gait, stance, refused=lambda c: True) -> list[Proposal | Climb]:
    """All that is proposed until something is accepted."""
    following = Obstinate(gait, stance, refused)
    following.pursue()
    return following.asked


def wanted(proposal: Proposal | Climb) -> tuple[str, ...]:
    if isinstance(proposal, Climb):
        return tuple(s.makes.surface if s.makes else "-" for s, _ in proposal.steps)
    return tuple(g.contacts[0].surface for g in proposal.goals)


def cycles(proposals) -> list[Proposal]:
    return [p for p in proposals if isinstance(p, Proposal) and p.goals]


@pytest.fixture(scope="module")
def gait() -> Gait:
    return gait_in(table())


@pytest.fixture(scope="module")
def wide() -> Gait:
    return gait_in(table(length=2.0))


# Frames.


@pytest.mark.parametrize("yaw", [-3.0, -1.0, 0.4, 2.5])
def test_the_frame_on_all_fours_is_found_again_from_its_contacts(gait, yaw):
    found = gait.quadrupedal_frame(on_fours(gait, 0.4, yaw))
    np.testing.assert_allclose(found.xy, [0.4, 0.0], atol=1e-12)
    assert found.turn_to(Frame(found.xy, yaw)) == pytest.approx(0, abs=1e-9)


def test_a_cycle_goes_no_farther_and_turns_no_more_than_it_may():
    a = Frame(np.zeros(2), 3.0)
    c = a.towards(Frame(np.array([1.0, 0.0]), -3.0), 0.1, 0.25)
    np.testing.assert_allclose([*c.xy, c.yaw], [0.1, 0.0, 3.0])  # there is time to turn
    turning = a.towards(Frame(np.zeros(2), -2.0), 0.1, 0.25)
    assert turning.yaw == pytest.approx(3.25)  # the short way round
    last = a.towards(Frame(np.array([0.05, 0.0]), 3.1), 0.1, 0.25)
    np.testing.assert_allclose([*last.xy, last.yaw], [0.05, 0.0, 3.1])
    part = a.part_way(Frame(np.array([2.0, -4.0]), 2.6), 0.25)
    np.testing.assert_allclose([*part.xy, part.yaw], [0.5, -1.0, 2.9])


def test_steps_are_a_third_of_a_limb_or_what_was_shown():
    far = gait_in(table(), replace(POLICY, reach={"LElbow": 5.0})).proportions
    near = gait_in(table(), replace(POLICY, reach={"LElbow": 0.1})).proportions
    assert near.step["left_arm"] == pytest.approx(0.3 * far.step["left_arm"])
    assert near.step["right_arm"] == far.step["right_arm"]


# On the feet, up and down.


def test_feet_step_to_where_the_body_stands_before_the_edge():
    gait = gait_in(table(face=0.45))
    (walk,) = proposed(gait, on_feet(0.0, 0.05))
    assert (walk.posture, walk.accept) == ("home", "some")
    # The right one first: the edge's middle is on its side.
    assert wanted(walk) == ("RFoot", "LFoot")
    step = min(gait.proportions.step[n] for n in ("left_leg", "right_leg"))
    for goal in walk.goals:
        lengths = [c.position[0] for c in goal.contacts]
        assert step >= lengths[0] > 0.0
        np.testing.assert_allclose(lengths, np.array(SHARES) * lengths[0])
    assert walk.body.xy[0] <= 0.45 - gait.proportions.stand + 1e-9
    # One foot is enough, where the other cannot.
    able = Obstinate(gait, on_feet(0.0, 0.05), lambda c: c.surface == "LFoot")
    ((change, option),), _ = able.pursue()
    assert (change.step.makes.surface, option) == ("RFoot", "ac4")


def test_before_the_edge_hands_elbows_and_knees_climb_in_the_policys_order(gait):
    (climb,) = proposed(gait, on_feet())
    assert isinstance(climb, Climb)
    assert wanted(climb) == (*HANDS, *ELBOWS, *KNEES)
    assert [o for _, o in climb.steps] == ["ac1"] * 2 + ["ac2"] * 2 + ["ac3"] * 2
    breaks = [step.breaks for step, _ in climb.steps]
    assert breaks == [(), (), ("LHand",), ("RHand",), ("LFoot",), ("RFoot",)]
    # From the edge inwards: knees, elbows, hands.
    x = {step.makes.surface: step.makes.position[0] for step, _ in climb.steps}
    assert 0.23 < x["LKnee"] < x["LElbow"] < x["LHand"]
    # What is left of it, whatever has been done.
    halfway = (contact("RHand", 0.5, -0.1), contact("LElbow", 0.4, 0.1), *on_feet())
    (climb,) = proposed(gait, halfway)
    assert wanted(climb) == ("RElbow", *KNEES)


def test_a_descent_is_the_ascent_reversed_and_stands_up_at_its_end(gait):
    edge = gait.platforms[0].exit
    back = on_fours(gait, 0.83 - gait.proportions.behind, math.pi)
    up, down = proposed(gait, back, refused=lambda c: False)
    assert (up.accept, wanted(up)) == ("never", (*HANDS, *ELBOWS, *KNEES))
    ankles = gait.ankles(Frame.behind(edge, -gait.proportions.stand))
    np.testing.assert_allclose(up.start, ankles)
    # Feet take the place of knees, hands that of elbows; then the hands let go.
    assert wanted(down) == ("RFoot", "LFoot", *HANDS[::-1], "-", "-")
    steps = [step for step, _ in down.steps]
    assert all(step.fixed for step in steps)
    assert [step.stands_up for step in steps] == [False] * 5 + [True]
    assert [step.reference is not None for step in steps] == [False] * 4 + [True] * 2
    # What has left the top is not climbed down again.
    feet = on_feet(0.83 + 0.3, yaw=math.pi)
    _, down = proposed(gait, (*feet, *back[:2]), refused=lambda c: False)
    assert wanted(down) == (*HANDS[::-1], "-", "-")
    # And where that cannot be done, nothing moves on top.
    able = Obstinate(gait, (*feet, *back[:2]), lambda c: len(able.asked) > 1)
    able.pursue()
    assert len(able.asked) == 2
    assert not cycles(able.asked)


def test_where_there_is_no_way_down_contacts_move_to_where_there_is(gait):
    """Only those that are elsewhere."""
    back = on_fours(gait, 0.83 - gait.proportions.behind, math.pi)

    def refused(c: Contact) -> bool:
        return c.support == GROUND

    up, *_ = proposed(gait, back, refused)
    there = {s.makes.surface: s.makes for s, _ in up.steps}
    off = {"LElbow": 0.03, "RElbow": 0.01, "LKnee": 0.04, "RKnee": 0.0}
    here = tuple(
        replace(there[s], position=there[s].position + np.array([d, 0.0, 0.0]))
        for s, d in off.items()
    )
    moved = proposed(gait, here, refused)[-1]
    assert wanted(moved) == ("LElbow", "LKnee")
    assert moved.accept == "some"
    for goal in moved.goals:
        to = goal.contacts[0]
        np.testing.assert_allclose(to.position, there[to.surface].position)


def test_where_not_all_of_a_pair_fit_on_a_tread_both_go_to_their_next_places():
    gait = gait_in(stairs(3, 0.1, 0.4))
    feet = [contact(c.surface, 0.51, c.position[1], "s1") for c in on_feet()]
    stance = (contact("LHand", 0.99, 0.17, "s2"), contact("RHand", 0.99, -0.17, "s2"))
    far, near = proposed(gait, (*feet, *stance), lambda c: c.surface == "LFoot")[:2]
    assert wanted(far) == wanted(near) == FEET
    for first, second in zip(far.goals, near.goals, strict=True):
        x = [c.position[0] for c in (*first.contacts, *second.contacts)]
        assert len(x) == 2
        assert x[0] > x[1] > 0.63
    # Where neither fits, what could be done is kept.
    able = Obstinate(gait, (*feet, *stance), lambda c: c.surface == "LFoot")
    changes, _ = able.pursue()
    assert [change.step.makes.surface for change, _ in changes] == ["RFoot"]


def test_where_it_gets_no_nearer_to_the_edge_it_may_climb_down_from_there(gait):
    for away, down in ((0.08, True), (0.16, False)):
        back = on_fours(gait, 0.83 - gait.proportions.behind - away, math.pi)
        *crawl, last = proposed(gait, back)
        assert cycles(crawl)
        assert isinstance(last, Climb) == down


# On all fours.


def test_legs_lead_backwards_and_arms_forwards(gait):
    here = Frame(np.zeros(2), math.pi)
    for x, order in ((0.1, (*KNEES, *ELBOWS)), (-0.1, (*ELBOWS, *KNEES))):
        assert gait.leading_first(here, Frame(np.array([x, 0.0]), math.pi)) == order


def test_a_cycle_that_fails_is_proposed_otherwise_in_order(wide):
    """It goes on and turns; on the spot, as it stands, there is nothing to move."""
    stance = on_fours(wide, 1.0)
    frame = wide.quadrupedal_frame(stance)
    tries = cycles(proposed(wide, stance))
    full, legs, half, straight, turned = tries
    # What is left of the way to the edge is less than a whole cycle.
    step = min(wide.proportions.step.values())
    assert step < frame.away(full.body) <= STRIDE * step + 1e-9
    assert full.body.yaw - frame.yaw == pytest.approx(TURN)
    assert wanted(full) == (*ELBOWS, *KNEES)
    assert wanted(legs) == (*KNEES, *ELBOWS)
    assert legs.body is full.body
    np.testing.assert_allclose(half.body.xy, (frame.xy + full.body.xy) / 2)
    assert straight.body.yaw == frame.yaw != full.body.yaw
    assert frame.away(turned.body) == 0.0
    # All the way, held as the policy has it; then shorter, too, and free.
    for proposal in tries:
        assert [(r.first, r.pelvis) for r in proposal.rounds] == [(1, 1), (0, 0)]
    for goal, here in zip(full.goals, stance, strict=True):
        away = [np.linalg.norm(c.position - here.position) for c in goal.contacts]
        np.testing.assert_allclose(away, np.array(SHARES) * away[0])


def test_the_others_come_back_around_a_limb_that_is_left_behind(wide):
    """Where they stand around it on all fours, then nearer to it."""
    stance = on_fours(wide, 1.0)
    tries = cycles(proposed(wide, stance, lambda c: c.surface == "RKnee"))
    back = [p for p in tries if p.accept == "never"]
    follows = [p for p in tries[6:] if wanted(p) == ("RKnee",)]
    assert set(map(wanted, back)) == {("LElbow", "RElbow", "LKnee")}
    assert all(p.after.changes for p in (*back, *follows))  # what was done is kept
    offset = wide.proportions.offsets["right_leg"]
    stuck = np.array([1.0, 0.0]) + offset
    for p, share in zip(back[:2], (1.0, 0.6), strict=True):
        np.testing.assert_allclose(p.body.local(stuck), share * offset, atol=1e-9)


def test_a_limb_that_lost_its_contact_is_set_down_first(wide):
    """Where it belongs, or else where it is."""
    stance = on_fours(wide, 1.0)
    for lost in (0, 3):
        surface = stance[lost].surface
        kept = tuple(c for c in stance if c.surface != surface)
        first, *_ = proposed(wide, kept)
        assert wanted(first) == (surface,)
        belongs, here = first.goals[0].contacts
        frame = wide.quadrupedal_frame(kept)
        offset = wide.proportions.offsets[wide.world.robot.limb_of(surface).name]
        np.testing.assert_allclose(frame.local(belongs.position), offset, atol=1e-9)
        assert np.linalg.norm(here.position - belongs.position) > MOVED.wanted
        ((change, _),), _ = Obstinate(wide, kept, lambda c: False).pursue()
        assert {c.surface for c in change.stance} == {c.surface for c in stance}


def test_it_turns_only_where_walls_leave_it_room():
    """A box of 2.4 m with a passage of 0.8 x 0.7 m in its middle, from x = 1.05 on."""
    wall = box("left", 1.05, 0.8, 0.1, 0.5)
    walls = [
        replace(wall, name=name, centre=np.array([1.45, y, 0.5]))
        for name, y in (("left", 0.40), ("right", -0.40))
    ]
    boxes, goal = (box("table", 0.25, 2.4, 1.2), *walls), np.array([3.0, 0.0])
    gait = gait_in(Scene(boxes=boxes, start=np.zeros(3), goal=goal))

    def heading(x, to, yaw=0.0):
        there = Frame(np.array([to, 0.0]), math.pi)
        here = Frame(np.array([x, 0.0]), yaw)
        found = gait.heading(gait.platforms[0], here, there)
        return found.yaw, found.xy[0]

    assert heading(0.5, 2.4)[0] == math.pi  # there is room at either end
    assert heading(1.4, 2.4) == (0.0, 2.4)  # on, as it is
    assert heading(0.5, 1.7) == (math.pi, 0.5)  # on the spot
    assert heading(1.4, 2.4, math.pi - 0.05)[0] == math.pi  # it faces there already


# Risers.


def test_knees_leave_their_thighs_room_before_a_riser():
    gait = gait_in(stairs(3, 0.1, 0.4))
    (platform,) = gait.platforms
    assert gait.has_risers(platform)
    riser = 0.63

    def placed(surface, x, boxes=()):
        body = Frame(np.array([x, 0.1]), 0.0)
        return gait.place(platform, surface, body, np.zeros(2), boxes)

    knee, elbow = placed("LKnee", riser - 0.07), placed("LElbow", riser - 0.07)
    assert (knee.support, elbow.support) == ("s1", "s1")
    assert knee.position[0] <= riser - BEFORE_RISER * gait.proportions.thigh
    assert elbow.position[0] > knee.position[0]
    assert knee.position[2] == pytest.approx(0.1)
    # What has climbed a riser is not put down before it again.
    above = placed("LKnee", riser - 0.07, platform.boxes[1:])
    assert above.support == "s2"
    assert riser < above.position[0] < riser + 0.05


@pytest.fixture(scope="module")
def risers() -> Gait:
    """Up at x = 0.73, down again at 1.23."""
    rows = (("a", 0.23, 0.1), ("b", 0.73, 0.2), ("c", 1.23, 0.1))
    boxes = tuple(box(n, x, 0.5, height=h) for n, x, h in rows)
    return gait_in(Scene(boxes=boxes, start=np.zeros(3), goal=np.array([2.1, 0.0])))


def test_over_a_riser_shorter_cycles_and_hands_are_proposed_first(risers):
    stance = on_fours(risers, 0.5, support="a")
    tries = cycles(proposed(risers, stance))[:12]
    ways = [risers.quadrupedal_frame(stance).away(p.body) for p in tries]
    np.testing.assert_allclose(ways, np.repeat(2 * RISER_SHARES, 2) * ways[0])
    assert ways[0] <= min(risers.proportions.step.values()) + 1e-9  # no longer stride
    arms = [{s[1:] for s in wanted(p) if s[1:] != "Knee"} for p in tries]
    assert arms == [{"Elbow"}] * 6 + [{"Hand"}] * 6
    assert [wanted(p)[0][1:] == "Knee" for p in tries] == [False, True] * 6
    level = gait_in(row(0.01, 0.5, 0.5))
    assert not level.has_risers(level.platforms[0])


def test_what_has_climbed_a_riser_does_not_go_back_down_for_another_ones_sake(risers):
    """Where knees are at 0.45 m, elbows belong before the riser."""
    elbows = (contact("LElbow", 0.80, 0.12, "b"), contact("RElbow", 0.80, -0.12, "b"))
    knees = (contact("LKnee", 0.45, 0.1, "a"), contact("RKnee", 0.45, -0.1, "a"))
    stance = (*elbows, *knees)
    tries = cycles(proposed(risers, stance, lambda c: c.surface == "RKnee"))
    back = [p for p in tries if p.accept == "never"]
    assert back
    for p in back:
        (goal,) = p.goals  # one by one: the stuck one may follow before all are back
        to = goal.contacts[0]
        here = next((c for c in p.after.stance if c.surface == to.surface), to)
        assert here.support <= to.support


# Gaps.


@pytest.fixture(scope="module")
def gap() -> Gait:
    """From x = 0.83 to 1.13: contacts are made up to 0.81 and from 1.15 on."""
    return gait_in(row(0.3, 0.6, 0.7))


def near_gap(gap: Gait, arms: float, legs: float) -> tuple[Contact, ...]:
    out = []
    for s in (*ELBOWS, *KNEES):
        x = arms if s in ELBOWS else legs
        y = gap.proportions.offsets[gap.world.robot.limb_of(s).name][1]
        out.append(contact(s, x, y, "b1" if x < 1.0 else "b2"))
    return tuple(out)


def due(gap: Gait, arms: float, legs: float) -> tuple[dict[str, float], ...]:
    """What is due where elbows and knees are at these x."""
    stance = near_gap(gap, arms, legs)
    on = {gap.world.robot.limb_of(c.surface).name: c for c in stance}
    (platform,) = gap.platforms

    def place(n, body, offset):
        return gap.place(platform, on[n].surface, body, offset)

    frame, to = gap.quadrupedal_frame(stance), Frame(np.array([1.6, 0.0]), 0.0)
    found = due_near_gap(gap.proportions, platform, on, frame, to, place)
    return tuple({n: float(c.position[0]) for n, c in x.items()} for x in found)


ARMS, LEGS = {"left_arm", "right_arm"}, {"left_leg", "right_leg"}


def test_far_from_a_gap_and_beyond_it_nothing_is_due_there(gap):
    assert due(gap, 0.55, 0.35) == ({}, {})
    assert due(gap, 1.40, 1.17) == ({}, {})


def test_arms_wait_at_a_gap_until_the_legs_are_near_enough(gap):
    stretched = 2.0 * gap.proportions.stretch
    walks, hops = due(gap, 0.80, 0.40)
    assert (set(walks), hops) == (LEGS, {})  # elbows are at the border already
    assert max(walks.values()) <= 0.40 + gap.proportions.step["left_leg"] + MOVED.wanted
    walks, hops = due(gap, 0.80, 0.98 - stretched + 0.01)
    assert set(hops) == ARMS
    assert all(1.15 <= x <= 1.17 for x in hops.values())
    # Knees any nearer to the elbows could not let go of them.
    assert all(x <= 0.98 - stretched + 2.0 * MOVED.wanted for x in walks.values())


def test_legs_step_across_together_once_the_arms_are_far_enough(gap):
    walks, hops = due(gap, 1.20, 0.80)
    assert (set(walks), hops) == (ARMS, {})
    walks, hops = due(gap, 0.98 + 2.0 * gap.proportions.stretch, 0.80)
    assert set(hops) == LEGS
    assert all(1.15 <= x <= 1.17 for x in hops.values())


def test_a_gap_is_ahead_until_the_last_contact_is_over_it(gap):
    (platform,) = gap.platforms

    def ahead(*x: float):
        pairs = zip((*ELBOWS, *KNEES), x, strict=True)
        stance = [contact(s, v, 0.0) for s, v in pairs]
        return gaps_ahead(platform, stance, np.array([1.6, 0.0]))

    assert ahead(0.7, 0.7, 0.5, 0.45) == [pytest.approx((0.38, 0.68))]
    assert len(ahead(1.4, 1.4, 1.2, 0.8)) == 1
    assert ahead(1.4, 1.4, 1.2, 1.15) == []


def test_where_knees_do_not_reach_across_they_do_from_a_stand_on_both_feet(gap):
    stance = near_gap(gap, 0.98 + 2.0 * gap.proportions.stretch, 0.80)
    asked = proposed(gap, stance, lambda c: c.surface in KNEES and c.support == "b2")
    tries = [p for p in cycles(asked) if p.rounds == FREELY]
    knees, stand, step = (p for p in tries if not set(wanted(p)) & set(ELBOWS))
    assert set(wanted(knees)) == set(wanted(step)) == set(KNEES)
    assert set(wanted(stand)) == set(FEET)
    for goal in stand.goals:
        assert goal.contacts[0].support == "b1"
        assert goal.contacts[0].position[0] == pytest.approx(0.80)
    # Where the knees do not, the feet go across.
    assert [c.surface for c in step.goals[0].contacts] == ["LKnee", "LFoot"]


# The whole way.


def followed(gait: Gait, stance: tuple[Contact, ...]):
    """Options and stances of the way where everything can be done."""
    for _ in range(200):
        changes, failure = Obstinate(gait, stance, lambda c: False).pursue()
        assert failure is None
        if not changes:
            return
        yield from ((name, change.stance) for change, name in changes)
        stance = changes[-1][0].stance
    raise AssertionError("it goes on for ever")


@pytest.mark.parametrize(
    ("scene", "supports"),
    [
        (table(), [GROUND, "table", GROUND]),
        (table(length=1.2, goal=[0.9, 0.0, 0.5]), [GROUND, "table"]),
        (row(0.3, 0.6, 0.7), [GROUND, "b1", "b2", GROUND]),
        (row(0.6, 0.6, 0.6), [GROUND, "b1", GROUND, "b2", GROUND]),
        (stairs(3, 0.15, 0.25), [GROUND, "s3"]),
        (Scene(start=np.zeros(3), goal=np.array([0.5, 0.2, 1.0])), [GROUND]),
    ],
)
def test_where_all_can_be_done_it_arrives_with_all_weight_on_one_after_the_other(
    scene, supports
):
    gait = gait_in(scene)
    way = list(followed(gait, on_feet()))
    whole = [{c.support for c in stance} for _, stance in way]
    whole = [s.pop() for s in ({GROUND}, *whole) if len(s) == 1]
    assert [k for k, _ in itertools.groupby(whole)] == supports
    last = way[-1][1]
    on_top = supports[-1] != GROUND
    frame = (gait.quadrupedal_frame if on_top else gait.feet_frame)(last)
    assert np.linalg.norm(frame.xy - gait.goal) < 0.15
    assert len(last) == (4 if on_top else 2)
    options = [k for k, _ in itertools.groupby(name for name, _ in way)]
    if "table" in supports:
        assert options[:3] == ["ac1", "ac2", "ac3"]


def test_the_repr_of_all_that_is_proposed_is_short(wide):
    able = Obstinate(wide, on_fours(wide, 1.0), lambda c: c.surface == "RKnee")
    able.pursue()
    climb, *_ = proposed(wide, on_feet())
    records = [
        climb,
        wide.proportions,
        wide.proportions.stairs,
        *wide.platforms,
        *able.asked,
    ]
    records += [p.after for p in able.asked] + [able.asked[2].goals[0]]
    assert max(len(repr(r)) for r in records) < 300


# What cannot be.


@pytest.mark.parametrize(
    ("scene", "policy", "field"),
    [
        (table(face=1.0), POLICY, "scene.boxes.table"),
        (table(height=2.0), POLICY, "scene.boxes.table"),
        (table(height=2.0, goal=[0.5, 0.0]), POLICY, "scene.boxes.table"),
        (table(), replace(POLICY, options=POLICY.options[-1:]), "policy.options"),
    ],
)
def test_a_scene_that_cannot_be_crossed_is_refused(scene, policy, field):
    with pytest.raises(InputError) as e:
        gait_in(scene, policy).check_route()
    assert e.value.field == field


def test_an_obstacle_beyond_reach_says_how_far_to_walk():
    with pytest.raises(InputError, match=r"must first walk 0\.77 m"):
        gait_in(table(face=1.0)).check_route()
