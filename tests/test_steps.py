"""Stances become moves of one limb at a time."""

import numpy as np
import pytest

from clamber.contact.contact import Contact, ContactSequence, Stance
from clamber.contact.steps import MOVED, split_steps
from clamber.model.robot import load_robot
from clamber.model.scene import GROUND, Scene
from clamber.model.world import World, build_world

FEET = ("LFoot", "RFoot")


@pytest.fixture(scope="module")
def world() -> World:
    return build_world(load_robot("coman"), Scene.from_height(0.275))


# Where each surface goes unless a test says otherwise: x, y on its support.
PLACES = {
    "LHand": (0.43, 0.17),
    "RHand": (0.43, -0.17),
    "LElbow": (0.40, 0.18),
    "RElbow": (0.40, -0.18),
    "LKnee": (0.30, 0.09),
    "RKnee": (0.30, -0.09),
    "LFoot": (0.03, 0.0726),
    "RFoot": (0.03, -0.0726),
}


def contact(surface: str, dx: float = 0.0, support: str | None = None) -> Contact:
    support = support or (GROUND if surface in FEET else "box")
    x, y = PLACES[surface]
    z = 0.0 if support == GROUND else 0.275
    return Contact(
        surface=surface,
        support=support,
        position=np.array([x + dx, y, z]),
        quaternion=np.array([1.0, 0.0, 0.0, 0.0]),
    )


def sequence(*stances: str | list[Contact]) -> ContactSequence:
    """Stances by the names of their surfaces, or with contacts of their own."""
    records = tuple(
        Stance(
            contacts=tuple(map(contact, s.split())) if isinstance(s, str) else tuple(s)
        )
        for s in stances
    )
    return ContactSequence(
        source="test",
        subject=None,
        scene=Scene.from_height(0.275),
        stances=records,
        t=np.arange(len(records) + 1.0),
    )


def moves(world: World, *stances: str | list[Contact]) -> list[str]:
    steps, _ = split_steps(sequence(*stances), world)
    return [f"{s.stance}: {s}" for s in steps]


SPLIT = {
    "a whole climb, limb by limb": (
        (
            "LFoot RFoot",
            "LFoot RFoot LHand",
            "LFoot RFoot LHand RHand",
            "LFoot RFoot LElbow RHand",
            "LFoot RFoot LElbow RElbow",
            "LKnee RFoot LElbow RElbow",
            "LKnee RKnee LElbow RElbow",
        ),
        [
            "1: air -> LHand on box",
            "2: air -> RHand on box",
            "3: LHand -> LElbow on box",
            "4: RHand -> RElbow on box",
            "5: LFoot -> LKnee on box",
            "6: RFoot -> RKnee on box",
        ],
    ),
    "limbs that change at once move one after the other, arms first": (
        ("LFoot RFoot", "LKnee RKnee LHand RHand"),
        [
            "1: air -> LHand on box",
            "1: air -> RHand on box",
            "1: LFoot -> LKnee on box",
            "1: RFoot -> RKnee on box",
        ],
    ),
    "a leg in the air, part of its next move": (
        ("LFoot RFoot", "LFoot RFoot LHand", "RFoot LHand", "LKnee RFoot LHand"),
        ["1: air -> LHand on box", "3: LFoot -> LKnee on box"],
    ),
    "a leg in the air while another limb moves": (
        ("LFoot RFoot", "RFoot LHand", "LKnee RFoot LHand"),
        ["1: air -> LHand on box", "2: LFoot -> LKnee on box"],
    ),
    "of two surfaces of an arm the elbow bears; that the hand leaves is nothing": (
        (
            "LFoot RFoot",
            "LFoot RFoot LHand",
            "LFoot RFoot LHand LElbow",
            "LFoot RFoot LElbow",
        ),
        ["1: air -> LHand on box", "2: LHand -> LElbow on box"],
    ),
    "of a shank that lies flat the knee bears": (
        (
            "LFoot RFoot LHand",
            [
                contact("LFoot", dx=0.3, support="box"),
                *map(contact, ("LKnee", "RFoot", "LHand")),
            ],
        ),
        ["1: air -> LHand on box", "1: LFoot -> LKnee on box"],
    ),
    "small shifts add up": (
        (
            "LFoot RFoot",
            *(
                [contact("LFoot"), contact("RFoot"), contact("LHand", 0.02 * i)]
                for i in range(4)
            ),
        ),
        ["1: air -> LHand on box", "3: LHand -> LHand on box"],
    ),
    "the same place on another support": (
        ("LFoot RFoot", [contact("LFoot", support="box"), contact("RFoot")]),
        ["1: LFoot -> LFoot on box"],
    ),
    "not made again, broken": (
        ("LFoot RFoot", "LFoot RFoot LHand", "LFoot RFoot"),
        ["1: air -> LHand on box", "2: LHand -> air"],
    ),
    "begun in mid-step: the foot that lands is down already": (
        ("LFoot", "LFoot RFoot", "LFoot RFoot LHand"),
        ["2: air -> LHand on box"],
    ),
    "begun on the hands: the robot stands all the same": (
        ("LHand RHand", "LHand RHand LKnee"),
        [
            "1: air -> LHand on box",
            "1: air -> RHand on box",
            "1: LFoot -> LKnee on box",
            "1: RFoot -> air",
        ],
    ),
}


