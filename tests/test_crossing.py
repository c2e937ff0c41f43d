"""The crossing is what it says it is, and its contacts are found again."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from itertools import pairwise

import numpy as np
import pytest

from clamber.contact.contact import ContactInterval, ContactSequence
from clamber.model.se3 import matrix_from_quat
from clamber.recording.demonstration import Demonstration
from clamber.recording.detect import detect_contacts
from clamber.recording.recording import load_demo
from support.crossing import CrossingOptions, synthesize_crossing

SEGMENTS = {
    "thigh": ("Hip", "Knee", 0.373),
    "shank": ("Knee", "Foot", 0.453),
    "upper_arm": ("Shoulder", "Elbow", 0.311),
    "forearm": ("Elbow", "Hand", 0.254),
}
LIMBS = [(s + a, s + b) for s in "LR" for a, b, _ in SEGMENTS.values()]
FEET = [(s + "Foot", s + "Foot.toe") for s in "LR"]
KINDS: list[dict] = [{}, {"length": 2.3, "height": 0.5}, {"width": 1.2, "sets": 3}]
each_kind = pytest.mark.parametrize("options", KINDS, ids=str)


@cache
def _clean(options: tuple) -> tuple[Demonstration, list[ContactInterval]]:
    o = CrossingOptions(noise=0.0, gaps=0, rate=60.0, **dict(options))
    return synthesize_crossing(np.random.default_rng(3), options=o)


def clean(options: dict) -> tuple[Demonstration, list[ContactInterval]]:
    return _clean(tuple(options.items()))


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


@each_kind
def test_limbs_never_change_length(options):
    demo, _ = clean(options)
    for a, b, length in SEGMENTS.values():
        for s in "LR":
            d = np.linalg.norm(demo.point(s + a) - demo.point(s + b), axis=1)
            np.testing.assert_allclose(d, length, atol=1e-6)
    for left, right in (("LHip", "RHip"), ("LShoulder", "RShoulder")):
        d = np.linalg.norm(demo.point(left) - demo.point(right), axis=1)
        assert np.ptp(d) < 1e-9
    shoulders = (demo.point("LShoulder") + demo.point("RShoulder")) / 2
    trunk = np.linalg.norm(shoulders - demo.point("Pelvis"), axis=1)
    assert 0.41 < trunk.min() <= trunk.max() < 0.56  # a rounded back is shorter


@each_kind
def test_what_truly_touches_is_perfectly_still(options):
    demo, truth = clean(options)
    for i in truth:
        held = (demo.t >= i.t0 + 1e-9) & (demo.t <= i.t1 - 1e-9)
        point = "Foot.toe" if i.part.endswith("Foot") else i.part[1:]
        p = demo.point(i.part[0] + point)[held]
        assert np.ptp(p, axis=0).max() < 1e-6, (i.part, i.t0)
        height = demo.scene.support(i.contact.support).height(p)
        assert np.all((height > 0.0) & (height < 0.12))


@each_kind
def test_nothing_goes_through_the_table_or_the_ground(options):
    demo, _ = clean(options)
    box = demo.scene.boxes[0]
    for a, b in [*LIMBS, *FEET, ("Pelvis", "Neck")]:
        for share in np.linspace(0.0, 1.0, 9):
            p = (1 - share) * demo.point(a) + share * demo.point(b)
            depth = np.min(box.size / 2 - np.abs(p - box.position), axis=1)
            assert depth.max() < -0.01, (a, b, demo.t[np.argmax(depth)])
            assert p[:, 2].min() > 0.03


@each_kind
def test_fingers_that_touch_are_over_the_table(options):
    demo, truth = clean(options)
    for i in truth:
        if i.part.endswith("Hand"):
            held = (demo.t > i.t0) & (demo.t < i.t1)
            tip = demo.point(i.part + ".tip")[held]
            assert np.all(demo.scene.support("table").inside(tip, 0.0))


@each_kind
def test_knees_bend_the_way_they_do(options):
    demo, _ = clean(options)
    left = demo.point("LHip") - demo.point("RHip")
    for s in "LR":
        hip, knee, ankle = (demo.point(s + n) for n in ("Hip", "Knee", "Foot"))
        bend = np.sum(np.cross(knee - hip, ankle - knee) * left, axis=1)
        assert bend.min() > -2e-3, demo.t[np.argmin(bend)]


@each_kind
def test_the_motion_is_continuous(options):
    demo, _ = clean(options)
    steps = np.linalg.norm(np.diff(demo.position, axis=0), axis=2)
    assert steps.max() * demo.rate < 3.0  # [m/s]


@each_kind
def test_the_person_turns_midway_and_stands_behind_the_table_in_the_end(options):
    demo, _ = clean(options)
    box, pelvis = demo.scene.boxes[0], demo.point("Pelvis")
    left = demo.point("LHip") - demo.point("RHip")
    faces = np.unwrap(np.arctan2(-left[:, 0], left[:, 1]))
    assert faces[0] == pytest.approx(0.0, abs=0.05)
    assert faces[-1] == pytest.approx(np.pi, abs=0.05)
    quarter = pelvis[np.argmin(np.abs(faces - np.pi / 2)), 0]
    assert abs(quarter - box.position[0]) < 0.1 * box.size[0]
    assert pelvis[0, 2] == pytest.approx(0.9, abs=0.02)
    assert pelvis[-1, 2] == pytest.approx(0.9, abs=0.02)
    far = box.position[0] + box.size[0] / 2
    assert 0.4 < pelvis[-1, 0] - far < 1.3


@each_kind
def test_hands_and_elbows_are_set_down_as_often_as_asked_for(options):
    _, truth = clean(options)
    sets = options.get("sets", 2)
    made = [i.part for i in sorted(truth, key=lambda i: i.t0) if i.t0 > 0.0]
    assert made[: 2 * sets] == ["LHand", "RHand"] * sets
    elbows = [p for p in made[2 * sets :] if not p.endswith("Hand")]
    assert elbows[: 2 * sets + 2] == ["LElbow", "RElbow"] * sets + ["LKnee", "RKnee"]
    assert made[-2 * sets :] == ["LFoot", "RFoot"] * sets
    crawl = elbows[2 * sets + 2 : elbows.index("LFoot")]
    cycle = ["LElbow", "RElbow", "LKnee", "RKnee"]
    assert len(crawl) >= 24
    assert crawl == cycle * (len(crawl) // 4)


def test_a_longer_table_takes_more_cycles():
    def knees(length: float) -> int:
        _, truth = clean({"length": length})
        return sum(i.part == "LKnee" for i in truth)

    assert knees(1.5) < knees(1.7) < knees(2.3)


def test_a_mirrored_crossing_is_the_mirror_image():
    (a, first), (b, second) = clean({}), clean({"mirrored": True})
    for name in a.names:
        if name[0] in "LR":
            other = {"L": "R", "R": "L"}[name[0]] + name[1:]
            image = b.point(other) * [1.0, -1.0, 1.0]
            np.testing.assert_allclose(a.point(name), image, atol=1e-12)
    assert [i.t0 for i in first] == [i.t0 for i in second]
    assert first[0].part[1:] == second[0].part[1:]


def test_the_built_in_crossing_is_always_the_same():
    a = load_demo("crossing")
    b, truth = synthesize_crossing(np.random.default_rng(20))
    np.testing.assert_allclose(a.position, b.position, atol=1e-16)
    assert a.synthetic
    assert "synthetic" in a.source
    np.testing.assert_allclose(a.scene.boxes[0].size, [1.7, 0.9, 0.6])
    pairs = match(detect_contacts(a), truth)
    for found, true in pairs:
        assert found.contact.support == true.contact.support
        assert abs(found.t0 - true.t0) < 0.05
        assert abs(found.t1 - true.t1) < 0.15  # a set of elbows slides a little first
        np.testing.assert_allclose(
            found.contact.position, true.contact.position, atol=5e-3
        )


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
    demo, _ = clean({})
    sequence = detect_contacts(demo)
    for stance, (a, b) in zip(sequence.stances, pairwise(sequence.t), strict=True):
        k = int(np.argmin(np.abs(demo.t - (a + b) / 2)))
        assert stance.pelvis is not None
        shift = stance.pelvis[:3] - demo.point("Pelvis")[k]
        assert np.linalg.norm(shift) < 0.06
        R = matrix_from_quat(stance.pelvis[3:])
        left = demo.point("LHip")[k] - demo.point("RHip")[k]
        assert R[:, 1] @ left / np.linalg.norm(left) > np.cos(0.2)


def test_a_part_that_rests_elsewhere_has_made_another_contact():
    demo, truth = clean({})
    times = [i.t1 for i in truth if i.part == "LElbow"]
    moved = demo.position.copy()
    # From one second after it was set down, the left hand and elbow lie 4 cm away.
    start = int(np.searchsorted(demo.t, times[0] - 1.0))
    end = int(np.searchsorted(demo.t, times[0]))
    columns = [k for k, n in enumerate(demo.names) if n in ("LElbow", "LHand")]
    assert end - start > 30
    slide = np.clip(np.arange(len(demo.t)) - start, 0, 15) / 15.0

    def elbows(distance: float) -> int:
        p = moved.copy()
        for k, n in enumerate(demo.names):
            if n.startswith("LHand") or k in columns:
                p[start:end, k, 0] += distance * slide[start:end]
        found = detect_contacts(replace(demo, position=p)).intervals
        return sum(i.part == "LElbow" for i in found)

    assert elbows(0.04) == elbows(0.0)
    assert elbows(0.12) == elbows(0.0) + 1
