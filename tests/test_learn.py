"""Cycles are found where they are, in one demonstration and in several."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from clamber.contact.contact import Contact, ContactSequence, Stance
from clamber.contact.learn import (
    build_demo_policy,
    contract_policies,
    dominant_actions,
    find_cycles,
    fit_distribution,
    learn_policy,
    pelvis_samples,
)
from clamber.contact.policy import GeneralPolicy, pelvis_rotation
from clamber.errors import InputError
from clamber.model.scene import Box, Scene
from clamber.model.se3 import matrix_from_quat, matrix_from_rpy, quat_from_matrix, wrap
from clamber.recording.detect import detect_contacts
from clamber.recording.recording import load_demo
from clamber.run.folder import load_sequence, save_sequence
from support.crossing import CrossingOptions, synthesize_crossing

HEIGHT = 0.6
SUBJECT = {
    "upper_arm": 0.3, "forearm": 0.25, "thigh": 0.4, "shank": 0.45, "trunk": 0.5,
}  # fmt: skip
HANDS, ELBOWS = ("LHand", "RHand"), ("LElbow", "RElbow")
CRAWL = (*ELBOWS, "LKnee", "RKnee")
FEET = ("LFoot", "RFoot")
LENGTH = 2.0  # [m] of the table, which begins at x = 0.4


def scene() -> Scene:
    box = Box(
        name="table",
        size=np.array([LENGTH, 1.0, HEIGHT]),
        centre=np.array([0.4 + LENGTH / 2, 0.0, HEIGHT / 2]),
        rotation=np.eye(3),
    )
    return Scene(boxes=(box,), start=np.zeros(3))


class Person:
    """Writes a contact sequence, action by action."""

    def __init__(self) -> None:
        self.down: dict[str, Contact] = {}
        self.stances: list[Stance] = []
        for foot in FEET:
            self.down[foot] = self.contact(foot, "ground", 0.0)
        self.see()

    def contact(self, surface: str, support: str, x: float) -> Contact:
        return Contact(
            surface=surface,
            support=support,
            position=np.array([x, 0.0, HEIGHT if support == "table" else 0.0]),
            quaternion=np.array([1.0, 0.0, 0.0, 0.0]),
        )

    def see(self, pelvis: np.ndarray | None = None) -> None:
        self.stances.append(Stance(contacts=tuple(self.down.values()), pelvis=pelvis))

    def lift(self, *surfaces: str) -> Person:
        for s in surfaces:
            del self.down[s]
        self.see()
        return self

    def put(
        self,
        surface: str,
        support: str,
        x: float,
        *,
        leaves: str = "",
        lifts: bool = True,
    ) -> Person:
        """Set a surface down at x, by itself or in place of another of its limb."""
        gone = {surface, leaves} & set(self.down)
        if lifts and gone:
            self.lift(*gone)
        for s in gone:
            self.down.pop(s, None)
        self.down[surface] = self.contact(surface, support, x)
        self.see()
        return self

    def sequence(self, source: str = "by hand") -> ContactSequence:
        return ContactSequence(
            source=source,
            subject=SUBJECT,
            scene=scene(),
            stances=tuple(self.stances),
            t=np.arange(len(self.stances) + 1.0),
        )


def crossing(
    hands: int = 2,
    elbows: int = 2,
    cycles: int = 4,
    feet: int = 2,
    swap: bool = False,
    noise: np.random.Generator | None = None,
) -> ContactSequence:
    """A crossing in few words; `noise` moves contacts and makes hands hesitate."""
    person = Person()

    def side(name: str) -> str:
        return {"L": "R", "R": "L"}[name[0]] + name[1:] if swap else name

    def place(x: float) -> float:
        return x if noise is None else x + noise.uniform(-0.02, 0.02)

    for i in range(hands):
        for s in map(side, HANDS):
            person.put(s, "table", place(0.5 + 0.12 * i))
    for i in range(elbows):
        for s in map(side, ELBOWS):
            person.put(s, "table", place(0.5 + 0.12 * i))
    for s in map(side, ("LKnee", "RKnee")):
        person.put(s, "table", place(0.5), leaves=s[0] + "Foot")
    for i in range(cycles):
        for s in map(side, CRAWL):
            person.put(s, "table", place(0.8 + 0.15 * i))
            if noise is not None and noise.random() < 0.3:  # a hand comes off, and on
                held = person.down.pop(side("LHand"))
                person.see()
                person.down[held.surface] = held
                person.see()
    for s in map(side, FEET):
        person.put(s, "ground", place(2.6), leaves=s[0] + "Knee")
    person.lift(*(set(person.down) - set(FEET)))
    for i in range(feet):
        for s in map(side, FEET):
            person.put(s, "ground", place(2.8 + 0.2 * i))
    return person.sequence()


def keys(policy: GeneralPolicy) -> list[tuple[str, str]]:
    return [(o.region, " ".join(sorted(o.surfaces))) for o in policy.options]


# Cycles in a row of names.


@pytest.mark.parametrize(
    ("row", "found"),
    [
        ("", None),
        ("abcdef", None),
        ("aaaa", None),  # one limb is no cycle
        ("abab", (0, 2, 2)),
        ("ababab", (0, 2, 3)),
        ("abba", (0, 2, 2)),  # the order within a cycle is free
        ("xabab", (1, 2, 2)),
        ("abcdabcd", (0, 4, 2)),
        ("abcddcba", (0, 4, 2)),
        ("abacab", None),
        ("aabab", (1, 2, 2)),
        ("abcdabcx", None),
        ("ababcdcd", (0, 2, 2)),
    ],
)
def test_the_first_cycle_that_repeats_is_found(row, found):
    assert find_cycles(row) == found


def brute_force(row: str) -> tuple[int, int, int] | None:
    for start in range(len(row)):
        for n in range(2, len(row)):
            parts = [row[k : k + n] for k in range(start, len(row), n)]
            same = [set(p) == set(parts[0]) and len(p) == n for p in parts]
            repeats = same.index(False) if False in same else len(same)
            if len(set(parts[0])) == n and repeats > 1:
                return start, n, repeats
    return None


def test_cycles_are_those_of_an_exhaustive_search(rng):
    for _ in range(500):
        row = "".join(rng.choice(list("abcd"), rng.integers(0, 14)))
        assert find_cycles(row) == brute_force(row), row


def test_a_planted_cycle_is_found_after_what_does_not_repeat(rng):
    for _ in range(100):
        n, repeats = rng.integers(2, 5), rng.integers(2, 6)
        cycle = list("abcd"[:n])
        row = [*"uvwxyz"[: rng.integers(0, 7)]]
        start = len(row)
        for _ in range(repeats):
            row += list(rng.permutation(cycle))
        found = find_cycles(row)
        assert found is not None
        assert found[0] == start
        assert found[1] <= n  # permutations may hold a shorter cycle
        if found[1] == n:
            assert found[2] == repeats


# The demo policy.


def test_the_table_has_an_action_for_each_contact_that_is_made():
    demo = build_demo_policy(crossing())
    made = [a for a in demo.actions if a is not None]
    expected = [*HANDS * 2, *ELBOWS * 2, "LKnee", "RKnee", *CRAWL * 4, *FEET * 3]
    assert made == expected
    assert demo.states[0].surfaces == FEET
    assert set(demo.states[-1].surfaces) == set(FEET)
    regions = [s.region for s in demo.states]
    assert regions[0] == "G"
    assert regions[1] == "M"
    assert regions[-1] == "G"


def test_contacts_that_are_given_up_belong_to_the_next_action_or_are_a_state():
    demo = build_demo_policy(Person().put("LFoot", "ground", 0.3).sequence())
    assert demo.actions == ("LFoot",)
    assert set(demo.states[0].surfaces) == set(FEET)
    person = Person().put("LHand", "table", 0.5).put("RHand", "table", 0.5)
    person.lift("LHand").put("RFoot", "ground", 0.3)  # another limb acts meanwhile
    demo = build_demo_policy(person.sequence())
    assert demo.actions == ("LHand", "RHand", None, "RFoot")
    assert set(demo.states[3].surfaces) == {*FEET, "RHand"}
    person = Person().put("LHand", "table", 0.5).lift("LHand")
    demo = build_demo_policy(person.sequence())
    assert demo.actions == ("LHand", None)
    assert demo.states[-1].surfaces == FEET  # the goal


@pytest.mark.parametrize(
    ("made", "slid", "action"),
    [
        ({"LHand": 0.5, "RHand": 0.5}, {"LHand": 0.58, "RHand": 0.7}, "RHand"),
        ({"LHand": 0.7, "LElbow": 0.5}, {"LHand": 0.91, "LElbow": 0.7}, "LElbow"),
    ],
)
def test_of_contacts_that_stay_the_one_that_bears_and_moved_furthest_acts(
    made, slid, action
):
    person = Person()
    for s, x in made.items():
        person.put(s, "table", x)
    for s, x in slid.items():
        person.down[s] = person.contact(s, "table", x)
    person.see()
    assert build_demo_policy(person.sequence()).actions == (*made, action)


def test_states_that_repeat_are_merged():
    person = Person().put("LHand", "table", 0.5)
    before = len(build_demo_policy(person.sequence()).actions)
    person.put("LHand", "table", 0.51)  # off, and on again where it was
    person.see()
    assert len(build_demo_policy(person.sequence()).actions) == before
    person.put("LHand", "table", 0.6)
    assert len(build_demo_policy(person.sequence()).actions) == before + 1


def test_surfaces_that_touch_at_once_act_one_after_the_other():
    person = Person()
    for s in HANDS:
        person.down[s] = person.contact(s, "table", 0.5)
    person.see()
    demo = build_demo_policy(person.sequence())
    assert demo.actions == HANDS
    assert demo.states[1].surfaces == (*FEET, "LHand")


def test_a_robots_own_plan_teaches_nothing():
    with pytest.raises(InputError, match="subject"):
        build_demo_policy(replace(crossing(), subject=None))


def test_a_hand_rules_only_where_its_elbow_does_not_bear():
    """Landing before its elbow, after it, and taking over from it."""
    before = Person().put("LHand", "table", 0.6).put("LElbow", "table", 0.5)
    before.lift("LElbow", "LHand")
    before.put("LHand", "table", 0.8).put("LElbow", "table", 0.7)
    after = Person().put("LElbow", "table", 0.5).put("LHand", "table", 0.7)
    after.put("RHand", "table", 0.7)
    instead = Person().put("LElbow", "table", 0.5).put("RElbow", "table", 0.5)
    for s in HANDS:
        instead.put(s, "table", 0.5, leaves=s[0] + "Elbow")
    for person, ruling in (
        (before, [0, 1, 3]),
        (after, [0, 2]),
        (instead, [0, 1, 2, 3]),
    ):
        assert dominant_actions(build_demo_policy(person.sequence())) == ruling


# The general policy of one demonstration.

WHOLE = [
    ("M", "LHand RHand"),
    ("M", "LElbow RElbow"),
    ("O", "LElbow LKnee RElbow RKnee"),
    ("goal", "LFoot RFoot"),
]


def test_the_cycles_are_found_with_their_regions():
    policy = learn_policy([crossing()])
    assert keys(policy) == WHOLE
    assert [o.name for o in policy.options] == ["ac1", "ac2", "ac3", "ac4"]
    assert [o.termination for o in policy.options] == ["M", "O", "goal", "goal"]
    assert [o.initiation for o in policy.options] == [("G",), ("M",), ("O",), ("G",)]
    assert policy.options[2].surfaces == CRAWL
    assert set(policy.options[0].held) == set(FEET)
    assert set(policy.options[2].held) == {*HANDS, *CRAWL}
    assert policy.goal == FEET


@pytest.mark.parametrize("counts", [(2, 2, 2, 2), (3, 2, 9, 4), (5, 4, 3, 3)], ids=str)
def test_repeats_are_counted(counts):
    hands, elbows, cycles, feet = counts
    policy = learn_policy([crossing(hands, elbows, cycles, feet)])
    assert keys(policy) == WHOLE
    # feet set down on the ground while arms are on the table are none of the goal's
    assert [o.repeats for o in policy.options] == [hands, elbows, cycles, feet]


def test_what_is_done_once_is_no_cycle():
    policy = learn_policy([crossing(hands=1, elbows=2)])
    assert keys(policy) == WHOLE[1:]
    assert keys(learn_policy([crossing(feet=1)])) == WHOLE[:3]


def test_the_other_side_first_is_the_same_policy_with_sides_changed():
    a, b = learn_policy([crossing()]), learn_policy([crossing(swap=True)])
    assert keys(a) == keys(b)
    for x, y in zip(a.options, b.options, strict=True):
        assert y.surfaces == tuple(
            {"L": "R", "R": "L"}[s[0]] + s[1:] for s in x.surfaces
        )


@pytest.mark.parametrize("seed", range(8))
def test_noise_and_hesitation_change_no_cycle(seed):
    policy = learn_policy([crossing(noise=np.random.default_rng(seed))])
    assert keys(policy) == WHOLE
    assert policy.options[2].repeats == 4


def test_a_cycle_that_is_interrupted_goes_on():
    person = Person()
    for x in (0.5, 0.6, 0.7, 0.8):
        for s in HANDS:
            person.put(s, "table", x)
        if x == 0.6:
            person.put("LHand", "table", 0.65)
    policy = learn_policy([person.sequence()])
    assert keys(policy) == WHOLE[:1]
    assert policy.options[0].repeats == 4


def test_a_walk_on_the_ground_alone_is_no_goal():
    person = Person()
    for x in (0.3, 0.6, 0.9):
        for s in FEET:
            person.put(s, "ground", x)
    assert keys(learn_policy([person.sequence()])) == [("G", "LFoot RFoot")]


def test_reach_is_the_longest_step_in_limb_lengths():
    policy = learn_policy([crossing()])
    arm, leg = 0.55, 0.85
    assert policy.reach["LHand"] == pytest.approx(0.12 / arm)
    assert policy.reach["RElbow"] == pytest.approx(0.18 / arm)  # 0.62 to 0.80
    assert policy.reach["LKnee"] == pytest.approx(0.30 / leg)  # 0.5 to 0.8
    assert policy.reach["LFoot"] == pytest.approx(0.20 / leg)  # not across the table
    assert set(policy.reach) == {*HANDS, *CRAWL, *FEET}


def test_without_a_repeated_cycle_there_is_no_policy():
    with pytest.raises(InputError) as e:
        learn_policy([crossing(1, 1, 1, 1)])
    assert "by hand" in str(e.value)
    assert "no repeated cycle" in str(e.value)
    with pytest.raises(InputError, match="at least one"):
        learn_policy([])


# Several demonstrations.


def test_pooling_a_demonstration_with_itself_changes_nothing():
    demo = build_demo_policy(crossing())
    one, two = contract_policies([demo]), contract_policies([demo, demo])
    assert one.options == two.options
    assert two.notes == one.notes
    assert two.secondary == ()
    assert len(two.demos) == 2


def test_several_are_pooled_and_their_disagreements_said():
    sides = [crossing(), crossing(), crossing(swap=True)]
    policy = learn_policy(sides)
    assert keys(policy) == WHOLE
    assert policy.options[0].surfaces == HANDS
    assert any("ac1" in n and "2 of 3" in n for n in policy.notes)
    assert policy.secondary == ()
    assert len(policy.notes) == len(set(policy.notes))


def test_one_that_leaves_a_cycle_out_still_fits():
    policy = learn_policy([crossing(hands=1), crossing(), crossing()])
    assert keys(policy) == WHOLE
    assert policy.secondary == ()
    assert any("does not show LHand, RHand in M" in n for n in policy.notes)


def test_the_median_of_repeats_counts():
    several = [crossing(cycles=n) for n in (2, 3, 9)]
    assert learn_policy(several).options[2].repeats == 3


def test_one_that_does_not_fit_is_a_secondary_policy():
    other = Person()
    for x in (0.5, 0.6, 0.7):
        for s in ("LKnee", "RKnee"):
            other.put(s, "table", x, leaves=s[0] + "Foot")
    for order in ([0, 1, 2], [2, 1, 0]):
        several = [crossing(), other.sequence("knees only"), crossing(cycles=6)]
        policy = learn_policy([several[k] for k in order])
        assert keys(policy) == WHOLE
        assert len(policy.demos) == 2
        assert len(policy.secondary) == 1
        assert keys(policy.secondary[0]) == [("O", "LKnee RKnee")]
        assert policy.secondary[0].sources == ("knees only",)


def test_one_without_a_cycle_is_named_among_others():
    lazy = replace(crossing(1, 1, 1, 1), source="lazy.c3d")
    with pytest.raises(InputError, match=r"lazy\.c3d"):
        learn_policy([crossing(), lazy])


# How the pelvis is held.


def test_a_normal_distribution_is_recovered(rng):
    mean, sigma = np.array([0.1, 1.4, -2.0]), np.array([0.05, 0.3, 0.2])
    d = fit_distribution(mean + sigma * rng.standard_normal((4000, 3)))
    np.testing.assert_allclose(d.mean, mean, atol=0.02)
    np.testing.assert_allclose(d.sigma, sigma, rtol=0.05)
    assert d.samples == 4000


def test_angles_across_pi_are_near_each_other(rng):
    angles = wrap(math.pi + 0.1 * rng.standard_normal((2000, 3)))
    d = fit_distribution(angles)
    assert np.all(np.abs(wrap(d.mean - math.pi)) < 0.02)
    np.testing.assert_allclose(d.sigma, 0.1, rtol=0.1)


def test_few_samples_impose_nothing():
    for n in (0, 1):
        d = fit_distribution(np.zeros((n, 3)))
        assert d.imposed == (None, None, None)
        assert d.samples == n
    two = fit_distribution(np.array([[0.0, 0.1, 0.2], [0.0, 0.3, 0.2]]))
    np.testing.assert_allclose(two.mean, [0.0, 0.2, 0.2])
    np.testing.assert_allclose(two.sigma, [0.0, math.sqrt(0.02), 0.0], atol=1e-12)


def _held(x: float, angles: tuple[float, float, float]) -> np.ndarray:
    R = pelvis_rotation(np.array(angles))
    return np.array([x, 0.0, 1.0, *quat_from_matrix(R)])


def posed() -> ContactSequence:
    """Hands four times; the pelvis goes over the table, and turns half around."""
    person = Person()
    yaws = [0.0, 0.1, 0.5, 2.0, math.pi, math.pi + 0.1]
    places = [0.1, 0.3, 0.6, 1.4, 2.2, 2.6]  # the table is from 0.4 to 2.4
    person.stances[0] = replace(person.stances[0], pelvis=_held(-0.5, (0, 0.2, 0)))
    for k, (x, yaw) in enumerate(zip(places, yaws, strict=True)):
        person.put(HANDS[k % 2], "table", 0.5 + 0.1 * k, lifts=False)
        pelvis = _held(x, (0.0, 1.6, yaw))
        person.stances[-1] = replace(person.stances[-1], pelvis=pelvis)
    person.put("LFoot", "ground", 3.0, lifts=False)
    person.stances[-1] = replace(person.stances[-1], pelvis=_held(3.0, (0, 0, math.pi)))
    return person.sequence()


def test_samples_are_of_the_edge_that_is_climbed_and_of_the_top():
    top, edge = pelvis_samples(build_demo_policy(posed()))
    # over the top: x in [0.4, 2.4]; near an edge: within a thigh, 0.4 m, of its line
    np.testing.assert_allclose(
        top[:, 2], wrap(np.array([0.5, 2.0, math.pi])), atol=1e-9
    )
    np.testing.assert_allclose(top[:, 1], 1.6)
    # before and behind the near edge, then the far one, against which 0 faces the table
    np.testing.assert_allclose(edge[:, 2], [0.0, 0.1, 0.5, 0.0, 0.1], atol=1e-9)


def test_the_distributions_do_not_depend_on_where_the_world_lies():
    yaw, shift = 1.1, np.array([2.0, -3.0, 0.0])
    R = matrix_from_rpy([0, 0, yaw])
    a = posed()
    box = a.scene.boxes[0]
    there = replace(box, centre=R @ box.centre + shift, rotation=R @ box.rotation)

    def moved(stance: Stance) -> Stance:
        assert stance.pelvis is not None
        w = quat_from_matrix(R @ pelvis_rotation_of(stance.pelvis))
        contacts = tuple(
            replace(c, position=R @ c.position + shift) for c in stance.contacts
        )
        position = R @ stance.pelvis[:3] + shift
        return replace(stance, contacts=contacts, pelvis=np.concatenate([position, w]))

    b = replace(
        a,
        scene=replace(a.scene, boxes=(there,), start=np.array([2.0, -3.0, yaw])),
        stances=tuple(moved(s) for s in a.stances),
    )
    for x, y in zip(
        pelvis_samples(build_demo_policy(a)),
        pelvis_samples(build_demo_policy(b)),
        strict=True,
    ):
        np.testing.assert_allclose(wrap(x - y), 0.0, atol=1e-9)


def pelvis_rotation_of(pelvis: np.ndarray) -> np.ndarray:
    return matrix_from_quat(pelvis[3:])


def test_a_sequence_without_a_pelvis_is_said_to_lack_it():
    policy = learn_policy([crossing()])
    assert policy.over_top.samples == policy.near_edge.samples == 0
    assert any("pelvis" in n for n in policy.notes)
    assert learn_policy([posed()]).notes == ()


# The built-in demonstration.


@cache
def detected(seed: int, **options) -> ContactSequence:
    o = CrossingOptions(**options)
    return detect_contacts(
        synthesize_crossing(np.random.default_rng(seed), options=o)[0]
    )


CROSSING = [*WHOLE[:3], WHOLE[1], WHOLE[0], WHOLE[3]]


@pytest.fixture(scope="module")
def built_in() -> ContactSequence:
    return detect_contacts(load_demo("crossing"))


def test_the_crossing_teaches_its_cycles(built_in):
    policy = learn_policy([built_in])
    assert keys(policy) == CROSSING
    names = [o.name for o in policy.options]
    assert names == ["ac1", "ac2", "ac3", "ac2", "ac1", "ac4"]
    assert policy.options[2].surfaces == CRAWL
    assert policy.goal == FEET
    assert policy.notes == ()


def test_the_crossing_teaches_how_the_pelvis_is_held(built_in):
    policy = learn_policy([built_in])
    top, edge = policy.over_top, policy.near_edge
    assert top.imposed[2] is None  # it turns around up there
    assert edge.imposed[2] is not None  # and faces the table at both ends
    assert abs(edge.mean[2]) < 0.1
    assert math.radians(80) < top.mean[1] < math.radians(120)  # on all fours
    assert edge.sigma[1] > top.sigma[1]  # upright before the table, on all fours on it
    assert top.imposed[0] is not None
    assert abs(top.mean[0]) < 0.05


def test_a_sequence_from_the_disk_teaches_the_same(built_in, tmp_path):
    save_sequence(built_in, tmp_path / "sequence.json")
    a, b = learn_policy([built_in]), learn_policy([load_sequence(tmp_path)])
    assert a.options == b.options
    np.testing.assert_array_equal(a.near_edge.mean, b.near_edge.mean)
    np.testing.assert_array_equal(a.over_top.sigma, b.over_top.sigma)
    assert dict(a.reach) == dict(b.reach)


def test_the_climb_has_no_cycle():
    with pytest.raises(InputError, match="no repeated cycle"):
        learn_policy([detect_contacts(load_demo("climb"))])


@pytest.mark.slow
@pytest.mark.parametrize(
    "options",
    [
        {"noise": 0.005},
        {"mirrored": True},
        {"length": 2.3, "height": 0.62},
        {"length": 1.5, "height": 0.5, "width": 1.2},
        {"sets": 3, "speed": 1.4, "gaps": 40},
        {"rate": 60.0, "speed": 0.8},
    ],
    ids=str,
)
def test_other_crossings_teach_the_same_cycles(options):
    policy = learn_policy([detected(7, **options)])
    assert keys(policy) == CROSSING
    assert policy.options[0].repeats == options.get("sets", 2)
    assert policy.near_edge.imposed[2] is not None
    assert policy.over_top.imposed[2] is None


@pytest.mark.slow
def test_crossings_of_several_tables_are_pooled(built_in):
    several = [
        built_in,
        detected(7, length=2.3, height=0.62),
        detected(7, mirrored=True),
    ]
    policy = learn_policy(several)
    assert keys(policy) == CROSSING
    assert policy.secondary == ()
    assert policy.over_top.samples > 2 * learn_policy([built_in]).over_top.samples
    assert any("2 of 3" in n for n in policy.notes)