@pytest.mark.parametrize("name", SPLIT)
def test_stances_are_split_into_steps_of_one_limb(world, name):
    stances, expected = SPLIT[name]
    assert moves(world, *stances) == expected


def test_a_step_says_what_it_changes_and_where_it_leads(world):
    demo = sequence("LFoot RFoot", "LKnee RFoot", "LKnee RFoot LHand", "RFoot LHand")
    (knee, hand, air), passed = split_steps(demo, world)
    assert not passed
    assert (knee.limb, knee.breaks, knee.fixed) == ("left_leg", ("LFoot",), False)
    assert knee.makes is demo.stances[1].contact("LKnee")
    assert (air.breaks, air.makes) == (("LKnee",), None)
    assert [s.stance for s in (knee, hand, air)] == [1, 2, 3]
    assert all(s.target is demo.stances[s.stance] for s in (knee, hand, air))


def test_a_stance_that_is_no_keyframe_is_skipped_and_says_why(world):
    air = ("LFoot RFoot", "LFoot RFoot LHand", "RFoot LHand", "LKnee RFoot LHand")
    hand = ("LFoot RFoot", "LFoot RFoot LHand LElbow", "LFoot RFoot LElbow")
    for stances, reason in (
        (air, "left leg in the air: part of its next step"),
        (hand, "no limb makes or breaks a load-bearing contact"),
    ):
        (skipped,) = split_steps(sequence(*stances), world)[1]
        assert (skipped.stance, skipped.reason) == (2, reason)


@pytest.mark.parametrize(
    ("dx", "moved"),
    [(0.0, False), (0.9 * MOVED.shown, False), (1.1 * MOVED.shown, True)],
)
def test_a_contact_made_again_in_the_same_place_has_not_moved(world, dx, moved):
    assert MOVED.shown == 0.03
    again = [contact("LFoot"), contact("RFoot"), contact("LHand", dx)]
    found = moves(
        world, "LFoot RFoot", "LFoot RFoot LHand", "LFoot RFoot", again, "LFoot LHand"
    )
    assert ("3: LHand -> LHand on box" in found) == moved


@pytest.mark.parametrize("seed", range(10))
def test_moves_done_in_order_lead_from_stance_to_stance(world, seed):
    """Whatever the stances: replayed, the moves end with what the last one demands."""
    rng = np.random.default_rng(seed)
    limbs = list(world.robot.limbs.values())
    stances: list[list[Contact]] = [[contact("LFoot"), contact("RFoot")]]
    for _ in range(8):
        chosen = [rng.choice([None, *x.surfaces]) for x in limbs]
        shift = 0.1 * int(rng.integers(3))
        stances.append([contact(str(s), shift) for s in chosen if s is not None])
    demo = sequence(*stances)
    steps, passed = split_steps(demo, world)
    assert {s.stance for s in steps} | {s.stance for s in passed} == set(range(1, 9))
    assert [s.stance for s in steps] == sorted(s.stance for s in steps)
    down = {c.surface: c for c in demo.stances[0].contacts}
    for step in steps:
        limb = world.robot.limbs[step.limb]
        for s in step.breaks:
            assert s in limb.surfaces
            del down[s]
        if step.makes is not None:
            c = step.makes
            assert c.surface in limb.surfaces
            assert c is demo.stances[step.stance].contact(c.surface)
            down[c.surface] = c
        assert sum(s in limb.surfaces for s in down) <= 1
    last = {c.surface: c for c in demo.stances[-1].contacts}
    assert set(down) == set(last)
    for name, c in last.items():
        assert np.linalg.norm(c.position - down[name].position) < MOVED.shown


@pytest.mark.parametrize(
    ("last", "stands_up"), [("LFoot RFoot", True), ("LKnee RFoot", False)]
)
def test_a_step_that_ends_on_the_feet_rises_if_it_is_the_last(world, last, stands_up):
    stances = ("LFoot RFoot", "LHand RHand LFoot RFoot", "RHand LFoot RFoot", last)
    steps = split_steps(sequence(*stances), world)[0]
    assert [s.stands_up for s in steps] == [False] * (len(steps) - 1) + [stands_up]
