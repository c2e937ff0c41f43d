"""Stances become moves of one limb at a time."""

import numpy as np
import pytest

from clamber.contact.contact import Contact, ContactSequence, Stance
from clamber.contact.steps import SAME_PLACE, Step, split_moves
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
    steps, _ = split_moves(sequence(*stances), world)
    return [f"{s.stance}: {s}" for s in steps]


def skipped(world: World, *stances: str | list[Contact]) -> list[str]:
    _, out = split_moves(sequence(*stances), world)
    return [f"{s.stance}: {s.reason}" for s in out]


def test_a_whole_climb_is_split_limb_by_limb(world):
    assert moves(
        world,
        "LFoot RFoot",
        "LFoot RFoot LHand",
        "LFoot RFoot LHand RHand",
        "LFoot RFoot LElbow RHand",
        "LFoot RFoot LElbow RElbow",
        "LKnee RFoot LElbow RElbow",
        "LKnee RKnee LElbow RElbow",
    ) == [
        "1: air -> LHand on box",
        "2: air -> RHand on box",
        "3: LHand -> LElbow on box",
        "4: RHand -> RElbow on box",
        "5: LFoot -> LKnee on box",
        "6: RFoot -> RKnee on box",
    ]


def test_a_knee_replaces_the_foot_of_its_leg(world):
    (step,), _ = split_moves(sequence("LFoot RFoot", "LKnee RFoot"), world)
    assert step.limb == "left_leg"
    assert step.breaks == ("LFoot",)
    assert step.makes is not None
    assert step.makes.surface == "LKnee"
    assert not step.fixed
    np.testing.assert_array_equal(step.makes.position, [0.30, 0.09, 0.275])


def test_limbs_that_change_at_once_move_one_after_the_other_arms_first(world):
    assert moves(world, "LFoot RFoot", "LKnee RKnee LHand RHand") == [
        "1: air -> LHand on box",
        "1: air -> RHand on box",
        "1: LFoot -> LKnee on box",
        "1: RFoot -> RKnee on box",
    ]


def test_a_leg_in_the_air_is_part_of_its_next_move(world):
    stances = ("LFoot RFoot LHand", "RFoot LHand", "LKnee RFoot LHand")
    assert moves(world, "LFoot RFoot", *stances) == [
        "1: air -> LHand on box",
        "3: LFoot -> LKnee on box",
    ]
    (reason,) = skipped(world, "LFoot RFoot", *stances)
    assert reason == "2: left leg in the air: part of its next move"


def test_a_stance_with_another_move_is_not_skipped_for_the_leg_in_the_air(world):
    stances = ("LFoot RFoot", "RFoot LHand", "LKnee RFoot LHand")
    assert moves(world, *stances) == [
        "1: air -> LHand on box",
        "2: LFoot -> LKnee on box",
    ]
    assert skipped(world, *stances) == []


def test_of_two_surfaces_of_an_arm_the_elbow_bears_the_load(world):
    stances = ("LFoot RFoot LHand", "LFoot RFoot LHand LElbow", "LFoot RFoot LElbow")
    assert moves(world, "LFoot RFoot", *stances) == [
        "1: air -> LHand on box",
        "2: LHand -> LElbow on box",
    ]
    # That the hand leaves later changes nothing that bears load.
    (reason,) = skipped(world, "LFoot RFoot", *stances)
    assert reason == "3: no limb makes or leaves a bearing contact"


def test_of_a_shank_that_lies_flat_the_knee_bears_the_load(world):
    toes = contact("LFoot", dx=0.3, support="box")
    shank = [toes, contact("LKnee"), contact("RFoot"), contact("LHand")]
    assert moves(world, "LFoot RFoot LHand", shank)[-1] == "1: LFoot -> LKnee on box"


@pytest.mark.parametrize(
    ("dx", "moved"), [(0.0, False), (0.9 * SAME_PLACE, False), (1.1 * SAME_PLACE, True)]
)
def test_a_contact_made_again_in_the_same_place_has_not_moved(world, dx, moved):
    assert SAME_PLACE == 0.03
    again = [contact("LFoot"), contact("RFoot"), contact("LHand", dx)]
    found = moves(
        world, "LFoot RFoot", "LFoot RFoot LHand", "LFoot RFoot", again, "LFoot LHand"
    )
    assert ("3: LHand -> LHand on box" in found) == moved


def test_small_shifts_add_up(world):
    """Each is near the last, yet they lead away from where the hand is."""
    stances = [
        [contact("LFoot"), contact("RFoot"), contact("LHand", 0.02 * i)]
        for i in range(4)
    ]
    assert moves(world, "LFoot RFoot", *stances) == [
        "1: air -> LHand on box",
        "3: LHand -> LHand on box",
    ]


def test_the_same_place_on_another_support_is_a_move(world):
    step_up = [contact("LFoot", support="box"), contact("RFoot")]
    assert moves(world, "LFoot RFoot", step_up) == ["1: LFoot -> LFoot on box"]


def test_a_contact_that_is_not_made_again_is_broken(world):
    stances = ("LFoot RFoot", "LFoot RFoot LHand", "LFoot RFoot")
    assert moves(world, *stances) == ["1: air -> LHand on box", "2: LHand -> air"]
    (_, last), _ = split_moves(sequence(*stances), world)
    assert last.makes is None
    assert last.breaks == ("LHand",)


def test_the_robot_stands_on_both_feet_wherever_the_recording_begins(world):
    """A recording that begins in mid-step: the foot that lands is down already."""
    assert moves(world, "LFoot", "LFoot RFoot", "LFoot RFoot LHand") == [
        "2: air -> LHand on box"
    ]
    assert moves(world, "LHand RHand", "LHand RHand LKnee") == [
        "1: air -> LHand on box",
        "1: air -> RHand on box",
        "1: LFoot -> LKnee on box",
        "1: RFoot -> air",
    ]


def test_each_step_knows_the_stance_it_leads_to(world):
    demo = sequence("LFoot RFoot", "LFoot RFoot LHand", "LKnee RFoot LHand")
    steps, _ = split_moves(demo, world)
    assert [s.stance for s in steps] == [1, 2]
    assert all(s.target is demo.stances[s.stance] for s in steps)


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
    steps, passed = split_moves(demo, world)
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
        assert np.linalg.norm(c.position - down[name].position) < SAME_PLACE


@pytest.mark.parametrize(
    ("last", "stands_up"), [("LFoot RFoot", True), ("LKnee RFoot", False)]
)
def test_a_step_that_ends_on_the_feet_rises_if_it_is_the_last(world, last, stands_up):
    stances = ("LFoot RFoot", "LHand RHand LFoot RFoot", "RHand LFoot RFoot", last)
    steps = split_moves(sequence(*stances), world)[0]
    assert [s.stands_up for s in steps] == [False] * (len(steps) - 1) + [stands_up]


def test_a_move_says_what_it_does():
    step = Step(limb="left_arm", breaks=("LHand",), makes=contact("LElbow"))
    assert str(step) == "LHand -> LElbow on box"
    assert str(Step(limb="left_arm", breaks=(), makes=contact("LHand"))).startswith(
        "air"
    )
    assert str(Step(limb="left_arm", breaks=("LHand",), makes=None)) == "LHand -> air"
