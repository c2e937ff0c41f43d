"""Synthetic demonstrations: sound as motions, shipped as made, their contacts found.

The figure of `support` is the oracle that detection is held against; what is true of a
person must be true of it.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from itertools import pairwise

import numpy as np
import pytest

from clamber.contact.contact import ContactInterval, ContactSequence
from clamber.model.se3 import matrix_from_quat
from clamber.recording.built_in import BUILT_IN
from clamber.recording.demonstration import Demonstration
from clamber.recording.detect import detect_contacts
from clamber.recording.recording import load_demo
from support.built_in import MADE, SEED
from support.climb import ClimbOptions, synthesize_climb
from support.crossing import CrossingOptions, synthesize_crossing
from support.figure import FOREARM, SHANK, THIGH, UPPER_ARM

pytestmark = pytest.mark.whole

SEGMENTS = {
    ("Hip", "Knee"): THIGH, ("Knee", "Foot"): SHANK,
    ("Shoulder", "Elbow"): UPPER_ARM, ("Elbow", "Hand"): FOREARM,
}  # fmt: skip
MOTIONS = {
    "climb": ClimbOptions(noise=0.0, gaps=0),
    "low climb": ClimbOptions(noise=0.0, gaps=0, height_ratio=0.57),
    "high climb": ClimbOptions(noise=0.0, gaps=0, height_ratio=1.12),
    "mirrored climb": ClimbOptions(noise=0.0, gaps=0, mirrored=True),
    "crossing": CrossingOptions(noise=0.0, gaps=0, rate=60.0),
    "long crossing": CrossingOptions(
        noise=0.0, gaps=0, rate=60.0, length=2.3, height=0.5, sets=3, mirrored=True
    ),
}
each = pytest.mark.parametrize("name", MOTIONS)
each_crossing = pytest.mark.parametrize("name", ["crossing", "long crossing"])


@cache
def clean(name: str) -> tuple[Demonstration, list[ContactInterval]]:
    options, rng = MOTIONS[name], np.random.default_rng(3)
    if isinstance(options, ClimbOptions):
        return synthesize_climb(rng, options=options)
    return synthesize_crossing(rng, options=options)


@each
def test_limbs_never_change_length(name):
    demo, _ = clean(name)
    for (a, b), length in SEGMENTS.items():
        for s in "LR":
            d = np.linalg.norm(demo.point(s + a) - demo.point(s + b), axis=1)
            np.testing.assert_allclose(d, length, atol=1e-6)
    shoulders = (demo.point("LShoulder") + demo.point("RShoulder")) / 2
    trunk = np.linalg.norm(shoulders - demo.point("Pelvis"), axis=1)
    assert 0.40 < trunk.min() <= trunk.max() < 0.56  # a rounded back is shorter


@each
def test_what_truly_touches_is_perfectly_still_and_its_fingers_over_the_box(name):
    demo, truth = clean(name)
    for i in truth:
        held = (demo.t >= i.t0 + 1e-9) & (demo.t <= i.t1 - 1e-9)
        support = demo.scene.support(i.contact.support)
        p = demo.point(i.part + ".toe" * i.part.endswith("Foot"))[held]
        assert np.ptp(p, axis=0).max() < 1e-6, (i.part, i.t0)
        assert np.all((support.height(p) > 0.0) & (support.height(p) < 0.12))
        if i.part.endswith("Hand"):
            assert support.inside(demo.point(i.part + ".tip")[held]).all()


@each
def test_nothing_goes_through_the_box_or_the_ground(name):
    demo, _ = clean(name)
    box = demo.scene.boxes[0]
    bones = [(s + a, s + b) for s in "LR" for a, b in SEGMENTS]
    bones += [(s + "Foot", s + "Foot.toe") for s in "LR"] + [("Pelvis", "Neck")]
    for a, b in bones:
        for share in np.linspace(0.0, 1.0, 9):
            p = (1 - share) * demo.point(a) + share * demo.point(b)
            depth = np.min(box.size / 2 - np.abs(p - box.centre), axis=1)
            assert depth.max() < -0.01, (a, b, demo.t[np.argmax(depth)])
            assert p[:, 2].min() > 0.03


@each
def test_knees_bend_the_way_they_do_and_nothing_jumps(name):
    demo, _ = clean(name)
    left = demo.point("LHip") - demo.point("RHip")
    for s in "LR":
        hip, knee, ankle = (demo.point(s + n) for n in ("Hip", "Knee", "Foot"))
        bend = np.sum(np.cross(knee - hip, ankle - knee) * left, axis=1)
        assert bend.min() > -2e-3, demo.t[np.argmin(bend)]
    steps = np.linalg.norm(np.diff(demo.position, axis=0), axis=2)
    assert steps.max() * demo.rate < 3.0  # [m/s]


def test_the_climb_makes_its_contacts_in_order_and_in_the_mirror():
    demo, truth = clean("climb")
    made = [i.part for i in truth if i.contact.support == "table"]
    assert made == ["LHand", "RHand", "LElbow", "RElbow", "LKnee", "RKnee"]
    off = {i.part: i.t1 for i in truth if i.contact.support == "ground"}
    on = {i.part: i.t0 for i in truth}
    assert on["RElbow"] < off["LFoot"] < on["LKnee"] < off["RFoot"] < on["RKnee"]
    mirrored, other = clean("mirrored climb")
    assert next(i.part for i in other if i.contact.support == "table") == "RHand"
    for a, b in (("LHand", "RHand"), ("RFoot.toe", "LFoot.toe")):
        image = mirrored.point(b) * [1.0, -1.0, 1.0]
        np.testing.assert_allclose(demo.point(a), image, atol=1e-12)


@each_crossing
def test_the_person_turns_midway_and_stands_behind_the_table_in_the_end(name):
    demo, _ = clean(name)
    box, pelvis = demo.scene.boxes[0], demo.point("Pelvis")
    left = demo.point("LHip") - demo.point("RHip")
    faces = np.abs(np.unwrap(np.arctan2(-left[:, 0], left[:, 1])))
    assert faces[[0, -1]] == pytest.approx([0.0, np.pi], abs=0.05)
    quarter = pelvis[np.argmin(np.abs(faces - np.pi / 2)), 0]
    assert abs(quarter - box.centre[0]) < 0.1 * box.size[0]
    assert pelvis[[0, -1], 2] == pytest.approx(0.9, abs=0.02)
    assert 0.4 < pelvis[-1, 0] - box.centre[0] - box.size[0] / 2 < 1.3


@each_crossing
def test_hands_and_elbows_are_set_down_as_often_as_asked_for(name):
    _, truth = clean(name)
    options = MOTIONS[name]
    assert isinstance(options, CrossingOptions)
    n, order = options.sets, "RL" if options.mirrored else "LR"
    made = [i.part for i in sorted(truth, key=lambda i: i.t0) if i.t0 > 0.0]
    assert made[: 2 * n] == [s + "Hand" for s in order] * n
    made = [p for p in made[2 * n :] if not p.endswith("Hand")]
    elbows, knees, feet = ([s + p for s in order] for p in ("Elbow", "Knee", "Foot"))
    assert made[: 2 * n + 2] == elbows * n + knees
    crawl = made[2 * n + 2 : made.index(feet[0])]
    assert crawl == (elbows + knees) * (len(crawl) // 4)
    assert len(crawl) >= 24
    assert made[-2 * n :] == feet * n


def test_noise_is_as_large_as_asked_for():
    quiet, loud = (
        synthesize_climb(
            np.random.default_rng(3), options=ClimbOptions(noise=x, gaps=0)
        )
        for x in (0.0, 0.005)
    )
    spread = np.std(loud[0].position - quiet[0].position)
    assert spread == pytest.approx(0.005, rel=0.02)


# The shipped ones.


def match(
    sequence: ContactSequence, truth: list[ContactInterval]
) -> list[tuple[ContactInterval, ContactInterval]]:
    """(found, true) pairs; fails unless each contact is found once and no other."""
    left, pairs = list(sequence.intervals), []
    for true in truth:
        overlap = [
            min(x.t1, true.t1) - max(x.t0, true.t0) if x.part == true.part else -1.0
            for x in left
        ]
        k = int(np.argmax(overlap))
        assert overlap[k] > 0.5 * (true.t1 - true.t0), f"missed {true.part} {true.t0}"
        pairs.append((left.pop(k), true))
    assert not left, f"invented {[(x.part, x.t0) for x in left]}"
    return pairs


@pytest.mark.parametrize("name", BUILT_IN)
def test_the_shipped_demonstrations_are_what_their_generators_make(name):
    synthesize, _, options = MADE[name]
    made, truth = synthesize(np.random.default_rng(SEED), options=options)
    shipped = load_demo(name)
    np.testing.assert_allclose(shipped.position, made.position, atol=1e-9)
    np.testing.assert_array_equal(shipped.t, made.t)
    assert (shipped.names, shipped.gaps) == (made.names, made.gaps)
    for a, b in zip(shipped.scene.boxes, made.scene.boxes, strict=True):
        np.testing.assert_array_equal([a.size, a.centre], [b.size, b.centre])
    assert shipped.synthetic
    assert shipped.source == made.source
    assert "synthetic" in shipped.source
    for found, true in match(detect_contacts(shipped), truth):
        assert found.contact.support == true.contact.support
        assert abs(found.t0 - true.t0) < 0.05
        assert abs(found.t1 - true.t1) < 0.15  # a set of elbows slides a little first
        place = true.contact.position
        np.testing.assert_allclose(found.contact.position, place, atol=5e-3)


@pytest.mark.slow
@pytest.mark.parametrize(
    "options",
    [
        {"noise": 0.005},
        {"mirrored": True, "gaps": 40},
        {"length": 2.3, "height": 0.62},
        {"length": 1.5, "height": 0.5, "width": 1.2},
        {"sets": 3, "speed": 1.4},
        {"rate": 60.0, "speed": 0.8},
    ],
    ids=str,
)
def test_detection_finds_every_contact_of_other_crossings(options):
    demo, truth = synthesize_crossing(
        np.random.default_rng(5), options=CrossingOptions(**options)
    )
    for found, true in match(detect_contacts(demo), truth):
        assert found.contact.support == true.contact.support
        assert abs(found.t0 - true.t0) < 0.05
        assert abs(found.t1 - true.t1) < 0.25


def test_detection_tells_how_the_pelvis_is_held():
    demo, _ = clean("crossing")
    sequence = detect_contacts(demo)
    for stance, (a, b) in zip(sequence.stances, pairwise(sequence.t), strict=True):
        k = int(np.argmin(np.abs(demo.t - (a + b) / 2)))
        assert stance.pelvis is not None
        shift = stance.pelvis[:3] - demo.point("Pelvis")[k]
        assert np.linalg.norm(shift) < 0.06
        R = matrix_from_quat(stance.pelvis[3:])
        left = demo.point("LHip")[k] - demo.point("RHip")[k]
        assert R[:, 1] @ left / np.linalg.norm(left) > np.cos(0.2)


@pytest.mark.parametrize(("distance", "more"), [(0.04, 0), (0.12, 1)])
def test_a_part_that_rests_elsewhere_has_made_another_contact(distance, more):
    """From a second before it lifts off, left hand and elbow lie elsewhere."""
    demo, truth = clean("crossing")
    rests = [i for i in truth if i.part == "LElbow"]
    lifts = rests[0].t1
    start, end = np.searchsorted(demo.t, [lifts - 1.0, lifts])
    p = demo.position.copy()
    slide = distance * np.clip(np.arange(end - start) / 15.0, 0.0, 1.0)
    for k, n in enumerate(demo.names):
        if n.startswith(("LHand", "LElbow")):
            p[start:end, k, 0] += slide

    found = detect_contacts(replace(demo, position=p)).intervals
    assert sum(i.part == "LElbow" for i in found) == len(rests) + more
